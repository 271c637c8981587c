"""Files of several segments: what holds where they overlap, and that nothing is interpolated from one to the next."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.file import read_orbit_file, read_truth_file
from starhil.emulator.truth.source import TruthStatus
from starhil.emulator.truth.spice_file import write_kernels
from starid.attitude import Attitude, propagate
from starid.catalog.earth import unix_time
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.truth.conftest import Orekit
from tests.emulator.truth.test_standard_files import needs

START_UNIX_S = unix_time("2026-03-20T12:00:00Z")
MILLIARCSECOND = 1e-3
RATE_RAD_S = np.radians([0.3, -0.1, 0.2])
BEFORE, AFTER = Attitude.from_radec_roll(83.8, -1.2, 30.0), Attitude.from_radec_roll(84.3, -1.2, 30.0)
"""Attitudes at the epoch of two motions at one rate, between which the body jumps."""


def date(t: float) -> str:
    return f"2026-03-20T12:{int(t) // 60:02d}:{t % 60:06.3f}"


def quaternion(start: Attitude, t: float) -> np.ndarray:
    """Attitude quaternion at a time, scalar last."""
    return propagate(start, RATE_RAD_S, t).quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0]


def row(start: Attitude, t: float, *, rates: bool = True) -> str:
    numbers = [*quaternion(start, t), *(np.degrees(RATE_RAD_S) if rates else ())]
    return " ".join(repr(float(number)) for number in numbers)


def segment(start: Attitude, times: range, *, rates: bool = True, **keywords: str) -> str:
    segments = {
        "REF_FRAME_A": "ICRF", "REF_FRAME_B": "BODY", "TIME_SYSTEM": "UTC",
        "ATTITUDE_TYPE": "QUATERNION/ANGVEL" if rates else "QUATERNION", **({"ANGVEL_FRAME": "BODY"} if rates else {}),
        **keywords,
    }  # fmt: skip
    meta = [f"{key} = {value}" for key, value in segments.items() if value]
    rows = [f"{date(t)} {row(start, t, rates=rates)}" for t in times]
    return "\n".join(("META_START", *meta, "META_STOP", "DATA_START", *rows, "DATA_STOP", ""))


def write(tmp_path: Path, *parts: str, version: str = "2.0") -> Path:
    path = tmp_path / "truth"
    path.write_text(f"CCSDS_AEM_VERS = {version}\n" + "".join(parts))
    return path


def off_arcsec(truth, t: float, start: Attitude, at: float | None = None) -> float:
    expected = propagate(start, RATE_RAD_S, t if at is None else at)
    return float(truth.state(t).attitude.error_to(expected).total_arcsec)


# --- useable spans ---


def test_useable_spans_decide_where_segments_overlap(tmp_path: Path) -> None:
    truth = read_truth_file(
        write(
            tmp_path,
            segment(BEFORE, range(21), USEABLE_STOP_TIME=date(17.5)),
            segment(AFTER, range(15, 41), USEABLE_START_TIME=date(17.5)),
        )
    )
    for t in (0.0, 16.2, 17.4999):
        assert off_arcsec(truth, t, BEFORE) < MILLIARCSECOND
    for t in (17.5, 18.3, 40.0):
        assert off_arcsec(truth, t, AFTER) < MILLIARCSECOND
    assert {truth.state(t).status for t in (0.0, 17.4, 17.5, 40.0)} == {TruthStatus.OK}


def test_the_first_useable_time_is_time_zero_and_after_the_last_the_attitude_is_held(tmp_path: Path) -> None:
    useable = {"USEABLE_START_TIME": date(4.5), "USEABLE_STOP_TIME": date(7.25)}
    truth = read_truth_file(write(tmp_path, segment(BEFORE, range(11), **useable)))
    assert truth.start_unix_s == START_UNIX_S + 4.5
    assert (
        truth.state(1.0).attitude.error_to(propagate(BEFORE, RATE_RAD_S, 5.5)).total_arcsec < MILLIARCSECOND
    )
    after, before = truth.state(3.0), truth.state(-1.0)
    assert (before.status, after.status) == (TruthStatus.BEFORE_START, TruthStatus.AFTER_END)
    assert after.attitude.error_to(propagate(BEFORE, RATE_RAD_S, 7.25)).total_arcsec < MILLIARCSECOND
    assert not after.rate_rad_s.any()
    assert after.unix_s == START_UNIX_S + 7.5


@pytest.mark.parametrize(
    ("useable", "message"),
    [
        (
            ({}, {}),
            "segment 2: overlaps the segment before; in a CCSDS file, USEABLE_START_TIME and USEABLE_STOP_TIME keep them apart",
        ),
        (
            ({"USEABLE_STOP_TIME": date(18)}, {"USEABLE_START_TIME": date(17)}),
            "segment 2: overlaps the segment before",
        ),
        (({"USEABLE_STOP_TIME": date(18)}, {"USEABLE_START_TIME": "18"}), "segment 2: not a date"),
        (
            ({"USEABLE_START_TIME": date(30)}, {}),
            "segment 1: no row is between USEABLE_START_TIME and USEABLE_STOP_TIME",
        ),
    ],
)
def test_spans_that_overlap_or_are_empty_are_named(tmp_path: Path, useable, message: str) -> None:
    parts = (segment(BEFORE, range(21), **useable[0]), segment(AFTER, range(15, 41), **useable[1]))
    with pytest.raises(EmulatorError) as error:
        read_truth_file(write(tmp_path, *parts))
    assert message in str(error.value)


# --- gaps ---


def two_segments(tmp_path: Path) -> Path:
    """Of two motions, with a gap from 10 to 20 s."""
    return write(tmp_path, segment(BEFORE, range(11)), segment(AFTER, range(20, 31)))


def check_gap(truth) -> None:
    assert [truth.state(t).status.value for t in (10.0, 10.001, 15.0, 19.99, 20.0)] == [
        "ok",
        "gap",
        "gap",
        "gap",
        "ok",
    ]
    assert off_arcsec(truth, 15.0, BEFORE, at=10.0) < MILLIARCSECOND
    assert not truth.state(15.0).rate_rad_s.any()
    assert off_arcsec(truth, 9.7, BEFORE) < MILLIARCSECOND
    assert off_arcsec(truth, 20.4, AFTER) < MILLIARCSECOND


def test_in_a_gap_between_segments_the_attitude_is_held_and_flagged(tmp_path: Path) -> None:
    check_gap(read_truth_file(two_segments(tmp_path)))


@pytest.mark.parametrize("name", ["out.aem", "out.tm"])
def test_a_converted_file_has_the_gap_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    if name.endswith(".tm"):
        needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    assert run_command_line("truth", "convert", str(two_segments(tmp_path)), "-o", name) == (0, "", "")
    check_gap(read_truth_file(Path(name)))


@pytest.mark.parametrize("name", ["out.aem", "out.tm"])
def test_converted_segments_that_overlap_keep_their_useable_spans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """In a CK, the later of two segments that share a time has precedence there."""
    if name.endswith(".tm"):
        needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    parts = (
        segment(BEFORE, range(21), USEABLE_STOP_TIME=date(17.5)),
        segment(AFTER, range(15, 41), USEABLE_START_TIME=date(17.5)),
    )
    assert run_command_line("truth", "convert", str(write(tmp_path, *parts)), "-o", name) == (0, "", "")
    truth = read_truth_file(Path(name))
    assert off_arcsec(truth, 17.3, BEFORE) < MILLIARCSECOND
    assert off_arcsec(truth, 17.4999, BEFORE) < MILLIARCSECOND
    assert off_arcsec(truth, 17.5001, AFTER) < MILLIARCSECOND
    assert {truth.state(t).status for t in (17.4999, 17.5, 17.5001)} == {TruthStatus.OK}


def test_a_repeated_file_repeats_its_gap(tmp_path: Path) -> None:
    from dataclasses import replace

    truth = replace(read_truth_file(two_segments(tmp_path)), repeat=True)
    assert truth.state(30.0 + 15.0).status is TruthStatus.GAP
    assert truth.state(30.0 + 5.0).status is TruthStatus.OK


# --- what a file must say ---


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"QUATERNION_TYPE": "LAST"}, "segment 1: ATTITUDE_DIR is missing"),
        ({"ATTITUDE_DIR": "A2B"}, "segment 1: QUATERNION_TYPE is missing"),
        ({"ATTITUDE_DIR": "BOTH", "QUATERNION_TYPE": "LAST"}, "segment 1: ATTITUDE_DIR must be A2B or B2A"),
        ({"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "4"}, "segment 1: QUATERNION_TYPE must be LAST or FIRST"),
    ],
)
def test_an_aem_of_version_1_says_direction_and_order(tmp_path: Path, keywords, message: str) -> None:
    path = write(tmp_path, segment(BEFORE, range(3), rates=False, **keywords), version="1.0")
    with pytest.raises(EmulatorError) as error:
        read_truth_file(path)
    assert str(error.value) == f"truth file {path}, {message}"


def test_attitudes_without_rates_are_named_as_unchecked(tmp_path: Path, caplog) -> None:
    path = write(tmp_path, segment(BEFORE, range(3), rates=False))
    read_truth_file(path)
    (said,) = (record.getMessage() for record in caplog.records)
    assert said == (
        f"truth file {path}: has no rates, so the sense of its attitudes cannot be checked; "
        "compare one of them with its source"
    )
    caplog.clear()
    read_truth_file(write(tmp_path, segment(BEFORE, range(3))))
    assert not caplog.records


# --- STK ---


def stk(rows: list[str], *boundaries: float, begin: str = "BEGIN") -> str:
    times = "".join(f"\n    {boundary:.16e}\n" for boundary in boundaries)
    return (
        "stk.v.12.0\n\n# WrittenBy    STK_v12.2.0\n\nBEGIN Attitude\n\n    numberOfAttitudePoints\t\t 31\n"
        "    ScenarioEpoch\t\t 20 Mar 2026 12:00:00.000\n    CentralBody\t\t Earth\n    CoordinateAxes\t\t ICRF\n\n"
        f"    {begin} SegmentBoundaryTimes\n{times}\n    END SegmentBoundaryTimes\n\n# first point\n\n"
        "    AttitudeTimeQuatAngVels\n\n" + "\n".join(rows) + "\n\nEND Attitude\n"
    )


@pytest.mark.parametrize("begin", ["BEGIN", "Begin"])
def test_nothing_is_interpolated_over_a_segment_boundary_of_stk(tmp_path: Path, begin: str) -> None:
    path = tmp_path / "truth.a"
    rows = [f"{t} {row(BEFORE, t)}" for t in range(11)] + [f"{t} {row(AFTER, t)}" for t in range(10, 31)]
    path.write_text(stk(rows, 0.0, 10.0, begin=begin))
    truth = read_truth_file(path)
    assert off_arcsec(truth, 9.9999, BEFORE) < MILLIARCSECOND
    assert off_arcsec(truth, 10.0, AFTER) < MILLIARCSECOND
    assert truth.state(9.9999).status is TruthStatus.OK


def test_segments_of_stk_share_the_one_row_at_a_boundary_or_have_a_gap_without_one(tmp_path: Path) -> None:
    path = tmp_path / "truth.a"
    rows = [f"{t} {row(BEFORE, t)}" for t in range(21)]
    path.write_text(stk(rows, 10.0))
    truth = read_truth_file(path)
    assert {truth.state(t).status for t in np.arange(0.0, 20.0, 0.3)} == {TruthStatus.OK}
    path.write_text(stk(rows, 10.5))
    truth = read_truth_file(path)
    assert [truth.state(t).status for t in (10.0, 10.2, 10.8, 11.0)] == [
        TruthStatus.OK, TruthStatus.GAP, TruthStatus.GAP, TruthStatus.OK,
    ]  # fmt: skip


def circle(t: float, sense: float = 1.0) -> list[float]:
    """Position and velocity on a circle, m, m/s; both senses meet at the epoch and after half a revolution."""
    cosine, sine = math.cos(1e-3 * t), sense * math.sin(1e-3 * t)
    return [7e6 * cosine, 7e6 * sine, 0.0, -7e3 * math.sin(1e-3 * t), sense * 7e3 * cosine, 0.0]


def manoeuvre(tmp_path: Path) -> Path:
    """An ephemeris of STK with two rows at its epoch, at which the motion turns back."""
    path = tmp_path / "orbit.e"
    rows = [(t, 1.0) for t in range(-300, 1, 30)] + [(t, -1.0) for t in range(0, 301, 30)]
    path.write_text(
        "stk.v.12.0\nBEGIN Ephemeris\nScenarioEpoch 20 Mar 2026 12:00:00.000\nCoordinateSystem ICRF\n"
        "BEGIN SegmentBoundaryTimes\n-3.0e+02\n0.0\nEND SegmentBoundaryTimes\nEphemerisTimePosVel\n"
        + "\n".join(" ".join(map(repr, (float(t), *circle(t, sense)))) for t, sense in rows)
        + "\nEND Ephemeris\n"
    )
    return path


AROUND_IT = (-200.0, -30.0, -0.01, 0.0, 30.0, 299.0)


def test_an_ephemeris_of_stk_with_a_manoeuvre_has_both_velocities_at_the_boundary(tmp_path: Path) -> None:
    orbit = read_orbit_file(manoeuvre(tmp_path))
    for t in AROUND_IT:
        state, expected = orbit.state(START_UNIX_S + t), circle(t, 1.0 if t < 0.0 else -1.0)
        assert state.position_m == pytest.approx(expected[:3], abs=0.02)
        assert state.velocity_m_s == pytest.approx(expected[3:], abs=0.003)


@pytest.mark.process
def test_orekit_reads_the_same_from_an_ephemeris_with_a_manoeuvre(orekit: Orekit, tmp_path: Path) -> None:
    path = manoeuvre(tmp_path)
    rows = orekit("ephemeris", path, "2026-03-20T12:00:00", *AROUND_IT)
    orbit = read_orbit_file(path)
    for t, numbers in zip(AROUND_IT, rows, strict=True):
        state = orbit.state(START_UNIX_S + t)
        assert state.position_m == pytest.approx(numbers[:3], abs=0.02)
        assert state.velocity_m_s == pytest.approx(numbers[3:], abs=0.003)


# --- OEM ---


def oem(*segments: tuple[range, float, dict[str, str]]) -> str:
    text = "CCSDS_OEM_VERS = 2.0\n"
    for times, sense, keywords in segments:
        given = {"CENTER_NAME": "EARTH", "REF_FRAME": "ICRF", "TIME_SYSTEM": "UTC", **keywords}
        text += "META_START\n" + "".join(f"{key} = {value}\n" for key, value in given.items()) + "META_STOP\n"
        for t in times:
            text += f"{date(t)} " + " ".join(repr(1e-3 * number) for number in circle(t, sense)) + "\n"
    return text


def test_useable_spans_of_an_oem_decide_and_a_gap_has_no_orbit(tmp_path: Path) -> None:
    path = tmp_path / "orbit.oem"
    path.write_text(
        oem(
            (range(0, 121, 20), 1.0, {"USEABLE_STOP_TIME": date(90)}),
            (range(60, 241, 20), -1.0, {"USEABLE_START_TIME": date(90)}),
            (range(300, 401, 20), 1.0, {}),
        )
    )
    orbit = read_orbit_file(path)
    for t, sense in ((10.0, 1.0), (89.9, 1.0), (90.0, -1.0), (240.0, -1.0), (310.0, 1.0)):
        assert orbit.state(START_UNIX_S + t).position_m == pytest.approx(circle(t, sense)[:3], abs=0.02)
    for t in (-1.0, 270.0, 401.0):
        with pytest.raises(EmulatorError, match="its dates do not include"):
            orbit.state(START_UNIX_S + t)


# --- SPICE ---

HAS_RATES = True


def kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[list[float], list[np.ndarray], list[np.ndarray]]:
    """Write a clock, leap seconds and a meta-kernel `bare.tm` of these; return ticks, quaternions and rates of 31 rows."""
    needs("spiceypy")
    import spiceypy as spice

    monkeypatch.chdir(tmp_path)
    write_kernels(read_truth_file(write(tmp_path, segment(BEFORE, range(31)))), Path("out.tm"), -44007)
    Path("bare.tm").write_text(Path("out.tm").read_text().replace("'out.bc'", "'test.bc'"))
    matrices = [propagate(BEFORE, RATE_RAD_S, t).matrix.copy() for t in range(31)]
    rates = [matrix.T @ RATE_RAD_S for matrix in matrices]
    return [1e6 * t for t in range(31)], [spice.m2q(matrix) for matrix in matrices], rates


def test_a_ck_of_type_1_is_an_error_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks, quaternions, rates = kernels(tmp_path, monkeypatch)
    import spiceypy as spice

    handle = spice.ckopn("test.bc", "test", 0)
    spice.ckw01(
        handle, ticks[0], ticks[-1], -44007, "J2000", HAS_RATES, "test", len(ticks), ticks, quaternions, rates
    )
    spice.ckcls(handle)
    with pytest.raises(EmulatorError) as error:
        read_truth_file(Path("bare.tm"))
    assert str(error.value) == (
        "truth file bare.tm: a segment of type 1 in its CK has no attitudes between its records; write it as type 3"
    )


def test_what_spice_does_not_find_is_an_error_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels(tmp_path, monkeypatch)
    import spiceypy as spice

    def finds_nothing(*_arguments: object) -> None:
        raise spice.exceptions.NotFoundError("Spice returns not found for function: ckgpav")

    monkeypatch.setattr(spice, "ckgpav", finds_nothing)
    with pytest.raises(EmulatorError) as error:
        read_truth_file(Path("out.tm"))
    assert str(error.value) == "out.tm: SPICE: Spice returns not found for function: ckgpav"


@pytest.mark.parametrize("name", ["it's.tm", 76 * "x" + ".tm"])
def test_a_ck_of_any_name_that_spice_can_read_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    assert run_command_line("truth", "convert", str(two_segments(tmp_path)), "-o", name) == (0, "", "")
    check_gap(read_truth_file(Path(name)))


@pytest.mark.parametrize("name", ["ö.tm", 77 * "x" + ".tm"])
def test_a_name_that_spice_cannot_read_is_rejected_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    source = two_segments(tmp_path)
    status, _, said = run_command_line("truth", "convert", str(source), "-o", name)
    assert status == 2
    assert said.endswith("SPICE cannot read a file of this name; give one of at most 79 ASCII characters\n")
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("kind", [2, 3])
def test_a_ck_has_gaps_between_its_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: int
) -> None:
    """Intervals from 0 to 10 s and from 20 to 30 s in one segment."""
    ticks, quaternions, rates = kernels(tmp_path, monkeypatch)
    import spiceypy as spice

    handle = spice.ckopn("test.bc", "test", 0)
    if kind == 3:
        rows = [*range(11), *range(20, 31)]
        given = [[each[row] for row in rows] for each in (ticks, quaternions, rates)]
        spice.ckw03(
            handle, ticks[0], ticks[-1], -44007, "J2000", HAS_RATES, "test", len(rows), *given, 2, [ticks[0], ticks[20]]
        )  # fmt: skip
    else:
        spice.ckw02(
            handle, ticks[0], ticks[-1], -44007, "J2000", "test", 2, [ticks[0], ticks[20]], [ticks[10], ticks[30]],
            [quaternions[0], quaternions[20]], [rates[0], rates[20]], [1e-6, 1e-6],
        )  # fmt: skip
    spice.ckcls(handle)
    truth = read_truth_file(Path("bare.tm"))
    assert [truth.state(t).status.value for t in (0.0, 9.9, 10.1, 19.9, 20.1, 30.0)] == [
        "ok", "ok", "gap", "gap", "ok", "ok",
    ]  # fmt: skip
    for t in (0.05, 9.7, 20.4, 29.95):
        assert off_arcsec(truth, t, BEFORE) < 0.01
