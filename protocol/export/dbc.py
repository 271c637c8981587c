"""The interface definition as a CAN database (DBC).

Each row yields its messages between the default addresses: request, telemetry and NACK, or telecommand, ACK
and NACK. A message longer than 8 bytes describes the data after its segments (7 bytes and a counter each)
have been joined, as is usual in DBC files for transport protocols.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from starhil.protocol.can_framing import (
    MAX_FRAME_DATA,
    REPLY_TYPES,
    REQUEST_TYPES,
    CanId,
    MessageType,
    nack_type,
)
from starhil.protocol.codec import Field, Row, Slot
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.messages import ErrorCode, ReplyKind, RequestKind
from starhil.protocol.quoting import Scope, dbc_string
from starhil.protocol.values import EnumDefinition, IcdError

EXTENDED: Final = 0x80000000
"""Flag of a 29-bit CAN ID in DBC files."""

_JOINED: Final = "Messages longer than 8 bytes describe the data after their segments are joined."


@dataclass(frozen=True)
class _Message:
    """One message of the database."""

    can_id: int
    name: str
    size: int
    sender: str
    signals: tuple[Field, ...]
    doc: str


def render(icd: InterfaceDefinition) -> str:
    """Return the text of the database. Raises IcdError for a unit without a CAN link."""
    if icd.link.can is None:
        raise IcdError(f"unit {icd.name}: has no CAN link ([link.can]), and a DBC holds only CAN messages")
    host = int(icd.device_parameters["host_address"].default)
    device = int(icd.device_parameters["can_address"].default)
    messages = [message for row in icd.rows for message in _messages(row, icd, host, device)]
    return "\n".join(_lines(icd, messages)) + "\n"


def _lines(icd: InterfaceDefinition, messages: list[_Message]) -> Iterator[str]:
    yield from (
        f"VERSION {dbc_string(f'{icd.name} {icd.version}')}",
        "",
        "NS_ :",
        "",
        "BS_:",
        "",
        "BU_: OBC SENSOR",
    )
    for message in messages:
        yield ""
        yield f"BO_ {message.can_id | EXTENDED} {message.name}: {message.size} {message.sender}"
        for signal in message.signals:
            yield from _signals(signal, "OBC" if message.sender == "SENSOR" else "SENSOR")
    yield ""
    yield f"CM_ {dbc_string(f'{icd.doc} {_JOINED}')};"
    for message in messages:
        yield f"CM_ BO_ {message.can_id | EXTENDED} {dbc_string(message.doc)};"
        for signal in message.signals:
            if signal.slot.type != "bytes":
                yield f"CM_ SG_ {message.can_id | EXTENDED} {signal.name} {dbc_string(signal.doc)};"
    yield 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN";'
    yield 'BA_DEF_DEF_ "VFrameFormat" "ExtendedCAN";'
    signals = [(message.can_id | EXTENDED, signal) for message in messages for signal in message.signals]
    for can_id, signal in signals:
        if signal.enum is not None:
            values = " ".join(f"{value} {dbc_string(name)}" for name, value in signal.enum.values.items())
            yield f"VAL_ {can_id} {signal.name} {values} ;"
    for can_id, signal in signals:
        if signal.kind == "float":
            yield f"SIG_VALTYPE_ {can_id} {signal.name} : {1 if signal.type == 'f32' else 2};"


def _messages(row: Row, icd: InterfaceDefinition, host: int, device: int) -> Iterator[_Message]:
    to_device = (row.id, host, device)
    to_host = (row.id, device, host)
    signals = tuple(field.changed(doc=meaning(row, field)) for field in row.named_fields.values())
    scope = Scope("DBC")
    for field in signals:
        for name in _names(field):
            scope.claim(name, f"{row.kind} {row.name}: field {field.name}")
    code = (
        Field(name="error", kind="enum", slot=Slot(0, "u8", 0, 1), enum=_error_codes(icd), doc="Error code."),
    )
    long = row.size > MAX_FRAME_DATA
    telemetry = row.kind == "telemetry"
    request = REQUEST_TYPES[RequestKind(row.kind)][long]
    reply = REPLY_TYPES[ReplyKind.TELEMETRY if telemetry else ReplyKind.ACK][long and telemetry]
    asked, answered = _id(request, *to_device), _id(reply, *to_host)
    if telemetry:
        yield _Message(asked, f"REQ_{row.name}", 0, "OBC", (), f"Request for: {row.doc}")
        yield _Message(answered, f"TLM_{row.name}", row.size, "SENSOR", signals, row.doc)
    else:
        yield _Message(asked, f"TC_{row.name}", row.size, "OBC", signals, row.doc)
        yield _Message(answered, f"ACK_{row.name}", 0, "SENSOR", (), f"Acknowledge of {row.name}.")
    refused = _id(nack_type(row.id), *to_host)
    yield _Message(refused, f"NACK_{row.name}", 1, "SENSOR", code, f"Refusal of {row.name}.")


def _error_codes(icd: InterfaceDefinition) -> EnumDefinition:
    """Return the error codes: the unit's, or the published ones if it has none."""
    published = {code.name.lower(): int(code) for code in ErrorCode}
    return icd.enums.get("error_code") or EnumDefinition(name="error_code", doc="", values=published)


def _id(kind: MessageType, row_id: int, source: int, destination: int) -> int:
    return CanId(kind, row_id, source, destination).pack()


def _names(field: Field) -> list[str]:
    """Return the names of the signals of a field: one for each byte of a string."""
    if field.slot.type != "bytes":
        return [field.name]
    return [f"{field.name}_{index}" for index in range(field.size)]


def _signals(field: Field, receiver: str) -> Iterator[str]:
    if field.slot.type == "bytes":
        for index, name in enumerate(_names(field)):
            yield f' SG_ {name} : {8 * (field.offset + index)}|8@1+ (1,0) [0|255] "" {receiver}'
        return
    big = field.slot.order == "big"
    byte, bit = field.place(field.bit_count - 1 if big else 0)
    sign = "-" if field.slot.type.startswith("i") or field.kind == "float" else "+"
    low, high = _limits(field)
    yield (
        f" SG_ {field.name} : {8 * byte + bit}|{field.bit_count}@{int(not big)}{sign} "
        f"({number(field.scale)},{number(field.bias)}) [{number(low)}|{number(high)}] {dbc_string(field.unit)} {receiver}"
    )


def _limits(field: Field) -> tuple[float, float]:
    if field.enum is not None:
        return min(field.enum.values.values()), max(field.enum.values.values())
    if field.kind == "float" and (field.minimum is None or field.maximum is None):
        return 0.0, 0.0
    return field.physical_limits
