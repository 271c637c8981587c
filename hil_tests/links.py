"""The OBC's end of a link: a transport and the host side of its framing behind one small interface."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final

from starhil.hil_tests.errors import LinkLostError
from starhil.hil_tests.wire_log import WireLog
from starhil.protocol.can_framing import CanFrame, CanHostReceiver, encode_request_frames
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import LinkFault, Reply, Request
from starhil.protocol.serial_framing import Dialect, HostReceiver, encode_request
from starhil.protocol.transports import open_can, open_serial

DEFAULT_HOST_ADDRESS: Final = 1
"""CAN address of the OBC, as public flight software has it."""
DEFAULT_DEVICE_ADDRESS: Final = 4
"""CAN address of the device, as public flight software has it."""
DEFAULT_BAUD: Final = 115200
FLUSH_PERIOD_S: Final = 0.05
"""How often a receiver is asked whether half a message has timed out."""


class HostLink(ABC):
    """Sends requests and hands over replies, faults and raw items as they come.

    Attributes
    ----------
    on_reply : callable
        Called with each reply, unsolicited ones included.
    on_fault : callable
        Called with each piece of input that made no message.
    on_raw : callable or None
        Called with each item before it is decoded: bytes on serial, frames on CAN.
    """

    name: str
    """`serial` or `can`."""

    def __init__(self, log: WireLog | None) -> None:
        self.on_reply: Callable[[Reply], None] = lambda _reply: None
        self.on_fault: Callable[[LinkFault], None] = lambda _fault: None
        self.on_raw: Callable[[bytes | CanFrame], None] | None = None
        self.log = log
        self._lost: ProtocolError | None = None
        self._flusher: asyncio.Task[None] | None = None

    @abstractmethod
    async def start(self) -> None:
        """Open the port or bus."""

    @abstractmethod
    async def close(self) -> None:
        """Close the port or bus."""

    @abstractmethod
    def request(self, request: Request, reply_size: int) -> None:
        """Send a request whose telemetry has `reply_size` bytes (0 for a telecommand)."""

    @abstractmethod
    def forget(self) -> None:
        """Drop what has come in of a reply that is no longer waited for."""

    @abstractmethod
    def _flush(self, now: float) -> list[LinkFault]:
        """Give up half a message that has timed out."""

    @property
    @abstractmethod
    def description(self) -> str:
        """What the link is connected to."""

    def check(self) -> None:
        """Raise LinkLostError if the port or bus is gone."""
        if self._lost is not None:
            raise LinkLostError(f"{self.description}: {self._lost}")

    def lost(self, error: ProtocolError) -> None:
        """Note that the transport has failed."""
        self._lost = error

    def found(self) -> None:
        """Note that the transport works (again)."""
        self._lost = None

    def _hand_over(self, events: list[Reply | LinkFault]) -> None:
        for event in events:
            if isinstance(event, LinkFault):
                self.on_fault(event)
            else:
                self.on_reply(event)

    def _start_flusher(self) -> None:
        self._flusher = asyncio.get_running_loop().create_task(self._flush_for_ever())

    async def _stop_flusher(self) -> None:
        if self._flusher is not None:
            self._flusher.cancel()
            await asyncio.gather(self._flusher, return_exceptions=True)
            self._flusher = None

    async def _flush_for_ever(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(FLUSH_PERIOD_S)
            for fault in self._flush(loop.time()):
                self.on_fault(fault)


class SerialLink(HostLink):
    """A serial line in one of the three reply dialects.

    Parameters
    ----------
    spec : str
        `/dev/…` or `socket://host:port`.
    dialect : Dialect
        Form of the replies.
    baud : int
        Bit rate of a real line.
    log : WireLog, optional
        Where every byte is logged.
    """

    name = "serial"

    def __init__(
        self,
        spec: str,
        *,
        dialect: Dialect = Dialect.B,
        baud: int = DEFAULT_BAUD,
        log: WireLog | None = None,
    ) -> None:
        super().__init__(log)
        self._spec = spec
        self._dialect = dialect
        self._receiver = HostReceiver(dialect)
        self._transport = open_serial(spec, baud=baud, paced=False)

    @property
    def description(self) -> str:
        """The port."""
        return f"serial {self._spec}"

    async def start(self) -> None:
        """Open the port."""
        await self._transport.start(self._received, self.lost)
        self._start_flusher()

    async def close(self) -> None:
        """Close the port."""
        await self._stop_flusher()
        await self._transport.close()

    def request(self, request: Request, reply_size: int) -> None:
        """Frame and send a request."""
        self._receiver.expect(request, reply_size)
        self.send(encode_request(request))

    def send(self, data: bytes) -> None:
        """Send bytes as they stand."""
        if self.log is not None:
            self.log.sent(data)
        if not self._transport.send(data):
            raise LinkLostError(f"{self.description}: the port does not take bytes")

    def forget(self) -> None:
        """Start with an empty receiver."""
        self._receiver = HostReceiver(self._dialect)

    def _received(self, data: bytes) -> None:
        self.found()
        if self.log is not None:
            self.log.received(data)
        if self.on_raw is not None:
            self.on_raw(data)
        self._hand_over(self._receiver.feed(data, asyncio.get_running_loop().time()))

    def _flush(self, now: float) -> list[LinkFault]:
        return self._receiver.flush(now)


class CanLink(HostLink):
    """A CAN bus with the CubeSpace identifier layout.

    Parameters
    ----------
    spec : str
        A channel as `open_can` takes it, such as `vcan0` or `socketcand:127.0.0.1:29536/vcan0`.
    host_address, device_address : int
        CAN addresses of this OBC and of the device.
    log : WireLog, optional
        Where every frame is logged.
    """

    name = "can"

    def __init__(
        self,
        spec: str,
        *,
        host_address: int = DEFAULT_HOST_ADDRESS,
        device_address: int = DEFAULT_DEVICE_ADDRESS,
        log: WireLog | None = None,
    ) -> None:
        super().__init__(log)
        self._spec = spec
        self.host_address = host_address
        self.device_address = device_address
        self._receiver = CanHostReceiver(host_address, device_address)
        self._transport = open_can(spec)

    @property
    def description(self) -> str:
        """The channel."""
        return f"CAN {self._spec}"

    async def start(self) -> None:
        """Join the bus."""
        await self._transport.start(self._received, self.lost)
        self._start_flusher()

    async def close(self) -> None:
        """Leave the bus."""
        await self._stop_flusher()
        await self._transport.close()

    def request(self, request: Request, reply_size: int) -> None:  # noqa: ARG002 -- CAN replies tell their kind
        """Send a request as frames."""
        for frame in encode_request_frames(request, self.host_address, self.device_address):
            self.send(frame)

    def send(self, frame: CanFrame) -> None:
        """Send a frame as it stands."""
        if self.log is not None:
            self.log.sent(frame)
        if not self._transport.send(frame):
            raise LinkLostError(f"{self.description}: the bus does not take frames")

    def forget(self) -> None:
        """Start with an empty receiver."""
        self._receiver = CanHostReceiver(self.host_address, self.device_address)

    def _received(self, frame: CanFrame) -> None:
        self.found()
        if self.log is not None:
            self.log.received(frame)
        if self.on_raw is not None:
            self.on_raw(frame)
        self._hand_over(self._receiver.feed(frame, asyncio.get_running_loop().time()))

    def _flush(self, now: float) -> list[LinkFault]:
        return self._receiver.flush(now)
