"""Error control: heartbeat producer and consumer, node guarding and life guarding (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import ERROR_CONTROL
from starhil.protocol.canopen.context import Context, EventKind, NmtState
from starhil.protocol.canopen.dictionary import Entry
from starhil.protocol.canopen.emergency import EmergencyCode, EmergencyProducer

GUARD_TIME: Final = (0x100C, 0)
LIFE_FACTOR: Final = (0x100D, 0)
CONSUMERS: Final = 0x1016
PRODUCER: Final = (0x1017, 0)
GUARDING_KEY: Final = b"guarding"


@dataclass
class Monitor:
    """Supervision of the heartbeat of one node; it begins with the first heartbeat."""

    period_s: float
    deadline: float | None = None
    lost: bool = False


class ErrorControl:
    """Produces the heartbeat of this node and supervises other nodes' heartbeats.

    `on_failure` is called when a supervised node or the guarding master falls silent; it applies the error behaviour of
    1029h.
    """

    def __init__(
        self, context: Context, emergency: EmergencyProducer, on_failure: Callable[[], None]
    ) -> None:
        self._context = context
        self._emergency = emergency
        self._on_failure = on_failure
        dictionary = context.dictionary
        self._guard_time = dictionary.find(*GUARD_TIME)
        self._life_factor = dictionary.find(*LIFE_FACTOR)
        self._producer = dictionary.find(*PRODUCER)
        self._producer.writer = self._producer_changed
        self._consumers = [entry for entry in dictionary if entry.key[0] == CONSUMERS and entry.key[1] > 0]
        for entry in self._consumers:
            entry.writer = partial(self._consumer_changed, entry)
        self._monitors: dict[int, Monitor] = {}
        self._toggle = 0
        self._next_heartbeat: float | None = None
        self._life_deadline: float | None = None
        self._guarding_lost = False

    def configure(self) -> None:
        """Reset: toggle bit 0, next heartbeat after one period, no heartbeat received yet."""
        self._toggle = 0
        self._life_deadline = None
        self._guarding_lost = False
        self._monitors.clear()
        for entry in self._consumers:
            self._watch(entry.number())
        self._schedule(self._producer.number())

    @property
    def next_deadline(self) -> float | None:
        """When the next heartbeat is due or a supervision expires."""
        times = [
            self._next_heartbeat,
            self._life_deadline,
            *(watch.deadline for watch in self._monitors.values()),
        ]
        return min((time for time in times if time is not None), default=None)

    def receive_heartbeat(self, node_id: int, data: bytes) -> None:
        """Process an error control message of another node (heartbeat or boot-up)."""
        monitor = self._monitors.get(node_id)
        if monitor is None or len(data) != 1 or node_id == self._context.node_id:
            return
        if data[0] == 0:
            self._context.report(EventKind.NODE_BOOTED, node_id)
        monitor.deadline = self._context.now + monitor.period_s
        if monitor.lost:
            monitor.lost = False
            self._context.report(EventKind.NODE_FOUND, node_id)
            self._emergency.clear_error(EmergencyCode.HEARTBEAT, key=bytes([node_id]))

    def receive_guarding(self) -> None:
        """Answer the guarding request of the master, unless the heartbeat is in use."""
        if self._producer.number() or self._context.state is NmtState.INITIALISING:
            return
        self._context.send(ERROR_CONTROL + self._context.node_id, bytes([self._toggle | self._context.state]))
        self._toggle ^= 0x80
        life_s = self._guard_time.number() * self._life_factor.number() * 1e-3
        self._life_deadline = self._context.now + life_s if life_s else None
        if self._guarding_lost:
            self._guarding_lost = False
            self._context.report(EventKind.GUARDING_FOUND)
            self._emergency.clear_error(EmergencyCode.HEARTBEAT, key=GUARDING_KEY)

    def tick(self) -> None:
        """Send the heartbeat if it is due, and check which nodes have fallen silent."""
        now = self._context.now
        if self._next_heartbeat is not None and now >= self._next_heartbeat:
            self._context.send(ERROR_CONTROL + self._context.node_id, bytes([self._context.state]))
            self._next_heartbeat = max(self._next_heartbeat + self._producer.number() * 1e-3, now)
        for node_id, monitor in self._monitors.items():
            if monitor.deadline is not None and now >= monitor.deadline:
                monitor.deadline = None
                monitor.lost = True
                self._context.report(EventKind.NODE_LOST, node_id)
                self._failed(bytes([node_id]), bytes([node_id]))
        if self._life_deadline is not None and now >= self._life_deadline:
            self._life_deadline = None
            self._guarding_lost = True
            self._context.report(EventKind.GUARDING_LOST)
            self._failed(GUARDING_KEY, b"")

    def _failed(self, key: bytes, data: bytes) -> None:
        self._emergency.communication_error(EmergencyCode.HEARTBEAT, data, key=key)
        self._on_failure()

    def _schedule(self, period_ms: int) -> None:
        self._next_heartbeat = self._context.now + period_ms * 1e-3 if period_ms else None

    def _producer_changed(self, data: bytes) -> None:
        period_ms = int.from_bytes(data, "little")
        self._schedule(period_ms)
        if period_ms:
            self._life_deadline = None

    def _consumer_changed(self, entry: Entry, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        node_id, period_ms = _consumer(value)
        others = [_consumer(other.number()) for other in self._consumers if other is not entry]
        if period_ms and any(other == node_id and period for other, period in others):
            raise SdoAbortError(AbortCode.INCOMPATIBLE, f"node {node_id} is supervised by another entry")
        old, old_period_ms = _consumer(entry.number())
        if old_period_ms and self._monitors.pop(old, None) is not None:
            self._emergency.clear_error(EmergencyCode.HEARTBEAT, key=bytes([old]))
        self._watch(value)

    def _watch(self, value: int) -> None:
        node_id, period_ms = _consumer(value)
        if 1 <= node_id <= 127 and period_ms:
            self._monitors[node_id] = Monitor(period_ms * 1e-3)


def _consumer(value: int) -> tuple[int, int]:
    """Return node ID and period, ms, of an entry of 1016h."""
    return value >> 16 & 0xFF, value & 0xFFFF
