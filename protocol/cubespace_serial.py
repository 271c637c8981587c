"""CubeSpace's serial line: the framing `escaped`, an ID before the data, and three public dialects of replies.

::

    request   all dialects   1F 7F  id  data                              1F FF
    reply     a              1F 7F  id  data, or the code of a result     1F FF   CubeComputer
              b              1F 7F      data, or the code of a result     1F FF   stand-alone CubeSense node
              c              1F 07  id  data, or nothing                  1F FF   generation 2: accepted
                             1F 0F  id  code                              1F FF   refused
                             1F 4F  id  data                              1F FF   unsolicited telemetry
                             1F 2F  id  data                              1F FF   event
    burst     all dialects   1F 7F  77  number (u16), 20 bytes of a file  1F FF

Every byte 1F within is doubled. In dialects a and b, the refusal of a telemetry request has the code instead of the
telemetry; this is our own choice, because no public source shows this case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from starhil.protocol.errors import ProtocolError
from starhil.protocol.framings import Escaped, EscapedDeframer, Receiving
from starhil.protocol.link_schema import CubeSpaceFraming, EscapedFraming, SerialLinkModel
from starhil.protocol.messages import (
    BURST_ID,
    DEFAULT_MAX_SIZE,
    DEFAULT_TIMEOUT_S,
    FIRST_TELEMETRY_ID,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)
from starhil.protocol.serial_interface import Dialect, RowShape, SerialStack

START: Final = 0x7F
BURST_SIZE: Final = 22
"""Bytes of a burst packet: its number (u16) and 20 bytes of the file."""


@dataclass(frozen=True)
class _Form:
    """The replies of a dialect."""

    starts: Mapping[ReplyKind, int]
    """Start byte of each kind of reply that the dialect has."""
    has_id: bool
    coded: frozenset[ReplyKind]
    """Kinds with an error code instead of data."""


_GENERATION_1: Final = dict.fromkeys((ReplyKind.ACK, ReplyKind.NACK, ReplyKind.TELEMETRY), START)
_GENERATION_2: Final = {
    ReplyKind.ACK: 0x07,
    ReplyKind.TELEMETRY: 0x07,
    ReplyKind.NACK: 0x0F,
    ReplyKind.EVENT: 0x2F,
    ReplyKind.UNSOLICITED: 0x4F,
}
_FORMS: Final = {
    Dialect.A: _Form(_GENERATION_1, has_id=True, coded=frozenset((ReplyKind.ACK, ReplyKind.NACK))),
    Dialect.B: _Form(_GENERATION_1, has_id=False, coded=frozenset((ReplyKind.ACK, ReplyKind.NACK))),
    Dialect.C: _Form(_GENERATION_2, has_id=True, coded=frozenset((ReplyKind.NACK,))),
}
_STARTS: Final = frozenset((START, *_GENERATION_2.values()))


def _framing(start: int) -> Escaped:
    return Escaped(EscapedFraming(kind="escaped", escape=0x1F, start=start, end=0xFF))


_FRAMINGS: Final = {start: _framing(start) for start in _STARTS}


def encode_request(request: Request, *, stuff_id: bool = True) -> bytes:
    """Frame a telecommand or telemetry request as an OBC sends it, the same in all dialects.

    Without `stuff_id`, an ID of 0x1F is not doubled, as in some flight software.
    """
    line = _FRAMINGS[START].encode(bytes((request.id,)) + request.data)
    doubled = 2 * _FRAMINGS[START].escape
    return line if stuff_id or line[2:4] != doubled else line[:2] + line[3:]


def encode_reply(reply: Reply, dialect: Dialect) -> bytes:
    """Frame a reply of a device in a dialect.

    Raises
    ------
    ProtocolError
        The dialect cannot carry the reply (unsolicited telemetry and events exist in dialect c only, echoes
        in none).
    """
    if reply.kind is ReplyKind.BURST:
        return _FRAMINGS[START].encode(bytes((BURST_ID,)) + reply.data)
    form = _FORMS[dialect]
    start = form.starts.get(reply.kind)
    if start is None:
        remedy = "" if reply.kind is ReplyKind.ECHO else "; use dialect c"
        raise ProtocolError(f"serial dialect {dialect} has no {reply.kind.value} messages{remedy}")
    if form.has_id and reply.id is None:
        raise ProtocolError(f"a {reply.kind.value} in this serial dialect needs an ID")
    body = b"" if reply.kind is ReplyKind.ACK else reply.data
    if reply.kind in form.coded:
        body = bytes((int(reply.code),))
    return _FRAMINGS[start].encode((bytes((reply.id or 0,)) if form.has_id else b"") + body)


class DeviceReceiver(EscapedDeframer[Request]):
    """The device's end: bytes in, requests and faults out."""

    def __init__(self, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        receiving = Receiving(
            lambda body: Request.of(body[0], body[1:]), lambda _body: None, max_size, timeout_s
        )
        super().__init__(receiving, _FRAMINGS[START], first_is_id=True)


class HostReceiver(EscapedDeframer[Reply]):
    """The OBC's end: bytes in, replies and faults out, in one dialect.

    In dialects a and b, replies cannot be interpreted alone: call `expect` before each request.
    """

    def __init__(
        self, dialect: Dialect, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        generation_2 = dialect is Dialect.C
        interpret = self._interpret_generation_2 if generation_2 else self._interpret_generation_1
        super().__init__(
            Receiving(interpret, lambda _body: None, max_size, timeout_s),
            _FRAMINGS[START],
            _STARTS if generation_2 else frozenset(),
            first_is_id=_FORMS[dialect].has_id,
        )
        self._dialect = dialect
        self._expected: tuple[Request, int] | None = None

    def expect(self, request: Request, reply_size: int) -> None:
        """Set the next request, and the data size of its telemetry in bytes (0 for a telecommand)."""
        self._expected = (request, reply_size)

    def _interpret_generation_1(self, body: bytes) -> Reply | LinkFault:
        if self._is_burst(body):
            return Reply(ReplyKind.BURST, BURST_ID, body[1:])
        expected, size = self._expected or (None, None)
        if self._dialect is Dialect.A:
            row_id, data = body[0], body[1:]
            size = size if expected is not None and expected.id == row_id else None
        elif expected is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        else:
            row_id, data = expected.id, body
        if row_id >= FIRST_TELEMETRY_ID:
            self._expected = None
            if len(data) == 1 and size not in (None, 1):
                return Reply(ReplyKind.NACK, row_id, code=error_code(data[0]))
            return Reply(ReplyKind.TELEMETRY, row_id, data)
        if len(data) != 1:
            return LinkFault(
                FaultKind.UART_PROTOCOL, f"ACK of telecommand {row_id} has {len(data)} bytes, must be 1"
            )
        self._expected = None
        code = error_code(data[0])
        return Reply(ReplyKind.NACK if code else ReplyKind.ACK, row_id, code=code)

    def _is_burst(self, body: bytes) -> bool:
        if len(body) != BURST_SIZE + 1 or body[0] != BURST_ID:
            return False
        if self._dialect is Dialect.A or self._expected is None:
            return True
        request, size = self._expected
        return request.kind is RequestKind.TELECOMMAND or size != len(body)

    def _interpret_generation_2(self, body: bytes) -> Reply | LinkFault:
        start, row_id, data = body[0], body[1], body[2:]
        if start == START:
            if row_id == BURST_ID and len(data) == BURST_SIZE:
                return Reply(ReplyKind.BURST, row_id, data)
            return LinkFault(FaultKind.UART_PROTOCOL, f"message {row_id} with the start byte of a request")
        kinds = [kind for kind, own in _GENERATION_2.items() if own == start]
        kind = kinds[-1] if row_id >= FIRST_TELEMETRY_ID else kinds[0]  # an ACK, or telemetry
        if kind is not ReplyKind.NACK:
            return Reply(kind, row_id, data)
        if len(data) != 1:
            return LinkFault(FaultKind.UART_PROTOCOL, f"NACK of {row_id} has {len(data)} bytes, must be 1")
        return Reply(kind, row_id, code=error_code(data[0]))


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
        return encode_request(request)

    def encode_reply(self, reply: Reply, style: Dialect | None = None) -> bytes:
        """Return a reply as bytes on the line, in a dialect; empty if the row has no answer."""
        if reply.kind in (ReplyKind.ACK, ReplyKind.NACK) and reply.id in self._silent:
            return b""
        return encode_reply(reply, self._style(style))

    def _style(self, style: Dialect | None) -> Dialect:
        return self.dialect or style or Dialect.B
