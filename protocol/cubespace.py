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
start byte, which `serial_stack` takes as the first byte of its header.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from starhil.protocol.link_schema import HeaderFieldModel
from starhil.protocol.messages import ReplyKind
from starhil.protocol.serial_interface import Dialect

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
