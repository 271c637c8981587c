"""Keys of rows in exports: the row ID and, if the link carries a class, the class code in the bits above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from starhil.protocol.codec import Row
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import MessageClass
from starhil.protocol.values import IcdError

CLASS_SHIFT: Final = 8
"""Position of the class code, in bits."""


def row_key(classes: Sequence[MessageClass], klass: str, row_id: int) -> int:
    """Return the key of a row.

    Raises IcdError for an ID that leaves no room for a class.
    """
    code = next((item.code for item in classes if item.name == klass), None)
    if code is None:
        return row_id
    if row_id >= 1 << CLASS_SHIFT:
        raise IcdError(
            f"class {klass}: ID {row_id} is above {(1 << CLASS_SHIFT) - 1}; an export cannot hold it beside a class"
        )
    return code << CLASS_SHIFT | row_id


def key_of(icd: InterfaceDefinition, row: Row) -> int:
    """Return the key of a row of a definition."""
    return row_key(icd.classes, row.klass, row.id)


def key_bits(icd: InterfaceDefinition) -> int:
    """Return the number of bits that can hold the key of every row: 8, 16 or 32."""
    longest = max((key_of(icd, row).bit_length() for row in icd.rows), default=0)
    return next(bits for bits in (8, 16, 32) if bits >= longest)
