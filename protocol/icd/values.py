"""Values of an interface definition: enumerations, limits, parameters, and the errors in definitions and values.

The tables of a definition are pydantic models, validated when the file is read and used as they are from then on.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from starhil.protocol.errors import IcdError, ProtocolError, did_you_mean
from starhil.protocol.messages import ErrorCode

HEX: Final = {"format": "hex"}
"""Schema of numbers that the reference pages show in hexadecimal."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=100)]
ParameterType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32", "f64", "bool", "enum8"]
_Scalar = TypeVar("_Scalar", bound=bool | int | float | str)
LARGEST_NUMBER: Final = 1e100
"""Largest magnitude of a number in a definition: divided by a scale, it is finite."""


def bounded(value: _Scalar) -> _Scalar:
    """Return a value that is not too large for a definition."""
    if isinstance(value, int | float) and abs(value) > LARGEST_NUMBER:
        raise PydanticCustomError("bounded", f"a number is at most {LARGEST_NUMBER:g}")
    return value


Number = Annotated[float, AfterValidator(bounded)]
Scalar = Annotated[bool | int | float | str, AfterValidator(bounded)]
Value = bool | int | float | str | bytes
"""A physical value: a flag, a number in its unit, the name of a member of an enumeration, or raw bytes."""

INTEGER_RANGES: Final[Mapping[str, tuple[int, int]]] = MappingProxyType(
    {
        f"{sign}{bits}": (0, 2**bits - 1) if sign == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        for sign in "ui"
        for bits in (8, 16, 24, 32, 64)
    }
)
"""Lowest and highest raw value of each integer type."""

SCALAR_SIZES: Final[Mapping[str, int]] = MappingProxyType(
    {"f32": 4, "f64": 8} | {name: int(name[1:]) // 8 for name in INTEGER_RANGES}
)
"""Bytes of each type of number."""

F32_MAX: Final = 3.4028234663852886e38
"""Largest finite single-precision number."""


class Located:
    """Context of a part of a definition, or of a value: its name is put in front of errors that are raised in it."""

    def __init__(self, where: str) -> None:
        self._where = where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if isinstance(error, ProtocolError):
            error.args = tuple(f"{self._where}: {text}" for text in error.args)


class MissingNameError(IcdError):
    """A name that the definition uses but does not define."""

    def __init__(self, text: str, name: str) -> None:
        super().__init__(text)
        self.name = name


class MessageError(ProtocolError):
    """A message or value that violates the interface definition.

    `code` is the published error code.
    """

    code: ErrorCode = ErrorCode.INVALID_PARAMETER

    def __init__(self, text: str, *, index: int = 0) -> None:
        super().__init__(text)
        self.index = index
        """Index of the rejected field in its row, reported in the telemetry row `acknowledge`."""


class LengthError(MessageError):
    """Data whose length differs from the size of the row."""

    code = ErrorCode.INVALID_LENGTH


class FieldError(MessageError):
    """A value outside its type, limits or enumeration; that of a row begins with row.field."""


class DefinitionModel(BaseModel):
    """A table of a definition; unknown keys and wrong types are rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


FLAGS: Final = {"false": False, "true": True}
"""Value of each member of an enumeration that is a flag."""


class EnumDefinition(DefinitionModel):
    """An enumeration."""

    name: Name
    """Name that fields refer to."""
    doc: str
    """Description."""
    values: dict[Name, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(min_length=1)
    """Name → number on the wire."""

    @field_validator("values")
    @classmethod
    def _distinct(cls, values: dict[str, int]) -> dict[str, int]:
        if len(set(values.values())) != len(values):
            raise PydanticCustomError("definition", "two names have the same number")
        return values

    @cached_property
    def names(self) -> Mapping[int, str]:
        """Name of each number."""
        return MappingProxyType({number: name for name, number in self.values.items()})

    @cached_property
    def is_flag(self) -> bool:
        """Whether the names are `true` and `false`, or one of them."""
        return self.values.keys() <= FLAGS.keys()

    def value_of(self, number: int) -> str | bool | int:
        """Return the name of a number, or what it stands for in a flag; a number without a name stays a number."""
        name = self.names.get(number)
        return number if name is None else FLAGS[name] if self.is_flag else name

    def number(self, value: Value) -> int:
        """Return the number of a name, a flag, or a number that has a name; raise FieldError otherwise."""
        name = str(value).lower() if isinstance(value, bool) else value
        if isinstance(name, str):
            if name in self.values:
                return self.values[name]
        elif isinstance(name, (int, float)) and name in self.names:
            return int(name)
        allowed = ", ".join(f"{name} ({number})" for name, number in self.values.items())
        hint = did_you_mean(value, self.values) if isinstance(value, str) else ""
        raise FieldError(f"{value!r} is not one of {allowed}{hint}")


def to_f32(value: float) -> float:
    """Round a number to single precision; a number that is too large becomes infinite."""
    if math.isfinite(value) and abs(value) > F32_MAX:
        return math.copysign(math.inf, value)
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def representable(low: float, high: float, type_: str) -> tuple[float, float]:
    """Return limits widened to values that the type can represent: the f32 nearest to a limit may be outside it."""
    return (min(low, to_f32(low)), max(high, to_f32(high))) if type_ == "f32" else (low, high)


WIDEST_BITS: Final = 1023
"""Most bits of a whole number that a float can hold."""


def number_of(value: Value) -> int | float:
    """Return the value if it is a number; raise FieldError otherwise."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise FieldError(f"{value!r} is not a number")
    if isinstance(value, int) and value.bit_length() > WIDEST_BITS:
        raise FieldError(f"a whole number of {value.bit_length()} bits fits no field")
    return value


def limits_text(minimum: float | None, maximum: float | None, unit: str) -> str:
    """Format limits for an error message, as in `0.1 to 20 Hz`."""
    low = "any" if minimum is None else f"{minimum:g}"
    high = "any" if maximum is None else f"{maximum:g}"
    return f"{low} to {high} {unit}".rstrip()


class Section(DefinitionModel):
    """A section of documentation: paragraphs and a table."""

    heading: Annotated[str, Field(min_length=1)]
    paragraphs: list[str] = []
    columns: list[str] = Field(min_length=1)
    rows: list[list[str]]

    @model_validator(mode="after")
    def _full_rows(self) -> Section:
        for number, row in enumerate(self.rows, 1):
            if len(row) != len(self.columns):
                raise PydanticCustomError(
                    "definition",
                    "row {row} has {found} cells, must have {wanted}",
                    {"row": number, "found": len(row), "wanted": len(self.columns)},
                )
        return self


class ParameterKeys(DefinitionModel):
    """What the device model and a unit say of a parameter."""

    name: Name
    type: ParameterType
    """Type on the wire."""
    unit: str = ""
    minimum: float | None = Field(default=None, alias="min")
    """None if the type or the enumeration gives it."""
    maximum: float | None = Field(default=None, alias="max")
    default: Scalar
    profile_key: str = ""
    """Key of a device profile that sets the default, of a parameter of a link."""
    doc: str


class DeviceParameter(ParameterKeys):
    """A parameter of the device model."""

    enumeration: str | None = Field(default=None, alias="enum")
    """Name of the enumeration."""


class Parameter(ParameterKeys):
    """A parameter with the limits of a unit, shared by bus, device and object dictionary."""

    id: int
    """ID in set_parameter and select_parameter, 1 to 254; 0 if the unit does not expose it."""
    minimum: float
    maximum: float
    enum: EnumDefinition | None

    @classmethod
    def limited(cls, keys: Mapping[str, Any], enum: EnumDefinition | None, number: int = 0) -> Parameter:
        """Return a parameter with the limits of its enumeration or type; raise IcdError if it has no valid ones."""
        given = {name: keys[name] for name in ParameterKeys.model_fields}
        parameter = cls.model_construct(**{**given, "id": number, "enum": enum})
        low: float | None = parameter.minimum
        high: float | None = parameter.maximum
        if enum is not None:
            low, high = float(min(enum.values.values())), float(max(enum.values.values()))
        elif parameter.type == "bool":
            low, high = 0.0, 1.0
        elif low is None or high is None or not low <= high:
            raise IcdError("needs min and max, with min not above max")
        else:
            lowest, highest = INTEGER_RANGES.get(parameter.type, (-math.inf, math.inf))
            if low < lowest or high > highest:
                raise IcdError(f"limits {low:g} to {high:g} do not fit type {parameter.type}")
        return parameter.model_copy(update={"minimum": low, "maximum": high})

    def check(self, value: Value) -> bool | int | float | str:
        """Return the value in the type of the parameter, or raise FieldError, whose text gives the limits.

        Numbers are accepted for Booleans (0, 1) and members of enumerations, because set_parameter sends
        numbers.
        """
        with Located(self.name):
            if self.enum is not None:
                return self.enum.names[self.enum.number(value)]
            if self.type == "bool":
                if isinstance(value, (bool, int, float)) and value in (0, 1):
                    return bool(value)
                raise FieldError(f"{value!r} is not on or off (1 or 0)")
            number = number_of(value)
            if self.type in INTEGER_RANGES:
                if not math.isfinite(number) or number != int(number):
                    raise FieldError(f"{number!r} is not a whole number")
                number = int(number)
            else:
                number = float(number)
            low, high = representable(self.minimum, self.maximum, self.type)
            if not low <= number <= high:
                limits = limits_text(self.minimum, self.maximum, self.unit)
                raise FieldError(f"{number:g} is outside {limits}")
            return number

    def to_number(self, value: Value) -> float:
        """Return the checked value as the number used in set_parameter and the telemetry row `parameter`."""
        checked = self.check(value)
        if isinstance(checked, str):
            return float(self.enum.values[checked]) if self.enum is not None else math.nan
        return float(checked)
