"""Truth and orbit from standard files, written by independent programs: Orekit, the packages oem and stk_files, and SPICE."""

from __future__ import annotations

import errno
import importlib.util
import io
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth import spice_file
from starhil.emulator.truth.file import read_orbit_file, read_truth_file
from starhil.emulator.truth.source import SlewSegment, SlewTruth
from starhil.emulator.truth.standard_frames import euler_turns, unix_ns
from starhil.emulator.truth.table import FileTruth
from starid.attitude import Attitude
from starid.catalog.earth import unix_time
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.truth.conftest import Orekit

SLEW = SlewTruth(
    Attitude.from_radec_roll(83.8, -1.2, 30.0),
    [SlewSegment(Attitude.from_radec_roll(120.0, 20.0, 80.0), math.radians(0.5))],
)
START = "2026-03-20T12:00:00.250"
START_UNIX_S = unix_time(START)
TIMES = [float(t) for t in range(int(SLEW.duration_s) + 1)]
STATES = [SLEW.state(t) for t in TIMES]
SHUSTER = [a.attitude.quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0] for a in STATES]
"""Attitude quaternions, scalar last."""
MICROARCSECOND, MILLIARCSECOND = 1e-6, 1e-3


def earth_orbit(t: float) -> list[float]:
    """Position and velocity, m and m/s."""
    cosine, sine = math.cos(1e-3 * t), math.sin(1e-3 * t)
    return [7e6 * cosine, 7e6 * sine, 0.0, -7e3 * sine, 7e3 * cosine, 0.0]


EARTH_ORBIT = [earth_orbit(t) for t in TIMES]


def needs(module: str) -> None:
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"the package {module} is not installed")


def worst_arcsec(truth: FileTruth, times: list[float]) -> float:
    return max(truth.state(t).attitude.error_to(SLEW.state(t).attitude).total_arcsec for t in times)


def dates(times: list[float]) -> list[str]:
    return [
        f"2026-03-20T{12 + int(t) // 3600:02d}:{int(t) // 60 % 60:02d}:{int(t) % 60:02d}.250" for t in times
    ]


def aem(kind: str = "QUATERNION/ANGVEL", rows: list[str] | None = None, **changed: str) -> str:
    keywords = {
        "REF_FRAME_A": "ICRF", "REF_FRAME_B": "INSTRUMENT_A", "TIME_SYSTEM": "UTC",
        "ATTITUDE_TYPE": kind, "ANGVEL_FRAME": "INSTRUMENT_A", **changed,
    }  # fmt: skip
    if rows is None:
        numbers = [[*q, *np.degrees(s.rate_rad_s)] for q, s in zip(SHUSTER, STATES, strict=True)]
        rows = [
            " ".join((date, *map(repr, map(float, each))))
            for date, each in zip(dates(TIMES), numbers, strict=True)
        ]
    lines = [f"{key} = {value}" for key, value in keywords.items() if value]
    return "\n".join(
        ("CCSDS_AEM_VERS = 2.0", "META_START", *lines, "META_STOP", "DATA_START", *rows, "DATA_STOP", "")
    )


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "truth"
    path.write_text(text)
    return path


# --- written by other programs ---


@pytest.fixture(scope="module")
def written(orekit: Orekit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of files that Orekit has written."""
    folder = tmp_path_factory.mktemp("orekit")
    rows = {
        "start": START,
        "t": TIMES,
        "matrix": [state.attitude.matrix.tolist() for state in STATES],
        "rate": [state.rate_rad_s.tolist() for state in STATES],
    }
    (folder / "rows.json").write_text(json.dumps(rows))
    assert orekit("write", folder) == []
    return folder


@pytest.mark.process
@pytest.mark.parametrize("name", ["v1.kvn", "v1.xml", "v2.kvn", "v2.xml"])
def test_an_aem_of_orekit_has_its_attitudes(written: Path, name: str) -> None:
    """They are in EME2000 and TAI there, the scalar first in version 1."""
    truth = read_truth_file(written / name)
    assert truth.start_unix_s == START_UNIX_S
    assert worst_arcsec(truth, TIMES) < MICROARCSECOND
    if name.startswith("v2"):
        assert truth.rates_rad_s == pytest.approx(np.array([state.rate_rad_s for state in STATES]), abs=1e-15)


@pytest.mark.process
def test_orekit_reads_a_written_aem(orekit: Orekit, written: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.aem"
    assert run_command_line("truth", "convert", str(written / "v2.kvn"), "-o", str(target)) == (0, "", "")
    rows = orekit("read", target)
    assert len(rows) == len(TIMES)
    for row, state in zip(rows, STATES, strict=True):
        error = Attitude.from_matrix(row["matrix"]).error_to(state.attitude)
        assert error.total_arcsec < MICROARCSECOND
        assert row["rate"] == pytest.approx(state.rate_rad_s, abs=1e-15)
    assert rows[0]["date"].startswith("2026-03-20T12:00:00.250")


@pytest.mark.parametrize("form", ["kvn", "xml"])
def test_an_oem_of_the_package_oem_has_its_positions(tmp_path: Path, form: str) -> None:
    needs("oem")
    from astropy.time import Time, TimeDelta
    from oem import OrbitEphemerisMessage
    from oem.components import EphemerisSegment, HeaderSection, MetaDataSection

    meta = {
        "OBJECT_NAME": "TEST", "OBJECT_ID": "1998-999A", "CENTER_NAME": "EARTH", "REF_FRAME": "ICRF", "TIME_SYSTEM": "TAI",
        "START_TIME": "2026-03-20T12:00:37.250", "STOP_TIME": "2026-03-20T12:04:54.250",
    }  # fmt: skip
    epochs = Time(START, scale="utc").tai + TimeDelta(TIMES, format="sec")
    states = np.array(EARTH_ORBIT).T / 1e3
    rows = (list(epochs), *states.tolist())
    header = HeaderSection({"CCSDS_OEM_VERS": "2.0", "CREATION_DATE": START, "ORIGINATOR": "TEST"})
    file = tmp_path / "orbit"
    OrbitEphemerisMessage(header, [EphemerisSegment(MetaDataSection(meta), rows)]).save_as(
        file, file_format=form
    )
    orbit = read_orbit_file(file)
    for t, row in list(zip(TIMES, EARTH_ORBIT, strict=True))[1:-1]:
        state = orbit.state(START_UNIX_S + t)
        assert state.position_m == pytest.approx(row[:3], abs=0.02)  # 7.5 km/s, dates to a microsecond
        assert state.velocity_m_s == pytest.approx(row[3:], abs=1e-4)
    with pytest.raises(EmulatorError, match="its dates do not include"):
        orbit.state(START_UNIX_S - 5.0)


@pytest.mark.parametrize("form", ["Quaternions", "QuatScalarFirst", "EulerAngles"])
@pytest.mark.parametrize("axes", ["ICRF", "J2000"])
def test_a_stk_file_of_the_package_stk_files_has_its_attitudes(tmp_path: Path, form: str, axes: str) -> None:
    needs("stk_files")
    from scipy.spatial.transform import Rotation
    from stk_files import AttitudeConfig, write_attitude

    data = {
        "Quaternions": np.array(SHUSTER),
        "QuatScalarFirst": np.roll(SHUSTER, 1, axis=1),
        "EulerAngles": Rotation.from_quat(SHUSTER).as_euler("ZYX", degrees=True),
    }[form]
    epoch = np.datetime64(START, "ms")
    config = AttitudeConfig(
        format=form, coordinate_axes=axes, time_format="EpSec", scenario_epoch=epoch,
        sequence=321 if form == "EulerAngles" else None,
    )  # fmt: skip
    text = io.StringIO()
    write_attitude(text, config, epoch + (1e3 * np.array(TIMES)).astype("timedelta64[ms]"), data)
    truth = read_truth_file(
        write(tmp_path, text.getvalue().replace("2026-03-20T12:00:00.250", "20 Mar 2026 12:00:00.250"))
    )
    assert truth.start_unix_s == START_UNIX_S
    worst = worst_arcsec(truth, TIMES)
    if axes == "ICRF":
        assert worst < 5 * MILLIARCSECOND  # the package rounds numbers
    else:  # the mean equator of J2000 differs from that of ICRS
        assert worst == pytest.approx(0.023, abs=0.005)


def test_a_stk_ephemeris_has_its_positions(tmp_path: Path) -> None:
    needs("stk_files")
    from stk_files import EphemerisConfig, write_ephemeris

    epoch = np.datetime64(START, "ms")
    config = EphemerisConfig(
        format="TimePosVel", coordinate_system="ICRF", time_format="EpSec", scenario_epoch=epoch
    )
    text = io.StringIO()
    times = epoch + (1e3 * np.array(TIMES)).astype("timedelta64[ms]")
    write_ephemeris(text, config, times, np.array(EARTH_ORBIT))
    orbit = read_orbit_file(write(tmp_path, text.getvalue()))
    for t, row in list(zip(TIMES, EARTH_ORBIT, strict=True))[1:-1]:
        assert orbit.state(START_UNIX_S + t).position_m == pytest.approx(row[:3], abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize("with_rates", [True, False])
def test_a_ck_has_the_attitudes_that_spice_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_rates: bool
) -> None:
    """Written by `truth convert`; SPICE itself says what is in the kernels, between the records too."""
    needs("spiceypy")
    import spiceypy as spice

    monkeypatch.chdir(tmp_path)
    text = (
        aem()
        if with_rates
        else aem("QUATERNION", [" ".join(row.split()[:5]) for row in aem().splitlines()[9:-1]])
    )
    source = write(tmp_path, text)
    done = run_command_line("truth", "convert", str(source), "-o", "out.tm", "--structure", "-44007")
    assert done == (0, "", "")
    original, truth = read_truth_file(source), read_truth_file(Path("out.tm"))
    assert truth.start_unix_s == pytest.approx(START_UNIX_S, abs=1e-6)
    assert (truth.rates_rad_s is not None) == with_rates
    spice.furnsh("out.tm")
    try:
        for t in np.linspace(0.3, 250.7, 41):
            ticks = spice.sce2c(-44, spice.str2et(START) + t)
            spice_says = Attitude.from_matrix(spice.ckgp(-44007, ticks, 0.0, "J2000")[0])
            assert truth.state(float(t)).attitude.error_to(spice_says).total_arcsec < MILLIARCSECOND
            ticks = spice.sce2c(-44, spice.str2et(START) + round(t))
            spice_says = Attitude.from_matrix(spice.ckgp(-44007, ticks, 1.0, "J2000")[0])
            at_record = original.state(float(round(t))).attitude
            assert at_record.error_to(spice_says).total_arcsec < MILLIARCSECOND
    finally:
        spice.kclear()


def test_kernels_replace_others_only_when_all_are_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    source = write(tmp_path, aem())
    words = ["-o", "out.tm", "--structure", "-44007"]
    assert run_command_line("truth", "convert", str(source), *words)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with monkeypatch.context() as full:
        full.setattr(spice_file, "_leap_seconds", Mock(side_effect=OSError(errno.ENOSPC, "No space left")))
        status, _, said = run_command_line("truth", "convert", str(source), *words)
    assert (status, "No space left" in said) == (2, True)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert run_command_line("truth", "convert", str(source), *words)[0] == 0
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in before}
    assert len(read_truth_file(Path("out.tm")).attitudes) > 100


def test_an_spk_gives_the_position(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("spiceypy")
    import spiceypy as spice

    monkeypatch.chdir(tmp_path)
    run_command_line("truth", "convert", str(write(tmp_path, aem())), "-o", "out.tm", "--structure", "-44007")
    spice.furnsh("out.tls")
    times = [-1.0, *TIMES, TIMES[-1] + 1.0]
    epochs, states = [spice.str2et(START) + t for t in times], np.array([earth_orbit(t) for t in times]) / 1e3
    handle = spice.spkopn("orbit.bsp", "test", 0)
    spice.spkw09(handle, -44, 399, "J2000", epochs[0], epochs[-1], "test", 3, len(times), states, epochs)
    spice.spkcls(handle)
    spice.kclear()
    Path("all.tm").write_text(Path("out.tm").read_text().replace("'out.bc'", "'out.bc', 'orbit.bsp'"))
    truth = read_truth_file(Path("all.tm"))
    for t, row in list(zip(TIMES, EARTH_ORBIT, strict=True))[1:-1]:
        orbit = truth.state(t).orbit
        assert orbit is not None
        assert orbit.position_m == pytest.approx(
            row[:3], abs=0.05
        )  # an ephemeris time has a resolution of 0.1 µs


def test_a_ck_without_its_clock_names_what_spice_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("spiceypy")
    monkeypatch.chdir(tmp_path)
    run_command_line("truth", "convert", str(write(tmp_path, aem())), "-o", "out.tm")
    Path("bare.tm").write_text(Path("out.tm").read_text().replace("'out.tsc',\n", ""))
    with pytest.raises(EmulatorError, match=r"SPICE: .*SCLK"):
        read_truth_file(Path("bare.tm"))


# --- interpolation ---


@pytest.mark.parametrize(
    ("step", "with_rates", "bound_arcsec"),
    [(1, True, 1e-4), (10, True, 0.6), (1, False, 3.0), (10, False, 300.0)],
)
def test_interpolation_follows_an_analytic_slew(
    tmp_path: Path, step: int, with_rates: bool, bound_arcsec: float
) -> None:
    rows = aem().splitlines()[9:-1][::step]
    kind = "QUATERNION/ANGVEL" if with_rates else "QUATERNION"
    rows = rows if with_rates else [" ".join(row.split()[:5]) for row in rows]
    truth = read_truth_file(write(tmp_path, aem(kind, rows)))
    worst = worst_arcsec(truth, np.arange(0.0, 250.0, 0.25).tolist())
    assert bound_arcsec / 10.0 < worst < bound_arcsec


def test_a_file_that_says_linear_is_interpolated_so(tmp_path: Path) -> None:
    rows = aem().splitlines()[9:-1][::10]
    linear = read_truth_file(
        write(tmp_path, aem(rows=rows, INTERPOLATION_METHOD="LINEAR", INTERPOLATION_DEGREE="1"))
    )
    assert worst_arcsec(linear, np.arange(0.0, 250.0, 0.1).tolist()) > 10.0


def test_the_truth_has_the_dates_of_the_file(tmp_path: Path) -> None:
    truth = replace(read_truth_file(write(tmp_path, aem())), start_s=100.0)
    assert truth.state(102.5).unix_s == pytest.approx(START_UNIX_S + 2.5, abs=1e-6)


# --- conventions ---


@pytest.mark.parametrize(
    ("date", "scale", "unix_s"),
    [
        ("2026-079T12:00:00.25Z", "UTC", START_UNIX_S),
        ("2026-03-20T12:00:37.250", "TAI", START_UNIX_S),
        ("2016-12-31T23:59:60.5", "UTC", 1_483_228_800.5),
        ("1 jan 2017 0:00:00.125", "UTC", 1_483_228_800.125),
    ],
)
def test_dates_have_their_nanoseconds(date: str, scale: str, unix_s: float) -> None:
    assert unix_ns("", date, scale) == round(unix_s * 8) * 125_000_000


@pytest.mark.parametrize("sequence", ["321", "XYZ", "313", "zyx"])
def test_euler_angles_are_turns_about_the_turned_axes(sequence: str) -> None:
    angles = [10.0, -20.0, 30.0]
    matrix = np.eye(3)
    for axis, angle in zip(
        sequence.translate(str.maketrans("xyzXYZ", "123123")), np.radians(angles), strict=True
    ):
        one, two = [(1, 2), (2, 0), (0, 1)][int(axis) - 1]
        turn = np.eye(3)
        turn[one, one] = turn[two, two] = math.cos(angle)
        turn[one, two], turn[two, one] = math.sin(angle), -math.sin(angle)
        matrix = turn @ matrix
    assert euler_turns("", sequence, np.array(angles)).inv().as_matrix() == pytest.approx(matrix, abs=1e-15)


def test_frames_may_be_exchanged_and_rates_in_either(tmp_path: Path) -> None:
    """The transformation from the body to ICRF, with the rate of ICRF relative to the body in both frames."""
    for frame in ("INSTRUMENT_A", "ICRF"):
        rows = []
        for date, q, state in zip(dates(TIMES), SHUSTER, STATES, strict=True):
            rate = -np.degrees(state.rate_rad_s)
            if frame == "ICRF":
                rate = state.attitude.matrix.T @ rate
            rows.append(" ".join((date, *map(repr, (*map(float, -q[:3]), float(q[3]), *map(float, rate))))))
        text = aem(rows=rows, REF_FRAME_A="INSTRUMENT_A", REF_FRAME_B="ICRF", ANGVEL_FRAME=frame)
        assert worst_arcsec(read_truth_file(write(tmp_path, text)), TIMES) < MICROARCSECOND


def test_a_quaternion_in_the_wrong_sense_is_rejected_by_its_rates(tmp_path: Path) -> None:
    wrong = []
    for row in aem().splitlines()[9:-1]:
        date, x, y, z, *rest = row.split()
        wrong.append(" ".join((date, *(repr(-float(v)) for v in (x, y, z)), *rest)))
    with pytest.raises(
        EmulatorError, match=r"segment 1, row \d+: rate contradicts the quaternion, .* sense or its frames"
    ):
        read_truth_file(write(tmp_path, aem(rows=wrong)))
    q, rate = SHUSTER[0], np.array([0.0, 0.1, 0.0])
    turned = [
        Attitude(q * [-1, -1, -1, 1]).rotated(-np.radians(rate) * t).quaternion_xyzw * [-1, -1, -1, 1]
        for t in range(5)
    ]
    lines = [" ".join(map(repr, map(float, (t, *each, *rate)))) for t, each in enumerate(turned)]
    head = "stk.v.11.0\nBEGIN Attitude\nScenarioEpoch 20 Mar 2026 12:00:00.0\nCoordinateAxes ICRF\nAttitudeTimeQuatAngVels\n"
    with pytest.raises(EmulatorError, match="rate contradicts the quaternion"):
        read_truth_file(write(tmp_path, head + "\n".join(lines) + "\nEND Attitude\n"))
    right = (
        head + "\n".join(" ".join((*line.split()[:6], "-0.1", "0.0")) for line in lines) + "\nEND Attitude\n"
    )
    assert len(read_truth_file(write(tmp_path, right)).attitudes) == 5


STK_HEAD = "stk.v.12.0\nBEGIN Attitude\n"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (aem(REF_FRAME_A="TOD"), "frame 'TOD' is not known; known: ICRF"),
        (aem(REF_FRAME_A="ICRF", REF_FRAME_B="EME2000"), "both frames are inertial"),
        (aem(TIME_SYSTEM="MET"), "time system 'MET' is not known; known: UTC, TAI"),
        (aem(ATTITUDE_TYPE="SPIN"), "ATTITUDE_TYPE 'SPIN' is not read; known: QUATERNION"),
        (aem().replace("VERS = 2.0", "VERS = 1.0"), "of version 1, only ATTITUDE_TYPE QUATERNION is read"),
        (aem(ANGVEL_FRAME="RTN"), "ANGVEL_FRAME 'RTN' is neither"),
        (aem(ANGVEL_FRAME=""), "ANGVEL_FRAME is missing"),
        (aem("QUATERNION"), "7 numbers in a row of QUATERNION, which has 4"),
        (aem("QUATERNION", [f"{START} 0 0 0 2"]), "quaternion is not of length 1"),
        (aem("QUATERNION", [f"{START} 0 0 0 1e200"]), "a number is outside ±1e+06"),
        (aem("QUATERNION", [f"{START} 0 0 0 x"]), "line 10: must be a date and numbers"),
        (aem("QUATERNION", ["20.3.2026 0 0 0 1"]), "not a date"),
        (aem("QUATERNION", [f"{START} 0 0 0 1"] * 2), "a date is not later"),
        (aem("QUATERNION", []), "no rows"),
        ("CCSDS_OEM_VERS = 2.0\nMETA_START\n", "not a CCSDS AEM"),
        ("<html/>", "not a CCSDS AEM"),
        ("<aem", "not XML"),
        ("<!DOCTYPE aem [<!ENTITY a 'b'>]><aem>&a;</aem>", "has a DOCTYPE, which no CCSDS message has; remove it"),
        (STK_HEAD + "CoordinateAxes Fixed\nScenarioEpoch 1 Jan 2026 0:00:00\nAttitudeTimeQuaternions\n0 0 0 0 1\n", "frame 'Fixed'"),
        (STK_HEAD + "ScenarioEpoch 1 Jan 2026 0:00:00\nAttitudeTimeYPRAngles\n", "format 'AttitudeTimeYPRAngles' is not read"),
        (STK_HEAD + "TimeFormat UTCG\nAttitudeTimeQuaternions\n", "needs a ScenarioEpoch and times in seconds"),
        (STK_HEAD + "CoordinateAxes ICRF\nScenarioEpoch 1 Jan 2026 0:00:00\nAttitudeTimeQuaternions\n0 0 0 1\n", "3 numbers in a row of QUATERNION, which has 4"),
        (STK_HEAD, "no data of STK's kind 'Attitude'"),
        (aem("QUATERNION", ["2026-03-20T12:00:00.x 0 0 0 1"]), "not a date"),
        (aem("EULER_ANGLE", [f"{START} 0 0 0"], EULER_ROT_SEQ="ZQX"), "'ZQX' is not a sequence of three axes"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_obeyed_is_an_error_that_says_why(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(EmulatorError) as error:
        read_truth_file(write(tmp_path, text))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_declarations_in_xml_take_no_memory(tmp_path: Path) -> None:
    """Half a megabyte of default attributes took 17 GB in the process of a run, and held its interpreter meanwhile."""
    attributes = " ".join(f"b{number} CDATA ''" for number in range(5_000))
    text = f"<!DOCTYPE aem [<!ATTLIST a {attributes}>]><aem>{'<a/>' * 5_000}</aem>"
    path = write(tmp_path, text)
    begin_s = time.process_time()
    with pytest.raises(EmulatorError, match="has a DOCTYPE"):
        read_truth_file(path)
    assert time.process_time() - begin_s < 0.5  # two seconds with the attributes


# --- convert ---


def test_true_and_measured_attitudes_of_a_truth_log_are_converted(tmp_path: Path) -> None:
    names = ["qx", "qy", "qz", "qw"]
    columns = [
        "time_of_exposure_s",
        "run_time_s",
        *(f"true_{n}" for n in names),
        *(f"true_w{a}_deg_s" for a in "xyz"),
    ]
    lines = [",".join((*columns, *(f"measured_{n}" for n in names)))]
    for t, state in zip(TIMES[:10], STATES, strict=False):
        measured = state.attitude.rotated(np.array([0.0, 0.0, 1e-5])).quaternion_xyzw.tolist()
        cells = [
            START_UNIX_S + t,
            t,
            *state.attitude.quaternion_xyzw.tolist(),
            *np.degrees(state.rate_rad_s).tolist(),
        ]
        lines.append(",".join([*map(repr, cells), *(map(repr, measured) if t != 3.0 else [""] * 4)]))
    log = write(tmp_path, "\n".join(lines))
    for option, rows, error_arcsec in (((), 10, 0.0), (("--measured",), 9, 2.0626)):
        target = tmp_path / "out.aem"
        assert run_command_line("truth", "convert", str(log), "-o", str(target), *option) == (0, "", "")
        found = read_truth_file(target)
        assert (len(found.attitudes), found.start_unix_s) == (rows, pytest.approx(START_UNIX_S, abs=1e-9))
        assert worst_arcsec(found, [0.0, 1.0, 2.0, 4.0, 9.0]) == pytest.approx(error_arcsec, abs=1e-4)


def test_a_file_without_dates_is_converted_only_with_a_date(tmp_path: Path) -> None:
    file = write(tmp_path, "t,qx,qy,qz,qw\n0,0,0,0,1\n1,0,0,0,1\n")
    status, _, said = run_command_line("truth", "convert", str(file), "-o", str(tmp_path / "out.aem"))
    assert (status, "give --date" in said) == (2, True)
    target = str(tmp_path / "out.aem")
    assert run_command_line("truth", "convert", str(file), "-o", target, "--date", START)[0] == 0
    assert read_truth_file(Path(target)).start_unix_s == START_UNIX_S


def test_the_aem_of_the_docs_is_read_and_its_conjugate_rejected_as_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[3] / "docs" / "truth-files.md").read_text(encoding="utf-8")
    text = page.partition("```text\n")[2].partition("```")[0]
    monkeypatch.chdir(tmp_path)
    Path("slew.aem").write_text(text)
    truth = read_truth_file(Path("slew.aem"))
    assert truth.start_unix_s == unix_time("2026-03-20T12:00:00Z")
    assert np.degrees(truth.state(7.0).rate_rad_s) == pytest.approx([0.0, 0.2, 0.0])
    Path("slew.aem").write_text(
        text.replace(" 0.0 0.0174", " 0.0 -0.0174").replace(" 0.0 0.0523", " 0.0 -0.0523")
    )
    with pytest.raises(EmulatorError) as error:
        read_truth_file(Path("slew.aem"))
    assert f"    {error.value}\n" in page
