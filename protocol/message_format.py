"""Formats of messages on a serial line: header, data and check within a framing.

A link has one format for both directions, unless its `format` gives a direction or some classes another framing or
check. Messages of several formats are told apart by their first byte.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from starhil.protocol.checks import Check
from starhil.protocol.conventions import Order
from starhil.protocol.envelope import Envelope, Header, HeaderError
from starhil.protocol.framings import BodySizeError, Framing
from starhil.protocol.link_schema import FixedFraming, FramingModel, HeaderFieldModel
from starhil.protocol.messages import FaultKind, LinkFault


class MessageFormat:
    """Framing, check and header of messages.

    Parameters
    ----------
    framing, model
        The framing and its keys.
    check
        The check.
    models
        Fields of the header.
    byte_order
        Byte order of the unit.
    codes
        Name of the class of each code in the header.
    where
        Field path of the header for error messages.
    """

    def __init__(
        self,
        framing: Framing,
        model: FramingModel,
        check: Check,
        models: Sequence[HeaderFieldModel],
        byte_order: Order,
        codes: Mapping[int, str],
        where: str,
    ) -> None:
        self.framing: Final = framing
        self.check: Final = check
        self.kind: Final = model.kind
        self.request_size: Final = model.request_size if isinstance(model, FixedFraming) else None
        """Bytes of each request, if all have the same size."""
        overhead = {"start": len(framing.start), "check": check.size, "end": len(framing.end)}
        self.header: Final = Header(models, byte_order, codes, overhead, where)

    def close(self, header: bytes, data: bytes) -> bytes:
        """Return header, data and check of a message."""
        if not self.check.size:
            return header + data
        return header + data + self.check.compute(self._covered(header, data))

    def _covered(self, header: bytes, data: bytes) -> bytes:
        covers = self.check.covers
        return (
            (self.framing.start if "start" in covers else b"")
            + (header if "header" in covers else b"")
            + (data if "data" in covers else b"")
        )

    def open(self, body: bytes) -> tuple[Envelope, bytes] | LinkFault:
        """Return header and data of a body, or its fault."""
        header = self.header
        end = len(body) - self.check.size
        try:
            envelope = header.unpack(body[: max(end, 0)])
        except HeaderError as error:
            if {"header", "data"} <= self.check.covers and not self._checks(body, 0, end):
                return self._bad_check(body[end:])
            return LinkFault(FaultKind.UART_PROTOCOL, str(error))
        if envelope is None:
            return LinkFault(
                FaultKind.UART_PROTOCOL, f"message of {len(body)} bytes is shorter than its header"
            )
        if not self._checks(body, envelope.size, end):
            return self._bad_check(body[end:])
        address = envelope.values.get("address")
        if address is not None and address != header.defaults["address"]:
            text = f"message to address {address:#04x}, not {header.defaults['address']:#04x}"
            return LinkFault(FaultKind.UART_ADDRESS, text)
        found = end - envelope.size
        if "length" in header.roles and envelope.values["length"] != header.length(envelope.size, found):
            text = f"{found} bytes of data, but length {envelope.values['length']}"
            return LinkFault(FaultKind.UART_PROTOCOL, text)
        return envelope, body[envelope.size : end]

    def _checks(self, body: bytes, header_size: int, end: int) -> bool:
        if not self.check.size:
            return True
        covered = self._covered(body[:header_size], body[header_size:end])
        return self.check.compute(covered) == body[end:]

    @staticmethod
    def _bad_check(check: bytes) -> LinkFault:
        return LinkFault(FaultKind.UART_CHECK, f"check {check.hex().upper()} is wrong")

    def measure(self, body: bytes, data_size: Callable[[Envelope], int]) -> int | None:
        """Return the size of the body that begins with these bytes, or None if more are needed.

        `data_size` returns the size of the data if the header carries no length. Raises BodySizeError.
        """
        try:
            envelope = self.header.unpack(body)
            if envelope is None:
                return None
            data = self.header.data_size(envelope) if "length" in self.header.roles else data_size(envelope)
        except HeaderError as error:
            raise BodySizeError(str(error)) from None
        return envelope.size + data + self.check.size
