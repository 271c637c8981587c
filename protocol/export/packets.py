"""Rows as packets, for the exports that know only packets.

A packet begins with the key of its row: the row ID and, if the link carries a class, the class code in the bits above.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from starhil.protocol.errors import IcdError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.link_schema import (
    CustomCheck,
    CustomFraming,
    FixedFraming,
    LengthFraming,
    MessageClass,
)
from starhil.protocol.serial.stack import SerialStack

CLASS_SHIFT: Final = 8
"""Position of the class code, in bits."""


def check_one_format(stack: SerialStack, target: str) -> None:
    """Raise IcdError for a serial link with what code for a target does not have: parts from a plugin, texts, several formats."""
    framing = stack.link.framing
    for what, model in (("framing", framing), ("check", stack.link.check)):
        if isinstance(model, CustomFraming | CustomCheck):
            raise IcdError(
                f"link.serial.{what}: {model.name!r} is Python code in the unit's plugin and cannot be exported"
            )
    stuffed = isinstance(framing, LengthFraming | FixedFraming) and framing.stuffing is not None
    for what, there in (
        ("requests that are texts", stack.text_formats),
        ("acknowledges and refusals that are texts", stack.link.acknowledge or stack.link.refusal),
        ("several formats of messages (`format`)", stack.link.format),
        ("byte stuffing", stuffed),
    ):
        if there:
            raise IcdError(f"link.serial: {what} cannot be exported to {target}")


def row_key(classes: Mapping[str, MessageClass], message_class: str, row_id: int) -> int:
    """Return the key of a row.

    Raises IcdError for an ID that leaves no room for a class.
    """
    code = classes[message_class].code if message_class else None
    if code is None:
        return row_id
    if row_id >= 1 << CLASS_SHIFT:
        raise IcdError(
            f"class {message_class}: ID {row_id} is above {(1 << CLASS_SHIFT) - 1}; an export cannot hold it beside a class"
        )
    return code << CLASS_SHIFT | row_id


def key_of(icd: InterfaceDefinition, row: Row) -> int:
    return row_key(icd.classes_by_name, row.message_class, row.id)


def key_bits(icd: InterfaceDefinition) -> int:
    """Return the number of bits that can hold the key of every row: 8, 16 or 32."""
    longest = max((key_of(icd, row).bit_length() for row in icd.rows), default=0)
    return next(bits for bits in (8, 16, 32) if bits >= longest)


def wire_order(row: Row, language: str) -> Iterator[Field]:
    """Yield the fields of a row in wire order, most significant bit of each byte first.

    Raises IcdError for a field whose bits are not adjacent on the wire: across the bytes of a little-endian bit field.
    """
    for slot in row.slots:
        fields = [
            piece for field in row.fields if field.slot is slot for piece in _pieces(row, field, language)
        ]
        yield from sorted(fields, key=_first_bit)


def _first_bit(field: Field) -> tuple[int, int]:
    byte, bit = field.place(field.bit_count - 1)
    return byte, -bit


def _pieces(row: Row, field: Field, language: str) -> Iterator[Field]:
    """Yield a field, or its parts in each byte if it is unused."""
    end = field.shift + field.width
    if field.slot.order == "big" or field.shift // 8 >= (end - 1) // 8:
        yield field
        return
    if field.name:
        raise IcdError(
            f"{row.kind} {row.name}: field {field.name}: {language} has no bits across the bytes of a little-endian bit "
            "field; split the field at the byte"
        )
    for byte in range(field.shift // 8, -(-end // 8)):
        first = max(field.shift, 8 * byte)
        yield field.changed(shift=first, width=min(end, 8 * byte + 8) - first)
