"""The events of a head since the start of the run: modes, validity, faults, telecommands with their outcome, clock, notes."""

from __future__ import annotations

import json
import time
from collections import defaultdict, deque
from dataclasses import asdict, dataclass
from typing import Any, Final

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.device.signals import Executed
from starhil.emulator.links.traffic import CONSOLE_ADDRESS, values_text
from starhil.emulator.run.head import Head
from starhil.emulator.run.tape import LONGEST_NOTE
from starhil.emulator.simulation.signal import Signal
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.messages import ErrorCode

KEPT_OF_A_KIND: Final = 1000
"""Number of kept events of each kind: many telecommands do not end what is known of the modes."""

LONGEST_TEXT: Final = 500
"""Longest text of an event, characters."""


@dataclass(frozen=True)
class RunEvent:
    """An event.

    Attributes
    ----------
    n
        Its number.
    t
        Simulation time, seconds.
    wall_s
        Unix time of the machine, seconds.
    kind
        `mode`, `attitude`, `fault`, `telecommand`, `clock`, `page` or `note`.
    level
        `info`, `good` or `bad`.
    """

    n: int
    t: float
    wall_s: float
    kind: str
    text: str
    level: str = "info"


class EventLog:
    """Keeps the events of a head, numbered; listens from the moment it is made."""

    def __init__(self, head: Head) -> None:
        self.added: Signal[RunEvent] = Signal("event")
        self._head = head
        self._events: dict[int, RunEvent] = {}
        self._of_kind: defaultdict[str, deque[int]] = defaultdict(deque)
        self._count = 0
        self.valid: bool | None = None
        """Whether the attitude of the last frame is valid; None in a mode without frames."""
        self._faults: dict[str, str] = {}
        device = head.device
        self._offset_ns = device.time.offset_ns
        device.signals.mode_changed.connect(self._mode_changed)
        device.signals.frame_published.connect(self._frame_published)
        device.signals.faults_changed.connect(self._faults_changed)
        device.signals.executed.connect(self._executed)
        self.add("mode", device.modes.mode.value.replace("_", " "))

    @property
    def start(self) -> int:
        """Number of the first event that is kept."""
        return next(iter(self._events), self._count)

    @property
    def end(self) -> int:
        """Number of the next event."""
        return self._count

    def texts(self, numbers: range) -> list[str]:
        """Return those of the events that are kept, as JSON."""
        return [json.dumps(asdict(self._events[number])) for number in numbers if number in self._events]

    def events(self) -> list[RunEvent]:
        """Return all events that are kept, oldest first."""
        return list(self._events.values())

    def add(self, kind: str, text: str, level: str = "info", at_s: float | None = None) -> RunEvent:
        """Add an event, now or at a simulation time, and report it."""
        run_s = self._head.clock.now_ns() / NANOSECONDS if at_s is None else at_s
        event = RunEvent(self._count, run_s, time.time(), kind, text[:LONGEST_TEXT], level)
        self._events[event.n] = event
        self._count += 1
        numbers = self._of_kind[kind]
        numbers.append(event.n)
        if len(numbers) > KEPT_OF_A_KIND:
            del self._events[numbers.popleft()]
        self.added.emit(event)
        return event

    def note(self, text: str, at_s: float | None = None) -> RunEvent:
        return self.add("note", text[:LONGEST_NOTE], at_s=at_s)

    def _mode_changed(self, transition: Transition) -> None:
        self._look_at_clock()
        error = self._head.device.modes.error if transition.after is Mode.ERROR else ""
        text = f"{transition.before.value} → {transition.after.value}{f': {error}' if error else ''} ({transition.cause.value})"
        self.add("mode", text.replace("_", " "), "bad" if error else "info")
        if not transition.after.makes_frames:
            self.valid = None

    def _frame_published(self, measurement: Measurement) -> None:
        self._look_at_clock()
        if measurement.valid != self.valid:
            self.valid = measurement.valid
            text = "valid" if measurement.valid else f"not valid: {measurement.reason.replace('_', ' ')}"
            self.add(
                "attitude", text, "good" if measurement.valid else "bad", measurement.mid_ns / NANOSECONDS
            )

    def _faults_changed(self, request: dict[str, Any]) -> None:
        """Add what has begun and ended; faults that end by themselves, such as a reset, are in the request alone."""
        active, commands = _by_name(self._head.faults.describe()), _by_name(request)
        for name in self._faults:
            if name not in active:
                self.add("fault", f"end: {name}", "good")
        for name, value in (commands | active).items():
            if self._faults.get(name) != value and (name in active or json.loads(value)):
                self.add("fault", f"begin: {name} {value}", "bad")
        self._faults = active

    def _executed(self, executed: Executed) -> None:
        request, row, icd = executed.request, executed.row, self._head.icd
        name = f"id {request.id}" if row is None else f"{row.name}{values_text(row, request.data)}"
        done = executed.code is ErrorCode.OK
        outcome = "accepted" if done else f"refused: {icd.error_name(int(executed.code))}"
        sender = "console: " if executed.console or request.source == CONSOLE_ADDRESS else ""
        self.add("telecommand", f"{sender}{name} {outcome}", "info" if done else "bad")
        self._look_at_clock()

    def _look_at_clock(self) -> None:
        """Add an event if the device's clock was set."""
        offset_ns = self._head.device.time.offset_ns
        if offset_ns != self._offset_ns:
            moved_s = (offset_ns - self._offset_ns) / NANOSECONDS
            self._offset_ns = offset_ns
            self.add("clock", f"device clock set, moved by {moved_s:+.6g} s")


def _by_name(levels: dict[str, Any]) -> dict[str, str]:
    """Return the faults of all levels as JSON, by level and name; those of a level with a list have themselves as names."""
    faults: dict[str, str] = {}
    for level, content in levels.items():
        if isinstance(content, dict):
            faults |= {f"{level} {name}": json.dumps(value) for name, value in content.items()}
        elif isinstance(content, list):
            faults |= {f"{level} {json.dumps(fault)}": "true" for fault in content}
    return faults
