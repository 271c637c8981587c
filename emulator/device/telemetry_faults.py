"""Faults in the content of telemetry: what a row reports is wrong, on every link, at the place where it becomes bytes.

::

    Snapshot ──`seen`──► Snapshot ──row──► bytes ──`changed`──► bytes ──Reply──`sent`──► replies
             freeze, turn, jump, stale                set, offset, nan, …            wrong ID, check, doubled, …

A fault affects messages of a row, or of all telemetry, in a pattern of time, with a probability, or a number of them.
Its effects are independent of link and unit: the first stage changes what the device knows, the second the fields of
the row, the third the message around it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.pipeline.messages import as_quaternion, as_triple
from starhil.emulator.simulation.config_model import Strict
from starhil.protocol.errors import ProtocolError, remedy
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field as RowField
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.icd.values import FieldError, Value
from starhil.protocol.messages import Flaw, Reply
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import cos, sin
from starid.attitude import Attitude

MAX_FAULTS: Final = 32
"""Most faults of telemetry at a time."""
Duration = Annotated[float, Field(ge=0.0, le=1e7)]
Names = Annotated[list[str], Field(default_factory=list, max_length=100)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
VECTOR_PART: Final = frozenset(
    f"attitude.{part}{axis}" for part in ("", "rotation_", "gibbs_", "mrp_") for axis in "xyz"
)
"""Quantities whose sign is that of the direction of the rotation."""


def nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


class TelemetryFault(Strict):
    """A fault in the content of telemetry."""

    row: str | None = None
    """Name of the telemetry row; for a telecommand, its answer; `start_burst`: the packets of a burst. Omitted: all
    telemetry that has the fields."""
    probability: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    """Probability that a message is affected."""
    count: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Number of messages to affect, after which the fault ends; omitted: no limit."""
    after_s: Duration = 0.0
    """Time from the injection to the beginning of the fault."""
    for_s: Duration | None = None
    """Duration, in each period if `every_s` is given; omitted: no limit."""
    every_s: Duration | None = None
    """Period in which the fault returns."""
    freeze: Literal["attitude", "all"] | None = None
    """What stays as in the first affected message: `attitude` (with its rates, stars, covariance and validity, while
    counters and times go on) or `all`."""
    turn_deg: Annotated[list[Angle], Field(min_length=3, max_length=3)] | None = None
    """Turn the attitude and the star vectors by these angles about x, y and z of the sensor (a rotation vector); all flags stay good."""
    jump_deg: Annotated[float, Field(ge=0.0, le=180.0)] = 0.0
    """Turn them by this angle about an axis that is random for each image."""
    stale_s: Duration = 0.0
    """Report times of exposure that are this much too old."""
    set: Annotated[dict[str, bool | int | float | str], Field(default_factory=dict, max_length=100)]
    """Value by field, also outside its limits: in its unit, the name or number of a member, bytes in hexadecimal."""
    offset: Annotated[dict[str, float], Field(default_factory=dict, max_length=100)]
    """Number that is added, by field, in its unit."""
    nan: Names
    """Fields (floats) that are not a number."""
    negate: Names
    """Fields with the opposite sign."""
    conjugate: bool = False
    """The inverse rotation: quaternion or rotation vector with the opposite vector part."""
    answer_with: str | None = None
    """Name of another telemetry row, whose ID and data are sent instead."""
    wrong_id: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    """ID that is sent instead of the row's; on CANopen, the CAN ID."""
    wrong_sequence: bool = False
    """A sequence number too large by one: in the header, the last segment's counter on CAN, the toggle bit of an SDO segment."""
    wrong_check: bool = False
    """A wrong checksum in an otherwise well-formed message on a serial line that has one."""
    truncate: Annotated[int, Field(ge=0, le=4096)] = 0
    """Number of bytes of data that are missing at the end of a well-formed message, or of the frame on CANopen."""
    duplicate: bool = False
    """Sent twice."""
    drop: bool = False
    """Not sent."""

    @model_validator(mode="after")
    def _check_whole(self) -> Self:
        if not self.effects:
            raise ValueError(f"does nothing; give one of {', '.join(EFFECTS)}")
        if self.every_s is not None and not (self.for_s and self.for_s < self.every_s):
            raise ValueError("every_s: needs for_s, shorter than it")
        return self

    @property
    def effects(self) -> frozenset[str]:
        """Keys of what is wrong."""
        return frozenset(name for name in EFFECTS if getattr(self, name) != _DEFAULTS[name])

    def is_on(self, since_ns: int) -> bool:
        """Return whether the fault is on at a time since its injection, nanoseconds."""
        begun_ns = since_ns - nanoseconds(self.after_s)
        if begun_ns < 0:
            return False
        if self.every_s is not None:
            begun_ns %= nanoseconds(self.every_s)
        return self.for_s is None or begun_ns < nanoseconds(self.for_s)


_PATTERN: Final = ("row", "probability", "count", "after_s", "for_s", "every_s")
EFFECTS: Final = tuple(name for name in TelemetryFault.model_fields if name not in _PATTERN)
"""Keys of `TelemetryFault` that say what is wrong; the others say when."""
_DEFAULTS: Final = {
    name: TelemetryFault.model_fields[name].get_default(call_default_factory=True) for name in EFFECTS
}
MESSAGE_EFFECTS: Final = frozenset(
    ("answer_with", "wrong_id", "wrong_sequence", "wrong_check", "truncate", "duplicate", "drop")
)
"""Those that concern the message around the data of a row, also of the answer to a telecommand."""
MESSAGE_PARTS: Final = {"wrong_id": "id", "wrong_sequence": "sequence", "wrong_check": "check"}
"""What the messages of a link must carry for an effect."""


class Injected:
    """A fault of telemetry that was injected at a simulation time."""

    def __init__(self, fault: TelemetryFault, at_ns: int, seed: str) -> None:
        self.fault = fault
        self._at_ns = at_ns
        self._seed = seed
        self._random = random.Random(seed)  # noqa: S311 (faults, not secrets)
        self._affected = 0
        self._held: Snapshot | None = None
        """The device at the first affected message since the fault is on."""

    def affects(self, snapshot: Snapshot, *, counted: bool) -> bool:
        """Return whether a message of this moment is affected; one that is not `counted` changes nothing."""
        fault = self.fault
        on = fault.is_on(snapshot.now_ns - self._at_ns)
        if not on or (fault.count is not None and self._affected >= fault.count):
            self._held = None if counted else self._held
            return False
        if not counted:
            return True
        if fault.probability < 1.0 and self._random.random() >= fault.probability:
            return False
        self._affected += 1
        if self._held is None and (
            fault.freeze == "all" or (snapshot.frame is not None and snapshot.frame.valid)
        ):
            self._held = snapshot
        return True

    def seen(self, snapshot: Snapshot) -> Snapshot:
        """Return what the device believes instead of a snapshot."""
        fault, past, frame = self.fault, self._held or snapshot, snapshot.frame
        if fault.freeze == "all":
            return past
        if frame is None:
            return snapshot
        if fault.freeze == "attitude" and past.frame is not None:
            frame = _with_attitude_of(past.frame, frame)
        if fault.turn_deg is not None:
            frame = _turned(frame, np.radians(fault.turn_deg))
        if fault.jump_deg:
            frame = _turned(frame, math.radians(fault.jump_deg) * self._axis(frame.counter))
        stale_ns = nanoseconds(fault.stale_s)
        if stale_ns:
            frame = replace(frame, mid_ns=frame.mid_ns - stale_ns, mid_unix_ns=frame.mid_unix_ns - stale_ns)
        return snapshot if frame is snapshot.frame else replace(snapshot, frame=frame)

    def _axis(self, counter: int) -> Array:
        """Return the random unit vector (3,) of an image, the same in each of its messages."""
        one = random.Random(f"{self._seed} {counter}")  # noqa: S311
        z, angle = one.uniform(-1.0, 1.0), one.uniform(-math.pi, math.pi)
        across = math.sqrt(1.0 - z * z)
        return np.array([across * cos(angle), across * sin(angle), z])

    def changed(self, row: Row, data: bytes) -> bytes:
        fields = row.named_fields
        values = row.decode(data)
        changes = _changes(self.fault, fields, values)
        if not changes:
            return data
        return row.encode({**values, **changes}, check=False)

    def sent(self, reply: Reply, row_of: Callable[[str], tuple[Row, bytes]]) -> list[Reply]:
        """Return the messages that are sent instead of one; `row_of` returns a row by its name, and its data."""
        fault = self.fault
        if fault.drop:
            return []
        if fault.answer_with is not None:
            row, data = row_of(fault.answer_with)
            reply = replace(reply, id=row.id, message_class=row.message_class, data=data)
        if fault.wrong_id is not None:
            reply = replace(reply, id=fault.wrong_id)
        if fault.truncate:
            reply = replace(reply, data=reply.data[: -fault.truncate])
        flaw = (Flaw.CHECK if fault.wrong_check else Flaw.NONE) | (
            Flaw.SEQUENCE if fault.wrong_sequence else Flaw.NONE
        )
        reply = replace(reply, flaw=reply.flaw | flaw)
        return [reply, reply] if fault.duplicate else [reply]


Hits: TypeAlias = Sequence[Injected]
"""The faults that affect a message."""


class TelemetryFaults:
    """The faults of telemetry of a device."""

    def __init__(self, icd: InterfaceDefinition, seed: int) -> None:
        self._icd = icd
        self._seed = seed
        self._number = 0
        """Faults injected so far, for their random numbers."""
        self._injected: list[Injected] = []

    @property
    def settings(self) -> list[TelemetryFault]:
        return [each.fault for each in self._injected]

    def inject(self, faults: Sequence[TelemetryFault], now_ns: int) -> None:
        self._injected = []
        for fault in faults:
            self._number += 1
            self._injected.append(Injected(fault, now_ns, f"telemetry {self._seed} {self._number}"))

    def hits(
        self, row: Row | None, snapshot: Snapshot, *, counted: bool = True, packet: bool = False
    ) -> Hits:
        """Return the faults that affect a message of a row at this moment, or a packet that its action sends.

        A message to the console, which is not `counted`, shows a fault that is on, and changes nothing for others.
        """
        if not self._injected or row is None:
            return ()
        return [
            each
            for each in self._injected
            if _concerns(each.fault, row, packet=packet) and each.affects(snapshot, counted=counted)
        ]

    def check(self, fault: TelemetryFault, shown: Mapping[str, frozenset[str]]) -> None:
        """Raise EmulatorError if a fault can never have an effect; `shown` is what messages carry, by link."""
        icd, rows = self._icd, {**self._icd.telemetry, **self._icd.telecommands}
        for key, name, known in (("row", fault.row, rows), ("answer_with", fault.answer_with, icd.telemetry)):
            if name is not None and name not in known:
                what = "row" if key == "row" else "telemetry row"
                raise EmulatorError(f"telemetry.{key}: no {what} named {name!r}{remedy(name, known)}")
        for key, part in MESSAGE_PARTS.items():
            if key in fault.effects and not any(part in found for found in shown.values()):
                links = " and ".join(shown) or "none"
                raise EmulatorError(
                    f"telemetry.{key}: no link of this run ({links}) has a {_PARTS[part]} in its messages"
                )
        in_data = fault.effects - MESSAGE_EFFECTS
        if fault.row in icd.telecommands:
            if in_data:
                text = f"{fault.row} is a telecommand, whose answer has no such data"
                raise EmulatorError(f"telemetry.{min(in_data)}: {text}")
            return
        targets = [icd.telemetry[fault.row]] if fault.row is not None else list(icd.telemetry.values())
        if fault.conjugate and not any(_vector_part(row) for row in targets):
            raise EmulatorError(f"telemetry.conjugate: {fault.row or icd.name} has no quaternion")
        for key, name, value in _by_field(fault):
            fields = [row.named_fields[name] for row in targets if name in row.named_fields]
            if not fields:
                names = {field for row in targets for field in row.named_fields}
                where = f"row {fault.row}" if fault.row is not None else f"no row of unit {icd.name}"
                said = "has no" if fault.row is not None else "has a"
                raise EmulatorError(f"telemetry.{key}: {where} {said} field {name!r}{remedy(name, names)}")
            for field in fields:
                _check_field(key, field, value)


_PARTS: Final = {"id": "row ID", "sequence": "sequence number", "check": "checksum"}


def with_flaws(hits: Hits, reply: Reply, row_of: Callable[[str], tuple[Row, bytes]]) -> list[Reply]:
    """Return the messages that are sent instead of one that faults affect."""
    replies = [reply]
    for hit in hits:
        replies = [new for each in replies for new in hit.sent(each, row_of)]
    return replies


def _concerns(fault: TelemetryFault, row: Row, *, packet: bool) -> bool:
    """Return whether a fault is one of a row, or of a packet that its action sends."""
    if fault.row is not None:
        return fault.row == row.name
    fields = [name for _, name, _ in _by_field(fault)]
    if row.kind == "telecommand":
        return packet and not fields
    return not fields or not row.named_fields.keys().isdisjoint(fields)


def _by_field(fault: TelemetryFault) -> list[tuple[str, str, Any]]:
    """Return key, field and value of what a fault does to single fields."""
    return [
        *(("set", name, value) for name, value in fault.set.items()),
        *(("offset", name, value) for name, value in fault.offset.items()),
        *(("nan", name, math.nan) for name in fault.nan),
        *(("negate", name, 0.0) for name in fault.negate),
    ]


def _check_field(key: str, field: RowField, value: Any) -> None:
    """Raise EmulatorError if a value cannot be sent in a field."""
    where = f"telemetry.{key}.{field.name}" if key in ("set", "offset") else f"telemetry.{key}"
    if key == "nan" and not field.slot.type.startswith("f"):
        raise EmulatorError(f"{where}: {field.name} is not a float, and cannot be NaN")
    if key in ("offset", "negate") and field.kind not in ("integer", "float", "bits"):
        raise EmulatorError(f"{where}: {field.name} is not a number")
    if key == "set":
        try:
            field.to_raw(_given(field, value), check=False)
        except (FieldError, ProtocolError) as error:
            raise EmulatorError(f"{where}: {error}") from None


def _given(field: RowField, value: bool | float | str) -> Value:
    """Return a value as the field takes it: bytes for hexadecimal text."""
    if field.kind != "bytes" or not isinstance(value, str):
        return value
    try:
        return bytes.fromhex(value)
    except ValueError:
        raise FieldError(f"must be bytes in hexadecimal, not {value!r}") from None


def _vector_part(row: Row) -> list[str]:
    """Return the fields of a row that the inverse rotation has with the opposite sign."""
    return [name for name, field in row.named_fields.items() if field.value in VECTOR_PART]


def _changes(
    fault: TelemetryFault, fields: Mapping[str, RowField], values: Mapping[str, Value]
) -> dict[str, Value]:
    changes: dict[str, Value] = {}
    negated = [*fault.negate]
    if fault.conjugate:
        negated += [name for name, field in fields.items() if field.value in VECTOR_PART]
    for name in negated:
        if name in fields:
            changes[name] = _number_in(fields[name], -_number(values[name]))
    for name, step in fault.offset.items():
        if name in fields:
            changes[name] = _number_in(fields[name], _number(changes.get(name, values[name])) + step)
    changes |= {name: _given(fields[name], value) for name, value in fault.set.items() if name in fields}
    return changes | {name: math.nan for name in fault.nan if name in fields}


def _number(value: Value) -> float:
    return value if isinstance(value, int | float) else 0.0


def _number_in(field: RowField, value: float) -> Value:
    """Return the nearest number that the type of a field holds; an integer that wraps goes on from the other end."""
    if field.kind == "float":
        return value
    low, high = field.type_limits
    raw = round((value - field.bias) / field.scale)
    raw = raw % (high - low + 1) if field.wrap and low == 0 else min(max(raw, low), high)
    return field.to_physical(raw)


def _with_attitude_of(past: Measurement, frame: Measurement) -> Measurement:
    return replace(
        frame,
        result=past.result,
        valid=past.valid,
        reason=past.reason,
        rate_rad_s=past.rate_rad_s,
        rate_valid=past.rate_valid,
    )


def _turned(frame: Measurement, turn_rad: Array) -> Measurement:
    """Return a frame whose attitude and star vectors are turned by a rotation vector (3,) in the sensor frame, rad."""
    if not frame.valid:
        return frame
    result, turned = frame.result, Attitude.identity().rotated(turn_rad)
    stars = tuple(
        replace(star, vector=as_triple(turned.to_sensor(np.array(star.vector)))) for star in result.stars
    )
    attitude = Attitude(np.array(result.quaternion_xyzw)).rotated(turn_rad)
    return replace(frame, result=replace(result, quaternion_xyzw=as_quaternion(attitude), stars=stars))
