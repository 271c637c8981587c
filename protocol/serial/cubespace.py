"""CubeSpace's serial line as data: the framing `escaped`, and three public dialects of replies.

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
telemetry; this is our own choice, because no public source shows this case. Dialect c marks the kind of a reply by its
start byte, which is the first byte of its header here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Final

from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd.link_schema import HeaderFieldModel
from starhil.protocol.messages import (
    BURST_ID,
    FIRST_TELEMETRY_ID,
    ErrorCode,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)
from starhil.protocol.serial.framings import CUBESPACE, Escaped
from starhil.protocol.serial.headers import HeaderCodec


class Dialect(StrEnum):
    """Formats of serial replies."""

    A = "a"
    B = "b"
    C = "c"


_ID: Final = HeaderFieldModel(role="id", type="u8")
REQUEST_HEADER: Final = (_ID,)

BURST_SIZE: Final = 22
"""Bytes of a burst packet: its number (u16) and 20 bytes of the file."""

_CODE: Final = HeaderFieldModel(role="status", type="u8")


def _start(byte: int) -> HeaderFieldModel:
    return HeaderFieldModel(type="u8", const=byte)


REPLIES: Final[Mapping[Dialect, Mapping[ReplyKind, Sequence[HeaderFieldModel]]]] = {
    Dialect.A: {
        ReplyKind.ACK: [_ID, _CODE],
        ReplyKind.NACK: [_ID, _CODE],
        ReplyKind.TELEMETRY: [_ID],
        ReplyKind.BURST: [_ID],
    },
    Dialect.B: {
        ReplyKind.ACK: [_CODE],
        ReplyKind.NACK: [_CODE],
        ReplyKind.TELEMETRY: [],
        ReplyKind.BURST: [_ID],
    },
    Dialect.C: {
        ReplyKind.ACK: [_start(0x07), _ID],
        ReplyKind.NACK: [_start(0x0F), _ID, _CODE],
        ReplyKind.TELEMETRY: [_start(0x07), _ID],
        ReplyKind.UNSOLICITED: [_start(0x4F), _ID],
        ReplyKind.EVENT: [_start(0x2F), _ID],
        ReplyKind.BURST: [_start(0x7F), _ID],
    },
}
"""The header of each kind of reply; neither ACK nor NACK has data."""


class DialectReplies:
    """The replies in a dialect: their framing, the header of each kind, and both directions of their codec.

    All replies to a request with the same start byte have the ID in the same place.
    """

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self.headers: Final = {
            kind: HeaderCodec(models, "little", {}, {}, f"link.serial.{kind.value}")
            for kind, models in REPLIES[dialect].items()
        }
        firsts = {kind: head.fields[0].const if head.fields else None for kind, head in self.headers.items()}
        roles = {kind: [item.role for item in head.fields] for kind, head in self.headers.items()}
        self._sizes = {kind: len(found) for kind, found in roles.items()}
        self._ids = {kind: found.index("id") for kind, found in roles.items() if "id" in found}
        """Kind → place of the ID in the header, if it has one."""
        self._coded = {kind for kind, found in roles.items() if "status" in found}
        self._starts: dict[int | None, list[ReplyKind]] = {}
        """First byte of a header, None if any → kinds of replies to a request."""
        for kind, start in firsts.items():
            if kind is not ReplyKind.BURST:
                self._starts.setdefault(start, []).append(kind)
        self._burst_start = firsts[ReplyKind.BURST]
        starts = frozenset(start for start in firsts.values() if start is not None)
        self.framing: Final = Escaped(CUBESPACE, starts, first_is_id=ReplyKind.TELEMETRY in self._ids)

    def encode(self, reply: Reply) -> bytes:
        """Return a reply as bytes on the line; raise ProtocolError for a kind that the dialect does not have."""
        header = self.headers.get(reply.kind)
        if header is None:
            others = [other for other, replies in REPLIES.items() if reply.kind in replies]
            remedy = f"; use dialect {' or '.join(others)}" if others else ""
            raise ProtocolError(f"serial dialect {self._dialect} has no {reply.kind.value} messages{remedy}")
        data = b"" if reply.kind in (ReplyKind.ACK, ReplyKind.NACK) else reply.data
        values = {"id": reply.id or 0, "status": int(reply.code)}
        return self.framing.encode(header.pack(values, reply.message_class, len(data)) + data)

    def decode(self, body: bytes, pending: Request | None, reply_size: int) -> Reply | LinkFault:
        """Return the reply in a body, whose kind follows from its start byte, row and size.

        `pending` is the request that awaits an answer, and `reply_size` the data size of its telemetry.
        """
        sizes = self._sizes
        if self._is_burst(body, pending, reply_size):
            return Reply(ReplyKind.BURST, BURST_ID, body[sizes[ReplyKind.BURST] :])
        kinds = self._starts.get(body[0]) or self._starts.get(None)
        if kinds is None:
            text = f"message {body[1]} with the start byte of a request"
            return LinkFault(FaultKind.UART_PROTOCOL, text)
        is_awaited = pending is not None
        if kinds[0] in self._ids:
            row_id = body[self._ids[kinds[0]]]
            is_awaited = pending is not None and pending.id == row_id
        elif pending is not None:
            row_id = pending.id
        else:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        if ReplyKind.ACK not in kinds:
            (kind,) = kinds  # given by the start byte
        elif row_id < FIRST_TELEMETRY_ID:
            kind = ReplyKind.ACK
        else:
            coded = ReplyKind.NACK in kinds and len(body) == sizes[ReplyKind.NACK]
            kind = ReplyKind.NACK if coded and is_awaited and reply_size != 1 else ReplyKind.TELEMETRY
        data = body[sizes[kind] :]
        code: ErrorCode | int = ErrorCode.OK
        if kind in self._coded:
            codes = len(body) - sizes[kind] + 1
            if codes != 1:
                name = "ACK of telecommand" if kind is ReplyKind.ACK else "NACK of"
                return LinkFault(FaultKind.UART_PROTOCOL, f"{name} {row_id} has {codes} bytes, must be 1")
            code = error_code(body[-1])
            if kind is ReplyKind.NACK and not code:  # no refusal has the code 0
                text = f"NACK of {row_id} with the code 0, which is no error: an acknowledge of an earlier request?"
                return LinkFault(FaultKind.UART_PROTOCOL, text)
            kind = ReplyKind.NACK if code else kind
        return Reply(
            kind,
            row_id,
            data,
            code,
            message_class=pending.message_class if is_awaited and pending is not None else "",
        )

    def _is_burst(self, body: bytes, pending: Request | None, reply_size: int) -> bool:
        size, place = self._sizes[ReplyKind.BURST] + BURST_SIZE, self._ids[ReplyKind.BURST]
        if len(body) != size or body[place] != BURST_ID or self._burst_start not in (None, body[0]):
            return False
        if ReplyKind.TELEMETRY in self._ids or pending is None:
            return True
        return pending.kind is RequestKind.TELECOMMAND or reply_size != len(body)
