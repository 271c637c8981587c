"""The CANopen link: connects the slave of `starhil.protocol.canopen` to a device, its clock and a CAN transport."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Final, TypeAlias

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.device.state_store import CANOPEN_FILE
from starhil.emulator.device.telemetry_faults import Hits, TelemetryFault
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import Link
from starhil.emulator.links.bus_address import BusAddress
from starhil.emulator.links.can import CanDamage
from starhil.emulator.sensor.pipeline.messages import ImageResult
from starhil.protocol.can.frame import MAX_STANDARD_ID, CanFrame
from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import GreyImage, abort_of, check_status
from starhil.protocol.canopen.cob import SDO_RECEIVE, SDO_TRANSMIT
from starhil.protocol.canopen.context import UNCONFIGURED_NODE, EventKind, SlaveEvent
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.canopen.emergency import EmergencyCode, ErrorRegister
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.canopen.storage import FileStorage, ParameterStorage, StorageError
from starhil.protocol.canopen.store_restore import Ended, write_at_once
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.icd.values import MessageError, Value
from starhil.protocol.messages import Reply
from starhil.protocol.transports.base import Transport

log = logging.getLogger("starhil.canopen")

MILLISECOND_NS: Final = NANOSECONDS // 1000
DEVICE_ERROR: Final = 0xFF00
"""Base of the EMCY error codes for the error mode; the number in `device_error` is added."""
FRAME_QUANTITIES: Final = ("attitude.", "rate.", "frame.", "stars.", "stars[")
"""Prefixes of the names of quantities that change with each exposure; it triggers TPDOs that map a row with
one of them."""
STATUS_QUANTITY: Final = "mode"
"""TPDOs that map a row with this quantity are triggered when it or the validity of the attitude changes."""

SDO_SEGMENT: Final = 0
SDO_UPLOAD: Final = 2
SDO_INITIATED: Final = (SDO_UPLOAD, 3, 4, 6)
"""Server command specifiers: a segment of an upload, and the answers that begin or refuse a transfer."""
SDO_TOGGLE: Final = 0x10

Action: TypeAlias = Callable[..., list[CanFrame]]
"""An action of the slave at a time, its argument `now`, seconds."""


def rows_reporting(icd: InterfaceDefinition, prefixes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the telemetry rows with a quantity whose name has one of these prefixes."""
    return tuple(
        row.name
        for row in icd.telemetry.values()
        if any(field.value is not None and field.value.startswith(prefixes) for field in row.fields)
    )


def not_before(deadline: float) -> int:
    """Return the first whole nanosecond that is not before a deadline in seconds.

    The arithmetic is exact: on the stepped clock, a wake-up one nanosecond early would repeat forever.
    """
    numerator, denominator = deadline.as_integer_ratio()
    return -(-numerator * NANOSECONDS // denominator)


class DeviceSample:
    """The device at one moment, `starhil.protocol.canopen.application.Sample`."""

    def __init__(self, requests: Requests, snapshot: Snapshot, hits: dict[str, Hits]) -> None:
        self._requests = requests
        self._shot = snapshot
        self._hits = hits

    def telemetry(self, row: Row) -> bytes:
        hits = self._hits[row.name] = self._requests.faults.hits(row, self._shot)
        try:
            return self._requests.telemetry(row.name, self._shot, hits)
        except Refused as refused:
            check_status(refused.code, row.name)
            raise

    def parameter(self, name: str) -> Value:
        return self._shot.parameters[name]


class DeviceApplication:
    """The application of the object dictionary, `starhil.protocol.canopen.application.Application`."""

    def __init__(self, requests: Requests, finish: Callable[[Deferred, SdoAbortError | None], None]) -> None:
        self._requests = requests
        self._device = requests.device
        self._finish_write = finish
        self._last_image: GreyImage | None = None
        self.hits: dict[str, Hits] = {}
        """Faults of the rows that were read in this sampling instant."""

    def clear(self) -> None:
        """Discard the captured image, because the device has restarted."""
        self._last_image = None

    def sample(self) -> DeviceSample:
        return DeviceSample(self._requests, self._device.snapshot(), self.hits)

    def telecommand(self, row: Row, payload: bytes) -> Deferred | None:
        """Execute a telecommand, which is counted and acknowledged as on the other links."""

        def refusal(replies: list[Reply]) -> SdoAbortError | None:
            try:
                for reply in replies:
                    check_status(reply.code, row.name)
            except SdoAbortError as abort:
                return abort
            return None

        answer = self._requests.handle(self._device.icd.request(row, payload))
        if isinstance(answer, PendingAnswer):
            return self._deferred(answer.then(refusal))
        abort = refusal(answer)
        if abort is not None:
            raise abort
        return None

    def set_parameter(self, name: str, value: Value) -> None:
        """Set a parameter; a value that contradicts another parameter is refused."""
        try:
            self._device.parameters.set({name: value})
        except MessageError as error:
            raise abort_of(error) from None

    def image(self, name: str) -> GreyImage:
        """Return the image that `take_image` captured, or the one that save_image stored."""
        if name == "stored":
            stored = self._device.images.state.stored
            if stored is not None:
                return GreyImage(stored.edge, stored.edge, stored.frame, stored.pixels)
        elif self._last_image is not None:
            return self._last_image
        raise SdoAbortError(AbortCode.NO_DATA, f"{name} image")

    def take_image(self, name: str) -> Deferred:
        """Capture a full image; the write is answered when it is complete."""
        if self._device.images.state.busy:
            raise SdoAbortError(AbortCode.DEVICE_STATE, f"{name}: another image is being captured")

        def captured(image: ImageResult | None) -> SdoAbortError | None:
            if image is None:
                return SdoAbortError(AbortCode.HARDWARE, "no frame")
            self._last_image = GreyImage(image.width, image.height, image.frame, image.pixels)
            return None

        return self._deferred(self._device.images.capture_full().then(captured))

    def save(self) -> Deferred:
        """Save the parameters of the device (1010h); the write is answered when they are on disk."""
        return self._deferred(self._device.save_parameters().then(_storage_refusal))

    def restore(self) -> Deferred:
        """Restore the defaults at the next restart (1011h)."""
        return self._deferred(self._device.forget_parameters().then(_storage_refusal))

    def _deferred(self, refusal: PendingAnswer[SdoAbortError | None]) -> Deferred:
        """Return the write that is answered when it is known whether it is refused."""
        deferred = Deferred()
        refusal.when_done(partial(self._finish_write, deferred))
        return deferred


def _storage_refusal(error: EmulatorError | None) -> SdoAbortError | None:
    return None if error is None else SdoAbortError(AbortCode.HARDWARE, str(error))


class CanopenLink(Link[CanFrame]):
    """Connects a device to a CAN bus as a CANopen slave.

    The node ID is the parameter `canopen_node` of the device, unless LSS has stored another one.
    """

    bus: ClassVar[str] = "can"

    def __init__(
        self,
        requests: Requests,
        transport: Transport[CanFrame],
        storage: ParameterStorage | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(requests, transport, CanDamage(extended=False), seed)
        device = self._device
        self.application = DeviceApplication(requests, self._finish_write)
        dictionary = DeviceDictionary(device.icd, self.application)
        self.slave = CanopenSlave(
            dictionary,
            self._wanted_node,
            storage=storage,
            bit_rates=frozenset(dictionary.layout.bit_rates),
            on_save=self.application.save,
            on_restore=self.application.restore,
            on_reset=self._reset_device,
            background=self._write_in_background,
        )
        self._dictionary = dictionary
        self._actions: deque[Action] = deque()
        self._busy = False
        self._resetting = False
        self._status_rows = rows_reporting(device.icd, (STATUS_QUANTITY,))
        self._frame_rows = tuple(
            name for name in rows_reporting(device.icd, FRAME_QUANTITIES) if name not in self._status_rows
        )
        self._attitude_valid = False
        self._reconnects = 0
        self._sdo_hits: Hits = ()
        """Faults of the row that the last SDO transfer reads."""
        self._node = BusAddress("node", "links.canopen.node")
        device.signals.frame_published.connect(self._frame_published)
        device.signals.mode_changed.connect(self._mode_changed)
        device.signals.restarted.connect(self._device_reset)
        device.signals.parameters_changed.connect(self._parameters_changed)

    async def start(self) -> str:
        """Join the bus and send the boot-up message; return the description of the bus."""
        bus, node = await super().start(), self.slave.node_id
        self._node.acquire(bus, 0 if node == UNCONFIGURED_NODE else node)
        self._run_action(self.slave.start)
        return bus

    @property
    def ready_fields(self) -> dict[str, str]:
        return super().ready_fields | {"canopen": str(self._wanted_node)}

    async def close(self) -> None:
        self._node.release()
        await super().close()

    @property
    def _wanted_node(self) -> int:
        return int(self._device.parameters["canopen_node"])

    def _receive(self, item: CanFrame) -> None:
        if not item.extended and not self._device.unresponsive:
            if item.id == SDO_RECEIVE + self.slave.node_id:
                self.obc_requests.count()
            self._run_action(partial(self.slave.receive, item))

    def _run_action(self, action: Action) -> None:
        """Run an action of the slave, send its frames and handle its events; nested actions run after it."""
        # an event of the slave may cause another action, whose frames must not overtake those of this one
        self._actions.append(action)
        if self._busy:
            return
        self._busy = True
        try:
            while self._actions:
                self.application.hits = {}
                frames = self._actions.popleft()(now=self._now())
                if not self._device.unresponsive:
                    for frame in frames:
                        for sent in self._with_faults(frame):
                            self.wire.send(sent)
                for event in self.slave.take_events():
                    self._handle_event(event)
        finally:
            self._busy = False
        self._schedule_tick()

    def _with_faults(self, frame: CanFrame) -> list[CanFrame]:
        """Return the frames that are sent instead of an SDO answer or a TPDO with a row that faults affect."""
        hits = self.application.hits
        if frame.id == SDO_TRANSMIT + self.slave.node_id:
            if frame.data[0] >> 5 in SDO_INITIATED:
                self._sdo_hits = [hit for found in hits.values() for hit in found]
            affecting = self._sdo_hits
        else:
            affecting = self._hits_of_pdo(frame.id) if any(hits.values()) else ()
        frames = [frame]
        for hit in affecting:
            frames = [new for each in frames for new in self._with_fault(hit.fault, each)]
        return frames

    def _hits_of_pdo(self, can_id: int) -> Hits:
        keys = self.slave.pdos.mapped_by(can_id)
        found = self.application.hits.items()
        return [hit for row, hits in found if keys & self._dictionary.sources.get(row, set()) for hit in hits]

    def _with_fault(self, fault: TelemetryFault, frame: CanFrame) -> list[CanFrame]:
        """Return the frames that are sent instead of one that a fault affects."""
        data, sdo = frame.data, frame.id == SDO_TRANSMIT + self.slave.node_id
        if fault.drop:
            return []
        if fault.answer_with is not None and sdo and data[0] >> 5 == SDO_UPLOAD:
            (index, subindex), _ = self._dictionary.entries_of(self._device.icd.telemetry[fault.answer_with])[
                0
            ]
            data = data[:1] + index.to_bytes(2, "little") + bytes((subindex,)) + data[4:]
        if fault.wrong_sequence and sdo and data[0] >> 5 == SDO_SEGMENT:
            data = bytes((data[0] ^ SDO_TOGGLE,)) + data[1:]
        if fault.truncate:
            data = data[: -fault.truncate]
        number = frame.id if fault.wrong_id is None else fault.wrong_id & MAX_STANDARD_ID
        flawed = replace(frame, id=number, data=data)
        return [flawed, flawed] if fault.duplicate else [flawed]

    def _schedule_tick(self) -> None:
        """Schedule a tick at the next deadline of the slave, unless an earlier one is already scheduled."""
        deadline = self.slave.next_deadline()
        if deadline is None:
            return
        due_ns = not_before(deadline)
        if self._timer is not None:
            if self._timer.due_ns <= due_ns:
                return
            self._timer.cancel()
        self._timer = self._device.scheduler.at(max(due_ns, self._device.clock.now_ns()), self._tick)

    def _tick(self, _due_ns: int) -> None:
        self._timer = None
        reconnects = self.transport.statistics.reconnects
        if reconnects != self._reconnects:
            self._reconnects = reconnects
            # the error is over when it can be reported: the node is on the bus again
            code = EmergencyCode.BUS_OFF_RECOVERED
            self._run_action(partial(self.slave.raise_emergency, code, ErrorRegister.COMMUNICATION))
            self._run_action(partial(self.slave.clear_emergency, code))
        self._run_action(self.slave.tick)

    def _handle_event(self, event: SlaveEvent) -> None:
        match event.kind:
            case EventKind.TIME:
                self._device.time.set_unix_ns(round(event.value * 1000) * MILLISECOND_NS)
            case EventKind.STORAGE_ERROR:
                self._device.stored.fail(event.detail)
            case EventKind.FAULT:
                log.warning("%s: %s", event.kind, event.detail)
            case _:
                log.debug("%s %g %s", event.kind, event.value, event.detail)

    def _reset_device(self) -> int:
        """Reset the device after an NMT reset of the node; return the node ID for the restart."""
        self._resetting = True
        try:
            self._device.reset("command")
        finally:
            self._resetting = False
        return self._wanted_node

    def _finish_write(self, deferred: Deferred, refusal: SdoAbortError | None) -> None:
        self._run_action(partial(self.slave.finish_write, deferred, refusal=refusal))

    def _write_in_background(self, work: Callable[[], None], ended: Ended) -> None:
        """Write a file in the thread of the device's state, while the bus is served."""
        errors: list[StorageError] = []

        def write() -> None:
            write_at_once(work, lambda error: None if error is None else errors.append(error))

        def written(error: EmulatorError | None) -> None:
            if error is not None:
                errors.append(StorageError(str(error)))
            ended(errors[0] if errors else None)
            self._run_action(self.slave.tick)

        self._device.write(write, written)

    def _notify_rows(self, rows: Sequence[str]) -> None:
        keys = frozenset(key for row in rows for key in self._dictionary.sources.get(row, ()))
        self._run_action(partial(self.slave.notify, keys))

    def _frame_published(self, measurement: Measurement) -> None:
        rows = self._frame_rows
        if measurement.valid != self._attitude_valid:
            self._attitude_valid = measurement.valid
            rows = (*rows, *self._status_rows)
        self._notify_rows(rows)

    def _mode_changed(self, transition: Transition) -> None:
        errors = self._device.icd.enum("device_error")
        if transition.after is Mode.ERROR:
            code = DEVICE_ERROR + errors.values.get(self._device.modes.error, 0)
            self._run_action(partial(self.slave.raise_emergency, code, ErrorRegister.MANUFACTURER))
        elif transition.before is Mode.ERROR:
            for number in errors.names:
                self._run_action(partial(self.slave.clear_emergency, DEVICE_ERROR + number))
        self._notify_rows(self._status_rows)

    def _parameters_changed(self, names: frozenset[str]) -> None:
        # a node ID that the OBC sets replaces one that was stored by LSS
        if "canopen_node" in names and self._wanted_node != self.slave.node_id:
            self.slave.store.clear_lss()
        placed = self._dictionary.parameters
        keys = frozenset(placed[name] for name in names if name in placed)
        self._run_action(partial(self.slave.notify, keys))

    def _device_reset(self, _cause: str) -> None:
        """Restart the node with the device, unless an NMT reset of the node caused the restart."""
        self._attitude_valid = False
        self.application.clear()
        if not self._resetting:
            self._run_action(partial(self.slave.reset_node, node_id=self._wanted_node))


def open_canopen(
    requests: Requests, transport: Transport[CanFrame], state_dir: Path | None, seed: int
) -> CanopenLink:
    """Return a link that stores its parameters in `state_dir`, or in memory if this is None."""
    storage = ParameterStorage() if state_dir is None else FileStorage(state_dir / CANOPEN_FILE)
    return CanopenLink(requests, transport, storage, seed)
