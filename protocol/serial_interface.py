"""The receiving end of a link, sans-I/O: bytes or CAN frames in, messages and faults out; and the dialects of CubeSpace."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Protocol, TypeVar

from starhil.protocol.messages import LinkFault

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
