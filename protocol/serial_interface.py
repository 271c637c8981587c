"""Interfaces of a serial link of any unit, at both ends."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

from starhil.protocol.messages import Reply, Request, RequestKind
from starhil.protocol.receiver import Receiver
from starhil.protocol.serial_framing import Dialect


class HostEnd(Receiver[bytes, Reply], Protocol):
    """The OBC's end."""

    def expect(self, request: Request, reply_size: int) -> None:
        """Set the next request, and the data size of its telemetry in bytes (0 for a telecommand)."""
        ...


@dataclass(frozen=True, slots=True)
class RowShape:
    """The properties of a row on which a link depends: kind, sizes and answers."""

    klass: str
    id: int
    kind: RequestKind
    request_size: int = 0
    """Number of data bytes in the request."""
    reply_size: int = 0
    """Number of data bytes in the reply."""
    answers: tuple[str, ...] = ("reply",)
    """`echo` and `reply`, in the order in which the device sends them."""


class SerialStack(ABC):
    """The serial link of a unit."""

    baud: int

    def supports_unsolicited(self, style: Dialect | None = None) -> bool:  # noqa: ARG002 -- for those with styles
        """Return whether this style has unsolicited telemetry."""
        return True

    @abstractmethod
    def device(self) -> Receiver[bytes, Request]:
        """Return a receiver for the device's end."""

    @abstractmethod
    def host(self, style: Dialect | None = None) -> HostEnd:
        """Return a receiver for the OBC's end."""

    @abstractmethod
    def encode_request(self, request: Request) -> bytes:
        """Return a request as bytes on the line."""

    @abstractmethod
    def encode_reply(self, reply: Reply, style: Dialect | None = None) -> bytes:
        """Return a reply as bytes on the line; empty if the unit has no such reply.

        Raises ProtocolError if the link cannot carry it.
        """
