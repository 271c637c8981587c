"""Documentation of the links, as sections: serial framing, CAN IDs, CANopen objects and PDOs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from pydantic import BaseModel

from starhil.protocol.can_framing import SEGMENT_DATA, MessageType
from starhil.protocol.canopen_schema import CanopenModel, PdoModel, PlacedObject
from starhil.protocol.conventions import EPOCHS, Order
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.link_schema import CubeSpaceFraming, HeaderFieldModel, SerialLinkModel
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.serial_stack import SerialStack, serial_answers
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


_MEANINGS: Final = {
    "address": "address of the unit",
    "source": "address of the OBC",
    "destination": "address of the OBC",
    "class": "code of the class",
    "id": "ID of the row",
    "sequence": "any number; a reply repeats that of its request",
    "length": "number of bytes of data",
    "status": "error code",
    "ack": "0 in a refusal, otherwise 1",
    "final": "1 in the last reply to a request",
    "flags": "a reply repeats those of its request",
    "ticks": "time since start",
    "time": "time of the unit's clock",
}
"""Meaning of the header fields, by role."""


def sections(icd: InterfaceDefinition) -> tuple[Section, ...]:
    """Return the sections about conventions, classes, error codes and links of the unit."""
    found = [_conventions(icd)]
    if icd.classes:
        found.append(_classes(icd))
    if _has_error_codes(icd):
        found.append(_errors(icd))
    if icd.link.serial is not None:
        cubespace = isinstance(icd.link.serial.framing, CubeSpaceFraming)
        serial = icd.link.serial
        found.append(_serial(icd, serial) if cubespace else _composed(serial, icd.conventions.byte_order))
    if icd.link.can is not None:
        found.append(_can())
    if icd.canopen is not None:
        found += [_objects(icd.canopen), _pdos(icd.canopen)]
    return tuple(found)


def _conventions(icd: InterfaceDefinition) -> Section:
    conventions = icd.conventions
    turn, conjugate = "v_reported = q ⊗ v_ICRS ⊗ q*", "v_reported = q* ⊗ v_ICRS ⊗ q"
    quaternion = {
        "rotation": f"{turn} (Hamilton's product, q* = (-x, -y, -z, w)): q turns vectors from ICRS into the reported frame",
        "attitude": f"{conjugate} (Hamilton's product, q* = (-x, -y, -z, w)): the q of the attitude matrix A(q)",
    }
    sign = {
        "positive": "the scalar part w is never negative",
        "any": "of q and -q, the one closer to the last reported quaternion",
    }
    epoch = conventions.epoch
    start = "midnight of the current day" if epoch == "midnight" else EPOCHS.get(epoch, epoch)
    rows = [
        ("quaternion", quaternion[conventions.quaternion]),
        ("sign", sign[conventions.scalar_sign]),
        (
            "axes x, y, z of the reported frame",
            f"{', '.join(conventions.axes)} of the sensor frame (+x right in the image, +y down, +z boresight)",
        ),
        ("epoch of all times", f"{start}, UTC without leap seconds"),
        ("byte order of fields", f"{conventions.byte_order}-endian, unless a type names another"),
    ]
    commands = [row.name for row in icd.telecommands.values() if row.action == "set_mode"]
    if commands and icd.device_parameters["start_mode"].default == "standby":
        text = "the unit boots to standby, in which no attitude is valid: send a mode that takes images with"
        rows.append(("first attitude", f"{text} {' or '.join(commands)}"))
    return Section(heading="Conventions", paragraphs=(), columns=("Convention", "Value"), rows=tuple(rows))


def _classes(icd: InterfaceDefinition) -> Section:
    def code(number: int | None) -> str:
        return "" if number is None else f"{number:02X}h"

    rows = []
    for item in icd.classes:
        reply = item.code if item.reply is None else item.reply
        unsolicited = reply if item.unsolicited is None else item.unsolicited
        rows.append((item.name, item.kind.value, code(item.code), code(reply), code(unsolicited)))
    columns = ("Class", "Rows", "Code in a request", "In a reply", "In unsolicited telemetry")
    return Section(
        heading="Classes",
        paragraphs=("Class and ID together select a row.",),
        columns=columns,
        rows=tuple(rows),
    )


def _has_error_codes(icd: InterfaceDefinition) -> bool:
    """Return whether a reply can carry an error code."""
    serial = icd.link.serial
    if serial is None:
        return icd.link.can is not None
    roles = {
        role for field in serial.reply_header for role in (field.role, *(bit.role for bit in field.bits))
    }
    return isinstance(serial.framing, CubeSpaceFraming) or "status" in roles


def _errors(icd: InterfaceDefinition) -> Section:
    numbers = {code.name.lower(): int(icd.error_number(code)) for code in ErrorCode}
    rows = tuple((f"{number} ({number:02X}h)", name) for name, number in numbers.items())
    return Section(heading="Error codes", paragraphs=(), columns=("Code", "Error"), rows=rows)


def _composed(link: SerialLinkModel, order: Order) -> Section:
    messages = (("request", link.request_header), ("reply", link.reply_header))
    text = (
        f"{link.baud} bit/s, 8 data bits, no parity, 1 stop bit. A message consists of header, data of the row and check; the framing marks "
        f"where it begins and ends. Framing: {_settings(link.framing)}. Check: {_settings(link.check)}."
    )
    return Section(
        heading="Serial line",
        paragraphs=(text,),
        columns=("Message", "Header field", "Type", "Value", "Meaning"),
        rows=tuple(
            (message, *cells)
            for message, header in messages
            for field in header
            for cells in _header_cells(field, order)
        ),
    )


def _settings(model: BaseModel) -> str:
    """Describe the settings of a framing or check in one line."""
    values = model.model_dump(exclude={"kind"}, exclude_none=True)
    kind = str(model.model_dump()["kind"])
    return (
        f"{kind} ({', '.join(f'{name} {_setting(value)}' for name, value in values.items())})"
        if values
        else kind
    )


def _setting(value: object) -> str:
    if isinstance(value, list | tuple):
        return " ".join(_setting(item) for item in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:X}h" if isinstance(value, int) else str(value)


def _header_cells(field: HeaderFieldModel, order: Order) -> Iterator[tuple[str, str, str, str]]:
    only = f"; in {', '.join(field.classes)}" if field.classes else ""
    type_ = field.type if field.type.endswith("8") else f"{field.type}, {field.order or order}-endian"
    bits = 0
    for bit in field.bits:
        yield (
            bit.role or "constant",
            f"{type_}, bits {bits} to {bits + bit.width - 1}",
            _fixed_value(bit.const, bit.default),
            _MEANINGS.get(bit.role or "", ""),
        )
        bits += bit.width
    if not field.bits:
        meaning = _MEANINGS.get(field.role or "", "")
        if field.role == "length":
            meaning = f"number of bytes of {', '.join(field.includes) or 'nothing'}"
        elif field.role in ("ticks", "time"):
            meaning = f"{meaning}, in units of {field.scale:g} s"
        yield field.role or "constant", type_ + only, _fixed_value(field.const, field.default), meaning


def _fixed_value(const: int | None, default: int | None) -> str:
    if const is not None:
        return f"{const:X}h"
    return "" if default is None else f"default {default:X}h"


def _serial(icd: InterfaceDefinition, link: SerialLinkModel) -> Section:
    stack = SerialStack(link)
    data = bytes((_DATA,))
    refusal = ErrorCode.INVALID_PARAMETER
    kinds = (
        Reply(ReplyKind.TELEMETRY, _TELEMETRY, data),
        Reply(ReplyKind.ACK, _TELECOMMAND),
        Reply(ReplyKind.NACK, _TELECOMMAND, code=refusal),
        Reply(ReplyKind.UNSOLICITED, _TELEMETRY, data),
        Reply(ReplyKind.EVENT, _TELEMETRY, data),
    )
    request = _format_message(stack.encode_request(Request.of(_TELECOMMAND, data)))
    text = (
        f"A request is {request}, with every byte 1F of the data doubled; 8 data bits, no parity, 1 stop bit. "
        "The parameter serial_dialect selects the format of the replies; the code is a number of the enumeration error_code."
    )
    choice = (
        "Dialect a is for OBC software written for the CubeComputer: a reply repeats the ID. Dialect b is for software that "
        "talks to a stand-alone node: a reply begins with the data and can only be interpreted with its request. Dialect c is "
        "generation 2. The dialect cannot be recognised from a message: with b instead of a, each value is shifted by one byte and "
        "telecommands seem unanswered."
    )
    rows = sorted(icd.telecommands_by_id.values(), key=lambda row: row.id)
    silent = [f"`{row.name}` ({row.id})" for row in rows if not serial_answers(icd, row)]
    silence = f"On this line, {' or '.join(silent)} is neither acknowledged nor refused."
    return Section(
        heading="Serial line",
        paragraphs=(text, choice, silence) if silent else (text, choice),
        columns=("Dialect", "Telemetry", "Telecommand accepted", "Refused", "Unsolicited telemetry", "Event"),
        rows=tuple(
            (dialect.value, *(_reply(stack, reply, dialect) for reply in kinds)) for dialect in Dialect
        ),
    )


def _reply(stack: SerialStack, reply: Reply, dialect: Dialect) -> str:
    if reply.kind not in stack.format(dialect).headers:
        return "none"
    return _format_message(stack.encode_reply(reply, dialect))


def _format_message(message: bytes) -> str:
    """Format an example message, with placeholders for its variable bytes."""
    return " ".join(_PLACEHOLDERS.get(byte, byte) for byte in message.hex(" ").upper().split())


def _can() -> Section:
    return Section(
        heading="CAN",
        paragraphs=(
            (
                "29-bit CAN IDs: type (bits 28 to 24), row ID (23 to 16), source address (15 to 8), destination "
                "address (7 to 0). By default the device has address 4 and the OBC 1 (parameters can_address and host_address)."
            ),
            f"A message of more than 8 bytes is sent in segments: up to {SEGMENT_DATA} bytes of data, then the number of remaining segments.",
        ),
        columns=("Type", "Message"),
        rows=tuple(
            (str(int(kind)), kind.name.lower().replace("_", " ").replace("extended", "segment"))
            for kind in MessageType
            if kind
        ),
    )


def _objects(layout: CanopenModel) -> Section:
    return Section(
        heading="CANopen objects",
        paragraphs=(
            (
                "The rows, fields and parameters of this definition as objects; types, sub-indices and limits are in the EDS. "
                "Objects below 2000h are defined by CiA 301."
            ),
        ),
        columns=("Index", "Name", "Content"),
        rows=tuple((f"{placed.index:04X}h", placed.name, _content(placed)) for placed in layout.object),
    )


def _content(placed: PlacedObject) -> str:
    if placed.requests:
        return "all rows, with the ID as sub-index: write a telecommand, read a telemetry row"
    if placed.parameters:
        return "all parameters, with the ID as sub-index"
    if placed.image is not None:
        return f"image {placed.image}: pixels as DOMAIN, size, frame counter"
    if placed.packed:
        return (
            "in narrower types: "
            + ", ".join(
                f"{field.name or field.source}{' (wraps)' if field.wrap else ''}" for field in placed.packed
            )
            + "; a number beyond the range of its type is clipped"
        )
    if placed.telemetry is not None:
        return f"telemetry {placed.telemetry}: one sub-index per field"
    if placed.members:
        return ", ".join(member.name for member in placed.members)
    shown = [] if placed.value is None else [f"reads {placed.value}"]
    return ", ".join(
        [*shown, *([] if placed.telecommand is None else [f"writing executes {placed.telecommand}"])]
    )


def _pdos(layout: CanopenModel) -> Section:
    rows = [("TPDO", number, pdo) for number, pdo in enumerate(layout.tpdo, 1)]
    rows += [("RPDO", number, pdo) for number, pdo in enumerate(layout.rpdo, 1)]
    return Section(
        heading="CANopen PDOs",
        paragraphs=("The default mapping; all PDOs can be remapped while the node is running.",),
        columns=("PDO", "Name", "At start", "Transmission type", "Mapped"),
        rows=tuple((f"{kind} {number}", *_pdo(pdo)) for kind, number, pdo in rows),
    )


def _pdo(pdo: PdoModel) -> tuple[str, str, str, str]:
    on = "on" if pdo.enabled else "off"
    return pdo.name, on, str(pdo.transmission_type), ", ".join(pdo.objects)
