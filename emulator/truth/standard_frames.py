"""Reference frames, dates and rates as standard files name them."""

from __future__ import annotations

from calendar import timegm
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from time import strptime
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_rates import FeedError, FeedRates
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.plausibility import doubt_between, doubt_of_orbit
from starhil.emulator.truth.source import Vector
from starhil.emulator.truth.table import FileTruth, OrbitTable, Span
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.catalog.earth import utc_of_tai

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

ICRS_NAMES: Final = ("ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "ICRS", "GCRS")
J2000_NAMES: Final = ("EME2000", "J2000")
"""Mean equator and equinox of J2000, which differ from ICRS by the frame bias of 23 milliarcseconds."""

TAI_MINUS: Final = {"TAI": 0.0, "TT": 32.184, "TDT": 32.184, "TDB": 32.184, "GPS": -19.0}
"""Label of a time scale minus TAI, seconds; TDB is within 2 ms of TT."""

MAX_METRES: Final = 1e12
"""Largest distance in an orbit file, m, and speed, m/s."""

DATES: Final = ("%Y-%m-%dT%H:%M:%S", "%Y-%jT%H:%M:%S", "%d %b %Y %H:%M:%S")
"""ISO 8601 with month or day of year, and STK's."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a file with dates: attitude ICRS→body, body rate in rad/s, position and velocity in GCRS."""

    attitude: Attitude
    rate_rad_s: Vector | None = None
    orbit: OrbitState | None = None


T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True)
class Block(Generic[T_co]):
    """Rows of a motion without interruption, with their dates, at least one."""

    where: str
    """File and segment, for messages."""
    dates_ns: Sequence[int]
    """Unix times, nanoseconds."""
    rows: Sequence[T_co]
    usable_ns: tuple[int | None, int | None] = (None, None)
    """Dates from which and to which the block holds, if some rows only support the interpolation."""


@lru_cache
def icrs_to(where: str, frame: str) -> Rotation:
    """Return the rotation from ICRS to an inertial frame; EmulatorError names one that is not known."""
    import erfa
    from scipy.spatial.transform import Rotation

    if frame.upper() in ICRS_NAMES:
        return Rotation.identity()
    if frame.upper() in J2000_NAMES:
        return Rotation.from_matrix(erfa.bp06(2_451_545.0, 0.0)[0])
    known = ", ".join((*ICRS_NAMES, *J2000_NAMES))
    raise EmulatorError(f"{where}: frame {frame[:40]!r} is not known; known: {known}")


def is_inertial(frame: str) -> bool:
    """Whether a frame is one of those of `icrs_to`."""
    return frame.upper() in (*ICRS_NAMES, *J2000_NAMES)


def unix_ns(where: str, text: str, scale: str = "UTC") -> int:
    """Return the Unix time of a date, nanoseconds: ISO 8601 with month or day of year, or as STK writes it."""
    whole_text, _, fraction = text.removesuffix("Z").partition(".")
    for form in DATES:
        with suppress(ValueError):
            whole = timegm(strptime(whole_text, form))
            label_ns = whole * NANOSECONDS + int((fraction + "0" * 9)[:9])
            break
    else:
        raise EmulatorError(f"{where}: not a date, e.g. 2026-03-20T12:00:00.0")
    if scale.upper() == "UTC":
        return label_ns
    if scale.upper() not in TAI_MINUS:
        known = ", ".join(("UTC", *TAI_MINUS))
        raise EmulatorError(f"{where}: time system {scale[:40]!r} is not known; known: {known}")
    tai_s = whole - TAI_MINUS[scale.upper()]
    return label_ns + round((utc_of_tai(tai_s) - whole) * NANOSECONDS)


def truth_of(path: Path, blocks: Sequence[Block[Row]], *, smooth: bool) -> FileTruth:
    """Return the truth of the blocks of a file.

    EmulatorError if dates do not increase, blocks overlap, or rates contradict attitudes: the quaternion has the wrong
    sense.
    """
    if not blocks:
        raise EmulatorError(f"truth file {path}: no rows")
    spans_ns = _spans_ns(blocks)
    zero_ns = spans_ns[0][0]
    for block in blocks:
        _check_sense(block)
    rows = [row for block in blocks for row in block.rows]
    rates = [row.rate_rad_s for row in rows if row.rate_rad_s is not None]
    orbit = [row.orbit for row in rows if row.orbit is not None]
    return FileTruth(
        np.array([date_ns - zero_ns for block in blocks for date_ns in block.dates_ns]) / NANOSECONDS,
        [row.attitude for row in rows],
        np.array(rates) if len(rates) == len(rows) else None,
        orbit if len(orbit) == len(rows) else None,
        spans=_spans(blocks, [tuple(ns - zero_ns for ns in span) for span in spans_ns]),
        smooth=smooth,
        start_unix_s=zero_ns / NANOSECONDS,
    )


def _check_sense(block: Block[Row]) -> None:
    """EmulatorError if the rates of a block contradict its attitudes."""
    check = FeedRates(timed=True)
    for number, (date_ns, row) in enumerate(zip(block.dates_ns, block.rows, strict=True), 1):
        try:
            check.body_rate((date_ns - block.dates_ns[0]) / NANOSECONDS, row.attitude, row.rate_rad_s)
        except FeedError as error:
            fault = str(error).partition("; ")[0].replace("q,", "the quaternion,")
            raise EmulatorError(
                f"{block.where}, row {number}: {fault}; its sense or its frames are wrong"
            ) from None


def orbit_of_rows(path: Path, frame: Rotation, blocks: Sequence[Block[Sequence[float]]]) -> OrbitTable:
    """Return the orbit of blocks of x, y, z, vx, vy, vz (m, m/s) in the frame to which `frame` turns ICRS."""
    if not blocks:
        raise EmulatorError(f"orbit file {path}: no rows")
    spans_ns = _spans_ns(blocks)
    times = np.array([date_ns for block in blocks for date_ns in block.dates_ns]) / NANOSECONDS
    values = np.array([row for block in blocks for row in block.rows], dtype=np.float64)
    if np.abs(values).max() > MAX_METRES:
        raise EmulatorError(f"orbit file {path}: a number is outside ±{MAX_METRES:g}")
    turned = [frame.inv().apply(values[:, first : first + 3]) for first in (0, 3)]
    states = [OrbitState(*pair) for pair in zip(*turned, strict=True)]
    for state in states:
        doubt = doubt_of_orbit(state)
        if doubt:
            raise EmulatorError(f"orbit file {path}: {doubt}")
    spans = _spans(blocks, spans_ns)
    for span in spans:
        for row in range(span.first, span.last):
            doubt = doubt_between(states[row], states[row + 1], float(times[row + 1] - times[row]))
            if doubt:
                raise EmulatorError(f"orbit file {path}: row {row + 1}: {doubt}")
    return OrbitTable(path, times, states, spans)


def _spans_ns(blocks: Sequence[Block[Any]]) -> list[tuple[int, int]]:
    """Return the dates from which and to which each block holds; EmulatorError if their order is wrong."""
    spans: list[tuple[int, int]] = []
    for block in blocks:
        dates = block.dates_ns
        if any(late <= early for early, late in pairwise(dates)):
            raise EmulatorError(f"{block.where}: a date is not later than the one before")
        start, stop = block.usable_ns
        begin = dates[0] if start is None else max(start, dates[0])
        end = dates[-1] if stop is None else min(stop, dates[-1])
        if begin > end:
            raise EmulatorError(f"{block.where}: no row is between USEABLE_START_TIME and USEABLE_STOP_TIME")
        if spans and begin < spans[-1][1]:
            raise EmulatorError(
                f"{block.where}: overlaps the segment before; "
                "in a CCSDS file, USEABLE_START_TIME and USEABLE_STOP_TIME keep them apart"
            )
        spans.append((begin, end))
    return spans


def _spans(blocks: Sequence[Block[Any]], spans_ns: Sequence[Sequence[int]]) -> list[Span]:
    """Return the spans of the rows of blocks one after the other, in seconds."""
    firsts = [0, *accumulate(len(block.rows) for block in blocks)]
    return [
        Span(first, after - 1, begin / NANOSECONDS, end / NANOSECONDS)
        for (first, after), (begin, end) in zip(pairwise(firsts), spans_ns, strict=True)
    ]


def euler_turns(where: str, sequence: str, angles_deg: Array) -> Rotation:
    """Return the rotations by successive turns (n, 3) of the frame about its axes: XYZ, or digits."""
    from scipy.spatial.transform import Rotation

    try:
        return Rotation.from_euler(
            sequence.upper().translate(str.maketrans("123", "XYZ")), angles_deg, degrees=True
        )
    except ValueError:
        raise EmulatorError(f"{where}: {sequence[:40]!r} is not a sequence of three axes") from None
