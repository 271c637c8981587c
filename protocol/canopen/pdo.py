"""Transmission and reception of PDOs, synchronous and event-driven (CiA 301, PDO)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.context import Context, EventKind, NmtState
from starhil.protocol.canopen.dictionary import check_value
from starhil.protocol.canopen.emergency import EmergencyCode, EmergencyProducer
from starhil.protocol.canopen.pdo_mapping import LAST_CYCLIC, Direction, Pdo


class ReceivePdo(Pdo):
    """Writes the mapped objects when its message arrives, or at the next SYNC if synchronous."""

    direction = Direction.RECEIVE

    def __init__(self, context: Context, number: int, emergency: EmergencyProducer) -> None:
        super().__init__(context, number)
        self._key = bytes([number + 1])
        self._error = partial(emergency.communication_error, key=self._key)
        self._size = 0
        self._pending: bytes | None = None
        self.next_deadline: float | None = None

    def configure(self) -> None:
        """Apply the current records and drop messages that wait for SYNC."""
        super().configure()
        self._size = sum(mapped.size for mapped in self._objects)
        self.stop()

    def stop(self) -> None:
        """Drop the message that waits for SYNC, and await no other in time."""
        self._pending = None
        self.next_deadline = None

    def receive(self, data: bytes) -> None:
        """Process a message in OPERATIONAL; report a wrong length and drop a message that is too short."""
        if self._context.state is not NmtState.OPERATIONAL:
            return
        detail = bytes([*self._key, len(data)])
        if len(data) < self._size:
            self._error(EmergencyCode.PDO_LENGTH_HIGH, active=False)
            self._error(EmergencyCode.PDO_LENGTH_LOW, detail)
            return
        self._error(EmergencyCode.PDO_LENGTH_LOW, active=False)
        self._error(EmergencyCode.RPDO_TIMEOUT, active=False)
        self._error(EmergencyCode.PDO_LENGTH_HIGH, detail, active=len(data) > self._size)
        self.next_deadline = self._context.now + self._event_s if self._event_s else None
        if self._synchronous:
            self._pending = data
        else:
            self._apply(data)

    def synchronise(self) -> None:
        """Apply the message that waits for SYNC."""
        if self._pending is not None:
            data, self._pending = self._pending, None
            self._apply(data)

    def tick(self) -> None:
        """Report that the next message did not arrive in time."""
        if self.next_deadline is not None and self._context.now >= self.next_deadline:
            self.next_deadline = None
            self._error(EmergencyCode.RPDO_TIMEOUT, self._key)

    def _apply(self, data: bytes) -> None:
        """Write all objects, or none if one value is outside its limits.

        Report a refusal by EMCY 8200h.
        """
        writes: list[tuple[int, int, bytes]] = []
        position = 0
        try:
            for mapped in self._objects:
                value = data[position : position + mapped.size]
                position += mapped.size
                if mapped.entry is not None:
                    check_value(mapped.entry.variable, value)
                    writes.append((*mapped.entry.key, value))
            for index, subindex, value in writes:
                self._context.dictionary.write(index, subindex, value)
        except SdoAbortError as refusal:
            self._context.report(EventKind.REFUSED, self.number + 1, f"RPDO: {refusal}")
            self._error(EmergencyCode.PROTOCOL, self._key + refusal.code.to_bytes(4, "little"))
            return
        self._error(EmergencyCode.PROTOCOL, active=False)


class TransmitPdo(Pdo):
    """Sends the mapped objects at SYNCs, at events or by its timer."""

    direction = Direction.TRANSMIT

    def __init__(self, context: Context, number: int) -> None:
        super().__init__(context, number)
        communication = self.direction + number
        self._inhibit, self._sync_start = (context.dictionary.find(communication, item) for item in (3, 6))
        self._inhibit.writer = self._check_disabled
        self._sync_start.writer = self._check_sync_start
        self.keys: frozenset[tuple[int, int]] = frozenset()
        """Keys of the mapped entries."""
        self._event = False
        self._syncs = 0
        self._started = False
        self._free_at = 0.0
        self._event_at: float | None = None

    def configure(self) -> None:
        """Apply the current records and restart the timers and the SYNC count."""
        super().configure()
        self.keys = frozenset(mapped.entry.key for mapped in self._objects if mapped.entry is not None)
        self.stop()

    def stop(self) -> None:
        """Drop the event that waits, and restart the timers and the SYNC count."""
        self._event = False
        self._syncs = 0
        self._started = self._sync_start.number() == 0
        self._free_at = self._context.now
        self._restart_timer()

    @property
    def active(self) -> bool:
        return self.exists and self._context.state is NmtState.OPERATIONAL

    @property
    def next_deadline(self) -> float | None:
        """When the event timer expires or the inhibit time ends for a waiting event."""
        due = self._free_at if self._event else self._event_at
        if due is None or not self.active or self._synchronous:
            return None
        return max(due, self._free_at)

    def start(self) -> None:
        """Enter OPERATIONAL: an event-driven PDO is sent once, acyclic ones wait for an event."""
        self._syncs = 0
        self._started = self._sync_start.number() == 0
        self._restart_timer()
        self._event = not self._synchronous

    def trigger(self, keys: Iterable[tuple[int, int]]) -> None:
        """Mark an event of these objects; `tick` sends an event-driven PDO once the inhibit time allows."""
        if self.active and not self.keys.isdisjoint(keys):
            self._event = True

    def synchronise(self, counter: int) -> None:
        """Act on a SYNC with this counter (0 if it carries none)."""
        kind = self._type.number()
        if not self.active or not self._synchronous:
            return
        if kind == 0:
            if self._event:
                self._send()
            return
        if not self._started:
            if counter and counter != self._sync_start.number():
                return
            self._started = True
            self._syncs = kind - 1
        self._syncs += 1
        if self._syncs >= kind:
            self._syncs = 0
            self._send()

    def tick(self) -> None:
        """Send the PDOs that are due by event or timer."""
        deadline = self.next_deadline
        if deadline is None or self._context.now < deadline:
            return
        due = None if self._event else self._event_at
        self._send()
        period = self._event_s
        if due is not None and period and due + period > self._context.now:
            self._event_at = due + period  # a late transmission does not shift the next one

    def _restart_timer(self) -> None:
        period = self._event_s
        self._event_at = self._context.now + period if period else None

    def _send(self) -> None:
        self._event = False
        self._restart_timer()
        try:
            data = b"".join(mapped.entry.read() for mapped in self._objects if mapped.entry is not None)
        except SdoAbortError as refusal:
            self._context.report(EventKind.REFUSED, self.number + 1, f"TPDO: {refusal}")
            return
        self._free_at = self._context.now + self._inhibit.number() * 1e-4
        self._context.send(self.can_id, data)

    def _check_disabled(self, data: bytes) -> None:
        if self._valid:
            raise SdoAbortError(AbortCode.VALUE_RANGE, f"disable the PDO before setting it to {data.hex()}")

    def _check_sync_start(self, data: bytes) -> None:
        if data[0] > LAST_CYCLIC:
            raise SdoAbortError(AbortCode.VALUE_RANGE, "SYNC start value is 0 to 240")
        self._check_disabled(data)


class PdoService:
    """All PDOs of a node."""

    def __init__(self, context: Context, emergency: EmergencyProducer) -> None:
        self._context = context
        numbers = partial(Direction.numbers, indices=context.dictionary.od.indices)
        self.receiving = [ReceivePdo(context, number, emergency) for number in numbers(Direction.RECEIVE)]
        self.transmitting = [TransmitPdo(context, number) for number in numbers(Direction.TRANSMIT)]
        self._all: list[ReceivePdo | TransmitPdo] = [*self.transmitting, *self.receiving]

    def configure(self, changed: Iterable[tuple[int, int]] | None = None) -> None:
        """Configure the PDOs with one of the changed entries in their records, or all."""
        indices = None if changed is None else {index for index, _ in changed}
        for pdo in self._all:
            if indices is None or not indices.isdisjoint(pdo.indices):
                pdo.configure()

    @property
    def next_deadline(self) -> float | None:
        """When the next timer of a PDO expires."""
        times = [pdo.next_deadline for pdo in self._all]
        return min((time for time in times if time is not None), default=None)

    def start(self) -> None:
        """Enter OPERATIONAL."""
        for transmitting in self.transmitting:
            transmitting.start()

    def stop(self) -> None:
        """Leave OPERATIONAL: drop all pending messages."""
        for pdo in self._all:
            pdo.stop()

    def trigger(self, keys: Iterable[tuple[int, int]]) -> None:
        """Trigger the TPDOs that map one of these objects."""
        for pdo in self.transmitting:
            pdo.trigger(keys)

    def mapped_by(self, can_id: int) -> frozenset[tuple[int, int]]:
        """Return the keys of the entries in the TPDO with a CAN ID; none if no TPDO has it."""
        return frozenset().union(
            *(pdo.keys for pdo in self.transmitting if pdo.active and pdo.can_id == can_id)
        )

    def synchronise(self, counter: int) -> None:
        """Act on a SYNC: first send samples of this instant, then apply received messages."""
        for transmitting in self.transmitting:
            transmitting.synchronise(counter)
        for receiving in self.receiving:
            receiving.synchronise()

    def tick(self) -> None:
        for pdo in self._all:
            pdo.tick()
