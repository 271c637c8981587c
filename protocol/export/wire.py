"""Documentation of the links, as sections: serial framing, CAN IDs, CANopen objects and PDOs."""

from __future__ import annotations

from typing import Final

from starhil.protocol.can_framing import SEGMENT_DATA, MessageType
from starhil.protocol.canopen.layout import CanopenModel, PdoModel, PlacedObject, read_layout
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request
from starhil.protocol.serial_framing import Dialect, encode_reply, encode_request
from starhil.protocol.values import Section

_TELEMETRY: Final = 0x80
_TELECOMMAND: Final = 0x60
_DATA: Final = 0xDA
_PLACEHOLDERS: Final = {
    f"{_TELEMETRY:02X}": "id",
    f"{_TELECOMMAND:02X}": "id",
    f"{_DATA:02X}": "data",
    f"{ErrorCode.INVALID_PARAMETER:02X}": "code",
}
"""Placeholder names for bytes of the example messages."""


def sections(icd: InterfaceDefinition) -> tuple[Section, ...]:
    """Return the sections on the links."""
    if icd.canopen is None:
        return (_serial(), _can())
    layout = read_layout(icd)
    return (_serial(), _can(), _objects(layout), _pdos(layout))


def _serial() -> Section:
    data = bytes((_DATA,))
    refusal = ErrorCode.INVALID_PARAMETER
    kinds = (
        Reply(ReplyKind.TELEMETRY, _TELEMETRY, data),
        Reply(ReplyKind.ACK, _TELECOMMAND),
        Reply(ReplyKind.NACK, _TELECOMMAND, code=refusal),
        Reply(ReplyKind.UNSOLICITED, _TELEMETRY, data),
        Reply(ReplyKind.EVENT, _TELEMETRY, data),
    )
    request = _format_message(encode_request(Request.of(_TELECOMMAND, data)))
    text = (
        f"A request is {request}, with every byte 1F of the data doubled; 8 data bits, no parity, 1 stop bit. "
        "The form of the replies is the parameter serial_dialect; the code is a number of the enumeration error_code."
    )
    choice = (
        "Dialect a is for OBC software written for the CubeComputer: a reply repeats the identifier. Dialect b is for software that "
        "talks to a stand-alone node: a reply begins with the data, and only the request says what they are. Dialect c is "
        "generation 2. Nothing in a message names its dialect: with b in place of a, each value is read from the byte after its own and "
        "telecommands seem unanswered."
    )
    return Section(
        "Serial line",
        (text, choice),
        ("Dialect", "Telemetry", "Telecommand accepted", "Refused", "Unsolicited telemetry", "Event"),
        tuple((dialect.value, *(_reply(reply, dialect) for reply in kinds)) for dialect in Dialect),
    )


def _reply(reply: Reply, dialect: Dialect) -> str:
    if reply.kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT) and not dialect.supports_unsolicited:
        return "none"
    return _format_message(encode_reply(reply, dialect))


def _format_message(message: bytes) -> str:
    """Format an example message, with placeholders for its variable bytes."""
    return " ".join(_PLACEHOLDERS.get(byte, byte) for byte in message.hex(" ").upper().split())


def _can() -> Section:
    return Section(
        "CAN",
        (
            (
                "Extended identifiers of 29 bits: type (bits 28 to 24), identifier of the row (23 to 16), source address (15 to 8), destination "
                "address (7 to 0). By default the device has address 4 and the OBC 1 (parameters can_address and host_address)."
            ),
            f"A message of more than 8 bytes goes in segments: up to {SEGMENT_DATA} bytes of data, then the number of segments still to come.",
        ),
        ("Type", "Message"),
        tuple(
            (str(int(kind)), kind.name.lower().replace("_", " ").replace("extended", "segment"))
            for kind in MessageType
            if kind
        ),
    )


def _objects(layout: CanopenModel) -> Section:
    return Section(
        "CANopen objects",
        (
            (
                "The rows, fields and parameters of this definition as objects; types, sub-indices and limits are in the electronic data sheet. "
                "Objects below 2000h are those of CiA 301."
            ),
        ),
        ("Index", "Name", "Content"),
        tuple((f"{placed.index:04X}h", placed.name, _content(placed)) for placed in layout.object),
    )


def _content(placed: PlacedObject) -> str:
    if placed.requests:
        return "all rows: the sub-index is the identifier; telecommands to write, telemetry to read"
    if placed.parameters:
        return "all parameters: the sub-index is the parameter's identifier"
    if placed.image is not None:
        return f"image {placed.image}: pixels as DOMAIN, size, frame counter"
    if placed.packed:
        return (
            "in narrower types: "
            + ", ".join(
                f"{field.name or field.source}{' (wraps)' if field.wrap else ''}" for field in placed.packed
            )
            + "; a number beyond its type is clipped"
        )
    if placed.telemetry is not None:
        return f"telemetry {placed.telemetry}: a sub-index a field"
    shown = [] if placed.value is None else [f"reads {placed.value}"]
    return ", ".join(
        [*shown, *([] if placed.telecommand is None else [f"writing executes {placed.telecommand}"])]
    )


def _pdos(layout: CanopenModel) -> Section:
    rows = [("TPDO", number, pdo) for number, pdo in enumerate(layout.tpdo, 1)]
    rows += [("RPDO", number, pdo) for number, pdo in enumerate(layout.rpdo, 1)]
    return Section(
        "CANopen PDOs",
        ("The mapping by default; all of them can be remapped while the node is running.",),
        ("PDO", "Name", "At start", "Transmission type", "Mapped"),
        tuple((f"{kind} {number}", *_pdo(pdo)) for kind, number, pdo in rows),
    )


def _pdo(pdo: PdoModel) -> tuple[str, str, str, str]:
    on = "on" if pdo.enabled else "off"
    return pdo.name, on, str(pdo.transmission_type), ", ".join(pdo.objects)
