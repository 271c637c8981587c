"""Unsolicited telemetry: lists of rows, each sent at a rate or with each frame, and rows sent after events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.device.parameters import Parameters
from starhil.emulator.device.signals import Signals
from starhil.emulator.simulation.scheduler import Event, Scheduler
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import NANOSECONDS

LONGEST_PERIOD_NS: Final = 1e18
"""Period of a row whose rate is hardly above zero, nanoseconds: longer than any run."""


@dataclass(frozen=True)
class Subscription:
    """A telemetry row and its rate, Hz; None: with each frame."""

    row: Row
    rate_hz: float | None


class Subscriptions:
    """Schedule of the rows that are sent unsolicited: by the definition, by telecommand and by two parameters.

    The parameters `unsolicited_selection` and `unsolicited_rate` select a row of their own. The rows that the
    definition sends at a rate, or after events, are sent whatever the telecommands and parameters select.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        scheduler: Scheduler,
        parameters: Parameters,
        now_ns: Callable[[], int],
        signals: Signals,
    ) -> None:
        self._icd = icd
        self._scheduler = scheduler
        self._parameters = parameters
        self._now_ns = now_ns
        self._send = signals.rows_due.emit
        self._lists: dict[str, Sequence[Subscription]] = {}
        self._events: dict[tuple[str, int], Event] = {}
        self._valid = False
        """Whether there is a valid attitude."""
        sent = [(row, row.unsolicited) for row in icd.telemetry.values() if row.unsolicited is not None]
        self._streamed = [Subscription(row, rate) for row, rate in sent if isinstance(rate, float)]
        self._reports = [(row, frozenset(events)) for row, events in sent if not isinstance(events, float)]
        signals.frame_published.connect(self._frame_published)
        signals.mode_changed.connect(self._mode_changed)
        signals.parameters_changed.connect(self._parameters_changed)
        signals.started.connect(self._restart)

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if names & {"unsolicited_rate", "unsolicited_selection"}:
            self._subscribe_by_parameters()

    def _restart(self, _cause: str) -> None:
        for origin in list(self._lists):
            self.replace(origin, ())
        self._valid = False
        self.replace("definition", self._streamed)
        self._subscribe_by_parameters()
        self._send(self._reporting("start"))

    def _reporting(self, event: str) -> list[Row]:
        return [row for row, events in self._reports if event in events]

    def _mode_changed(self, change: Transition) -> None:
        due: list[Row] = []
        if change.before is not change.after:
            due += self._reporting("mode")
        if change.after is Mode.ERROR:
            due += self._reporting("error")
        if not change.after.makes_frames:
            due += self._reporting_validity(valid=False)
        self._send(due)

    def _reporting_validity(self, *, valid: bool) -> list[Row]:
        """Return the rows that report a change of the validity, if this is one."""
        changed, self._valid = valid is not self._valid, valid
        return self._reporting("validity") if changed else []

    def _subscribe_by_parameters(self) -> None:
        rate_hz = float(self._parameters["unsolicited_rate"])
        row = self._icd.telemetry_row(int(self._parameters["unsolicited_selection"]))
        self.replace("parameters", [Subscription(row, rate_hz)] if row is not None and rate_hz > 0.0 else [])

    def replace(self, origin: str, subscriptions: Sequence[Subscription]) -> None:
        """Replace the list of one origin (a telecommand, or parameters) from now on."""
        for key in [key for key in self._events if key[0] == origin]:
            self._events.pop(key).cancel()
        self._lists[origin] = subscriptions
        for number, subscription in enumerate(subscriptions):
            if subscription.rate_hz is not None:
                self._schedule((origin, number), subscription.row, subscription.rate_hz, self._now_ns())

    def _frame_published(self, measurement: Measurement) -> None:
        """Send the rows that are due with each frame."""
        due = self._reporting("frame") + self._reporting_validity(valid=measurement.valid)
        for subscriptions in self._lists.values():
            due += [subscription.row for subscription in subscriptions if subscription.rate_hz is None]
        self._send(due)

    def _schedule(self, key: tuple[str, int], row: Row, rate_hz: float, due_ns: int) -> None:
        period_ns = max(1, round(min(NANOSECONDS / rate_hz, LONGEST_PERIOD_NS)))

        def due(at_ns: int) -> None:
            missed = max(0, (self._now_ns() - at_ns) // period_ns)
            self._schedule(key, row, rate_hz, at_ns + (missed + 1) * period_ns)
            self._send([row])

        self._events[key] = self._scheduler.at(due_ns, due)
