"""Rows: physical values to bytes and back.

     row   | field | field | b7 b6 … b0 | field …        fields follow each other without gaps
     bits  the first bit of a definition is the lowest bit of the number that the bytes make
     value physical = raw × scale + bias; an enumeration names raw values; a flag is one bit or 0 and 1

Source: docs/units.md, which defines the terms; integers are two's complement and floats IEEE 754 in the byte order
of the field. A field without a name is sent as zeros.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal

from starhil.hil_tests.judge.messages import Value

FieldKind = Literal["integer", "float", "enum", "flag", "bits", "bytes", "text", "unused"]
RowKind = Literal["telecommand", "telemetry"]
SIZES: Final = {
    "u8": 1, "i8": 1, "u16": 2, "i16": 2, "u24": 3, "i24": 3, "u32": 4, "i32": 4, "u64": 8, "i64": 8, "f32": 4, "f64": 8,
}  # fmt: skip
"""Bytes of each type of number."""
FORMATS: Final = {
    ("little", "f32"): "<f",
    ("little", "f64"): "<d",
    ("big", "f32"): ">f",
    ("big", "f64"): ">d",
}
"""Format of floating types in `struct`, by byte order."""
LARGEST_OF_FORMAT: Final = {"f32": (2.0 - 2.0**-23) * 2.0**127, "f64": math.inf}
"""Largest finite number of each floating type; any finite number fits f64."""
PARAMETER: Final = "parameter."
"""Beginning of the name of a quantity that is a parameter."""
FLAGS: Final = {"false": False, "true": True}
"""An enumeration with no other names is a flag."""


@dataclass(frozen=True)
class Field:
    """One value of a row, and where it lies.

    Attributes
    ----------
    name
        Empty for unused bytes or bits.
    type, order
        Type (`bytes` for raw bytes and text) and byte order of the bytes that hold it.
    offset, size
        These bytes in the row.
    shift, width
        Lowest bit and number of bits; a width of 0 stands for the whole number.
    unit, scale, bias, minimum, maximum
        Physical value; limits None if only the type limits it.
    value, argument, telecommand
        Quantity that it reports, argument of the action that it sets, telecommand whose value it reports.
    shared
        Names of the enumeration whose number stands for further values too.
    parameter
        Parameter that it sets or reports.
    wrap
        Whether a number outside the limits is sent modulo the range instead of as the nearest limit.
    """

    name: str
    kind: FieldKind
    type: str
    order: Literal["little", "big"]
    offset: int
    size: int
    shift: int = 0
    width: int = 0
    scale: float = 1.0
    bias: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    enum: Mapping[str, int] | None = None
    default: Value | None = None
    const: int | float | None = None
    value: str | None = None
    argument: str | None = None
    telecommand: str | None = None
    unit: str = ""
    shared: frozenset[str] = frozenset()
    parameter: str | None = None
    wrap: bool = False

    @property
    def quantity(self) -> str:
        """Quantity that it reports; empty if it reports none."""
        return self.value or (PARAMETER + self.parameter if self.parameter else "")

    @property
    def resolution(self) -> float:
        """Largest difference between a number and what the field carries of it."""
        return (1e-9 if self.kind == "float" else 0.51) * abs(self.scale)

    @property
    def of_parameter(self) -> tuple[object, ...]:
        """Parameter and layout; fields that are alike in them carry the same numbers."""
        return self.parameter, self.unit, self.kind, self.type, self.width, self.scale, self.bias

    @property
    def type_limits(self) -> tuple[int, int]:
        """Lowest and highest raw number that the bits can hold."""
        bits = self.width or 8 * self.size
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if self.type.startswith("i") else (0, (1 << bits) - 1)

    @cached_property
    def raw_limits(self) -> tuple[int, int]:
        """Lowest and highest raw number within the limits."""
        ends = [
            None if end is None else round((end - self.bias) / self.scale)
            for end in (self.minimum, self.maximum)
        ]
        low, high = ends if self.scale > 0 else ends[::-1]
        least, greatest = self.type_limits
        return least if low is None else max(low, least), greatest if high is None else min(high, greatest)

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest physical number."""
        if self.kind == "float":
            widest = LARGEST_OF_FORMAT[self.type]
            low, high = self.minimum, self.maximum
            return -widest if low is None else low, widest if high is None else high
        low, high = sorted(raw * self.scale + self.bias for raw in self.raw_limits)
        return low, high

    @cached_property
    def plain(self) -> Value:
        """A value that must be accepted: the default, otherwise the one nearest zero."""
        for given in (self.const, self.default):
            if given is not None:
                return given
        match self.kind:
            case "bytes":
                return bytes(self.size)
            case "text":
                return ""
            case "flag":
                return False
            case "enum":
                return next(iter(self.enum or {}), 0)
            case _:
                low, high = self.limits
                return min(max(0.0 if self.kind == "float" or self.scale != 1.0 else 0, low), high)

    def raw_of(self, value: Value) -> int | float | bytes:
        """Return the raw value of a physical one; a member of an enumeration by its name or number."""
        if isinstance(value, bytes):
            if self.type != "bytes":
                raise TypeError(f"{self.name}: bytes are not a number")
            return value
        if self.kind == "text":
            return str(value).encode("latin-1")
        if isinstance(value, str) or (isinstance(value, bool) and self.enum is not None):
            return (self.enum or {})[str(value).lower() if isinstance(value, bool) else value]
        if self.kind == "float":
            return (value - self.bias) / self.scale
        if self.kind in ("enum", "flag") or (self.scale == 1.0 and self.bias == 0.0):
            return round(value)
        return round((value - self.bias) / self.scale)

    def write(self, data: bytearray, raw: float | bytes) -> None:
        """Write a raw value to the bytes of a row; zeros complete raw bytes and text."""
        place = slice(self.offset, self.offset + self.size)
        if isinstance(raw, bytes):
            data[place] = raw.ljust(self.size, b"\0")
        elif self.type in LARGEST_OF_FORMAT:
            data[place] = struct.pack(FORMATS[self.order, self.type], raw)
        elif self.width:
            others = int.from_bytes(data[place], self.order) & ~((1 << self.width) - 1 << self.shift)
            data[place] = (others | int(raw) << self.shift).to_bytes(self.size, self.order)
        else:
            data[place] = int(raw).to_bytes(self.size, self.order, signed=self.type.startswith("i"))

    def read(self, data: bytes) -> int | float | bytes:
        """Return the raw value in the bytes of a row."""
        piece = data[self.offset : self.offset + self.size]
        if self.type == "bytes":
            return piece
        if self.type in LARGEST_OF_FORMAT:
            return float(struct.unpack(FORMATS[self.order, self.type], piece)[0])
        number = int.from_bytes(piece, self.order, signed=self.type.startswith("i") and not self.width)
        return number >> self.shift & (1 << self.width) - 1 if self.width else number

    def physical(self, raw: float | bytes) -> Value:
        """Return the physical value; a number without a name in the enumeration stays a number."""
        if isinstance(raw, bytes):
            return raw.rstrip(b"\0").decode("latin-1") if self.kind == "text" else raw
        if self.kind == "flag":
            return bool(raw)
        if self.kind == "enum":
            names = self.enum or {}
            members: Mapping[str, Value] = FLAGS if names.keys() <= FLAGS.keys() else {}
            return next(
                (members.get(name, name) for name, number in names.items() if number == raw), int(raw)
            )
        return raw * self.scale + self.bias if self.scale != 1.0 or self.bias != 0.0 else raw

    def fault(self, raw: float | bytes) -> str | None:
        """Return what is wrong with a received raw value; None if it is as defined."""
        if self.kind == "unused":
            return "zeros expected" if any(raw if isinstance(raw, bytes) else (int(raw),)) else None
        if isinstance(raw, bytes):
            return None
        if self.const is not None:
            return None if self.physical(raw) == self.const else f"{self.const} expected"
        if self.kind == "enum" and self.enum is not None:
            return None if raw in self.enum.values() else "not in its enumeration"
        low, high = self.limits
        if self.type == "f32" and self.kind == "float":  # the limits may be rounded to single precision
            low, high = min(low, single(low)), max(high, single(high))
        inside = low <= raw * self.scale + self.bias <= high and math.isfinite(raw)
        if self.kind != "float":
            inside = self.raw_limits[0] <= raw <= self.raw_limits[1]
        return None if inside else f"outside {low:g} to {high:g}"

    def random_value(self, rng: random.Random, *, at_limit: bool = False) -> Value:
        """Return a value within the limits; of a number, a limit (or 0 or 1 of a float) if wanted."""
        match self.kind:
            case "bytes":
                return rng.randbytes(self.size)
            case "text":
                return "x" * rng.randint(0, self.size)
            case "flag":
                return rng.random() < 0.5
            case "enum":
                return rng.choice(list(self.enum or ()))
            case "float":
                low, high = self.limits
                edges = [edge for edge in (low, high, 0.0, 1.0) if low <= edge <= high and abs(edge) < 1e30]
                at_limit = at_limit or high - low > 1e9
                return rng.choice(edges) if at_limit and edges else rng.uniform(low, high)
            case _:
                return self.physical(
                    rng.choice(self.raw_limits) if at_limit else rng.randint(*self.raw_limits)
                )

    def any_value(self, special: bytes, turn: int, rng: random.Random) -> Value:
        """Return a value within the limits, if possible made of special bytes in the first two turns, else random."""
        if turn < 2 and special:
            pattern = (special * (turn + self.size))[turn:][: self.size]
            if self.kind == "bytes":
                return pattern
            if self.kind == "float":
                number = float(self.read(bytes(self.offset) + pattern))
                low, high = self.limits
                return min(max(number if abs(number) < 1e30 else 0.0, low), high)
            raw = int.from_bytes(pattern, self.order)
            if self.kind in ("integer", "bits") and self.raw_limits[0] <= raw <= self.raw_limits[1]:
                return self.physical(raw)
        return self.random_value(rng)


def single(number: float) -> float:
    return (
        float(struct.unpack("<f", struct.pack("<f", number))[0])
        if abs(number) <= LARGEST_OF_FORMAT["f32"]
        else number
    )


@dataclass(frozen=True)
class Row:
    """A telecommand or telemetry row.

    Attributes
    ----------
    fields
        All fields in wire order, unused ones included.
    action, arguments
        Action that a telecommand performs, and its fixed arguments.
    answers
        Answers in order: `echo`, `reply`, `row:NAME`.
    request
        Text that requests the row on a serial line; empty if a header does.
    unsolicited
        Rate in Hz at which it is sent without a request, or events after which it is sent; None if it is not.
    only_sent
        Whether no request reads it.
    min_size
        Fewest bytes of data, if a telecommand's data may end early.
    """

    kind: RowKind
    id: int
    name: str
    fields: tuple[Field, ...]
    message_class: str = ""
    provenance: str = "ours"
    source: str = ""
    action: str | None = None
    arguments: Mapping[str, Value] = field(default_factory=dict)
    answers: tuple[str, ...] = ("reply",)
    request: str = ""
    unsolicited: float | Sequence[str] | None = None
    only_sent: bool = False
    min_size: int = 0

    def __repr__(self) -> str:
        return f"Row({self.kind} {self.id} {self.name})"

    @cached_property
    def size(self) -> int:
        """Bytes of data."""
        return max((item.offset + item.size for item in self.fields), default=0)

    @cached_property
    def named(self) -> Mapping[str, Field]:
        """The fields that carry values, by name, in wire order."""
        return {item.name: item for item in self.fields if item.name}

    @property
    def is_telemetry(self) -> bool:
        return self.kind == "telemetry"

    @property
    def is_streamed(self) -> bool:
        """Whether the unit sends the row regularly: at a rate, or with each measurement."""
        return isinstance(self.unsolicited, float) or "frame" in (self.unsolicited or ())

    @property
    def carries_files(self) -> bool:
        """Whether the row reports images or files, which cannot be read at all times."""
        return any((item.value or "").startswith(("image.", "file.")) for item in self.named.values())

    def example(self) -> dict[str, Value]:
        return {name: item.plain for name, item in self.named.items()}

    def encode(self, values: Mapping[str, Value] | None = None) -> bytes:
        """Return the bytes of a row; a missing value becomes the plain one. Limits are not looked at."""
        by_name = {**self.example(), **(values or {})}
        if by_name.keys() != self.named.keys():
            raise LookupError(f"{self.name} has no field {', '.join(by_name.keys() - self.named.keys())}")
        data = bytearray(self.size)
        for name, item in self.named.items():
            item.write(data, item.raw_of(by_name[name]))
        return bytes(data)

    def decode(self, data: bytes) -> dict[str, Value]:
        """Return the physical values by name, of the fields that the data carry.

        Raises ValueError for a wrong length.
        """
        if not self.has_length(data):
            raise ValueError(f"{self.name}: {len(data)} bytes, must be {self.size}")
        return {item.name: item.physical(item.read(data)) for item in self.carried(data)}

    def has_length(self, data: bytes) -> bool:
        """Return whether the row may have so many bytes."""
        return self.min_size <= len(data) <= self.size

    def carried(self, data: bytes) -> Iterator[Field]:
        """Yield the fields in data that may end early: those that are complete, and raw bytes as far as they go."""
        for item in self.named.values():
            if item.offset + item.size <= len(data) or (item.kind == "bytes" and item.offset <= len(data)):
                yield item

    def faults(self, data: bytes) -> Iterator[str]:
        """Yield the values that are outside their limits, and unused bits that are not zero."""
        for item in self.fields:
            raw = item.read(data)
            if (text := item.fault(raw)) is not None:
                yield f"{self.name}.{item.name or 'unused'}: {item.physical(raw)!r}, {text}"

    def bad_values(self, item: Field) -> Iterator[tuple[str, bytes]]:
        """Yield data of a telecommand with one field outside its limits, each with a name of what is wrong."""
        good = self.encode()

        def with_raw(raw: float | bytes) -> bytes:
            data = bytearray(good)
            item.write(data, raw)
            return bytes(data)

        if item.kind == "float":
            low, high = item.limits
            step = 0.1 * max(abs(low), abs(high), 1.0)
            yield "nan", with_raw(math.nan)
            yield "infinite", with_raw(math.inf)
            if item.minimum is not None:
                yield "low", with_raw(item.raw_of(low - step))
            if item.maximum is not None:
                yield "high", with_raw(item.raw_of(high + step))
        elif item.kind == "enum" and not item.width:
            known = set((item.enum or {}).values())
            yield "unknown", with_raw(next(n for n in range(255, -1, -1) if n not in known))
        elif item.kind in ("integer", "bits"):
            (low_raw, high_raw), (least, greatest) = item.raw_limits, item.type_limits
            if low_raw > least:
                yield "low", with_raw(low_raw - 1)
            if high_raw < greatest:
                yield "high", with_raw(high_raw + 1)
