"""STK's external attitude (.a) and ephemeris (.e) files, as segments with the keywords of a CCSDS AEM or OEM.

A quaternion describes the transformation from CoordinateAxes to the body, as in an AEM; angular velocities are degrees per
second in the body frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.ccsds_file import Segment, attitudes_of, orbit_of
from starhil.emulator.truth.standard_frames import NANOSECONDS, unix_ns
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starid.files import read_number

STK: Final = "stk.v."
MAX_SECONDS: Final = 1e9
KILOMETRES: Final = {"meters": 1e-3, "meter": 1e-3, "m": 1e-3, "kilometers": 1.0, "kilometer": 1.0, "km": 1.0}

FORMATS: Final[dict[str, dict[str, str]]] = {
    "AttitudeTimeQuaternions": {"ATTITUDE_TYPE": "QUATERNION"},
    "AttitudeTimeQuatScalarFirst": {"ATTITUDE_TYPE": "QUATERNION", "QUATERNION_TYPE": "FIRST"},
    "AttitudeTimeQuatAngVels": {"ATTITUDE_TYPE": "QUATERNION/ANGVEL", "ANGVEL_FRAME": "BODY"},
    "AttitudeTimeEulerAngles": {"ATTITUDE_TYPE": "EULER_ANGLE"},
    "EphemerisTimePosVel": {},
    "EphemerisTimePosVelAcc": {},
}
"""Formats that are read, and the keywords that they stand for."""


def read_attitude(path: Path, text: str) -> FileTruth:
    """Read an attitude file."""
    return attitudes_of(path, [_read(f"truth file {path}", text, "Attitude")])


def read_ephemeris(path: Path, text: str) -> OrbitTable:
    """Read an ephemeris file about the Earth."""
    return orbit_of(path, [_read(f"orbit file {path}", text, "Ephemeris")])


def _read(where: str, text: str, what: str) -> Segment:
    """Read a file whose data have one of the known formats."""
    known = [name for name in FORMATS if name.startswith(what)]
    keywords: dict[str, str] = {}
    kind = ""
    rows: list[tuple[int, list[float]]] = []
    epoch_ns = 0
    for number, line in enumerate((each.partition("#")[0].strip() for each in text.splitlines()), 1):
        key, _, value = (part.strip() for part in line.replace("\t", " ").partition(" "))
        if key == "END":
            break
        if not kind and key.startswith(what) and not value:
            kind = key
            if kind not in known:
                raise EmulatorError(f"{where}: format {kind[:40]!r} is not read; known: {', '.join(known)}")
            if keywords.get("TimeFormat", "EpSec") != "EpSec" or "ScenarioEpoch" not in keywords:
                raise EmulatorError(f"{where}: needs a ScenarioEpoch and times in seconds (TimeFormat EpSec)")
            epoch_ns = unix_ns(where, keywords["ScenarioEpoch"])
        elif not kind:
            keywords[key] = value
        elif line:
            try:
                seconds, *numbers = [read_number(cell) for cell in line.split()]
            except ValueError:
                raise EmulatorError(f"{where} line {number}: not numbers") from None
            if abs(seconds) > MAX_SECONDS:
                raise EmulatorError(f"{where} line {number}: the time is outside ±{MAX_SECONDS:g} s")
            rows.append((epoch_ns + round(seconds * NANOSECONDS), numbers))
    if not kind:
        raise EmulatorError(f"{where}: no data of STK's kind {what!r}; known formats: {', '.join(known)}")
    if what == "Ephemeris":
        unit = keywords.get("DistanceUnit", "meters").lower()
        if unit not in KILOMETRES:
            raise EmulatorError(
                f"{where}: DistanceUnit {unit[:40]!r} is not known; known: {', '.join(KILOMETRES)}"
            )
        rows = [(at_ns, [KILOMETRES[unit] * number for number in numbers]) for at_ns, numbers in rows]
    translated = {
        "REF_FRAME_A": keywords.get("CoordinateAxes", "(none)"),
        "REF_FRAME_B": "BODY",
        "EULER_ROT_SEQ": keywords.get("Sequence", "(none)"),
        "REF_FRAME": keywords.get("CoordinateSystem", "(none)"),
        "CENTER_NAME": keywords.get("CentralBody", "Earth"),
    }
    return Segment(translated | FORMATS[kind], rows)
