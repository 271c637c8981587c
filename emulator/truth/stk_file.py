"""STK's external attitude (.a) and ephemeris (.e) files.

A quaternion describes the transformation from CoordinateAxes to the body as an attitude matrix does, so that the one
that rotates vectors is its conjugate; angular velocities are degrees per second in the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_message import checked_attitude, checked_rate
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.standard_frames import (
    NANOSECONDS,
    Row,
    body_attitude,
    euler_turn,
    icrs_to,
    orbit_of_rows,
    truth_of,
    unix_ns,
)
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starid.files import read_number

STK: Final = "stk.v."

ATTITUDES: Final = {
    "AttitudeTimeQuaternions": 4,
    "AttitudeTimeQuatScalarFirst": 4,
    "AttitudeTimeQuatAngVels": 7,
    "AttitudeTimeEulerAngles": 3,
}
"""Formats that are read, and the numbers after the time in a row of each."""

EPHEMERIDES: Final = {"EphemerisTimePosVel": 6, "EphemerisTimePosVelAcc": 9}

MAX_SECONDS: Final = 1e9

METRES: Final = {"meters": 1.0, "meter": 1.0, "m": 1.0, "kilometers": 1e3, "kilometer": 1e3, "km": 1e3}


@dataclass(frozen=True)
class Content:
    """Format and keywords of a file, and its rows: Unix time in nanoseconds and numbers."""

    kind: str
    keywords: dict[str, str]
    dates_ns: list[int]
    rows: list[list[float]]


def read_attitude(path: Path, text: str) -> FileTruth:
    """Read an attitude file."""
    where = f"truth file {path}"
    content = _read(where, text, "Attitude", ATTITUDES)
    to_axes = icrs_to(where, content.keywords.get("CoordinateAxes", "(none)"))
    rows = []
    for at_ns, numbers in zip(content.dates_ns, content.rows, strict=True):
        rate = None
        try:
            if content.kind == "AttitudeTimeEulerAngles":
                turn = euler_turn(where, content.keywords.get("Sequence", "(none)"), np.array(numbers))
            else:
                scalar_first = content.kind == "AttitudeTimeQuatScalarFirst"
                turn = checked_attitude(
                    "quaternion", np.roll(numbers[:4], -1 if scalar_first else 0), "attitude"
                )
            if content.kind == "AttitudeTimeQuatAngVels":
                rate = checked_rate("rate", np.radians(numbers[4:]))
        except FeedError as error:
            raise EmulatorError(f"{where}: {error}") from None
        rows.append(Row(at_ns, body_attitude(to_axes, turn), rate))
    return truth_of(path, [rows], smooth=True)


def read_ephemeris(path: Path, text: str) -> OrbitTable:
    """Read an ephemeris file about the Earth."""
    where = f"orbit file {path}"
    content = _read(where, text, "Ephemeris", EPHEMERIDES)
    unit = content.keywords.get("DistanceUnit", "meters").lower()
    if unit not in METRES or content.keywords.get("CentralBody", "Earth") != "Earth":
        raise EmulatorError(f"{where}: needs Earth as CentralBody, and meters or kilometers as DistanceUnit")
    frame = icrs_to(where, content.keywords.get("CoordinateSystem", "(none)"))
    rows = [[METRES[unit] * number for number in numbers[:6]] for numbers in content.rows]
    return orbit_of_rows(path, frame, content.dates_ns, rows)


def _read(where: str, text: str, what: str, known: dict[str, int]) -> Content:
    """Read a file whose data have one of the known formats."""
    keywords: dict[str, str] = {}
    kind = ""
    dates: list[int] = []
    rows: list[list[float]] = []
    epoch_ns = 0
    for number, line in enumerate((each.partition("#")[0].strip() for each in text.splitlines()), 1):
        key, _, value = (part.strip() for part in line.replace("\t", " ").partition(" "))
        if key == "END":
            break
        if not kind and key.startswith(f"{what}") and not value:
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
            if abs(seconds) > MAX_SECONDS or len(numbers) != known[kind]:
                raise EmulatorError(
                    f"{where} line {number}: {len(numbers)} numbers after the time, not {known[kind]}"
                )
            dates.append(epoch_ns + round(seconds * NANOSECONDS))
            rows.append(numbers)
    if not kind:
        raise EmulatorError(f"{where}: no data of STK's kind {what!r}; known formats: {', '.join(known)}")
    return Content(kind, keywords, dates, rows)
