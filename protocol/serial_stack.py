"""The serial link of a unit according to its definition, sans-I/O.

Units of the CubeSpace family use the codec in `serial_framing`, with its three reply dialects. The link of any
other unit is composed of parts from `framings`, `checks` and `envelope` (`composed_stack`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from starhil.protocol.checks import CheckFunction
from starhil.protocol.codec import Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.conventions import Order
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.link_schema import CubeSpaceFraming, MessageClass, SerialLinkModel
from starhil.protocol.messages import (
    DEFAULT_MAX_SIZE,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
)
from starhil.protocol.serial_framing import DeviceReceiver, Dialect, HostReceiver
from starhil.protocol.serial_framing import encode_reply as encode_cubespace_reply
from starhil.protocol.serial_framing import encode_request as encode_cubespace_request
from starhil.protocol.serial_interface import RowShape, SerialStack
from starhil.protocol.values import IcdError


class CubeSpaceStack(SerialStack):
    """The serial link of the CubeSpace family; its style is the reply dialect, by default b.

    Attributes
    ----------
    dialect
        The only dialect of the unit, used for any style; None if it has all three.
    """

    def __init__(self, link: SerialLinkModel, rows: Sequence[RowShape] = ()) -> None:
        self.baud = link.baud
        self._timeout_s = link.timeout
        self._max_size = link.max_size or DEFAULT_MAX_SIZE
        given = link.framing.dialect if isinstance(link.framing, CubeSpaceFraming) else None
        self.dialect: Final = None if given is None else Dialect(given)
        self._silent = frozenset(row.id for row in rows if not row.answers)

    def device(self) -> DeviceReceiver:
        """Return a receiver for the device's end."""
        return DeviceReceiver(max_size=self._max_size, timeout_s=self._timeout_s)

    def host(self, style: Dialect | None = None) -> HostReceiver:
        """Return a receiver for the OBC's end, in a dialect."""
        return HostReceiver(self._style(style), max_size=self._max_size, timeout_s=self._timeout_s)

    def supports_unsolicited(self, style: Dialect | None = None) -> bool:
        """Return whether this dialect has unsolicited telemetry."""
        return self._style(style).supports_unsolicited

    def encode_request(self, request: Request) -> bytes:
        """Return a request as bytes on the line."""
        return encode_cubespace_request(request)

    def encode_reply(self, reply: Reply, style: Dialect | None = None) -> bytes:
        """Return a reply as bytes on the line, in a dialect; empty if the row has no answer."""
        if reply.kind in (ReplyKind.ACK, ReplyKind.NACK) and reply.id in self._silent:
            return b""
        return encode_cubespace_reply(reply, self._style(style))

    def _style(self, style: Dialect | None) -> Dialect:
        return self.dialect or style or Dialect.B


def build_stack(
    link: SerialLinkModel,
    classes: Sequence[MessageClass] = (),
    rows: Sequence[RowShape] = (),
    byte_order: Order = "little",
    *,
    framings: Mapping[str, Callable[[], object]] | None = None,
    checks: Mapping[str, CheckFunction] | None = None,
) -> SerialStack:
    """Return the serial link of a unit.

    Raises
    ------
    IcdError
        Parts of the link are incompatible.
    """
    if isinstance(link.framing, CubeSpaceFraming):
        return CubeSpaceStack(link, rows)
    return ComposedStack(link, classes, rows, byte_order, framings=framings, checks=checks)


def chosen_dialect(icd: InterfaceDefinition, wanted: str | None) -> Dialect | None:
    """Return the dialect of serial replies of a unit; None if it has no dialects.

    Parameters
    ----------
    icd
        Definition of the unit.
    wanted
        The user's choice; None for the default: the only dialect of the unit, otherwise b.

    Raises
    ------
    IcdError
        The unit does not have this dialect.
    """
    framing = None if icd.link.serial is None else icd.link.serial.framing
    if not isinstance(framing, CubeSpaceFraming):
        if wanted is not None:
            raise IcdError(f"unit {icd.name} has no reply dialects; do not select one")
        return None
    if framing.dialect is not None and wanted not in (None, framing.dialect):
        raise IcdError(f"unit {icd.name} has only dialect {framing.dialect}; do not select another")
    return Dialect(framing.dialect or wanted or Dialect.B)


def serial_answers(icd: InterfaceDefinition, row: Row) -> tuple[str, ...]:
    """Return the answers of a row on the serial line, of which there may be fewer than on other links."""
    framing = None if icd.link.serial is None else icd.link.serial.framing
    silent = isinstance(framing, CubeSpaceFraming) and row.name in framing.unanswered
    return () if silent else row.answers


def build_serial_stack(icd: InterfaceDefinition) -> SerialStack:
    """Return the serial link of a definition.

    Raises
    ------
    IcdError
        The unit has none, or parts of it are incompatible.
    """
    link = icd.link.serial
    if link is None:
        raise IcdError(f"unit {icd.name}: has no serial link")
    shapes = [
        RowShape(
            row.klass,
            row.id,
            RequestKind(row.kind),
            row.size if row.kind == "telecommand" else 0,
            row.size if row.kind == "telemetry" else 0,
            serial_answers(icd, row),
        )
        for row in icd.rows
    ]
    return build_stack(
        link,
        icd.classes,
        shapes,
        icd.conventions.byte_order,
        framings=icd.plugin.framings,
        checks=icd.plugin.checks,
    )
