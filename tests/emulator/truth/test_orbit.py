"""Orbits: two-body motion, J2, TLE, interpolation, and how they are configured."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from sgp4.api import accelerated

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.config import OrbitConfig
from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.orbit import (
    EARTH_GM_M3_S2,
    KeplerOrbit,
    OrbitState,
    TleOrbit,
    interpolate_orbit,
)
from starhil.emulator.truth.source import FixedTruth, TruthState
from starid.arithmetic.matrices import length
from starid.attitude import Attitude
from starid.catalog.earth import unix_time

pytestmark = pytest.mark.lowest("sgp4")

NEW_YEAR = 1_767_225_600.0
VANGUARD = (  # Vallado et al. 2006, AIAA 2006-6753, satellite 5
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753",
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667",
)


def orbit(**changes) -> KeplerOrbit:
    values = {
        "epoch_unix_s": NEW_YEAR,
        "semi_major_axis_m": 7e6,
        "eccentricity": 0.01,
        "inclination_rad": 1.7,
        "raan_rad": 2.0,
        "argument_of_perigee_rad": 0.5,
        "mean_anomaly_rad": 1.0,
        "j2": False,
    }
    return KeplerOrbit(**{**values, **changes})


@pytest.mark.parametrize("eccentricity", [0.0, 0.01, 0.7, 0.97])
def test_two_body_motion_obeys_newton_and_keeps_energy_and_momentum(eccentricity):
    path = orbit(semi_major_axis_m=4e8, eccentricity=eccentricity)
    period = 2.0 * math.pi * math.sqrt(path.semi_major_axis_m**3 / EARTH_GM_M3_S2)
    start = path.state(NEW_YEAR)
    for share in (0.0, 0.02, 0.3, 0.77):
        at = NEW_YEAR + share * period
        state, h = path.state(at), 20.0
        before, after = path.state(at - h), path.state(at + h)
        speed = np.linalg.norm(state.velocity_m_s)
        assert (after.position_m - before.position_m) / (2 * h) == pytest.approx(
            state.velocity_m_s, abs=1e-3 * speed
        )
        pull = -EARTH_GM_M3_S2 * state.position_m / np.linalg.norm(state.position_m) ** 3
        acceleration = (after.velocity_m_s - before.velocity_m_s) / (2 * h)
        assert acceleration == pytest.approx(pull, abs=2e-3 * np.linalg.norm(pull))
        assert np.cross(state.position_m, state.velocity_m_s) == pytest.approx(
            np.cross(start.position_m, start.velocity_m_s), rel=1e-9
        )
    assert path.state(NEW_YEAR + period).position_m == pytest.approx(start.position_m, abs=1.0)


def test_perigee_node_and_inclination_are_where_the_elements_say():
    path = orbit(mean_anomaly_rad=0.0, argument_of_perigee_rad=0.0)
    perigee = path.state(NEW_YEAR)
    assert perigee.position_m == pytest.approx(7e6 * 0.99 * np.array([math.cos(2.0), math.sin(2.0), 0.0]))
    normal = np.cross(perigee.position_m, perigee.velocity_m_s)
    assert math.acos(normal[2] / np.linalg.norm(normal)) == pytest.approx(1.7)
    assert perigee.velocity_m_s[2] > 0.0


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"eccentricity": 0.0},
        {"eccentricity": 0.0, "inclination_rad": 0.0},
        {"inclination_rad": 3.0, "eccentricity": 0.6, "semi_major_axis_m": 2e7},
    ],
)
def test_an_orbit_through_a_state_is_the_orbit_it_came_from(changes):
    path = orbit(**changes)
    again = KeplerOrbit.from_state(NEW_YEAR + 1000.0, path.state(NEW_YEAR + 1000.0), j2=False)
    for t in (0.0, 1000.0, 4000.0):
        assert again.state(NEW_YEAR + t).position_m == pytest.approx(
            path.state(NEW_YEAR + t).position_m, abs=0.1
        )


def test_the_node_of_a_sun_synchronous_orbit_follows_the_sun():
    path = orbit(
        semi_major_axis_m=6_978_137.0, eccentricity=0.0, inclination_rad=math.radians(97.79), j2=True
    )

    def node(t: float) -> float:
        state = path.state(t)
        h = np.cross(state.position_m, state.velocity_m_s)
        return math.atan2(h[0], -h[1])

    drift = math.degrees((node(NEW_YEAR + 10 * 86400.0) - node(NEW_YEAR)) / 10.0)
    assert drift == pytest.approx(360.0 / 365.2422, abs=0.002)


def test_a_tle_agrees_with_the_published_state_in_j2000():
    epoch = unix_time("2000-06-27T18:50:19.733571")
    state = TleOrbit(*VANGUARD).state(epoch + 3 * 86400.0)
    # AIAA 2006-6753, appendix C: the state in J2000 by the IAU-76/80 reduction
    assert state.position_m == pytest.approx(1e3 * np.array([-9059.9413786, 4659.6972, 813.9588875]), abs=5.0)
    assert state.velocity_m_s == pytest.approx(
        1e3 * np.array([-2.233348094, -4.110136162, -3.157394074]), abs=0.005
    )


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (("nonsense", VANGUARD[1]), "TLE"),
        ((VANGUARD[0][:-1] + "4", VANGUARD[1]), "checksum"),
        ((VANGUARD[0], VANGUARD[0]), "TLE"),
    ],
)
def test_a_bad_tle_is_named_in_one_line(lines, said):
    with pytest.raises(EmulatorError, match=said) as caught:
        TleOrbit(*lines)
    assert "\n" not in str(caught.value)


def summed(line):
    """Return the 69 characters of a line of a TLE with its checksum."""
    kept = line[:68].ljust(68)
    return kept + str(sum(int(each) if each.isdecimal() else each == "-" for each in kept) % 10)


@pytest.mark.parametrize(
    ("changed", "old", "new", "message"),
    [
        (
            0,
            "00179.78495062",
            "  00379.784950",
            "day of the epoch must be a number from 1 to 367, not '00379.784950'",
        ),
        (0, "00179.78495062", "00000.78495062", "day of the epoch"),
        (1, " 34.2682", "  1e5000", "inclination must be a number from 0 to 180, not '  1e5000'"),
        (1, "348.7242", "348.724x", "right ascension of the node"),
        (1, "1859667", "18-9667", "eccentricity"),
        (1, "10.82419157", "00.00000000", "mean motion must be a number from 0.01 to 20"),
    ],
)
def test_a_tle_whose_columns_are_shifted_is_rejected_though_its_checksum_is_right(changed, old, new, message):
    """Such orbits were beyond Jupiter, or had no position at all."""
    lines = list(VANGUARD)
    assert old in lines[changed]
    lines[changed] = summed(lines[changed].replace(old, new))
    with pytest.raises(EmulatorError, match=re.escape(message)):
        TleOrbit(*lines)


def test_a_tle_that_leaves_the_earth_has_no_position():
    """A drag term whose columns are shifted had the satellite beyond the stars the next day."""
    first = "1 25544U 98067A   24001.50000000  .00016717     10270-3 0  9009     "
    second = "2 25544  51.6400 208.9163 0006317  69.9862  25.2906 15.49560532    1"
    if not accelerated:  # this sgp4 is strict about columns, and the compiled one is not
        with pytest.raises(EmulatorError, match="TLE format error"):
            TleOrbit(summed(first), summed(second))
        return
    orbit = TleOrbit(summed(first), summed(second))
    start = unix_time("2024-01-01T12:00:00")
    assert length(orbit.state(start).position_m) < 7e6
    for days in (6, 7, 8, 30):
        with pytest.raises(EmulatorError, match="TLE: has no position at the run's date"):
            orbit.state(start + 86400.0 * days)


def test_interpolated_states_lie_on_the_orbit():
    path = orbit()
    before, after, truth = (path.state(NEW_YEAR + t) for t in (0.0, 10.0, 3.0))
    between = interpolate_orbit(before, after, 0.3, 10.0)
    assert between.position_m == pytest.approx(truth.position_m, abs=0.01)
    assert between.velocity_m_s == pytest.approx(truth.velocity_m_s, abs=0.01)


def test_a_truth_file_carries_position_and_velocity(tmp_path):
    path = orbit()
    rows = ["t,qx,qy,qz,qw,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s"]
    for t in (0.0, 10.0, 20.0):
        state = path.state(NEW_YEAR + t)
        numbers = [t, 0, 0, 0, 1, *state.position_m, *state.velocity_m_s]
        rows.append(",".join(repr(float(number)) for number in numbers))
    file = tmp_path / "truth.csv"
    file.write_text("\n".join(rows))
    truth = read_truth_file(file)
    for t in (-1.0, 0.0, 13.0, 20.0, 30.0):
        found = truth.state(t).orbit
        assert found is not None
        assert found.position_m == pytest.approx(
            path.state(NEW_YEAR + min(max(t, 0.0), 20.0)).position_m, abs=0.01
        )
    file.write_text("t,qx,qy,qz,qw,x_m\n0,0,0,0,1,7e6")
    with pytest.raises(EmulatorError, match="column y_m is missing"):
        read_truth_file(file)


def test_a_state_takes_date_and_orbit_of_the_run_unless_its_source_brings_them():
    run = orbit()
    state = FixedTruth(Attitude.identity()).state(5.0)
    completed = state.completed(NEW_YEAR, run)
    assert completed.unix_s == NEW_YEAR
    assert completed.orbit is not None
    assert np.array_equal(completed.orbit.position_m, run.state(NEW_YEAR).position_m)
    own = OrbitState(np.ones(3), np.zeros(3))
    brought = TruthState(state.attitude, state.rate_rad_s, orbit=own, unix_s=7.0).completed(NEW_YEAR, run)
    assert (brought.orbit, brought.unix_s) == (own, 7.0)
    assert state.completed(NEW_YEAR, None).orbit is None


ORBIT = TypeAdapter(OrbitConfig)


def test_orbits_of_a_profile_are_built_from_elements_state_or_tle():
    elements = {"kind": "kepler", "semi_major_axis_km": 7000, "inclination_deg": 98.0, "raan_deg": 10.0}
    kepler = ORBIT.validate_python(elements).build(NEW_YEAR, Path())
    state = kepler.state(NEW_YEAR)
    typed = {
        "kind": "state",
        "position_m": state.position_m.tolist(),
        "velocity_m_s": state.velocity_m_s.tolist(),
        "date": "2026-01-01T00:00:00Z",
    }
    later = NEW_YEAR + 600.0
    same = ORBIT.validate_python(typed).build(0.0, Path()).state(later)
    assert same.position_m == pytest.approx(kepler.state(later).position_m, abs=0.01)
    tle = {"kind": "tle", "line1": VANGUARD[0], "line2": VANGUARD[1]}
    distance = np.linalg.norm(
        ORBIT.validate_python(tle).build(962_131_819.0, Path()).state(962_131_819.0).position_m
    )
    assert 7e6 < distance < 1.1e7


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"kind": "state", "position_m": [7e6, 0, 0], "velocity_m_s": [0, 0, 2e4]}, EmulatorError),
        ({"kind": "state", "position_m": [7e6, 0, 0], "velocity_m_s": [7e3, 0, 0]}, EmulatorError),
        (
            {"kind": "kepler", "semi_major_axis_km": 7000, "inclination_deg": 9.0, "eccentricity": 0.2},
            EmulatorError,
        ),
        (
            {"kind": "kepler", "semi_major_axis_km": 7000, "inclination_deg": 9.0, "date": "soon"},
            ValidationError,
        ),
    ],
)
def test_an_impossible_orbit_is_rejected(values, error):
    with pytest.raises(error):
        ORBIT.validate_python(values).build(NEW_YEAR, Path())


@pytest.mark.parametrize("date", ["2026-01-01", "2026-01-01T01:00:00+01:00", 1_767_225_600])
def test_dates_are_utc_unless_they_say_otherwise(date):
    assert unix_time(date) == NEW_YEAR


@pytest.mark.parametrize("date", ["tomorrow", "1066-10-14", True, None, [2026, 1, 1], float("nan")])
def test_an_invalid_date_is_rejected(date):
    with pytest.raises(ValueError, match="date from 1970 to 2100"):
        unix_time(date)
