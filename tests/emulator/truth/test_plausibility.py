"""Positions, velocities and dates in wrong units are named with the likely mistake, in a live feed and in files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.config import StateConfig
from starhil.emulator.truth.file import read_orbit_file, read_truth_file
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.plausibility import doubt_of_date, doubt_of_orbit
from starhil.emulator.truth.source import TruthStatus
from starid.attitude import Attitude
from starid.catalog.earth import unix_time
from tests.emulator.runs import Control

RUN = unix_time("2026-01-01")
DAY_S = 86_400.0
POSITION_M, VELOCITY_M_S = [7.2e6, 0.0, 0.0], [0.0, 7.44e3, 0.0]


def feed(caplog, n=20, *, position=POSITION_M, velocity=VELOCITY_M_S, unix_s=RUN):
    """Send messages at 10 Hz; return the truth and the warnings."""
    live = LiveTruth(Attitude.identity())
    live.set_run(1.0, RUN)
    for k in range(n):
        t = 0.1 * k
        message = {
            "t": t, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.0, 0.0],
            "position_m": position, "velocity_m_s": velocity, "unix_s": unix_s + t,
        }  # fmt: skip
        assert live.receive(json.dumps(message), t), live.last_fault
    return live, [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"position": [7.2e3, 0.0, 0.0]}, "position seems to be in kilometres instead of metres"),
        (
            {"velocity": [0.0, 7.44, 0.0]},
            "velocity seems to be in kilometres per second instead of metres per second",
        ),
        (
            {"position": [7.2e3, 0.0, 0.0], "velocity": [0.0, 7.44, 0.0]},
            "position and velocity seem to be in kilometres instead of metres",
        ),
        (
            {"position": [1.1, 0.0, 0.0]},
            "the position is inside the Earth: give metres and m/s relative to the Earth's centre, GCRS",
        ),
        (
            {"unix_s": RUN - 946_728_000.0},
            "the date is 1996-01-01, but that of the run 2026-01-01: it seems to be seconds since J2000 instead of Unix time",
        ),
        (
            {"unix_s": RUN - 315_964_800.0},
            "the date is 2015-12-28, but that of the run 2026-01-01: it seems to be GPS time instead of Unix time",
        ),
        (
            {"unix_s": unix_time("2060-01-01")},
            "the date is 2060-01-01, but that of the run 2026-01-01: set run.start_unix_s if it is right",
        ),
    ],
)
def test_a_feed_in_wrong_units_is_flagged_and_named_once(wrong, said, caplog):
    live, warnings = feed(caplog, **wrong)
    assert warnings == [f"truth feed: implausible: {said}"]
    for t in (0.05, 1.9, 1.95):  # between messages, at the last, after it
        assert live.state(t).status is TruthStatus.IMPLAUSIBLE
    assert live.state(9.0).status is TruthStatus.STALE


def test_a_feed_that_becomes_right_is_no_longer_flagged(caplog):
    live, _ = feed(caplog, 10, position=[7.2e3, 0.0, 0.0])
    message = {"t": 1.0, "q": [0.0, 0.0, 0.0, 1.0], "position_m": POSITION_M, "velocity_m_s": VELOCITY_M_S}
    assert live.receive(json.dumps(message), 1.0)
    assert live.state(1.0).status is TruthStatus.OK


def test_a_feed_that_is_right_and_wrong_in_turn_does_not_fill_the_log(caplog):
    live = LiveTruth(Attitude.identity())
    live.set_run(1.0, RUN)
    for k in range(200):
        position = [7.2e3, 0.0, 0.0] if k % 2 else POSITION_M
        message = {
            "t": 0.1 * k,
            "q": [0.0, 0.0, 0.0, 1.0],
            "position_m": position,
            "velocity_m_s": VELOCITY_M_S,
        }
        assert live.receive(json.dumps(message), 0.1 * k)
    assert len(caplog.records) == len(("1", "10", "100"))


@pytest.mark.parametrize(
    ("position", "velocity"),
    [
        (POSITION_M, VELOCITY_M_S),
        ([0.0, 0.0, 6.357e6], [0.0, 0.0, 0.0]),  # at rest on the pole
        ([6.378e6, 0.0, 0.0], [0.0, 465.0, 0.0]),  # on the equator
        ([6.9e6, 0.0, 0.0], [0.0, 160.0, 0.0]),  # apogee of a sounding rocket from 69° north
        ([4.2164e7, 0.0, 0.0], [0.0, 3075.0, 0.0]),  # geostationary
        ([6.6e6, 0.0, 0.0], [0.0, 1.7e4, 0.0]),  # a fast fly-by
        ([1.47e9, 0.0, 0.0], [0.0, 300.0, 0.0]),  # L2
        ([2.0e11, 0.0, 0.0], [0.0, 5e4, 0.0]),  # between the planets
    ],
)
def test_what_flies_is_plausible(position, velocity, caplog):
    live, warnings = feed(caplog, position=position, velocity=velocity)
    assert live.state(1.9).status is TruthStatus.OK
    assert not warnings


@pytest.mark.parametrize("distance_m", np.geomspace(6.5e6, 1e9, 12))
@pytest.mark.parametrize("share", [0.1, 1.0, math.sqrt(2.0)])
def test_each_mistake_in_units_of_an_orbit_is_found(distance_m, share):
    speed = share * math.sqrt(3.986004418e14 / distance_m)
    assert not doubt_of_orbit(OrbitState(np.array([distance_m, 0.0, 0.0]), np.array([0.0, speed, 0.0])))
    km = OrbitState(np.array([1e-3 * distance_m, 0.0, 0.0]), np.array([0.0, 1e-3 * speed, 0.0]))
    assert "in kilometres instead of metres" in doubt_of_orbit(km)


def test_a_date_within_the_life_of_a_mission_is_plausible():
    for years in (-14, -10, -2, 0, 5, 14):
        assert not doubt_of_date(RUN + years * 365.25 * DAY_S + 90.0 * DAY_S, RUN)


OEM = """CCSDS_OEM_VERS = 2.0
META_START
CENTER_NAME = EARTH
REF_FRAME = ICRF
TIME_SYSTEM = UTC
META_STOP
2026-03-20T12:00:00 {} 0 0 0 {} 0
2026-03-20T12:01:00 {} 0 0 0 {} 0
"""
STK = """stk.v.12.0
BEGIN Ephemeris
ScenarioEpoch 20 Mar 2026 12:00:00
CoordinateSystem ICRF
{}EphemerisTimePosVel
0 {} 0 0 0 {} 0
60 {} 0 0 0 {} 0
END Ephemeris
"""
CSV = "t,qx,qy,qz,qw,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s\n0,0,0,0,1,{},0,0,0,{},0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OEM.format(*(7.2e6, 7440.0) * 2), "position and velocity seem to be in metres instead of kilometres"),
        (OEM.format(*(7200.0, 7440.0) * 2), "velocity seems to be in metres per second instead of kilometres per second"),
        (STK.format("", *(7200.0, 7.44) * 2), "position and velocity seem to be in kilometres instead of metres"),
        (STK.format("DistanceUnit Kilometers\n", *(7.2e6, 7440.0) * 2), "position and velocity seem to be in metres instead of kilometres"),
    ],
)  # fmt: skip
def test_an_orbit_file_in_wrong_units_names_file_and_units(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "orbit"
    path.write_text(text)
    with pytest.raises(EmulatorError) as error:
        read_orbit_file(path)
    assert str(error.value) == f"orbit file {path}: {message}"


def test_positions_of_a_truth_file_in_wrong_units_are_named_by_line(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(CSV.format(7200.0, 7.44))
    with pytest.raises(EmulatorError) as error:
        read_truth_file(path)
    assert str(error.value) == (
        f"truth file {path} line 2: position and velocity seem to be in kilometres instead of metres"
    )


@pytest.mark.parametrize(
    ("position", "velocity", "message"),
    [
        (
            [7.2e3, 0.0, 0.0],
            [0.0, 7.44, 0.0],
            "position and velocity seem to be in kilometres instead of metres",
        ),
        (
            [7.2e6, 0.0, 0.0],
            [0.0, 7.44, 0.0],
            "velocity seems to be in kilometres per second instead of metres per second",
        ),
    ],
)
def test_a_state_of_a_profile_in_wrong_units_is_named(
    position, velocity, message: str, tmp_path: Path
) -> None:
    config = StateConfig(kind="state", position_m=position, velocity_m_s=velocity)
    with pytest.raises(EmulatorError) as error:
        config.build(RUN, tmp_path)
    assert str(error.value) == f"orbit: {message}"


def test_the_status_shows_a_feed_of_another_date(run) -> None:
    async def scenario(emulation, _line):
        message = {"t": 0.0, "q": [0.0, 0.0, 0.0, 1.0], "unix_s": RUN - 946_728_000.0}
        emulation.feed.receive(json.dumps(message).encode())
        async with Control(emulation) as control:
            return await control.do("status")

    assert run(scenario, truth={"kind": "live"})["truth_status"] == "implausible"


def in_orbit(t: float) -> list[float]:
    """Position and velocity of a circular orbit of 7000 km, km and km/s."""
    angle = 1.078e-3 * t
    cosine, sine = math.cos(angle), math.sin(angle)
    return [7000.0 * cosine, 7000.0 * sine, 0.0, -7.546 * sine, 7.546 * cosine, 0.0]


OEM_HEADER = (
    "CCSDS_OEM_VERS = 2.0\nMETA_START\nCENTER_NAME = EARTH\nREF_FRAME = ICRF\nTIME_SYSTEM = UTC\nMETA_STOP\n"
)
CSV_HEADER = "t,qx,qy,qz,qw,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s\n"


def test_a_wrong_sign_in_one_row_of_an_orbit_shows_between_the_rows(tmp_path: Path) -> None:
    """Between them the satellite had 340 km/s, and its aberration was wrong by four minutes of arc."""
    path = tmp_path / "file"
    for wrong in (False, True):
        rows = [in_orbit(60.0 * n) for n in range(6)]
        if wrong:
            rows[3][0] *= -1.0
        oem = [f"2026-01-01T00:0{n}:00 " + " ".join(map(repr, row)) for n, row in enumerate(rows)]
        csv = [
            ",".join(map(repr, [60.0 * n, 0, 0, 0, 1, *(1e3 * x for x in row)])) for n, row in enumerate(rows)
        ]
        for header, lines, read, where in (
            (OEM_HEADER, oem, read_orbit_file, "orbit file .*: row 3: "),
            (CSV_HEADER, csv, read_truth_file, "truth file .* line 4: "),
        ):
            path.write_text(header + "\n".join(lines))
            if wrong:
                with pytest.raises(
                    EmulatorError, match=where + ".*halfway to the next row: a number is wrong"
                ):
                    read(path)
            else:
                read(path)


def test_rows_between_which_a_satellite_goes_most_of_the_way_around_are_too_far_apart(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for hours, enough in ((0.5, True), (1.0, False)):
        rows = [
            f"2026-01-01T{int(hours * n):02d}:{round(60 * hours * n) % 60:02d}:00 "
            + " ".join(map(repr, in_orbit(3600.0 * hours * n)))
            for n in range(4)
        ]
        path.write_text(OEM_HEADER + "\n".join(rows))
        if enough:
            read_orbit_file(path)
        else:
            with pytest.raises(EmulatorError, match="rows are too far apart"):
                read_orbit_file(path)
