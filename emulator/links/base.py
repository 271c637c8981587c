"""Base of the links: passes requests from a transport to the device, and replies back."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar

from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.requests import Requests
from starhil.emulator.links.wire_faults import Damage, WireFaults
from starhil.emulator.simulation.scheduler import Event
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.messages import DEFAULT_TIMEOUT_S, ErrorCode, LinkFault, Receiver, Reply, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.transports.base import Transport

Item = TypeVar("Item")
Style = TypeVar("Style")

log = logging.getLogger("starhil.link")

FLUSH_MARGIN_S: Final = 0.01
"""An incomplete message is dropped this much later than the receiver's timeout."""


MAX_HELD: Final = 256
"""Number of requests that wait for the answer to an earlier one; further ones are lost, as in the buffer of a device, and flagged
as an overrun. They are answered at once when it is over, which takes some 25 ms."""


@dataclass
class ObcRequests:
    """Requests of the OBC on a link, without those of the console."""

    requests: int = 0
    last_s: float | None = None
    """Time of the last one on the loop's clock, seconds; None before the first."""
    _loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop, repr=False)

    def count(self) -> None:
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
        self.obc_requests: Final = ObcRequests()
        self.wire: WireFaults[Item] = WireFaults(self._transmit, damage, device.clock, device.scheduler, seed)
        """Outgoing side of the link, with its faults."""
        self._timer: Event | None = None

    async def start(self) -> str:
        """Open the transport; return its description: a port or bus."""
        await self.transport.start(self._receive, self._log_transport_error)
        return self.transport.description

    @property
    def dialect(self) -> Dialect | None:
        """The current format of replies, on a line whose unit has dialects."""
        return None

    @property
    def shown_in_replies(self) -> frozenset[str]:
        """What its messages carry besides data: `id`, `sequence`, `check`."""
        return frozenset(("id", "sequence"))

    @property
    def ready_fields(self) -> dict[str, str]:
        """Fields of the ready line, once the transport is open."""
        return {self.bus: self.transport.description}

    async def close(self) -> None:
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


class Phase(Enum):
    """What a link does while it answers a request."""

    EXECUTING = "the device executes the request; further input and unsolicited messages wait"
    PENDING = "the answer takes time; further input waits, unsolicited messages do not"
    OVER = "everything is answered; nothing waits"


class Turn(Enum):
    """What ends a phase."""

    ANSWERED = "the answer has been sent"
    DELAYED = "the device answers later"
    RESTARTED = "the device has restarted"


NEXT_PHASE: Final = {
    (Phase.EXECUTING, Turn.DELAYED): Phase.PENDING,
    (Phase.EXECUTING, Turn.ANSWERED): Phase.OVER,
    (Phase.EXECUTING, Turn.RESTARTED): Phase.EXECUTING,  # by this request, which is answered
    (Phase.PENDING, Turn.ANSWERED): Phase.OVER,
    (Phase.PENDING, Turn.RESTARTED): Phase.OVER,
    (Phase.OVER, Turn.ANSWERED): Phase.OVER,  # late, after a restart
    (Phase.OVER, Turn.RESTARTED): Phase.OVER,
}


@dataclass(eq=False)
class Exchange(Generic[Style]):
    """A request and its answer."""

    style: Style
    """Format of the answer: that in which the request found the link."""
    phase: Phase = Phase.EXECUTING
    caused: list[Reply] = field(default_factory=list)
    """Unsolicited messages that the request has caused; they follow its answer."""

    def advance(self, turn: Turn) -> None:
        """Begin the phase that follows a turn."""
        self.phase = NEXT_PHASE[self.phase, turn]


class RequestLink(Link[Item], Generic[Item, Style]):
    """Passes requests from a transport to the device, and replies back, in order.

    A change of dialect, bit rate or address takes effect between two exchanges, so that it is answered in the old style.
    """

    _timeout_s: float = DEFAULT_TIMEOUT_S
    """Silence after which the receiver abandons an incomplete message."""

    def __init__(
        self, requests: Requests, transport: Transport[Item], damage: Damage[Item], seed: int
    ) -> None:
        super().__init__(requests, transport, damage, seed)
        self._style = self._wanted_style()
        """The style of what is sent: dialect and bit rate, or source address."""
        self._exchange = Exchange(self._style, Phase.OVER)
        """The latest exchange."""
        self._receiver = self._new_receiver()
        self._held_input: deque[Request | LinkFault] = deque()
        """Input that arrived during the exchange, because replies are sent in the order of requests."""
        self._device.signals.unsolicited.connect(self._send_unsolicited)
        self._device.signals.restarted.connect(self._device_restarted)
        self._device.signals.parameters_changed.connect(self._adopt_style)

    @abstractmethod
    def _new_receiver(self) -> Receiver[Item, Request]:
        """Return a new receiver for the framing."""

    @abstractmethod
    def _wanted_style(self) -> Style:
        """Return the style that the parameters demand."""

    @abstractmethod
    def _style_changed(self, before: Style) -> None:
        """Let port and receiver follow the style."""

    @abstractmethod
    def _send(self, reply: Reply, style: Style) -> None:
        """Send a reply."""

    @abstractmethod
    def _is_console(self, request: Request) -> bool:
        """Return whether console or recording sent a request."""

    def _adopt_style(self, _cause: object = None) -> None:
        """Follow the parameters, unless an exchange has to end first."""
        if self._exchange.phase is Phase.OVER:
            before, self._style = self._style, self._wanted_style()
            if self._style != before:
                self._style_changed(before)

    def _send_unsolicited(self, reply: Reply) -> None:
        if self._exchange.phase is Phase.EXECUTING:
            self._exchange.caused.append(reply)
        else:
            self._send(reply, self._style)

    def _receive(self, item: Item) -> None:
        self._held_input.extend(self._receiver.feed(item, self._now()))
        self._dispatch_waiting()
        while len(self._held_input) > MAX_HELD:
            self._held_input.pop()
            self._requests.count_overrun()
        self._schedule_flush()

    def _dispatch_waiting(self) -> None:
        while self._held_input and self._exchange.phase is Phase.OVER:
            self._dispatch(self._held_input.popleft())

    def _dispatch(self, event: Request | LinkFault) -> None:
        if isinstance(event, LinkFault):
            self._requests.count_fault(event)
            return
        exchange = self._exchange = Exchange(self._style)
        console = self._is_console(event)
        if not console:
            self.obc_requests.count()
        try:
            answer = self._requests.handle(event, console=console)
        except BaseException:
            # later requests would wait for this one for ever
            exchange.advance(Turn.ANSWERED)
            raise
        if isinstance(answer, PendingAnswer):
            answer = answer.then(lambda replies: replies if event.polled else [])
            exchange.advance(Turn.DELAYED)
            answer.when_done(partial(self._answer_later, exchange))
        else:
            self._answer(exchange, answer if event.polled else [])

    def _answer_later(self, exchange: Exchange[Style], replies: list[Reply]) -> None:
        self._answer(exchange, replies)
        self._dispatch_waiting()

    def _answer(self, exchange: Exchange[Style], replies: list[Reply]) -> None:
        """Send the replies to a request, and then the unsolicited messages that it has caused."""
        for reply in replies:
            self._send_reply(reply, exchange.style)
        exchange.advance(Turn.ANSWERED)
        self._adopt_style()
        for reply in exchange.caused:
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
            due_ns = self._device.clock.now_ns() + round((self._timeout_s + FLUSH_MARGIN_S) * NANOSECONDS)
            self._timer = self._device.scheduler.at(due_ns, self._flush)

    def _flush(self, _due_ns: int) -> None:
        self._timer = None
        for fault in self._receiver.flush(self._now()):
            self._requests.count_fault(fault)
        self._schedule_flush()

    def _device_restarted(self, _cause: str) -> None:
        """Discard incomplete and waiting input, and await no answer from before."""
        self._receiver = self._new_receiver()
        self._held_input.clear()
        self._exchange.advance(Turn.RESTARTED)
        self._adopt_style()
