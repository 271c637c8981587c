"""What every link does: requests from a transport to the device, replies back, messages given up that do not end."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from typing import Final, Generic, Protocol, TypeVar

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.scheduler import Event
from starhil.emulator.links.wire_faults import Pieces, WireFaults
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import LinkFault, Reply, Request
from starhil.protocol.transports.base import Transport

Item = TypeVar("Item")
Arriving_contra = TypeVar("Arriving_contra", contravariant=True)
Style = TypeVar("Style")

log = logging.getLogger("starhil.link")

FLUSH_S: Final = 0.51
"""Time after which a message that has begun is looked at: a little more than the receivers' time-out of 0.5 s."""


class Receiver(Protocol[Arriving_contra]):
    """The device's end of a framing."""

    @property
    def busy(self) -> bool:
        """Whether a message has begun and not ended."""
        ...

    def feed(self, item: Arriving_contra, now: float, /) -> list[Request | LinkFault]:
        """Take what arrived and return what it completes."""
        ...

    def flush(self, now: float) -> list[LinkFault]:
        """Give up what has been silent for too long."""
        ...


class DeviceLink(ABC, Generic[Item, Style]):
    """Binds a device to a transport.

    Parameters
    ----------
    requests
        The device's handling of requests.
    transport
        Where items (bytes, frames) come from and go to.
    pieces
        How items are damaged by wire faults.
    seed
        Seed of wire faults.
    """

    def __init__(
        self, requests: Requests, transport: Transport[Item], pieces: Pieces[Item], seed: int
    ) -> None:
        device = requests.device
        self._requests = requests
        self._device = device
        self._loop = asyncio.get_running_loop()
        self.transport: Final = transport
        self._receiver = self._new_receiver()
        self._timer: Event | None = None
        self.wire: WireFaults[Item] = WireFaults(transport.send, pieces, device.clock, device.scheduler, seed)
        requests.unsolicited_receivers.append(self._unsolicited)
        device.on_reset.append(self._forget)

    @abstractmethod
    def _new_receiver(self) -> Receiver[Item]:
        """Make the framing's receiver."""

    @abstractmethod
    def _style(self) -> Style:
        """Return what replies look like at present (dialect, own address)."""

    @abstractmethod
    def _send(self, reply: Reply, style: Style) -> None:
        """Send a reply."""

    def _unsolicited(self, reply: Reply) -> None:
        """Send what the device says by itself."""
        self._send(reply, self._style())

    async def start(self) -> str:
        """Open the transport; return what was taken."""
        await self.transport.start(self._receive, self._complain)
        return self.transport.description

    async def close(self) -> None:
        """Give the transport back."""
        if self._timer is not None:
            self._timer.cancel()
        await self.transport.close()

    def _now(self) -> float:
        """Run time, s: a message that does not end is given up in the device's own time."""
        return self._device.clock.now_ns() / NANOSECONDS

    def _receive(self, item: Item) -> None:
        for event in self._receiver.feed(item, self._now()):
            self._take(event)
        self._watch()

    def _take(self, event: Request | LinkFault) -> None:
        if isinstance(event, LinkFault):
            self._requests.count_fault(event)
            return
        style = self._style()  # the answer to a change of style still goes out in the old one

        def answer(reply: Reply) -> None:
            self._send(reply, style)

        for reply in self._requests.handle(event, answer) or ():
            answer(reply)

    def _watch(self) -> None:
        """Look again at a message that was begun."""
        if self._timer is None and self._receiver.busy:
            due_ns = self._device.clock.now_ns() + round(FLUSH_S * NANOSECONDS)
            self._timer = self._device.scheduler.at(due_ns, self._flush)

    def _flush(self, _due_ns: int) -> None:
        self._timer = None
        for fault in self._receiver.flush(self._now()):
            self._requests.count_fault(fault)
        self._watch()

    def _forget(self) -> None:
        """Begin anew, as the device has restarted."""
        self._receiver = self._new_receiver()

    def _complain(self, error: ProtocolError) -> None:
        log.warning("%s", error)
