"""The interface definition as a CAN database (DBC).

Each row yields its messages between the default addresses: request, telemetry and NACK, or telecommand, ACK
and NACK. A message longer than 8 bytes describes the data after its segments (7 bytes and a counter each)
have been joined, as is usual in DBC files for transport protocols.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from starhil.protocol.can.cubespace import REPLY_TYPES, REQUEST_TYPES, CanId, MessageType, nack_type
from starhil.protocol.can.frame import MAX_FRAME_DATA
from starhil.protocol.errors import IcdError
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row, Slot
from starhil.protocol.icd.quoting import Scope, dbc_string
from starhil.protocol.icd.values import EnumDefinition
from starhil.protocol.messages import ErrorCode, ReplyKind

EXTENDED: Final = 0x80000000
"""Flag of a 29-bit CAN ID in DBC files."""


class _Signal(NamedTuple):
    """One signal of a message: a field, or one byte of a string."""

    name: str
    start: int
    bits: int
    order: int = 1
    """1 for little-endian, 0 for big-endian."""
    sign: str = "+"
    scale: float = 1.0
    bias: float = 0.0
    low: float = 0
    high: float = 255
    unit: str = ""


class _Message(NamedTuple):
    can_id: int
    """With the flag `EXTENDED`."""
    name: str
    size: int
    sender: str
    fields: tuple[Field, ...]
    doc: str


def render(icd: InterfaceDefinition) -> str:
    """Return the text of the database. Raises IcdError for a unit without a CAN link."""
    if icd.link.can is None:
        raise IcdError(f"unit {icd.name}: has no CAN link ([link.can]), and a DBC holds only CAN messages")
    host = int(icd.device_parameters["host_address"].default)
    device = int(icd.device_parameters["can_address"].default)
    messages = [message for row in icd.rows for message in _messages(row, icd, host, device)]
    return fill("dbc.j2", icd=icd, messages=messages, signals=_signals, number=number, string=dbc_string)


def _messages(row: Row, icd: InterfaceDefinition, host: int, device: int) -> Iterator[_Message]:
    to_device = (row.id, host, device)
    to_host = (row.id, device, host)
    fields = tuple(field.changed(doc=meaning(row, field)) for field in row.named_fields.values())
    scope = Scope("DBC")
    for field in fields:
        for signal in _signals(field):
            scope.claim(signal.name, f"{row.kind} {row.name}: field {field.name}")
    code = (
        Field(name="error", kind="enum", slot=Slot(0, "u8", 0, 1), enum=_error_codes(icd), doc="Error code."),
    )
    long = row.size > MAX_FRAME_DATA
    telemetry = row.kind == "telemetry"
    request = REQUEST_TYPES[row.kind][long]
    reply = REPLY_TYPES[ReplyKind.TELEMETRY if telemetry else ReplyKind.ACK][long and telemetry]
    request_id, reply_id = _id(request, *to_device), _id(reply, *to_host)
    if row.only_sent:
        sent = MessageType.UNSOLICITED_FIRST if long else MessageType.UNSOLICITED_LAST
        yield _Message(_id(sent, *to_host), f"TLM_{row.name}", row.size, "SENSOR", fields, row.doc)
        return
    if telemetry:
        yield _Message(request_id, f"REQ_{row.name}", 0, "OBC", (), f"Request for: {row.doc}")
        yield _Message(reply_id, f"TLM_{row.name}", row.size, "SENSOR", fields, row.doc)
    else:
        yield _Message(request_id, f"TC_{row.name}", row.size, "OBC", fields, row.doc)
        yield _Message(reply_id, f"ACK_{row.name}", 0, "SENSOR", (), f"Acknowledge of {row.name}.")
    refused = _id(nack_type(row.id), *to_host)
    yield _Message(refused, f"NACK_{row.name}", 1, "SENSOR", code, f"Refusal of {row.name}.")


def _error_codes(icd: InterfaceDefinition) -> EnumDefinition:
    """Return the error codes: the unit's, or the published ones if it has none."""
    published = {code.name.lower(): int(code) for code in ErrorCode}
    return icd.enums.get("error_code") or EnumDefinition(name="error_code", doc="", values=published)


def _id(kind: MessageType, row_id: int, source: int, destination: int) -> int:
    return CanId(kind, row_id, source, destination).pack() | EXTENDED


def _signals(field: Field) -> Iterator[_Signal]:
    if field.slot.type == "bytes":
        for index in range(field.size):
            yield _Signal(f"{field.name}_{index}", 8 * (field.offset + index), 8)
        return
    big = field.slot.order == "big"
    byte, bit = field.place(field.bit_count - 1 if big else 0)
    sign = "-" if field.slot.type.startswith("i") or field.kind == "float" else "+"
    yield _Signal(
        field.name, 8 * byte + bit, field.bit_count, int(not big), sign, field.scale, field.bias, *_limits(field), field.unit
    )  # fmt: skip


def _limits(field: Field) -> tuple[float, float]:
    if field.enum is not None:
        return min(field.enum.values.values()), max(field.enum.values.values())
    if field.kind == "float" and (field.minimum is None or field.maximum is None):
        return 0.0, 0.0
    return field.physical_limits
