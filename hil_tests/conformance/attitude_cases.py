"""Attitude cases for any link: |q| = 1, invalid in standby, agreement of all forms, and of each with the truth if it is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final, Self

from starhil.hil_tests.attitude import Quaternion, as_reported, conjugate, from_reported, to_radec_roll
from starhil.hil_tests.conformance.attitude_forms import (
    QUATERNION,
    VECTOR_PART,
    Axes,
    Conventions,
    Reading,
    angle_deg,
    axes_of,
    readings,
)
from starhil.hil_tests.conformance.case import CaseFailed, CaseSkipped, Probe, check
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

ATTITUDE_S: Final = 20.0
"""Maximum time until an attitude is valid."""
TRUTH_DEG: Final = 2.0
"""Largest difference from the truth, which may have moved since the exposure, and between the attitudes in a row."""
MODE_S: Final = 5.0
"""Maximum time until a commanded mode is reported."""
SEARCHING: Final = "lost_in_space"
TRACKING: Final = "tracking"
STANDBY: Final = "standby"


@dataclass(frozen=True)
class AttitudeRow:
    """A row with attitudes in any form; `flag` is the field of their validity, if it has one."""

    row: Row
    conventions: Conventions
    readings: tuple[Reading, ...]
    flag: str | None

    @classmethod
    def of(cls, row: Row, conventions: Conventions, fields: Iterable[Field] | None = None) -> Self | None:
        """Return the attitudes in the fields of a row, default: all; None if there are none."""
        chosen = list(row.named.values() if fields is None else fields)
        found = tuple(readings(chosen, conventions))
        flag = next((item.name for item in chosen if item.value == "attitude.valid"), None)
        return cls(row, conventions, found, flag) if found else None

    @property
    def title(self) -> str:
        return f"{self.row.name} has one attitude in all forms if it is valid, and the true one"

    def is_valid(self, values: Mapping[str, Value]) -> bool:
        """Return whether the flag, which may be the number 1, is set; without a flag, whether any number is not 0."""
        if self.flag is not None:
            return values[self.flag] == 1
        return self._is_stated(values)

    def _is_stated(self, seen: Mapping[str, Value]) -> bool:
        return any(seen[item.name] for reading in self.readings for item in reading.fields)

    def becomes_valid(self, probe: Probe) -> None:
        """Have the unit identify stars, and check the first attitude that is valid; before, in standby, none is."""
        rest, search = mode_command(probe, STANDBY), mode_command(probe, SEARCHING)
        with identifying_stars(probe):
            if rest is not None and search is not None:
                rest()
                values = probe.values(self.row)
                check(
                    not self.is_valid(values),
                    "no valid attitude in standby (R11, docs/rules.md)",
                    "a valid one",
                )
                check_mode(probe, STANDBY)
                search()
            if search is not None:
                check_mode(probe, SEARCHING, TRACKING)
            end = probe.now() + ATTITUDE_S
            while not self.is_valid(values := probe.values(self.row)):
                if probe.now() > end:
                    self._check_flag(probe, values)
                    raise CaseSkipped(f"no attitude was valid within {ATTITUDE_S:g} s: no stars in view?")
                probe.sleep(0.1)
            self.check(probe, values)
            self._check_truth(probe)

    def check(self, probe: Probe, values: Mapping[str, Value]) -> None:
        """Fail the case if an attitude is valid in standby, of a wrong length, not the truth, or not that of other fields."""
        if not self.is_valid(values):
            return
        if in_standby(probe):
            still = self.is_valid(probe.values(self.row)) and in_standby(probe)
            check(not still, "no valid attitude in standby (R11, docs/rules.md)", "a valid one")
        self._check_attitudes(probe, values)

    def _check_attitudes(self, probe: Probe, values: Mapping[str, Value]) -> None:
        """Compare the first attitude with the truth, and the others with both."""
        others: list[tuple[str, Axes, float]] = []
        truth = None if probe.truth is None else probe.truth()
        for reading in self.readings:
            axes = reading.axes(values, self.conventions)
            true = [] if truth is None else [(self._stated(truth, reading), axes_of(truth), 0.0)]
            for what, other, rounding_deg in (true + others)[:2]:
                error_deg = angle_deg(axes, other)
                limit_deg = TRUTH_DEG + reading.rounding_deg + rounding_deg
                numbers = tuple(round(float(values[item.name]), 4) for item in reading.fields)
                wanted = f"{what} in {reading}, to {limit_deg:.3g} deg"
                check(error_deg <= limit_deg, wanted, f"{numbers}, {error_deg:.2f} deg off")
            others.append((f"the attitude of {reading}", axes, reading.rounding_deg))

    def _stated(self, truth: Quaternion, reading: Reading) -> str:
        """Return the text of the true attitude: as a quaternion if the unit reports one, otherwise as angles."""
        if reading.form in (QUATERNION, VECTOR_PART):
            reported = as_reported(truth, self.conventions)
            return f"the true attitude {tuple(round(math.copysign(1.0, reported.w) * part, 4) for part in reported)}"
        ra, dec, roll = (round(angle, 3) for angle in to_radec_roll(truth))
        return f"the true attitude RA {ra} deg, Dec {dec} deg, roll {roll} deg"

    def _check_truth(self, probe: Probe) -> None:
        """Skip the case, which has passed, if the conjugate of the true attitude would have passed as well."""
        limits = [TRUTH_DEG + item.rounding_deg for item in self.readings if item.form.has_inverse]
        if probe.truth is None or not limits:
            return
        truth = probe.truth()
        turned = from_reported(conjugate(as_reported(truth, self.conventions)), self.conventions)
        error_deg = angle_deg(axes_of(turned), axes_of(truth))
        if error_deg <= max(limits):
            reason = f"a conjugated attitude would pass too: at this truth it is only {error_deg:.2f} deg off"
            raise CaseSkipped(f"{reason}; point the unit elsewhere")

    def _check_flag(self, probe: Probe, values: Mapping[str, Value]) -> None:
        """Fail the case if the true attitude is reported, but never as valid."""
        if self.flag is None or probe.truth is None or not self._is_stated(values):
            return
        try:
            self._check_attitudes(probe, values)
        except CaseFailed:
            return
        wanted = f"{self.flag} set within {ATTITUDE_S:g} s, because the reported attitude is the true one"
        raise CaseFailed(wanted, f"{self.flag} = {values[self.flag]!r}")


def _mode_fields(probe: Probe) -> Iterator[tuple[Row, Field]]:
    for row in probe.telemetry_rows():
        yield from (
            (row, item) for item in row.named.values() if item.value == "mode" and probe.carries(row, item)
        )


def reported_mode(probe: Probe) -> Value | None:
    """Return the mode that a row reports, the first of several with one number; None if no row does."""
    row, item = next(_mode_fields(probe), (None, None))
    return None if row is None or item is None else probe.values(row)[item.name]


def in_standby(probe: Probe) -> bool:
    """Return whether a row reports standby, by a number that stands for no other mode."""
    for row, item in _mode_fields(probe):
        if STANDBY not in item.shared:
            return probe.values(row)[item.name] == STANDBY
    return False


def check_mode(probe: Probe, commanded: str, *entered: str) -> None:
    """Fail the case unless rows report in time the mode commanded, or one since entered by itself (R13).

    A field that has no number for the commanded mode, or another mode's, is left out.
    """
    modes = (commanded, *entered)
    for row, item in _mode_fields(probe):
        if commanded not in (item.enum or {}):
            continue
        end = probe.now() + MODE_S
        while (seen := probe.values(row)[item.name]) not in modes:
            within = f"within {MODE_S:g} s of the telecommand (R13, docs/rules.md)"
            check(probe.now() < end, f"{item.name} of {row.name} {' or '.join(modes)} {within}", seen)
            probe.sleep(0.1)


def mode_command(probe: Probe, mode: Value | None) -> Callable[[], None] | None:
    """Return what commands a mode; None if no telecommand does, or the mode is unknown."""
    for row in probe.telecommands():
        if row.action != "set_mode" or mode is None:
            continue
        field = next((name for name, item in row.named.items() if item.argument == "mode"), None)
        if field is not None and mode in (row.named[field].enum or {}):
            return partial(probe.command, row.name, **{field: mode})
        if field is None and row.arguments.get("mode") == mode:
            return partial(probe.command, row.name)
    return None


def changes_mode(telecommands: Iterable[Row]) -> bool:
    return any(row.action == "set_mode" for row in telecommands)


@contextmanager
def identifying_stars(probe: Probe) -> Iterator[None]:
    """Have the unit identify stars, if a telecommand starts this; restore the mode that it reports afterwards."""
    start = mode_command(probe, SEARCHING)
    if start is None:
        yield
        return
    before = reported_mode(probe)
    restore = mode_command(probe, SEARCHING if before == TRACKING else before)
    start()
    try:
        yield
    finally:
        if restore is not None:
            restore()
