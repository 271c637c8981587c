"""Date, orbit and velocity in the requests of the device, and the velocity with which it corrects aberration."""

from __future__ import annotations

import numpy as np
import pytest

from starhil.emulator.device.navigation import known_orbit
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.truth.orbit import KeplerOrbit, OrbitState
from starhil.emulator.truth.table import OrbitTable, Span
from starhil.protocol.icd import FieldError
from starhil.protocol.messages import ErrorCode
from starid.catalog.earth import earth_velocity

NEW_YEAR = 1_767_225_600.0
EQUINOX = 1_774_008_000.0
ELEMENTS = {"semi_major_axis_km": 6900.0, "inclination_deg": 97.5, "raan_deg": 40.0, "mean_anomaly_deg": 10.0}
KNOWN = {
    "orbit_epoch": int(EQUINOX),
    "orbit_semi_major_axis": 6900.0,
    "orbit_inclination": 97.5,
    "orbit_node": 40.0,
    "orbit_mean_anomaly": 10.0,
}


def running(make_bench, **profile):
    bench = make_bench(Profile.model_validate({**profile})).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    return bench


def test_requests_carry_the_date_and_the_orbit_of_the_run(make_bench):
    bench = running(make_bench, sky={"date": "2026-03-20T12:00:00Z"}, orbit={"kind": "kepler", **ELEMENTS})
    first, second = bench.pipeline.frames[:2]
    assert first.truth.unix_s == pytest.approx(EQUINOX + 1.05, abs=0.1)
    assert second.truth.unix_s - first.truth.unix_s == pytest.approx(1.0)
    moved = second.truth.orbit.position_m - first.truth.orbit.position_m
    assert moved == pytest.approx(first.truth.orbit.velocity_m_s, rel=0.01, abs=10.0)
    assert np.linalg.norm(first.truth.orbit.position_m) == pytest.approx(6.9e6, rel=1e-6)


def test_without_date_and_orbit_the_date_is_that_of_the_device_and_the_place_the_earths_centre(make_bench):
    frame = running(make_bench).pipeline.frames[0]
    assert frame.truth.unix_s == pytest.approx(NEW_YEAR, abs=2.0)
    assert (frame.truth.orbit, frame.observer_velocity) == (None, None)


def test_a_device_that_corrects_aberration_takes_the_velocity_of_the_earth_at_its_own_clock(make_bench):
    bench = running(
        make_bench, sky={"date": "2026-03-20T12:00:00Z"}, parameters={"corrects_aberration": True}
    )
    frame = bench.pipeline.frames[0]
    assert frame.observer_velocity == pytest.approx(earth_velocity(NEW_YEAR + 1.0), abs=0.1)
    assert bench.command("set_unix_time", seconds=int(EQUINOX), milliseconds=0) is ErrorCode.OK
    bench.step(1.0)
    assert bench.pipeline.frames[-1].observer_velocity == pytest.approx(earth_velocity(EQUINOX), abs=0.1)


def test_nothing_is_corrected_under_a_sky_without_aberration_and_one_line_says_so(make_bench, caplog):
    bench = running(make_bench, parameters={"corrects_aberration": True})
    assert len(bench.pipeline.frames) >= 2
    assert {frame.observer_velocity for frame in bench.pipeline.frames} == {None}
    assert caplog.text.count("corrects_aberration has no effect") == 1


def test_photographs_have_aberration_without_a_date(make_bench):
    bench = running(make_bench, images={"folder": "night"}, parameters={"corrects_aberration": True})
    assert bench.pipeline.frames[0].observer_velocity == pytest.approx(
        earth_velocity(NEW_YEAR + 1.0), abs=0.1
    )


def test_an_uploaded_orbit_adds_its_velocity(make_bench):
    bench = running(
        make_bench,
        run={"start_unix_s": EQUINOX},
        sky={"bodies": "ephemeris"},
        orbit={"kind": "kepler", **ELEMENTS},
        parameters={"corrects_aberration": True},
    )
    bench.device.parameters.set(KNOWN)
    bench.step(1.0)
    frame = bench.pipeline.frames[-1]
    expected = earth_velocity(frame.truth.unix_s) + frame.truth.orbit.velocity_m_s
    assert frame.observer_velocity == pytest.approx(expected, abs=0.5)


def test_elements_in_parameters_give_an_orbit():
    assert known_orbit(KNOWN) == KeplerOrbit(
        EQUINOX, 6.9e6, 0.0, *(np.radians(value) for value in (97.5, 40.0, 0.0, 10.0))
    )
    assert known_orbit({}) is None


def test_an_orbit_that_intersects_the_earth_is_refused(bench):
    with pytest.raises(FieldError, match=r"orbit_semi_major_axis: .*intersects the Earth"):
        bench.device.parameters.set({"orbit_semi_major_axis": 6000.0})
    with pytest.raises(FieldError, match=r"orbit_semi_major_axis: .*intersects the Earth"):
        bench.device.parameters.set({"orbit_semi_major_axis": 7000.0, "orbit_eccentricity": 0.2})
    bench.device.parameters.set({"orbit_semi_major_axis": 26600.0, "orbit_eccentricity": 0.7})


def test_a_run_continues_after_its_orbit_has_decayed(make_bench, caplog):
    bench = make_bench(Profile()).start()

    class Decays:
        def state(self, _unix_s):
            raise EmulatorError("orbit: TLE: satellite has decayed")

    bench.device.surroundings._orbit = Decays()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    assert [frame.truth.orbit for frame in bench.pipeline.frames] == [None] * len(bench.pipeline.frames)
    assert len(bench.pipeline.frames) >= 2
    assert caplog.text.count("has decayed; the run continues without an orbit") == 1


def test_after_a_gap_of_an_orbit_file_the_run_has_its_orbit_again(make_bench, caplog):
    bench = make_bench(Profile()).start()
    surroundings, start = bench.device.surroundings, bench.device.surroundings._start_unix_s
    place = OrbitState(np.array([7e6, 0.0, 0.0]), np.array([0.0, 7.5e3, 0.0]))
    spans = [Span(0, 0, start, start + 10.0), Span(1, 1, start + 20.0, start + 30.0)]
    surroundings._orbit = OrbitTable("orbit.oem", np.array([start, start + 20.0]), [place] * 2, spans)
    has_orbit = [surroundings.state(second * 10**9).orbit is place for second in (5, 12, 15, 25, 35)]
    assert has_orbit == [True, False, False, True, False]
    assert caplog.text.count("the run continues without an orbit") == 2  # once for each gap


def test_an_invalid_orbit_in_a_profile_names_the_profile(make_bench):
    tle = {"kind": "tle", "line1": "1", "line2": "2"}
    with pytest.raises(EmulatorError, match=r"profile .*: orbit: line 1 of the TLE"):
        make_bench(Profile.model_validate({"orbit": tle}))


def test_a_bad_date_is_named():
    with pytest.raises(ValueError, match="date from 1970 to 2100"):
        Profile.model_validate({"sky": {"date": "soon"}})
