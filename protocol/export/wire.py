"""Documentation of the links, as sections: serial framing, CAN IDs, CANopen objects and PDOs."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

from pydantic import BaseModel

from starhil.protocol.can.cubespace import MessageType
from starhil.protocol.export.templates import text_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.canopen_schema import CanopenModel, PdoModel, PlacedObject
from starhil.protocol.icd.conventions import EPOCHS, Order
from starhil.protocol.icd.link_schema import (
    CountedMessage,
    CubeSpaceFraming,
    FormatModel,
    HeaderFieldModel,
    SerialLinkModel,
)
from starhil.protocol.icd.values import Section
from starhil.protocol.messages import ErrorCode


def texts_of(table: str) -> dict[str, Any]:
    texts: dict[str, Any] = _texts()[table]
    return texts


@cache
def _texts() -> dict[str, Any]:
    return tomllib.loads(text_of("wire.toml"))


def _section(name: str, rows: Iterable[tuple[str, ...]], **values: object) -> Section:
    """Return a section with its texts filled in; a paragraph that is empty then is left out."""
    texts = texts_of(name)
    paragraphs = [paragraph.format(**values) for paragraph in texts.get("paragraphs", ())]
    return Section(
        heading=texts["heading"],
        paragraphs=[paragraph for paragraph in paragraphs if paragraph],
        columns=texts["columns"],
        rows=[list(row) for row in rows],
    )


def sections(icd: InterfaceDefinition) -> tuple[Section, ...]:
    """Return the sections about conventions, classes, error codes and links of the unit."""
    parts = [_conventions(icd)]
    if icd.classes:
        parts.append(_classes(icd))
    if _has_error_codes(icd):
        parts.append(_errors(icd))
    if icd.link.serial is not None:
        if isinstance(icd.link.serial.framing, CubeSpaceFraming):
            parts.append(_cubespace(icd, icd.link.serial.framing))
        else:
            parts.append(_composed(icd, icd.link.serial))
    if icd.link.can is not None:
        parts.append(_can())
    if icd.canopen is not None:
        parts += [_objects(icd.canopen), _pdos(icd.canopen)]
    return tuple(parts)


def _conventions(icd: InterfaceDefinition) -> Section:
    conventions = icd.conventions
    epoch = conventions.epoch
    start = "midnight of the current day" if epoch == "midnight" else EPOCHS.get(epoch, epoch)
    rows = [
        ("quaternion", texts_of("quaternion")[conventions.quaternion]),
        ("sign", texts_of("sign")[conventions.scalar_sign]),
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
    return _section("conventions", rows)


def _classes(icd: InterfaceDefinition) -> Section:
    def code(number: int | None) -> str:
        return "" if number is None else f"{number:02X}h"

    rows = (
        (item.name, item.kind, code(item.code), code(item.reply_code), code(item.unsolicited_code))
        for item in icd.classes
    )
    return _section("classes", rows)


def _has_error_codes(icd: InterfaceDefinition) -> bool:
    """Return whether a reply can carry an error code."""
    serial = icd.link.serial
    if serial is None:
        return icd.link.can is not None
    has_status = any("status" in field.by_role for field in serial.reply_header)
    return has_status or isinstance(serial.framing, CubeSpaceFraming)


def _errors(icd: InterfaceDefinition) -> Section:
    numbers = {code.name.lower(): int(icd.error_number(code)) for code in ErrorCode}
    return _section("errors", ((f"{number} ({number:02X}h)", name) for name, number in numbers.items()))


def _composed(icd: InterfaceDefinition, link: SerialLinkModel) -> Section:
    order = icd.conventions.byte_order
    rows = (
        (message, *cells)
        for message, header in (("request", link.request_header), ("reply", link.reply_header))
        for field in header
        for cells in _header_cells(field, order)
    )
    framing, check = _settings(link.framing), _settings(link.check)
    formats = " ".join(_format_text(item) for item in link.format)
    texts = "; ".join(f"`{row.name}` by `{row.request}`" for row in icd.rows if row.request)
    answers = [
        f"{what} by the text `{text}`"
        for what, text in (("acknowledged", link.acknowledge), ("refused", link.refusal))
        if text is not None
    ]
    said = [f"Rows are requested by texts: {texts}."] * bool(texts)
    said += [f"Requests are {' and '.join(answers)}."] * bool(answers)
    return _section(
        "composed", rows, baud=link.baud, framing=framing, check=check, formats=formats, texts=" ".join(said)
    )


def _format_text(item: FormatModel) -> str:
    """Describe in a sentence which messages have another framing or check."""
    whose = f" of class {' or '.join(item.classes)}" if item.classes else ""
    what = {"request": "Requests", "reply": "Replies"}.get(item.direction or "", "Messages")
    parts = (("framing", item.framing), ("check", item.check))
    return f"{what}{whose}: {', '.join(f'{name} {_settings(model)}' for name, model in parts if model is not None)}."


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
    for bit, shift in field.placed_bits:
        yield (
            bit.role or "constant",
            f"{type_}, bits {shift} to {shift + bit.width - 1}",
            _fixed_value(bit.const, bit.default),
            _counter(bit.counts) or texts_of("role").get(bit.role or "", ""),
        )
    if not field.bits:
        meaning = texts_of("role").get(field.role or "", "")
        if field.role == "length":
            offset = f" {'+' if field.offset > 0 else '−'} {abs(field.offset)}" if field.offset else ""
            meaning = f"number of bytes of {', '.join(field.includes) or 'nothing'}{offset}"
        elif field.counts:
            meaning = _counter(field.counts)
        elif field.role in ("ticks", "time"):
            meaning = f"{meaning}, in units of {field.scale:g} s"
        yield field.role or "constant", type_ + only, _fixed_value(field.const, field.default), meaning


def _counter(counts: list[CountedMessage]) -> str:
    return str(texts_of("counted")["".join(sorted(set(counts)))]) if counts else ""


def _fixed_value(const: int | None, default: int | None) -> str:
    if const is not None:
        return f"{const:X}h"
    return "" if default is None else f"default {default:X}h"


def _cubespace(icd: InterfaceDefinition, framing: CubeSpaceFraming) -> Section:
    texts = texts_of("cubespace")
    rows = sorted(icd.telecommands.values(), key=lambda row: row.id)
    silent = " or ".join(
        f"`{row.name}` ({row.id})" for row in rows if not row.answers or row.name in framing.unanswered
    )
    return _section(
        "cubespace",
        ((name, *cells) for name, cells in texts["replies"].items() if framing.dialect in (None, name)),
        **texts["one_dialect" if framing.dialect else "all_dialects"],
        silence=f"No reply follows {silent}, whether accepted or rejected." if silent else "",
    )


def _can() -> Section:
    kinds = (kind for kind in MessageType if kind)
    names = ((kind, kind.name.lower().replace("_", " ").replace("extended", "segment")) for kind in kinds)
    return _section("can", ((str(int(kind)), name) for kind, name in names))


def _objects(layout: CanopenModel) -> Section:
    rows = ((f"{placed.index:04X}h", placed.name, _content(placed)) for placed in layout.object)
    return _section("objects", rows)


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
    if placed.telemetry is not None and placed.type is not None:
        written = f"; writing executes {placed.telecommand}" if placed.telecommand is not None else ""
        return f"telemetry {placed.telemetry} as one number{written}"
    if placed.telemetry is not None:
        return f"telemetry {placed.telemetry}: one sub-index per field"
    if placed.members:
        return ", ".join(member.name for member in placed.members)
    shown = [] if placed.value is None else [f"reads {placed.value}"]
    return ", ".join(
        [*shown, *([] if placed.telecommand is None else [f"writing executes {placed.telecommand}"])]
    )


def _pdos(layout: CanopenModel) -> Section:
    pdos = [("TPDO", number, pdo) for number, pdo in enumerate(layout.tpdo, 1)]
    pdos += [("RPDO", number, pdo) for number, pdo in enumerate(layout.rpdo, 1)]
    return _section("pdos", ((f"{kind} {number}", *_pdo(pdo)) for kind, number, pdo in pdos))


def _pdo(pdo: PdoModel) -> tuple[str, str, str, str]:
    on = "on" if pdo.enabled else "off"
    return pdo.name, on, str(pdo.transmission_type), ", ".join(pdo.objects)
