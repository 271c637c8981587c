"""Times and counts in telemetry, against the tester's clock and what it has sent.

::

    reading ── from t1 to t2 ──┐  requests, a pause  ┌── from t3 to t4 ── reading
    a time   advances by t3 - t2 to t4 - t1, to the resolution of its field and `DRIFT`
    a count  advances by what was sent, a count of frames with time

The clocks of unit and tester need not agree: only elapsed times are compared. Source: docs/quantities.md, which says
what each quantity counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Final

from starhil.hil_tests.conformance.attitude_cases import changes_mode, identifying_stars
from starhil.hil_tests.conformance.case import Case, CaseSkipped, Probe, case_in, check
from starhil.hil_tests.conformance.link_probe import FRAME_S, LinkProbe
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

PAUSE_S: Final = 1.5
"""Time between two readings: more than the second of a time in whole seconds."""
DRIFT: Final = 0.01
"""Largest difference between the rates of the two clocks."""
REQUESTS_BETWEEN: Final = 3
"""Requests sent between two readings."""
FRAME_RATE_HZ: Final = 100.0
"""Highest rate of measurements."""
DAY_S: Final = 86_400.0
SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FRACTIONS_OF: Final = {
    "uptime": (),
    "uptime.seconds": ("uptime.milliseconds",),
    "clock.unix": (),
    "clock.seconds": ("clock.milliseconds", "clock.microseconds", "clock.nanoseconds"),
    "clock.day": ("clock.day_milliseconds", "clock.submilliseconds"),
    "frame.time": (),
    "frame.time_seconds": ("frame.time_nanoseconds",),
}
"""Times that go on without end, and the fractions that may stand beside them in a row."""
COUNT_INCREMENTS: Final = {
    "counters.telemetry": (1, 0),
    "counters.telecommands": (0, 1),
    "counters.requests": (1, 1),
}
"""Counts of requests: how much a telemetry request and a telecommand add."""
FRAMES: Final = frozenset({"frame.counter", "counters.frames"})


@dataclass(frozen=True)
class Time:
    """A time in a row: fields that add up to it."""

    fields: tuple[Field, ...]

    def __str__(self) -> str:
        return " + ".join(item.name for item in self.fields)

    @property
    def of_frame(self) -> bool:
        """Whether it is the time of a measurement."""
        return self.fields[0].quantity.startswith("frame.")

    @property
    def resolution_s(self) -> float:
        """Largest error of a difference by the rounding of the fields, s."""
        return max(min(2.0 * item.resolution * _seconds(item) for item in self.fields), 1e-6)

    def seconds(self, seen: Mapping[str, Value]) -> float:
        return sum(float(seen[item.name]) * _seconds(item) for item in self.fields)

    def passed(self, before: Mapping[str, Value], after: Mapping[str, Value], epoch: str) -> float:
        """Return the difference of two times, s; a time of the day or one that wraps begins again."""
        whole = self.fields[0]
        passed = self.seconds(after) - self.seconds(before)
        span = _span(whole) * _seconds(whole) if whole.wrap else 0.0
        if epoch == "midnight" and not whole.quantity.startswith("uptime"):
            span = min(span or DAY_S, DAY_S)
        return passed + span if passed < 0.0 else passed


def _seconds(item: Field) -> float:
    return DAY_S if item.quantity == "clock.day" else SECONDS.get(item.unit, 1.0)


def _span(item: Field) -> float:
    low, high = item.raw_limits
    return (high - low + 1) * abs(item.scale)


def times_of(row: Row) -> Iterator[Time]:
    """Yield the times in a row; the nth whole number has the nth of each fraction."""
    named = list(row.named.values())
    for whole, fractions in FRACTIONS_OF.items():
        for number, item in enumerate([field for field in named if field.quantity == whole]):
            parts = [[field for field in named if field.quantity == name] for name in fractions]
            yield Time((item, *(found[number] for found in parts if number < len(found))))


def counts_of(row: Row, quantities: Mapping[str, object] | frozenset[str]) -> list[Field]:
    return [item for item in row.named.values() if item.quantity in quantities and item.kind == "integer"]


def plain_command(unit: Unit) -> Row | None:
    """Return a telecommand without effect that is acknowledged; None if there is none."""
    return next(
        (
            row
            for row in unit.telecommands.values()
            if row.action in (None, "nothing") and "reply" in unit.serial_answers(row)
        ),
        None,
    )


def clock_cases(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield the cases for rows with times or counts that can be read."""
    command = plain_command(unit)
    for row in unit.telemetry.values():
        if row.only_sent and not row.is_streamed:
            continue
        times = [item for item in times_of(row) if not item.of_frame]
        counts = [item for item in counts_of(row, COUNT_INCREMENTS) if unit.readable and not row.only_sent]
        counted_requests = [item for item in counts if COUNT_INCREMENTS[item.quantity][0]]
        if times or counted_requests:
            title = (
                f"times and counts of requests in {row.name} advance as the tester's clock and requests do"
            )
            run = partial(_clocks, row, times, counted_requests)
            yield case_in("clocks", row.name, title, run, row)
        commanded = [item for item in counts if COUNT_INCREMENTS[item.quantity][1]]
        if commanded and command is not None:
            title = f"counts of telecommands in {row.name} advance as they are sent"
            run = partial(_commands, row, commanded, command)
            yield case_in("clocks", f"{row.name}.telecommands", title, run, row, intrusive=True)
        measured = [item for item in times_of(row) if item.of_frame]
        frames = counts_of(row, FRAMES)
        if measured or frames:
            title = f"times and counts of measurements in {row.name} advance as the tester's clock does"
            run = partial(_measurements, row, measured, frames)
            intrusive = changes_mode(unit.telecommands.values())
            yield case_in("clocks", f"{row.name}.frames", title, run, row, intrusive=intrusive)


@dataclass(frozen=True)
class Passage:
    """Two readings of a row, and the shortest and longest time between them, s."""

    before: Mapping[str, Value]
    after: Mapping[str, Value]
    least_s: float
    most_s: float

    def within(self, tolerance_s: float) -> tuple[float, float]:
        """Return the bounds of a time that passed, s."""
        return self.least_s * (1.0 - DRIFT) - tolerance_s, self.most_s * (1.0 + DRIFT) + tolerance_s


def passage_of(probe: Probe, row: Row, between: Callable[[], None]) -> Passage:
    """Read a row before and after something."""
    t1 = probe.now()
    before = probe.values(row)
    t2 = probe.now()
    between()
    t3 = probe.now()
    after = probe.values(row)
    return Passage(before, after, t3 - t2, probe.now() - t1)


def _counted(item: Field, passage: Passage) -> float | None:
    """Return by how much a count has advanced; None if it stands at its limit, which it does not leave."""
    before, after = float(passage.before[item.name]), float(passage.after[item.name])
    if after >= item.limits[1] and not item.wrap:
        return None
    return after - before + (_span(item) if after < before and item.wrap else 0.0)


def _check_sent(row: Row, counts: list[Field], passage: Passage, telemetry: int, telecommands: int) -> None:
    for item in counts:
        count = _counted(item, passage)
        per_read, per_command = COUNT_INCREMENTS[item.quantity]
        wanted = (telemetry * per_read + telecommands * per_command) * 1.0
        at = f"{row.name}.{item.name} ({item.quantity}) {wanted:g} more"
        check(count in (None, wanted), at, f"{passage.before[item.name]!s} and {passage.after[item.name]!s}")


def check_times(row: Row, times: list[Time], passage: Passage, epoch: str) -> None:
    """Fail the case unless times have advanced as the tester's clock has."""
    for item in times:
        low, high = passage.within(item.resolution_s)
        passed = item.passed(passage.before, passage.after, epoch)
        wanted = f"{row.name}.{item} {low:.3f} to {high:.3f} s later, by the tester's clock"
        check(low <= passed <= high, wanted, f"{passed:.9g} s")


def _clocks(row: Row, times: list[Time], counts: list[Field], probe: LinkProbe) -> None:
    def wait() -> None:
        for _ in range(REQUESTS_BETWEEN if probe.unit.readable else 0):
            probe.expect_alive()
        probe.sleep(PAUSE_S)

    passage = passage_of(probe, row, wait)
    check_times(row, times, passage, probe.unit.conventions.epoch)
    _check_sent(row, counts, passage, REQUESTS_BETWEEN + 1, 0)


def _commands(row: Row, counts: list[Field], command: Row, probe: LinkProbe) -> None:
    def send() -> None:
        for _ in range(REQUESTS_BETWEEN):
            probe.send_command(command, command.encode())

    _check_sent(row, counts, passage_of(probe, row, send), 1, REQUESTS_BETWEEN)


def _measurements(row: Row, times: list[Time], counts: list[Field], probe: LinkProbe) -> None:
    """Compare what changes with each measurement, while there are measurements."""
    commanded = changes_mode(probe.unit.telecommands.values())
    with identifying_stars(probe) if commanded else nullcontext():
        probe.sleep(PAUSE_S)
        passage = passage_of(probe, row, partial(probe.sleep, 2 * PAUSE_S))
    still = []
    for time in times:
        passed = time.passed(passage.before, passage.after, probe.unit.conventions.epoch)
        if passed == 0.0 or time.seconds(passage.before) == 0.0:
            still.append(str(time))
            continue
        low, high = passage.within(FRAME_S + time.resolution_s)
        wanted = f"{row.name}.{time} at most {high:.3f} s later, by the tester's clock"
        check(max(low, time.resolution_s / 4) <= passed <= high, wanted, f"{passed:.9g} s")
    for item in counts:
        count = _counted(item, passage)
        if not count:
            still.append(item.name)
            continue
        most = passage.most_s * FRAME_RATE_HZ + 1.0
        check(0.0 < count <= most, f"{row.name}.{item.name} at most {most:.0f} more", f"{count:g}")
    if still:
        raise CaseSkipped(f"not judged, because nothing was measured meanwhile: {', '.join(still)}")
