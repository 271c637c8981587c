"""The OBC's end of a link: a transport and the host side of its framing."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Final, Generic, TypeVar

from starhil.hil_tests.client.wire_log import WireLog
from starhil.hil_tests.errors import LinkLostError
from starhil.protocol.can.cubespace import CanHostReceiver, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import LinkFault, Receiver, Reply, ReplyKind, Request
from starhil.protocol.serial.stack import HostReceiver, SerialStack, chosen_dialect
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.serial import open_serial

DEFAULT_HOST_ADDRESS: Final = 1
"""CAN address of the OBC in public flight software."""
DEFAULT_DEVICE_ADDRESS: Final = 4
"""CAN address of the device in public flight software."""
DEFAULT_BAUD: Final = 115200
FLUSH_PERIOD_S: Final = 0.05
"""Period at which a receiver is polled for an incomplete message that has timed out."""

Item = TypeVar("Item", bytes, CanFrame)


class HostLink(ABC, Generic[Item]):
    """Sends requests; calls `on_reply` with each reply, also an unsolicited one, and `on_fault` for invalid input.

    Each item, bytes on serial or a frame on CAN, is passed to `on_raw` before it is decoded.
    """

    name: str
    """`serial` or `can`."""
    _receiver: Receiver[Item, Reply]

    def __init__(
        self,
        transport: Transport[Item],
        description: str,
        log: WireLog | None,
        make_receiver: Callable[[], Receiver[Item, Reply]],
    ) -> None:
        self.on_reply: Callable[[Reply], None] = lambda _reply: None
        self.on_fault: Callable[[LinkFault], None] = lambda _fault: None
        self.on_raw: Callable[[bytes | CanFrame], None] | None = None
        self.description = description
        self._log = log
        self._make_receiver: Callable[[], Receiver[Item, Reply]] = make_receiver
        self._receiver = make_receiver()
        self._transport: Transport[Item] = transport
        self._lost: ProtocolError | None = None
        self._flusher: asyncio.Task[None] | None = None

    @abstractmethod
    def request(self, request: Request) -> None:
        """Send a request."""

    def reset_receiver(self) -> None:
        """Discard an incomplete reply that is no longer awaited."""
        self._receiver = self._make_receiver()

    def answers(self, row: Row) -> tuple[str, ...]:
        """Return the answers of a row on this link; none if no reply may be awaited."""
        return row.answers

    def marks_unsolicited(self, message_class: str) -> bool:  # noqa: ARG002 -- on most links, all of it
        """Return whether unsolicited telemetry of a class says that it is."""
        return True

    def dialect_of_reply(self, request: Request) -> str | None:  # noqa: ARG002 -- only a serial line has dialects
        """Return the dialect, other than that of the link, in which what came since a request is its reply."""
        return None

    def is_from_device(self, item: Item) -> bool:  # noqa: ARG002 -- a serial line has only one peer
        """Return whether the device has sent a received item."""
        return True

    async def start(self) -> None:
        """Open the port or join the bus."""
        await self._transport.start(self._on_receive, self._on_transport_error)
        self._flusher = asyncio.get_running_loop().create_task(self._flush_periodically())

    async def close(self) -> None:
        """Close the port or leave the bus."""
        if self._flusher is not None:
            self._flusher.cancel()
            await asyncio.gather(self._flusher, return_exceptions=True)
            self._flusher = None
        await self._transport.close()

    def send(self, item: Item) -> None:
        """Send bytes or a frame unchanged.

        Raises LinkLostError: the port or bus accepts no data.
        """
        if self._log is not None:
            self._log.sent(item)
        if not self._transport.send(item):
            raise LinkLostError(f"{self.description}: accepts no data")

    def check(self) -> None:
        """Raise LinkLostError if the port or bus was lost."""
        if self._lost is not None:
            raise LinkLostError(f"{self.description}: {self._lost}")

    def _on_transport_error(self, error: ProtocolError) -> None:
        self._lost = error

    def _on_receive(self, item: Item) -> None:
        self._lost = None
        if self._log is not None:
            self._log.received(item)
        if self.on_raw is not None:
            self.on_raw(item)
        for event in self._receiver.feed(item, asyncio.get_running_loop().time()):
            if isinstance(event, LinkFault):
                self.on_fault(event)
            else:
                self.on_reply(event)

    async def _flush_periodically(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(FLUSH_PERIOD_S)
            for fault in self._receiver.flush(loop.time()):
                self.on_fault(fault)


class SerialHostLink(HostLink[bytes]):
    """A serial line with the framing of the unit's definition.

    `spec` is `/dev/…` or `socket://host:port`; `dialect` the format of replies, of a unit that has several, `b` by default.
    """

    name = "serial"
    _receiver: HostReceiver

    def __init__(
        self,
        icd: InterfaceDefinition,
        spec: str,
        *,
        dialect: str | None = None,
        baud: int = DEFAULT_BAUD,
        log: WireLog | None = None,
    ) -> None:
        self._stack = SerialStack(icd)
        self._dialect = chosen_dialect(icd, dialect)
        self._since_request = bytearray()
        host = partial(self._stack.host, self._dialect)
        super().__init__(open_serial(spec, baud=baud, paced=False), f"serial {spec}", log, host)

    def request(self, request: Request) -> None:
        """Frame and send a request."""
        self._since_request.clear()
        self.send(self._receiver.request(request))

    def _on_receive(self, item: bytes) -> None:
        self._since_request += item[: self._stack.max_size - len(self._since_request)]
        super()._on_receive(item)

    def dialect_of_reply(self, request: Request) -> str | None:
        """Return the dialect, other than that of the link, in which what came since a request is its reply."""
        row = self._stack.icd.row(request.id, request.message_class)
        kinds = ReplyKind.ACK, ReplyKind.NACK, ReplyKind.TELEMETRY
        for dialect in self._stack.dialects:
            receiver = self._stack.host(dialect)
            receiver.request(request)
            for reply in receiver.feed(bytes(self._since_request), 0.0):
                if isinstance(reply, LinkFault) or reply.id != request.id or reply.kind not in kinds:
                    continue
                whole = row is None or reply.kind is not ReplyKind.TELEMETRY or len(reply.data) == row.size
                if whole and dialect is not self._dialect:
                    return dialect.value
        return None

    def marks_unsolicited(self, message_class: str) -> bool:
        """Return whether unsolicited telemetry of a class says that it is."""
        return self._stack.marks_unsolicited(message_class)

    def answers(self, row: Row) -> tuple[str, ...]:
        """Return the answers of a row on the serial line."""
        return self._stack.answers(row)


class CanHostLink(HostLink[CanFrame]):
    """A CAN bus with the CubeSpace layout of CAN IDs.

    `spec` is a channel for `open_can`, such as `vcan0` or `socketcand:127.0.0.1:29536/vcan0`.
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
        host = partial(CanHostReceiver, host_address, device_address)
        super().__init__(open_can(spec), f"CAN {spec}", log, host)
        self.host_address = host_address
        self.device_address = device_address

    def request(self, request: Request) -> None:
        """Send a request as frames."""
        for frame in encode_request_frames(request, self.host_address, self.device_address):
            self.send(frame)

    def is_from_device(self, item: CanFrame) -> bool:
        """Return whether the source of a frame is the device."""
        return item.extended and item.id >> 8 & 0xFF == self.device_address
