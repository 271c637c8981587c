"""CCSDS attitude and orbit ephemerides: AEM (504.0-B, versions 1 and 2) and OEM (502.0-B), as KVN or XML.

Both notations are read into the same segments: a dictionary of keywords, and rows of a date and numbers. A quaternion
describes the transformation from REF_FRAME_A to REF_FRAME_B as an attitude matrix does, so that the one that rotates
vectors is its conjugate. One of the two frames must be inertial and known (`standard_frames`), the other is the body.

Nothing is interpolated from one segment to the next (504.0-B-2 4.2.4.8.3, 502.0-B-3 5.2.4.6). Segments may overlap if
their useable spans do not, but for a shared end. In version 1 the direction of the transformation and the place of the
scalar have no default, so that files without them are rejected; version 2 has only A to B, and the scalar last.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from xml.etree import ElementTree as ET

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_message import NORM_TOLERANCE
from starhil.emulator.truth.source import MAX_RATE_DEG_S
from starhil.emulator.truth.standard_frames import (
    Block,
    Row,
    euler_turns,
    icrs_to,
    is_inertial,
    orbit_of_rows,
    truth_of,
    unix_ns,
)
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.arithmetic.arrays import Array
from starid.arithmetic.matrices import lengths
from starid.attitude import Attitude
from starid.storage.files import read_number

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

log = logging.getLogger("starhil.truth")

TYPES: Final = {"QUATERNION": 4, "EULER_ANGLE": 3, "QUATERNION/ANGVEL": 7, "EULER_ANGLE/ANGVEL": 6}
"""Attitude types that are read, and the numbers in a row of each."""

DOCTYPE: Final = "<!DOCTYPE"
"""Begins declarations of entities and default attributes, which could make a small file take any amount of memory."""

MAX_NUMBER: Final = 1e6
"""Largest number in a row of attitudes; angles may exceed a turn."""

XML_ORDER: Final = {"EPOCH": 0, "Q1": 1, "Q2": 2, "Q3": 3, "QC": 4}
"""Elements that come first in a row, whatever their order in the file."""


T = TypeVar("T")


@dataclass
class Segment:
    """Keywords of the metadata, and rows of a Unix time, nanoseconds, and numbers."""

    keywords: dict[str, str]
    rows: list[tuple[int, list[float]]]


def is_ccsds(text: str) -> bool:
    return text.startswith(("CCSDS_", "<"))


def read_aem(path: Path, text: str) -> FileTruth:
    where = f"truth file {path}"
    version, segments = _segments(where, "AEM", text)
    for number, segment in enumerate(segments, 1):
        if version != "1":
            break
        if _keyword(f"{where}, segment {number}", segment, "ATTITUDE_TYPE").upper() != "QUATERNION":
            raise EmulatorError(f"{where}: of version 1, only ATTITUDE_TYPE QUATERNION is read")
        for key in ("ATTITUDE_DIR", "QUATERNION_TYPE"):
            _keyword(f"{where}, segment {number}", segment, key)
    return attitudes_of(path, segments)


def read_oem(path: Path, text: str) -> OrbitTable:
    """Read positions and velocities of an OEM about the Earth."""
    _, segments = _segments(f"orbit file {path}", "OEM", text)
    return orbit_of(path, segments)


def attitudes_of(path: Path, segments: Sequence[Segment]) -> FileTruth:
    """Return the truth of segments with the keywords of an AEM, in any notation."""
    blocks = []
    for number, segment in enumerate(segments, 1):
        where = f"truth file {path}, segment {number}"
        rows = _attitudes(where, segment)
        if rows:
            blocks.append(_block(where, segment, rows))
    methods = {segment.keywords.get("INTERPOLATION_METHOD", "").upper() for segment in segments}
    truth = truth_of(path, blocks, smooth="LINEAR" not in methods)
    if truth.rates_rad_s is None:
        log.warning(
            "truth file %s: has no rates, so the sense of its attitudes cannot be checked; "
            "compare one of them with its source",
            path,
        )
    return truth


def orbit_of(path: Path, segments: Sequence[Segment]) -> OrbitTable:
    """Return the orbit of segments with the keywords of an OEM, in any notation; km and km/s."""
    where = f"orbit file {path}"
    frames = {_keyword(where, segment, "REF_FRAME") for segment in segments}
    centres = {_keyword(where, segment, "CENTER_NAME").upper() for segment in segments}
    if len(frames) != 1 or centres != {"EARTH"}:
        raise EmulatorError(f"{where}: needs one reference frame, and the Earth as its centre")
    blocks = []
    for number, segment in enumerate(segments, 1):
        for size in {len(numbers) for _, numbers in segment.rows} - {6, 9}:
            raise EmulatorError(f"{where}: {size} numbers in a row; position and velocity are 6")
        rows = [[1e3 * number for number in numbers[:6]] for _, numbers in segment.rows]
        if rows:
            blocks.append(_block(f"{where}, segment {number}", segment, rows))
    return orbit_of_rows(path, icrs_to(where, frames.pop()), blocks)


def _block(where: str, segment: Segment, rows: Sequence[T]) -> Block[T]:
    """Return converted rows of a segment with its dates and its useable span."""
    usable = [
        unix_ns(where, segment.keywords[key], segment.keywords.get("TIME_SYSTEM", "UTC"))
        if key in segment.keywords
        else None
        for key in ("USEABLE_START_TIME", "USEABLE_STOP_TIME")
    ]
    return Block(where, [at_ns for at_ns, _ in segment.rows], rows, (usable[0], usable[1]))


def write_aem(truth: FileTruth, sensor: str) -> str:
    """Return the rows of a truth with dates as an AEM 2.0 (KVN), GCRF to the frame named `sensor`."""
    begin_ns = 1000 * round(1e6 * (truth.start_unix_s or 0.0))  # the resolution of such a float is 0.2 µs
    dates = [_date(begin_ns + round(t * NANOSECONDS)) for t in truth.times_s.tolist()]
    numbers = np.array([attitude.quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0] for attitude in truth.attitudes])
    kind, frame_of_rates = "QUATERNION", []
    if truth.rates_rad_s is not None:
        kind, frame_of_rates = "QUATERNION/ANGVEL", [f"ANGVEL_FRAME = {sensor}"]
        numbers = np.hstack((numbers, np.degrees(truth.rates_rad_s)))
    lines = ["CCSDS_AEM_VERS = 2.0", f"CREATION_DATE = {dates[0]}", "ORIGINATOR = starhil"]
    for span in truth.spans:
        start, stop = dates[span.first], dates[span.last]
        begin, end = (_date(begin_ns + round(t * NANOSECONDS)) for t in (span.begin_s, span.end_s))
        useable = [f"USEABLE_START_TIME = {begin}", f"USEABLE_STOP_TIME = {end}"]
        lines += [
            *("META_START", "OBJECT_NAME = STARHIL", "OBJECT_ID = UNKNOWN"),
            *("REF_FRAME_A = GCRF", f"REF_FRAME_B = {sensor}", "TIME_SYSTEM = UTC", f"START_TIME = {start}"),
            *(useable if (begin, end) != (start, stop) else ()),
            *(f"STOP_TIME = {stop}", f"ATTITUDE_TYPE = {kind}", *frame_of_rates, "META_STOP", "DATA_START"),
            *(
                " ".join((date, *map(repr, row)))
                for date, row in zip(dates[span.rows], numbers[span.rows].tolist(), strict=True)
            ),
            "DATA_STOP",
        ]
    return "\n".join(lines) + "\n"


def _attitudes(where: str, segment: Segment) -> list[Row]:
    from scipy.spatial.transform import Rotation

    kind = _keyword(where, segment, "ATTITUDE_TYPE").upper()
    if kind not in TYPES:
        raise EmulatorError(f"{where}: ATTITUDE_TYPE {kind[:40]!r} is not read; known: {', '.join(TYPES)}")
    frames = [_keyword(where, segment, f"REF_FRAME_{letter}") for letter in "AB"]
    of_a = is_inertial(frames[1])  # A is the body
    if of_a and is_inertial(frames[0]):
        raise EmulatorError(f"{where}: both frames are inertial; one must be the body")
    to_reference = icrs_to(where, frames[of_a])
    if not segment.rows:
        return []
    for size in {len(numbers) for _, numbers in segment.rows} - {TYPES[kind]}:
        raise EmulatorError(f"{where}: {size} numbers in a row of {kind}, which has {TYPES[kind]}")
    values, rates = np.array([numbers for _, numbers in segment.rows]), None
    if np.abs(values).max() > MAX_NUMBER:
        raise EmulatorError(f"{where}: a number is outside ±{MAX_NUMBER:g}")
    if kind.startswith("QUATERNION"):
        scalar_first = _choice(where, segment, "QUATERNION_TYPE", "LAST", "FIRST")
        quaternions, values = np.roll(values[:, :4], -1 if scalar_first else 0, axis=1), values[:, 4:]
        if not (np.abs(lengths(quaternions) - 1.0) <= NORM_TOLERANCE).all():
            raise EmulatorError(f"{where}: a quaternion is not of length 1")
        turns = Rotation.from_quat(quaternions)
    else:
        turns = euler_turns(where, _keyword(where, segment, "EULER_ROT_SEQ"), values[:, :3])
        values = values[:, 3:]
    is_inverse = _choice(where, segment, "ATTITUDE_DIR", "A2B", "B2A")
    to_body = turns if is_inverse != of_a else turns.inv()
    if kind.endswith("/ANGVEL"):
        rates = _rates_of_body(where, segment, np.radians(values), frames, to_body, of_a=of_a)
    quaternions = (to_body * to_reference).as_quat()
    return [
        Row(Attitude(quaternion), None if rates is None else rates[row])
        for row, quaternion in enumerate(quaternions)
    ]


def _rates_of_body(
    where: str, segment: Segment, rates: Array, frames: Sequence[str], to_body: Rotation, *, of_a: bool
) -> Array:
    """Return the rates (n, 3) of the body in its frame, from those of frame B relative to A in either frame."""
    frame = _keyword(where, segment, "ANGVEL_FRAME")
    if frame not in frames:
        raise EmulatorError(f"{where}: ANGVEL_FRAME {frame[:40]!r} is neither REF_FRAME_A nor REF_FRAME_B")
    if not np.degrees(np.abs(rates)).max() <= MAX_RATE_DEG_S * (1.0 + 1e-12):
        raise EmulatorError(f"{where}: a rate exceeds {MAX_RATE_DEG_S:g} degrees per second")
    turned: Array = rates if frame == frames[not of_a] else to_body.apply(rates)
    return -turned if of_a else turned


def _segments(where: str, kind: str, text: str) -> tuple[str, list[Segment]]:
    """Return the first digit of the version, and the segments."""
    read = _from_xml if text.startswith("<") else _from_kvn
    version, segments = read(where, kind, text)
    if version is None:
        raise EmulatorError(f"{where}: not a CCSDS {kind}")
    if not segments:
        raise EmulatorError(f"{where}: has no segment with metadata and data")
    return version[:1], segments


def _from_kvn(where: str, kind: str, text: str) -> tuple[str | None, list[Segment]]:
    version: str | None = None
    segments: list[Segment] = []
    in_covariance = False
    for number, line in enumerate((each.strip() for each in text.splitlines()), 1):
        key, equals, value = (part.strip() for part in line.partition("="))
        if key == f"CCSDS_{kind}_VERS":
            version = value
        elif key == "META_START":
            segments.append(Segment({}, []))
        elif key.endswith(("_START", "_STOP")):
            in_covariance = key == "COVARIANCE_START"
        elif not segments or in_covariance or not line or line.startswith("COMMENT"):
            continue
        elif equals:
            segments[-1].keywords[key] = value
        else:
            segments[-1].rows.append(_row(f"{where} line {number}", segments[-1].keywords, line.split()))
    return version, segments


def _from_xml(where: str, kind: str, text: str) -> tuple[str | None, list[Segment]]:
    if DOCTYPE in text:
        raise EmulatorError(f"{where}: has a DOCTYPE, which no CCSDS message has; remove it")
    try:
        root = ET.fromstring(text)  # noqa: S314 (without entities and default attributes)
    except (ET.ParseError, ValueError) as error:
        raise EmulatorError(f"{where}: not XML ({error})") from None
    message = next((node for node in root.iter() if _name(node) == kind.lower()), None)
    if message is None:
        return None, []
    segments = []
    for node in message.iter("segment"):
        keywords = {each.tag: (each.text or "").strip() for each in node.iterfind("metadata/*")}
        rows = []
        for state in node.iterfind("data/*"):
            if state.tag in ("attitudeState", "stateVector"):
                leaves = [each for each in state.iter() if len(each) == 0 and each.tag != "COMMENT"]
                leaves.sort(key=lambda leaf: XML_ORDER.get(leaf.tag, len(XML_ORDER)))
                rows.append(_row(where, keywords, [(leaf.text or "").strip() for leaf in leaves]))
        keywords["QUATERNION_TYPE"] = "LAST"  # the elements have names, by which they are ordered
        segments.append(Segment(keywords, rows))
    return message.get("version", ""), segments


def _name(node: Any) -> str:
    return re.sub(r"^\{.*\}", "", str(node.tag))


def _row(where: str, keywords: dict[str, str], cells: list[str]) -> tuple[int, list[float]]:
    try:
        date, *numbers = cells
        values = [read_number(number) for number in numbers]
    except ValueError:
        raise EmulatorError(f"{where}: must be a date and numbers") from None
    return unix_ns(where, date, keywords.get("TIME_SYSTEM", "(none)")), values


def _keyword(where: str, segment: Segment, key: str) -> str:
    if key not in segment.keywords:
        raise EmulatorError(f"{where}: {key} is missing")
    return segment.keywords[key]


def _choice(where: str, segment: Segment, key: str, default: str, other: str) -> bool:
    """Return whether a keyword has its other value instead of the default one."""
    value = segment.keywords.get(key, default).upper()
    if value not in (default, other):
        raise EmulatorError(f"{where}: {key} must be {default} or {other}")
    return value == other


def _date(at_ns: int) -> str:
    whole, rest = divmod(at_ns, NANOSECONDS)
    return f"{datetime.fromtimestamp(whole, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}"
