"""Headers of serial messages: fields by role, packed to bytes and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.icd.conventions import NANOSECONDS, Order
from starhil.protocol.icd.link_schema import HeaderFieldModel

WRAPPING_ROLES: Final = frozenset(("ticks", "time", "sequence"))
"""Roles whose values wrap around."""


class HeaderError(ProtocolError):
    """A header that is invalid for this unit."""


class HeaderContent(NamedTuple):
    """Content of a header by role, and its size."""

    values: Mapping[str, int]
    size: int
    message_class: str
    """Name of the class, or an empty text."""


class HeaderCodec:
    """The fields before the data of a message.

    `classes` are the names of the classes by code, `overhead` the sizes of `start`, `check` and `end`, which a length may
    include, and `where` is the field path for error messages.
    """

    def __init__(
        self,
        models: Sequence[HeaderFieldModel],
        byte_order: Order,
        classes: Mapping[int, str],
        overhead: Mapping[str, int],
        where: str,
    ) -> None:
        for number, model in enumerate(models, 1):
            _check_field(model, f"{where}: {number}")
        self._where = where
        self.fields: Final = tuple(models)
        self.byte_order: Final = byte_order
        """Byte order of the fields that have none of their own."""
        self._steps: Final = tuple(
            (
                item.role, item.size, item.order or byte_order, item.type.startswith("i"), item.const, item.initial,
                item.classes, tuple((bit.role, shift, bit.mask, bit.const, bit.initial) for bit, shift in item.placed_bits),
            )
            for item in self.fields
        )  # fmt: skip
        """What `pack` and `unpack` need of each field; looking it up takes three times as long."""
        self._classes = classes
        self.overhead: Final = overhead
        """Sizes of `start`, `check` and `end`."""
        length = next((field for field in self.fields if field.role == "length"), None)
        parts, offset = ([], 0) if length is None else (length.includes, length.offset)
        self._counted: Final = (
            offset + sum(overhead.get(part, 0) for part in parts), parts.count("header"), parts.count("data")
        )  # fmt: skip
        """What a length counts: bytes of fixed parts and its offset, and how often header and data."""
        self._sizes: Final[dict[str, int]] = {}
        """Class → size of the header."""
        self.defaults: Final = {
            role: part.initial for field in self.fields for role, part in field.by_role.items()
        }
        """Value of each role for messages that do not set it."""
        self.roles: Final = frozenset(self.defaults)
        """Roles that the header carries in any class of messages."""
        self.counts: Final = frozenset(
            kind for field in self.fields for part in field.by_role.values() for kind in part.counts
        )
        """Messages whose `sequence` the sender counts: `reply`, `unsolicited`."""

    def roles_in(self, message_class: str) -> frozenset[str]:
        return frozenset(
            role for field in self.fields if field.in_class(message_class) for role in field.by_role
        )

    def size(self, message_class: str) -> int:
        size = self._sizes.get(message_class)
        if size is None:
            size = self._sizes[message_class] = sum(
                field.size for field in self.fields if field.in_class(message_class)
            )
        return size

    def count_ns(self, role: str) -> int:
        """Return the nanoseconds per count of `ticks` or `time`."""
        return next(round(field.scale * NANOSECONDS) for field in self.fields if field.role == role)

    def length(self, header_size: int, data_size: int) -> int:
        """Return the value of the length field in a message."""
        fixed, headers, data = self._counted
        return fixed + headers * header_size + data * data_size

    def pack(self, values: Mapping[str, int], message_class: str, data_size: int) -> bytes:
        """Return the header of a message with `data_size` bytes of data.

        Raises HeaderError if a value does not fit its field.
        """
        packed = b""
        for role, size, order, signed, _, default, classes, bits in self._steps:
            if classes is not None and message_class not in classes:
                continue
            if bits:
                value = 0
                for name, shift, mask, _, given in bits:
                    part = given if name is None else values.get(name, given)
                    if name in WRAPPING_ROLES:
                        part &= mask
                    if not 0 <= part <= mask:
                        raise self._misfit(name, part, mask.bit_length())
                    value |= part << shift
            elif role is None:
                value = default
            elif role == "length":
                value = self.length(self.size(message_class), data_size)
            else:
                value = values.get(role, default)
            if role in WRAPPING_ROLES:
                packed += (value & (1 << 8 * size) - 1).to_bytes(size, order)
                continue
            try:
                packed += value.to_bytes(size, order, signed=signed)
            except OverflowError:
                raise self._misfit(role, value, 8 * size) from None
        return packed

    def _misfit(self, role: str | None, value: int, bits: int) -> HeaderError:
        return HeaderError(f"{self._where}: {role or 'constant'} {value} does not fit {bits} bits")

    def unpack(self, body: bytes, message_class: str = "") -> HeaderContent | None:
        """Decode the header of a body of a class, if that is known; return None if the body is too short.

        Raises HeaderError for a wrong constant or an unknown class.
        """
        values: dict[str, int] = {}
        position = 0
        for role, size, order, signed, const, _, classes, bits in self._steps:
            if classes is not None and message_class not in classes:
                continue
            end = position + size
            if end > len(body):
                return None
            value = int.from_bytes(body[position:end], order, signed=signed)
            if const is not None and value != const and role != "address":
                raise HeaderError(f"header has {value:#x}, expected {const:#x}")
            if role is not None:
                values[role] = value
            for name, shift, mask, required, _ in bits:
                field_bits = value >> shift & mask
                if required is not None and field_bits != required:
                    raise HeaderError(f"header has bits {field_bits:#x}, expected {required:#x}")
                if name is not None:
                    values[name] = field_bits
            if not message_class and "class" in values:
                if values["class"] not in self._classes:
                    raise HeaderError(f"no class with code {values['class']}")
                message_class = self._classes[values["class"]]
            position = end
        return HeaderContent(values, position, message_class)

    def address_in(self, body: bytes) -> int | None:
        """Return the address in a body, which may be incomplete or damaged; None if the header carries none in every message."""
        position = 0
        for role, size, order, _, _, _, classes, bits in self._steps:
            if classes is not None:
                return None
            part = body[position : position + size]
            if len(part) < size:
                return None
            value = int.from_bytes(part, order)
            if role == "address":
                return value
            for name, shift, mask, _, _ in bits:
                if name == "address":
                    return value >> shift & mask
            position += size
        return None

    def data_size(self, envelope: HeaderContent) -> int:
        """Return the data size according to the length in a header.

        Raises HeaderError if the length is less than the size of the other parts that it includes.
        """
        data = envelope.values["length"] - self.length(envelope.size, 0)
        if data < 0:
            raise HeaderError(f"length {envelope.values['length']} is less than the parts that it includes")
        return data


def _check_field(model: HeaderFieldModel, where: str) -> None:
    if bool(model.bits) != model.type.startswith("bits"):
        raise IcdError(f"{where}: types bits8, bits16 and bits32 have `bits`, the other types have none")
    if model.role in ("ticks", "time") and round(model.scale * NANOSECONDS) < 1:
        raise IcdError(f"{where}: scale {model.scale:g} s is below a nanosecond")
    if model.role is None and model.const is None and model.default is None and not model.bits:
        raise IcdError(f"{where}: needs a role, or `const` or `default`")
    counting = [bit.role for bit in model.bits if bit.counts] + [model.role] * bool(model.counts)
    if any(role != "sequence" for role in counting):
        raise IcdError(f"{where}: only role sequence has `counts`")
    unpolled = [part for role, part in model.by_role.items() if role == "poll" and part.initial != 1]
    if unpolled:
        raise IcdError(f"{where}: role poll needs `default = 1`; otherwise no request would be answered")
    if model.offset and model.role != "length":
        raise IcdError(f"{where}: only role length has an `offset`")
    width = sum(bit.width for bit in model.bits)
    if model.bits and width != 8 * model.size:
        raise IcdError(f"{where}: the bits add up to {width}, must be {8 * model.size}")
