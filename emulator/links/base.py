"""Base of the links: passes requests from a transport to the device, and replies back."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar

from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.requests import Requests
from starhil.emulator.links.wire_faults import Damage, WireFaults
from starhil.emulator.simulation.clock import NANOSECONDS
from starhil.emulator.simulation.scheduler import Event
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import ErrorCode, LinkFault, Receiver, Reply, Request
from starhil.protocol.transports.base import Transport

Item = TypeVar("Item")
Style = TypeVar("Style")

log = logging.getLogger("starhil.link")

FLUSH_S: Final = 0.51
"""Delay after which an incomplete message is dropped, seconds; just above the receivers' timeout, 0.5 s."""


@dataclass
class Heard:
    """Requests of the OBC on a link, without those of the console."""

    requests: int = 0
    last_s: float | None = None
    """Time of the last one on the loop's clock, seconds; None before the first."""
    _loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop, repr=False)

    def count(self) -> None:
        """Count a request."""
        self.requests += 1
        self.last_s = self._loop.time()


class Link(ABC, Generic[Item]):
    """Connects a device to a transport."""

    bus: ClassVar[str]
    """Name of the bus, `serial` or `can`; a link fault affects every link on its bus."""

    def __init__(
        self, requests: Requests, transport: Transport[Item], damage: Damage[Item], seed: int
    ) -> None:
        device = self._device = requests.device
        self._requests = requests
        self.transport: Final = transport
        self.heard: Final = Heard()
        """Requests of the OBC."""
        self.wire: WireFaults[Item] = WireFaults(self._transmit, damage, device.clock, device.scheduler, seed)
        """Outgoing side of the link, with its faults."""
        self._timer: Event | None = None

    async def start(self) -> str:
        """Open the transport; return its description: a port or bus."""
        await self.transport.start(self._receive, self._log_transport_error)
        return self.transport.description

    async def close(self) -> None:
        """Close the transport."""
        if self._timer is not None:
            self._timer.cancel()
        await self.transport.close()

    @abstractmethod
    def _receive(self, item: Item) -> None:
        """Process an item that has arrived."""

    def _transmit(self, item: Item) -> None:
        """Pass an item, after its faults, to the transport."""
        self.transport.send(item)

    def _now(self) -> float:
        """Return the simulation time, seconds, which also applies to time-outs of messages."""
        return self._device.clock.now_ns() / NANOSECONDS

    def _log_transport_error(self, error: ProtocolError) -> None:
        log.warning("%s", error)


AnyLink: TypeAlias = Link[Any]
"""An open link of any kind."""


class RequestLink(Link[Item], Generic[Item, Style]):
    """Passes requests from a transport to the device, and replies back, in order."""

    def __init__(
        self, requests: Requests, transport: Transport[Item], damage: Damage[Item], seed: int
    ) -> None:
        super().__init__(requests, transport, damage, seed)
        self._loop = asyncio.get_running_loop()
        self._receiver = self._new_receiver()
        self._held_input: deque[Request | LinkFault] = deque()
        """Input that arrived while a reply is pending, because replies are sent in the order of requests."""
        self._pending: PendingAnswer[list[Reply]] | None = None
        self._executing = False
        self._caused: list[Reply] = []
        """Unsolicited messages that the request being executed has caused so far; they follow its replies."""
        self._device.signals.unsolicited.connect(self._send_unsolicited)
        self._device.signals.restarted.connect(self._reset_receiver)

    @abstractmethod
    def _new_receiver(self) -> Receiver[Item, Request]:
        """Return a new receiver for the framing."""

    @abstractmethod
    def _reply_style(self) -> Style:
        """Return the current format of replies: dialect or source address."""

    @abstractmethod
    def _send(self, reply: Reply, style: Style) -> None:
        """Send a reply."""

    @abstractmethod
    def _is_console(self, request: Request) -> bool:
        """Return whether console or recording sent a request."""

    def _send_unsolicited(self, reply: Reply) -> None:
        """Send unsolicited telemetry."""
        if self._executing:
            self._caused.append(reply)
        else:
            self._send(reply, self._reply_style())

    def _receive(self, item: Item) -> None:
        self._held_input.extend(self._receiver.feed(item, self._now()))
        self._dispatch_waiting()
        self._schedule_flush()

    def _dispatch_waiting(self) -> None:
        while self._held_input and self._pending is None:
            self._dispatch(self._held_input.popleft())

    def _dispatch(self, event: Request | LinkFault) -> None:
        if isinstance(event, LinkFault):
            self._requests.count_fault(event)
            return
        style = self._reply_style()  # a change of format is answered in the old format
        console = self._is_console(event)
        if not console:
            self.heard.count()
        self._executing = True
        try:
            answer = self._requests.handle(event, console=console)
        finally:
            self._executing = False
        caused, self._caused = self._caused, []
        if isinstance(answer, PendingAnswer):
            self._pending = answer = answer.then(lambda replies: replies if event.polled else [])
            answer.when_done(partial(self._answer_later, answer, caused, style))
        else:
            self._answer(answer if event.polled else [], caused, style)

    def _answer_later(
        self, answer: PendingAnswer[list[Reply]], caused: list[Reply], style: Style, replies: list[Reply]
    ) -> None:
        self._answer(replies, caused, style)
        if self._pending is answer:
            self._pending = None
            self._dispatch_waiting()

    def _answer(self, replies: list[Reply], caused: list[Reply], style: Style) -> None:
        """Send the replies to a request, and then the unsolicited messages that it has caused."""
        for reply in replies:
            self._send_reply(reply, style)
        for reply in caused:
            self._send_unsolicited(reply)

    def _send_reply(self, reply: Reply, style: Style) -> None:
        """Send a reply, with the unit's code for an error."""
        if isinstance(reply.code, ErrorCode):
            number = self._device.icd.error_number(reply.code)
            if number != reply.code:
                reply = replace(reply, code=number)
        self._send(reply, style)

    def _schedule_flush(self) -> None:
        """Schedule a flush while a message is incomplete."""
        if self._timer is None and self._receiver.busy:
            due_ns = self._device.clock.now_ns() + round(FLUSH_S * NANOSECONDS)
            self._timer = self._device.scheduler.at(due_ns, self._flush)

    def _flush(self, _due_ns: int) -> None:
        self._timer = None
        for fault in self._receiver.flush(self._now()):
            self._requests.count_fault(fault)
        self._schedule_flush()

    def _reset_receiver(self, _cause: str) -> None:
        """Discard incomplete and pending input, because the device has restarted."""
        self._receiver = self._new_receiver()
        self._held_input.clear()
        self._pending = None
