"""Expectations of a session script: conditions on fields, and limits of the attitude error."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from starhil.hil_tests.attitude import (
    AttitudeError,
    Quaternion,
    attitude_error,
    from_radec_roll,
    from_vector_part,
    unit,
    wrapped_difference,
)
from starhil.hil_tests.errors import BenchError, ScriptError
from starhil.hil_tests.script_reader import TableReader
from starhil.protocol.names import did_you_mean
from starhil.protocol.values import Value

RELATIVE_ROUNDING: Final = 1e-6
"""Numbers without a tolerance may differ by the rounding of a 32-bit float."""

WHOLE_DIGITS: Final = 1e4
"""Numbers from this one on are shown with six decimals, to keep the fraction of a Unix time."""

CLOCK_VARIABLES: Final = ("now", "now_s", "now_ms")
"""Predefined variables: Unix time of the OBC in seconds, its whole seconds, and its milliseconds."""


@dataclass(frozen=True)
class Variable:
    """A reference to a captured value, written `$name` in a script."""

    name: str


Operand = Value | Variable


def operand(value: Any, reader: TableReader, key: str, known: frozenset[str]) -> Operand:
    """Read a plain value or a `$name`, which an earlier step must have captured."""
    if isinstance(value, str) and value.startswith("$"):
        name = value[1:]
        if name not in known and name not in CLOCK_VARIABLES:
            every = [*known, *CLOCK_VARIABLES]
            reader.fail(
                f"'{key}': nothing was captured as '${name}' before this step{did_you_mean(name, every)}"
            )
        return Variable(name)
    if not isinstance(value, bool | int | float | str):
        reader.fail(f"'{key}' must be a number, true, false or a text, not {value!r}")
    return value


def resolve(value: Operand, variables: Mapping[str, Value]) -> Value:
    """Return the current value of an operand."""
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


@dataclass(frozen=True)
class Expectation:
    """Conditions on one field; all that are given must hold.

    Attributes
    ----------
    equals : operand
        The expected value; `plus` is added to a number.
    within : float
        Largest absolute difference from `equals`, in the unit of the field.
    angle : bool
        Whether to compare modulo 360 degrees.
    minimum, maximum, above : operand
        Bounds, the last one exclusive.
    one_of : tuple of operands
        Allowed values.
    differs_from : operand
        A value that is not allowed.
    """

    field: str
    equals: Operand | None = None
    within: float | None = None
    plus: float = 0.0
    angle: bool = False
    minimum: Operand | None = None
    maximum: Operand | None = None
    above: Operand | None = None
    one_of: tuple[Operand, ...] = ()
    differs_from: Operand | None = None

    def mismatch(self, value: Value, variables: Mapping[str, Value]) -> str | None:
        """Return a description of the mismatch, or None if the value meets the conditions."""
        for check in (self._equality, self._bounds, self._choices):
            text = check(value, variables)
            if text is not None:
                return f"{self.field} is {show(value)}, expected {text}"
        return None

    def _equality(self, value: Value, variables: Mapping[str, Value]) -> str | None:
        if self.equals is None:
            return None
        expected = resolve(self.equals, variables)
        if not _is_number(value) or not _is_number(expected):
            return (
                None
                if value == expected and isinstance(value, bool) == isinstance(expected, bool)
                else show(expected)
            )
        wanted = float(expected) + self.plus
        tolerance = RELATIVE_ROUNDING * abs(wanted) if self.within is None else self.within
        if isinstance(value, int) and self.within is None:
            tolerance = 0.0
        distance = wrapped_difference(float(value), wanted) if self.angle else abs(float(value) - wanted)
        if distance <= tolerance:
            return None
        text = show(wanted if self.plus else expected)
        return text if self.within is None else f"{text} ± {self.within:g} (off by {distance:.6g})"

    def _bounds(self, value: Value, variables: Mapping[str, Value]) -> str | None:
        bounds: tuple[tuple[Operand | None, Callable[[float, float], bool], str], ...] = (
            (self.minimum, operator.ge, "at least"),
            (self.maximum, operator.le, "at most"),
            (self.above, operator.gt, "more than"),
        )
        for limit, holds, word in bounds:
            if limit is None:
                continue
            bound = resolve(limit, variables)
            if not (_is_number(value) and _is_number(bound) and holds(float(value), float(bound))):
                return f"{word} {show(bound)}"
        return None

    def _choices(self, value: Value, variables: Mapping[str, Value]) -> str | None:
        if self.one_of:
            allowed = [resolve(item, variables) for item in self.one_of]
            if value not in allowed:
                return f"one of {', '.join(show(item) for item in allowed)}"
        if self.differs_from is not None:
            refused = resolve(self.differs_from, variables)
            if value == refused:
                return f"anything but {show(refused)}"
        return None


def _is_number(value: Value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def read_expectation(field: str, value: Any, reader: TableReader, known: frozenset[str]) -> Expectation:
    """Read the expectation for one field: a plain value, or a table of conditions."""
    if not isinstance(value, dict):
        return Expectation(field, equals=operand(value, reader, field, known))
    table = TableReader(value, f"{reader.location}: {field}")

    def part(key: str) -> Operand | None:
        return operand(table.value(key), table, key, known) if table.has(key) else None

    angle = table.has("angle_deg")
    equals = part("angle_deg") if angle else part("value")
    one_of = table.value("one_of", [])
    if not isinstance(one_of, list):
        table.fail("'one_of' must be a list")
    expectation = Expectation(
        field,
        equals=equals,
        within=table.optional_number("within", minimum=0.0),
        plus=table.number("plus", 0.0),
        angle=angle,
        minimum=part("min"),
        maximum=part("max"),
        above=part("above"),
        one_of=tuple(operand(item, table, "one_of", known) for item in one_of),
        differs_from=part("not"),
    )
    table.reject_unknown_keys()
    if not value:
        table.fail("is empty: give value, min, max, above, one_of, not or angle_deg")
    if equals is None and ("within" in value or "plus" in value):
        table.fail("'within' and 'plus' need 'value' or 'angle_deg' as well")
    return expectation


# --- attitudes ---


@dataclass(frozen=True)
class AttitudeCheck:
    """Largest allowed attitude errors in arcseconds; None: not checked.

    `truth` is the attitude given in the step; None: the script's.
    """

    cross_arcsec: float | None
    roll_arcsec: float | None
    total_arcsec: float | None
    truth: Quaternion | None

    def judge(
        self, values: Mapping[str, Value], truth: Quaternion
    ) -> tuple[AttitudeError | None, str | None]:
        """Return the attitude error of telemetry `values`, and the problem or None."""
        try:
            measured = measured_attitude(values)
        except BenchError as refusal:
            return None, str(refusal)
        error = attitude_error(measured, truth)
        for word, limit, found in (
            ("cross-boresight", self.cross_arcsec, error.cross_boresight_arcsec),
            ("roll", self.roll_arcsec, error.roll_arcsec),
            ("total", self.total_arcsec, error.total_arcsec),
        ):
            if limit is not None and not found <= limit:
                return error, f"{word} error {found:.1f} arcsec, expected at most {limit:g} arcsec"
        return error, None


def measured_attitude(values: Mapping[str, Value]) -> Quaternion:
    """Return the attitude in a telemetry row that has q_x, q_y, q_z and optionally q_w.

    Raises
    ------
    BenchError
        The attitude in the row is flagged invalid, or there is none.
    """
    if values.get("valid") is False:
        raise BenchError(f"the attitude is not valid (reason {show(values.get('reason', '?'))})")
    parts = [float(values[key]) for key in ("q_x", "q_y", "q_z")]
    if "q_w" in values:
        return unit([*parts, float(values["q_w"])])
    return from_vector_part(*parts)


def read_stated_attitude(reader: TableReader) -> Quaternion | None:
    """Read `ra_deg, dec_deg, roll_deg` or `quaternion_xyzw`; None if the table has neither."""
    if reader.has("quaternion_xyzw"):
        try:
            return unit(reader.numbers("quaternion_xyzw", 4))
        except ScriptError:
            raise
        except BenchError as error:
            reader.fail(f"'quaternion_xyzw': {error}")
    if any([reader.has("ra_deg"), reader.has("dec_deg"), reader.has("roll_deg")]):
        dec = reader.number("dec_deg")
        if abs(dec) > 90.0:
            reader.fail(f"'dec_deg' must lie within -90 and 90, not {dec:g}")
        return from_radec_roll(reader.number("ra_deg"), dec, reader.number("roll_deg"))
    return None


def read_attitude_check(reader: TableReader) -> AttitudeCheck:
    """Read the table `attitude` of a step: tolerances and, optionally, the true attitude."""
    check = AttitudeCheck(
        reader.optional_number("within_arcsec", minimum=0.0),
        reader.optional_number("roll_within_arcsec", minimum=0.0),
        reader.optional_number("total_within_arcsec", minimum=0.0),
        read_stated_attitude(reader),
    )
    reader.reject_unknown_keys()
    limits = (check.cross_arcsec, check.roll_arcsec, check.total_arcsec)
    if all(limit is None or math.isinf(limit) for limit in limits):
        reader.fail("needs a tolerance: within_arcsec, roll_within_arcsec or total_within_arcsec")
    return check
