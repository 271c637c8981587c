"""Cases on the attitude in a row, on any link: |q| = 1, invalid in standby, and the truth where the tester knows it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol, Self

from starhil.hil_tests.attitude import Quaternion, attitude_error, unit
from starhil.hil_tests.conformance.case import CaseSkipped, check
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

ATTITUDE_S: Final = 20.0
"""Maximum time until an attitude is valid."""
TRUTH_DEG: Final = 2.0
"""Largest difference from the truth, which may have moved since the exposure."""
QUATERNION: Final = ("attitude.x", "attitude.y", "attitude.z", "attitude.w")
SEARCHING: Final = "lost_in_space"
STANDBY: Final = "standby"

TruthSource = Callable[[], Quaternion]
"""Returns the true attitude at present, as the unit reports attitudes."""


class RowAccess(Protocol):
    """Rows of a unit on some link."""

    truth: TruthSource | None

    def telecommands(self) -> Iterable[Row]:
        """Return the telecommands that the link carries."""

    def telemetry_rows(self) -> Iterable[Row]:
        """Return the telemetry that the link carries."""

    def carries(self, row: Row, item: Field) -> bool:
        """Return whether the link carries a field of a row."""

    def values(self, row: Row) -> dict[str, Value]:
        """Read the values of a row; one outside its limits fails the case."""

    def command(self, name: str, **values: Value) -> None:
        """Send a telecommand by name, which must be accepted."""

    def now(self) -> float:
        """Time, s."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


@dataclass(frozen=True)
class AttitudeRow:
    """A row with a quaternion and a flag of its validity; `names` of the fields by quantity."""

    row: Row
    names: Mapping[str, str]

    @classmethod
    def of(cls, row: Row) -> Self | None:
        """Return the attitude in a row; None if it has none."""
        names = {item.value: name for name, item in row.named.items() if item.value is not None}
        return cls(row, names) if names.keys() >= {"attitude.valid", *QUATERNION} else None

    @property
    def title(self) -> str:
        """Title of the case."""
        return f"{self.row.name} has a quaternion of length 1 if it is valid"

    def is_valid(self, seen: Mapping[str, Value]) -> bool:
        """Return whether the flag, which may be a number, is set."""
        return str(seen[self.names["attitude.valid"]]).lower() in ("true", "1")

    def becomes_valid(self, access: RowAccess) -> None:
        """Have the unit identify stars, and check the first attitude that is valid; before, in standby, none is."""
        rest, search = mode_command(access, STANDBY), mode_command(access, SEARCHING)
        with identifying_stars(access):
            if rest is not None and search is not None:
                rest()
                seen = access.values(self.row)
                check(
                    not self.is_valid(seen),
                    "no valid attitude in standby (R11, docs/rules.md)",
                    "a valid one",
                )
                search()
            end = access.now() + ATTITUDE_S
            while not self.is_valid(seen := access.values(self.row)):
                if access.now() > end:
                    raise CaseSkipped(f"no attitude was valid within {ATTITUDE_S:g} s: no stars in view?")
                access.sleep(0.1)
            self.check(access, seen)

    def check(self, access: RowAccess, seen: Mapping[str, Value]) -> None:
        """Fail the case if an attitude is valid in standby, not of length 1, or not the truth."""
        if not self.is_valid(seen):
            return
        if in_standby(access):
            still = self.is_valid(access.values(self.row)) and in_standby(access)
            check(not still, "no valid attitude in standby (R11, docs/rules.md)", "a valid one")
        parts = [float(seen[self.names[name]]) for name in QUATERNION]
        step = max(abs(self.row.named[self.names[name]].scale) for name in QUATERNION)
        length = sum(part**2 for part in parts) ** 0.5
        tolerance = 1e-5 + (2.0 * step if step < 1.0 else 0.0)
        check(abs(length - 1.0) < tolerance, "a quaternion of length 1", f"{length:.7f}")
        if access.truth is not None:
            truth = access.truth()
            error_deg = attitude_error(unit(parts), truth).total_arcsec / 3600.0
            wanted, seen_parts = (tuple(round(part, 4) for part in each) for each in (truth, parts))
            expected = f"the true attitude {wanted}, to {TRUTH_DEG:g} deg"
            check(error_deg <= TRUTH_DEG, expected, f"{seen_parts}, {error_deg:.2f} deg off")


def _mode_fields(access: RowAccess) -> Iterator[tuple[Row, Field]]:
    for row in access.telemetry_rows():
        yield from (
            (row, item) for item in row.named.values() if item.value == "mode" and access.carries(row, item)
        )


def reported_mode(access: RowAccess) -> Value | None:
    """Return the mode that a row reports, the first of several with one number; None if no row does."""
    row, item = next(_mode_fields(access), (None, None))
    return None if row is None or item is None else access.values(row)[item.name]


def in_standby(access: RowAccess) -> bool:
    """Return whether a row reports standby, by a number that stands for no other mode."""
    for row, item in _mode_fields(access):
        if STANDBY not in item.shared:
            return access.values(row)[item.name] == STANDBY
    return False


def mode_command(access: RowAccess, mode: Value | None) -> Callable[[], None] | None:
    """Return what commands a mode; None if no telecommand does, or the mode is unknown."""
    for row in access.telecommands():
        if row.action != "set_mode" or mode is None:
            continue
        field = next((name for name, item in row.named.items() if item.argument == "mode"), None)
        if field is not None and mode in (row.named[field].enum or {}):
            return partial(access.command, row.name, **{field: mode})
        if field is None and row.arguments.get("mode") == mode:
            return partial(access.command, row.name)
    return None


def changes_mode(telecommands: Iterable[Row]) -> bool:
    """Return whether a telecommand sets the mode."""
    return any(row.action == "set_mode" for row in telecommands)


@contextmanager
def identifying_stars(access: RowAccess) -> Iterator[None]:
    """Have the unit identify stars, if a telecommand starts this; restore the mode that it reports afterwards."""
    start = mode_command(access, SEARCHING)
    if start is None:
        yield
        return
    before = reported_mode(access)
    restore = mode_command(access, SEARCHING if before == "tracking" else before)
    start()
    try:
        yield
    finally:
        if restore is not None:
            restore()
