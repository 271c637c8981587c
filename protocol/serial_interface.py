"""The two ends of a link, sans-I/O: bytes or CAN frames in, messages and faults out; and the serial link of any unit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, TypeVar

from starhil.protocol.messages import LinkFault, Reply, Request, RequestKind

Arriving_contra = TypeVar("Arriving_contra", contravariant=True)
Message_co = TypeVar("Message_co", covariant=True)


class Receiver(Protocol[Arriving_contra, Message_co]):
    """The receiving side of a link."""

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete, so that `flush` may become due."""
        ...

    def feed(self, item: Arriving_contra, now: float, /) -> Sequence[Message_co | LinkFault]:
        """Return the messages and faults that an item completes; `now` is the time of arrival, s."""
        ...

    def flush(self, now: float) -> list[LinkFault]:
        """Drop an incomplete message that has timed out; return the faults."""
        ...


class Dialect(StrEnum):
    """Formats of serial replies."""

    A = "a"
    B = "b"
    C = "c"

    @property
    def supports_unsolicited(self) -> bool:
        """Whether the dialect has unsolicited telemetry and events."""
        return self is Dialect.C


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
