"""STK's external attitude (.a) and ephemeris (.e) files, as segments with the keywords of a CCSDS AEM or OEM.

A quaternion describes the transformation from CoordinateAxes to the body, as in an AEM; angular velocities are degrees per
second in the body frame. Keywords may have any case. Over a segment boundary nothing is interpolated: the rows before and
after it are segments, which share the row at the boundary, or have one each if there are two.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.ccsds_file import Segment, attitudes_of, orbit_of
from starhil.emulator.truth.standard_frames import unix_ns
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.storage.files import read_number

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


BOUNDARIES: Final = "segmentboundarytimes"


def read_attitude(path: Path, text: str) -> FileTruth:
    return attitudes_of(path, _read(f"truth file {path}", text, "Attitude"))


def read_ephemeris(path: Path, text: str) -> OrbitTable:
    """Read an ephemeris file about the Earth."""
    return orbit_of(path, _read(f"orbit file {path}", text, "Ephemeris"))


def _read(where: str, text: str, what: str) -> list[Segment]:
    """Read a file whose data have one of the known formats."""
    formats = {name.lower(): name for name in FORMATS if name.startswith(what)}
    keywords: dict[str, str] = {}
    kind = ""
    groups: list[str] = []
    rows: list[tuple[int, list[float]]] = []
    boundaries_ns: list[int] = []
    for number, line in enumerate((each.partition("#")[0].strip() for each in text.splitlines()), 1):
        key, _, value = (part.strip() for part in line.replace("\t", " ").partition(" "))
        if key.upper() == "BEGIN":
            groups.append(value.lower())
        elif key.upper() == "END":
            if not groups[1:]:
                break
            groups.pop()
        elif groups[1:]:
            if groups[-1] == BOUNDARIES and line:
                boundaries_ns.append(_times_and_numbers(f"{where} line {number}", line)[0])
        elif not kind and key.startswith(what) and not value:
            kind = formats.get(key.lower(), "")
            if not kind:
                raise EmulatorError(
                    f"{where}: format {key[:40]!r} is not read; known: {', '.join(formats.values())}"
                )
            if keywords.get("timeformat", "EpSec") != "EpSec" or "scenarioepoch" not in keywords:
                raise EmulatorError(f"{where}: needs a ScenarioEpoch and times in seconds (TimeFormat EpSec)")
        elif not kind:
            keywords[key.lower()] = value
        elif line:
            rows.append(_times_and_numbers(f"{where} line {number}", line))
    if not kind:
        raise EmulatorError(
            f"{where}: no data of STK's kind {what!r}; known formats: {', '.join(formats.values())}"
        )
    if what == "Ephemeris":
        factor = _kilometres(where, keywords.get("distanceunit", "meters").lower())
        rows = [(since_ns, [factor * number for number in numbers]) for since_ns, numbers in rows]
    translated = {
        "REF_FRAME_A": keywords.get("coordinateaxes", "(none)"),
        "REF_FRAME_B": "BODY",
        "EULER_ROT_SEQ": keywords.get("sequence", "(none)"),
        "REF_FRAME": keywords.get("coordinatesystem", "(none)"),
        "CENTER_NAME": keywords.get("centralbody", "Earth"),
    }
    epoch_ns = unix_ns(where, keywords["scenarioepoch"])
    return [
        Segment(translated | FORMATS[kind], [(epoch_ns + since_ns, numbers) for since_ns, numbers in part])
        for part in _split(rows, sorted(boundaries_ns))
    ]


def _kilometres(where: str, unit: str) -> float:
    """Return a unit of distance, km."""
    if unit not in KILOMETRES:
        raise EmulatorError(
            f"{where}: DistanceUnit {unit[:40]!r} is not known; known: {', '.join(KILOMETRES)}"
        )
    return KILOMETRES[unit]


def _times_and_numbers(where: str, line: str) -> tuple[int, list[float]]:
    """Return the time of a line, nanoseconds from the epoch, and the numbers after it."""
    try:
        seconds, *numbers = [read_number(cell) for cell in line.split()]
    except ValueError:
        raise EmulatorError(f"{where}: not numbers") from None
    if abs(seconds) > MAX_SECONDS:
        raise EmulatorError(f"{where}: the time is outside ±{MAX_SECONDS:g} s")
    return round(seconds * NANOSECONDS), numbers


def _split(
    rows: list[tuple[int, list[float]]], boundaries_ns: list[int]
) -> Iterator[list[tuple[int, list[float]]]]:
    """Split rows at increasing times: of the rows at a time, the first ends a part, and the last begins the next."""
    begin = 0
    for at_ns in boundaries_ns:
        before = bisect_left(rows, at_ns, begin, key=lambda row: row[0])
        after = bisect_right(rows, at_ns, begin, key=lambda row: row[0])
        if before > begin and after < len(rows):
            has_row = after > before
            yield rows[begin : before + has_row]
            begin = after - has_row
    yield rows[begin:]
