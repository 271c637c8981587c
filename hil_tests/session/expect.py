"""Expectations of a session script: conditions on the fields of a row, and limits of the attitude error."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Final, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
    model_validator,
)

from starhil.hil_tests.attitude import (
    AttitudeDifference,
    Quaternion,
    attitude_error,
    attitude_in,
    from_radec_roll,
    from_reported,
    to_radec_roll,
    unit,
)
from starhil.hil_tests.errors import BenchError
from starhil.protocol.errors import did_you_mean, remedy
from starhil.protocol.icd.codec import Field as RowField
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.values import FLAGS, Value

RELATIVE_ROUNDING: Final = 1e-6
"""Numbers without a tolerance may differ by the rounding of a 32-bit float."""

WHOLE_DIGITS: Final = 1e4
"""Numbers from this one on are shown with six decimals, to keep the fraction of a Unix time."""

LARGE_ARCSEC: Final = 3600.0
"""Attitude errors from here on are given in degrees, with both attitudes."""

CLOCK_VARIABLES: Final = ("now", "now_s", "now_ms")
"""Predefined variables: Unix time of the OBC in seconds, its whole seconds, and its milliseconds."""


@dataclass(frozen=True)
class Variable:
    """A reference to a captured value, written `$name` in a script."""

    name: str


Operand = Value | Variable


class Keys(BaseModel):
    """A table of a session script: no unknown keys, and no conversion between numbers, flags and texts."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=True)


def read_operand(value: Any, info: ValidationInfo) -> Operand:
    """Read a plain value or a `$name`, which an earlier step must have captured."""
    if isinstance(value, str) and value.startswith("$"):
        every = [*(info.context or {}).get("captured", ()), *CLOCK_VARIABLES]
        if value[1:] not in every:
            raise ValueError(
                f"nothing was captured as '{value}' before this step{did_you_mean(value[1:], every)}"
            )
        return Variable(value[1:])
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f"must be a number, true, false or a text, not {value!r}")  # noqa: TRY004 -- for pydantic
    return value


ReadOperand = Annotated[Operand, PlainValidator(read_operand)]
NonNegative = Annotated[float, Field(ge=0.0)]


def resolve(value: Operand, variables: Mapping[str, Value]) -> Value:
    return variables[value.name] if isinstance(value, Variable) else value


def show(value: Value) -> str:
    """Format a value for a reader."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}" if abs(value) < WHOLE_DIGITS else f"{value:.6f}".rstrip("0").rstrip(".")
    if isinstance(value, bytes):
        return (
            value.hex(" ").upper()
            if len(value) <= 16
            else f"{value[:16].hex(' ').upper()} … ({len(value)} bytes)"
        )
    return str(value)


class Conditions(Keys):
    """Conditions on one field, of which all that are given must hold; a plain value stands for `{ value = … }`.

    `value` is compared with `plus` added and `within` as tolerance, `angle_deg` also modulo 360 degrees; `above` is
    exclusive, `min` and `max` are not.
    """

    value: ReadOperand | None = None
    angle_deg: ReadOperand | None = None
    within: NonNegative | None = None
    plus: float = 0.0
    minimum: ReadOperand | None = Field(None, alias="min")
    maximum: ReadOperand | None = Field(None, alias="max")
    above: ReadOperand | None = None
    one_of: list[ReadOperand] = Field(default_factory=list)
    differs_from: ReadOperand | None = Field(None, alias="not")

    @model_validator(mode="after")
    def _can_be_checked(self) -> Self:
        if not self.model_fields_set:
            raise ValueError("is empty: give value, min, max, above, one_of, not or angle_deg")
        if self.equals is None and {"within", "plus"} & self.model_fields_set:
            raise ValueError("'within' and 'plus' need 'value' or 'angle_deg' as well")
        return self

    @property
    def equals(self) -> Operand | None:
        """The expected value or angle."""
        return self.value if self.angle_deg is None else self.angle_deg

    def mismatch(self, field: str, value: Value, variables: Mapping[str, Value]) -> str | None:
        """Return a description of the mismatch of a field, or None if its value meets the conditions."""
        wanted = next(self._unmet(value, variables), None)
        return None if wanted is None else f"{field} is {show(value)}, expected {wanted}"

    def _unmet(self, value: Value, variables: Mapping[str, Value]) -> Iterator[str]:
        """Yield what is expected instead, for each condition that does not hold."""
        if (text := self._inequality(value, variables)) is not None:
            yield text
        bounds: tuple[tuple[Operand | None, Callable[[float, float], bool], str], ...] = (
            (self.minimum, operator.ge, "at least"),
            (self.maximum, operator.le, "at most"),
            (self.above, operator.gt, "more than"),
        )
        for limit, holds, words in bounds:
            if limit is not None:
                bound = resolve(limit, variables)
                if not (_is_number(value) and _is_number(bound) and holds(float(value), float(bound))):
                    yield f"{words} {show(bound)}"
        allowed = [resolve(item, variables) for item in self.one_of]
        if allowed and value not in allowed:
            yield f"one of {', '.join(map(show, allowed))}"
        if self.differs_from is not None and value == (other := resolve(self.differs_from, variables)):
            yield f"anything but {show(other)}"

    def _inequality(self, value: Value, variables: Mapping[str, Value]) -> str | None:
        if self.equals is None:
            return None
        expected = resolve(self.equals, variables)
        if not _is_number(value) or not _is_number(expected):
            return (
                None
                if value == expected and isinstance(value, bool) == isinstance(expected, bool)
                else show(expected)
            )
        target = float(expected) + self.plus
        tolerance = RELATIVE_ROUNDING * abs(target) if self.within is None else self.within
        if isinstance(value, int) and self.within is None:
            tolerance = 0.0
        angle = self.angle_deg is not None
        distance = abs(math.remainder(float(value) - target, 360.0)) if angle else abs(float(value) - target)
        if distance <= tolerance:
            return None
        text = show(target if self.plus else expected)
        return text if self.within is None else f"{text} ± {self.within:g} (off by {distance:.6g})"


def _is_number(value: Value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


ReadConditions = Annotated[
    Conditions, BeforeValidator(lambda given: given if isinstance(given, dict) else {"value": given})
]


# --- attitudes ---


class StatedAttitude(Keys):
    """An attitude as `ra_deg, dec_deg, roll_deg` or `quaternion_xyzw`, or none."""

    ra_deg: float | None = None
    dec_deg: float | None = None
    roll_deg: float | None = None
    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None

    @model_validator(mode="after")
    def _is_an_attitude(self) -> Self:
        self.attitude  # noqa: B018 -- raises
        return self

    @property
    def attitude(self) -> Quaternion | None:
        """The attitude; None if the table has none."""
        if self.quaternion_xyzw is not None:
            try:
                return unit(self.quaternion_xyzw)
            except BenchError as error:
                raise ValueError(f"'quaternion_xyzw': {error}") from None
        angles = {name: getattr(self, name) for name in ("ra_deg", "dec_deg", "roll_deg")}
        missing = [name for name, angle in angles.items() if angle is None]
        if len(missing) == len(angles):
            return None
        if missing:
            raise ValueError(f"'{missing[0]}' must be a number, but is missing")
        if abs(angles["dec_deg"]) > 90.0:
            raise ValueError(f"'dec_deg' must lie within -90 and 90, not {angles['dec_deg']:g}")
        return from_radec_roll(*angles.values())


class AttitudeCheck(StatedAttitude):
    """Largest attitude errors, and the true attitude if it is not the script's."""

    within_arcsec: NonNegative | None = None
    roll_within_arcsec: NonNegative | None = None
    total_within_arcsec: NonNegative | None = None

    @model_validator(mode="after")
    def _has_a_limit(self) -> Self:
        if {self.within_arcsec, self.roll_within_arcsec, self.total_within_arcsec} == {None}:
            raise ValueError("needs a tolerance: within_arcsec, roll_within_arcsec or total_within_arcsec")
        return self

    def judge(
        self, row: Row, values: Mapping[str, Value], truth: Quaternion, conventions: Conventions
    ) -> tuple[AttitudeDifference | None, str | None]:
        """Return the error of the attitude in the values of a row, and the problem or None."""
        try:
            measured = from_reported(attitude_in(row, values), conventions)
        except BenchError as refusal:
            return None, str(refusal)
        error = attitude_error(measured, truth)
        for word, limit, arcsec in (
            ("cross-boresight", self.within_arcsec, error.cross_boresight_arcsec),
            ("roll", self.roll_within_arcsec, error.roll_arcsec),
            ("total", self.total_within_arcsec, error.total_arcsec),
        ):
            if limit is not None and not arcsec <= limit:
                problem = f"{word} error {show_angle(arcsec)}, expected at most {limit:g} arcsec"
                if arcsec > LARGE_ARCSEC:
                    problem += f"; measured {describe(measured)}, true {describe(truth)}"
                return error, problem
        return error, None


def show_angle(arcsec: float) -> str:
    """Format an error: in arcseconds, or in degrees if it is large."""
    return f"{arcsec:.1f} arcsec" if arcsec <= LARGE_ARCSEC else f"{arcsec / 3600.0:.3f} deg"


def describe(attitude: Quaternion) -> str:
    ra_deg, dec_deg, roll_deg = to_radec_roll(attitude)
    return f"RA {ra_deg:.4f}, Dec {dec_deg:.4f}, roll {roll_deg:.4f} deg"


def unknown_fields(key: str, row: Row, names: Iterable[str]) -> Iterator[str]:
    """Yield an error for each name under a key that is no field of a row."""
    known = row.named_fields
    for name in names:
        if name not in known:
            yield f"{key}: row '{row.name}' has no field '{name}'{remedy(name, known)}"


def impossible(item: RowField, conditions: Conditions) -> Iterator[str]:
    """Yield why conditions can never hold, and convert their values in place to those of the field."""
    if item.kind == "bytes":
        numeric = {"min", "max", "above", "within", "plus", "angle_deg"}
        keys = {Conditions.model_fields[name].alias or name for name in conditions.model_fields_set}
        for key in sorted(numeric & keys):
            yield f"'{item.name}' is bytes, and '{key}' is for numbers; give value, one_of or not"
    problems: list[str] = []

    def convert(value: Operand) -> Operand:
        try:
            return value if isinstance(value, Variable) else _expected(item, value)
        except ValueError as error:
            problems.append(f"'{item.name}' is {error}")
            return value

    for key in ("value", "angle_deg", "differs_from"):
        if (value := getattr(conditions, key)) is not None:
            setattr(conditions, key, convert(value))
    conditions.one_of = [convert(value) for value in conditions.one_of]
    yield from problems


def _expected(item: RowField, value: Value) -> Value:
    """Return a value of a script as the field has it: bytes for hexadecimal text, true for the name `true` of a flag."""
    if item.kind == "bytes":
        with suppress(ValueError):
            if isinstance(value, str) and len(data := bytes.fromhex(value)) == item.size:
                return data
        raise ValueError(f"{item.size} bytes in hexadecimal, not {show(value)!r}")
    if item.is_flag:
        value = FLAGS.get(value, value) if item.enum is not None and isinstance(value, str) else value
        if not isinstance(value, bool):
            raise ValueError(f"true or false, not {value!r}")
    elif item.enum is not None:
        if value not in item.enum.values and type(value) is not int:
            hint = did_you_mean(show(value), item.enum.values) or f"; one of: {', '.join(item.enum.values)}"
            raise ValueError(f"never '{show(value)}'{hint}")
    elif isinstance(value, bool):
        raise ValueError(f"not true or false, not {value!r}")
    elif item.kind != "text" and isinstance(value, str):
        raise ValueError(f"a number, not {value!r}")
    return value
