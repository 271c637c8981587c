"""The CANopen link: binds the slave of `starhil.protocol.canopen` to a device, its clock and a CAN transport."""

from __future__ import annotations

import logging
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.cycle import Measurement
from starhil.emulator.device.device import Device
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.device.refusal import Refused
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.bus_address import BusAddress
from starhil.emulator.links.wire_faults import WireFaults
from starhil.protocol.can_framing import MAX_FRAME_DATA, MAX_STANDARD_ID, CanFrame
from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import GreyImage, abort_of, check_status
from starhil.protocol.canopen.context import UNCONFIGURED, EventKind, SlaveEvent
from starhil.protocol.canopen.device_dictionary import build_dictionary
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.canopen.emergency import ErrorCode, ErrorRegister
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.canopen.storage import FileStorage, MemoryStorage, ParameterStorage, StorageError
from starhil.protocol.codec import Row
from starhil.protocol.messages import Reply, Request, RequestKind
from starhil.protocol.transports.base import Transport
from starhil.protocol.values import MessageError, Value

if TYPE_CHECKING:
    from starhil.emulator.device.scheduler import Event
    from starhil.protocol.errors import ProtocolError

log = logging.getLogger("starhil.canopen")

MILLISECOND_NS: Final = NANOSECONDS // 1000
STORAGE_FILE: Final = "canopen.json"
DEVICE_ERROR: Final = 0xFF00
"""EMCY error code of the device's error mode: plus the number of `device_error`."""
STATUS_ROW: Final = "device_status"
FRAME_ROWS: Final = (
    "precise_attitude",
    "identified_stars",
    "star_magnitudes",
    "star_performance_1",
    "star_performance_2",
    "star_timing",
    "quaternion",
    "rates",
)
"""Telemetry that is new with each frame: TPDOs with any of it have an event then."""

Action: TypeAlias = Callable[[float], list[CanFrame]]


def not_before(deadline: float) -> int:
    """First nanosecond at which a deadline in seconds has come, exactly.

    One nanosecond less, and on the stepped clock the slave would be called again and again before its time.
    """
    numerator, denominator = deadline.as_integer_ratio()
    return -(-numerator * NANOSECONDS // denominator)


class BaseFramePieces:
    """How frames of the base format are damaged: what a bus with a checksum lets through is another frame."""

    def corrupt(self, item: CanFrame, rng: random.Random) -> CanFrame:
        """Turn one bit of the data, or of the identifier where there is no data."""
        if not item.data:
            return replace(item, id=item.id ^ 1 << rng.randrange(11))
        damaged = bytearray(item.data)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return replace(item, data=bytes(damaged))

    def junk(self, rng: random.Random) -> CanFrame:
        """Make a frame with a random identifier."""
        data = rng.randbytes(rng.randint(0, MAX_FRAME_DATA))
        return CanFrame(rng.randint(0, MAX_STANDARD_ID), data, extended=False)

    def split(self, item: CanFrame, size: int) -> Sequence[CanFrame]:
        """Leave a frame whole: a frame is never split."""
        _ = size
        return [item]


class DeviceApplication:
    """The device as its object dictionary sees it.

    Parameters
    ----------
    device
        What answers.
    finish
        Tells the result of a write that was deferred.
    """

    def __init__(self, device: Device, finish: Callable[[Deferred, SdoAbortError | None], None]) -> None:
        self._device = device
        self._finish = finish
        self._frame: GreyImage | None = None

    def forget(self) -> None:
        """Forget the frame that was taken: the device has restarted."""
        self._frame = None

    def telemetry(self, row: Row) -> bytes:
        """Return the present bytes of a telemetry row."""
        try:
            return self._device.telemetry(row.name)
        except Refused as refused:
            check_status(refused.code, row.name)
            raise

    def telecommand(self, row: Row, payload: bytes) -> Deferred | None:
        """Execute a telecommand; it counts and is acknowledged as on the other links."""
        deferred = Deferred()

        def done(reply: Reply) -> None:
            refusal: SdoAbortError | None = None
            try:
                check_status(reply.code, row.name)
            except SdoAbortError as abort:
                refusal = abort
            self._finish(deferred, refusal)

        replies = self._device.handle(Request(RequestKind.TELECOMMAND, row.id, payload), done)
        if replies is None:
            return deferred
        for reply in replies[:1]:
            check_status(reply.code, row.name)
        return None

    def parameter(self, name: str) -> Value:
        """Return a parameter's value in its unit."""
        return self._device.parameters[name]

    def set_parameter(self, name: str, value: Value) -> None:
        """Set a parameter; what contradicts another one is refused."""
        try:
            self._device.parameters.set({name: value})
        except MessageError as error:
            raise abort_of(error) from None

    def image(self, name: str) -> GreyImage:
        """Return the frame that was taken, or the image that save_image stored."""
        if name == "stored":
            stored = self._device.images.stored
            if stored is not None:
                return GreyImage(stored.edge, stored.edge, stored.frame, stored.pixels)
        elif self._frame is not None:
            return self._frame
        raise SdoAbortError(AbortCode.NO_DATA, f"{name} image")

    def take_image(self, name: str) -> Deferred:
        """Take a whole frame; the write is answered when it has come."""
        if self._device.images.busy:
            raise SdoAbortError(AbortCode.DEVICE_STATE, f"{name}: another image is being taken")
        deferred = Deferred()

        def done(picture: GreyImage | None) -> None:
            if picture is None:
                self._finish(deferred, SdoAbortError(AbortCode.HARDWARE, "no frame"))
            else:
                self._frame = picture
                self._finish(deferred, None)

        self._device.images.take_full(
            lambda full: done(
                None if full is None else GreyImage(full.width, full.height, full.frame, full.pixels)
            )
        )
        return deferred

    def save(self) -> Deferred:
        """Store the device's parameters (1010h); the write is answered when they are on the disk."""
        return self._later(self._device.save_parameters)

    def restore(self) -> Deferred:
        """Let the defaults hold from the next restart on (1011h)."""
        return self._later(self._device.forget_parameters)

    def _later(self, work: Callable[[Callable[[EmulatorError | None], None]], None]) -> Deferred:
        deferred = Deferred()

        def done(error: EmulatorError | None) -> None:
            self._finish(deferred, None if error is None else SdoAbortError(AbortCode.HARDWARE, str(error)))

        work(done)
        return deferred


class CanopenLink:
    """A node on the bus.

    Parameters
    ----------
    device
        What it is.
    transport
        Where frames come from and go to.
    storage
        Where communication parameters survive a restart.
    seed
        Seed of wire faults.

    The node-ID is the device's parameter `canopen_node`, unless LSS has stored another.
    """

    def __init__(
        self,
        device: Device,
        transport: Transport[CanFrame],
        storage: ParameterStorage | None = None,
        seed: int = 0,
    ) -> None:
        self._device = device
        self.transport: Final = transport
        dictionary = build_dictionary(device.icd)
        self.application = DeviceApplication(device, self._finish)
        dictionary.application = self.application
        bit_rates = frozenset(dictionary.layout.bit_rates)
        self.slave = CanopenSlave(dictionary, self._wanted_node, storage=storage, bit_rates=bit_rates)
        self.slave.store.on_save = self.application.save
        self.slave.store.on_restore = self.application.restore
        self.slave.on_reset = self._reset_device
        self._dictionary = dictionary
        self._actions: deque[Action] = deque()
        self._busy = False
        self._resetting = False
        self._attitude_valid = False
        self._timer: Event | None = None
        self._reconnects = 0
        self._node = BusAddress("node", "links.canopen.node")
        self.wire: WireFaults[CanFrame] = WireFaults(
            transport.send, BaseFramePieces(), device.clock, device.scheduler, seed
        )
        device.on_frame.append(self._frame_made)
        device.on_mode.append(self._mode_changed)
        device.on_reset.append(self._device_reset)
        device.parameters.observe(self._parameters_changed)

    async def start(self) -> str:
        """Join the bus and boot up; return what was taken."""
        await self.transport.start(self._receive, self._complain)
        node = self.slave.node_id
        self._node.take(self.transport.description, 0 if node == UNCONFIGURED else node)
        self._do(self.slave.start)
        return self.transport.description

    async def close(self) -> None:
        """Leave the bus."""
        self._node.release()
        if self._timer is not None:
            self._timer.cancel()
        await self.transport.close()

    @property
    def _wanted_node(self) -> int:
        return int(self._device.parameters["canopen_node"])

    def _now(self) -> float:
        return self._device.clock.now_ns() / NANOSECONDS

    def _receive(self, frame: CanFrame) -> None:
        if not frame.extended and not self._device.deaf:
            self._do(lambda now: self.slave.receive(frame, now))

    def _do(self, action: Action) -> None:
        """Let the slave do something and send what it says; what that causes in the device comes after it."""
        self._actions.append(action)
        if self._busy:
            return
        self._busy = True
        try:
            while self._actions:
                frames = self._actions.popleft()(self._now())
                if not self._device.deaf:
                    for frame in frames:
                        self.wire.send(frame)
                for event in self.slave.take_events():
                    self._take(event)
        finally:
            self._busy = False
        self._plan()

    def _plan(self) -> None:
        """Wake up when the slave wants to; a wake-up that was entered for an earlier time does no harm and stays."""
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
            self._do(partial(self._raise, ErrorCode.BUS_OFF_RECOVERED, ErrorRegister.COMMUNICATION))
            self._do(partial(self._clear, ErrorCode.BUS_OFF_RECOVERED))
        self._do(self.slave.tick)

    def _raise(self, code: int, bits: int, now: float) -> list[CanFrame]:
        return self.slave.raise_emergency(code, bits, now=now)

    def _clear(self, code: int, now: float) -> list[CanFrame]:
        return self.slave.clear_emergency(code, now=now)

    def _take(self, event: SlaveEvent) -> None:
        """Act on what the slave reports."""
        match event.kind:
            case EventKind.TIME:
                self._device.time.set_unix_ns(round(event.value * 1000) * MILLISECOND_NS)
            case EventKind.STORAGE_ERROR | EventKind.FAULT:
                log.warning("%s: %s", event.kind, event.detail)
            case _:
                log.debug("%s %g %s", event.kind, event.value, event.detail)

    def _reset_device(self) -> int:
        """Restart the device because NMT resets the node."""
        self._resetting = True
        try:
            self._device.reset("command")
        finally:
            self._resetting = False
        return self._wanted_node

    def _finish(self, deferred: Deferred, refusal: SdoAbortError | None) -> None:
        self._do(lambda now: self.slave.finish_write(deferred, now, refusal))

    def _notify(self, rows: Sequence[str]) -> None:
        keys = frozenset(key for row in rows for key in self._dictionary.sources.get(row, ()))
        self._do(lambda now: self.slave.notify(keys, now))

    def _frame_made(self, measurement: Measurement) -> None:
        rows: tuple[str, ...] = FRAME_ROWS
        if measurement.valid != self._attitude_valid:
            self._attitude_valid = measurement.valid
            rows = (*rows, STATUS_ROW)
        self._notify(rows)

    def _mode_changed(self, transition: Transition) -> None:
        if transition.after is Mode.ERROR:
            # The cause of the error stands only when the change is done.
            self._device.scheduler.at(self._device.clock.now_ns(), self._device_failed)
            return
        if transition.before is Mode.ERROR:
            for number in self._device.icd.enums["device_error"].names:
                self._do(partial(self._clear, DEVICE_ERROR + number))
        self._notify([STATUS_ROW])

    def _device_failed(self, _due_ns: int) -> None:
        numbers = self._device.icd.enums["device_error"].values
        code = DEVICE_ERROR + numbers.get(self._device.modes.error, 0)
        if self._device.modes.mode is Mode.ERROR:
            self._do(partial(self._raise, code, ErrorRegister.MANUFACTURER))
            self._notify([STATUS_ROW])

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "canopen_node" in names and self._wanted_node != self.slave.node_id:
            try:
                self.slave.store.clear_lss()
            except StorageError as error:
                log.warning("%s", error)
        keys = frozenset(self._dictionary.parameters[name] for name in names)
        self._do(lambda now: self.slave.notify(keys, now))

    def _device_reset(self) -> None:
        """Restart with the device, unless the restart came over this bus and is done already."""
        self._attitude_valid = False
        self.application.forget()
        if not self._resetting:
            self._do(lambda now: self.slave.reset_node(now, self._wanted_node))

    def _complain(self, error: ProtocolError) -> None:
        log.warning("%s", error)


def open_canopen(
    device: Device, transport: Transport[CanFrame], state_dir: Path | None, seed: int
) -> CanopenLink:
    """Make the link with its parameters in `state_dir`, or in memory until the process ends."""
    storage = MemoryStorage() if state_dir is None else FileStorage(state_dir / STORAGE_FILE)
    return CanopenLink(device, transport, storage, seed)
