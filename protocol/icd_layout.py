"""Layout of the fields of a row, in the order of the definition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, Protocol

from starhil.protocol.codec import Field, FieldKind, Row, RowKind, Slot
from starhil.protocol.field_text import fields_of
from starhil.protocol.icd_schema import BitModel, FieldModel, RepeatModel, Scalar
from starhil.protocol.link_schema import Order
from starhil.protocol.values import INTEGER_RANGES, SCALAR_SIZES, EnumDefinition, IcdError

NUMBER: Final = "[n]"


class Definitions(Protocol):
    """The parts of a definition to which fields refer."""

    byte_order: Order

    def enum_of(self, name: str | None, where: str) -> EnumDefinition:
        """Return an enumeration by name."""
        ...

    def check_parameter(self, name: str | None, unit: str, where: str) -> str | None:
        """Check that the parameter of a field exists and has the unit of the field."""
        ...


class Layout:
    """The fields of one row, and the bytes that they occupy.

    Parameters
    ----------
    number
        Number of the row if the entry expands to several, otherwise None.
    """

    def __init__(
        self, definitions: Definitions, where: str, kind: RowKind, provenance: str, number: int | None
    ) -> None:
        self._definitions = definitions
        self._where = where
        self._kind = kind
        self._provenance = provenance
        self._number = number
        self.fields: list[Field] = []
        self.slots: list[Slot] = []
        self.size = 0

    def include(self, row: Row) -> None:
        """Append the fields of another row; fields of a telecommand report the last accepted values."""
        moved = {slot.index: self._slot(slot.type, slot.size, slot.order) for slot in row.slots}
        for item in row.fields:
            field = replace(item, slot=moved[item.slot.index])
            if row.kind != self._kind:
                source = row.name if field.parameter is None and field.const is None else None
                field = replace(field, value=None, argument=None, telecommand=source)
            self._append(field)

    def add(self, model: FieldModel) -> None:
        """Append a field, a series of numbered fields, a repeated group, or the bits of a bit field.

        Raises IcdError, after which the layout is as before.
        """
        fields, slots, size = len(self.fields), len(self.slots), self.size
        try:
            self._add(model)
        except IcdError:
            del self.fields[fields:], self.slots[slots:]
            self.size = size
            raise

    def _add(self, model: FieldModel) -> None:
        where = f"{self._where}: field {model.name or 'unused'}"
        if model.text is not None:
            for item in self._of_text(model):
                self._add_single(item, f"{self._where}: field {item.name or 'unused'}", "", self._number)
            return
        if model.repeat is not None:
            self._add_repeat(model, model.repeat, where)
            return
        if model.count is None:
            self._add_single(model, where, "", self._number)
        for number in range(1, (model.count or 0) + 1):
            self._add_single(model, where, f"_{number}", number)

    def _add_repeat(self, model: FieldModel, repeat: RepeatModel, where: str) -> None:
        if model.model_fields_set - {"repeat", "doc"}:
            raise IcdError(f"{where}: `repeat` allows no other keys but `doc`")
        group = [single for item in repeat.fields for single in self._of_text(item)]
        if any(item.repeat is not None or item.count is not None for item in group):
            raise IcdError(f"{where}: a repeated group cannot contain `repeat` or `count`")
        for number in range(repeat.first, repeat.first + repeat.count):
            for item in group:
                self._add_single(item, where, f"_{number}", number)

    def _of_text(self, model: FieldModel) -> list[FieldModel]:
        """Expand the text of a field to fields; return any other field itself."""
        if model.text is None:
            return [model]
        where = f"{self._where}: field {model.text!r}"
        if model.model_fields_set != {"text"}:
            raise IcdError(f"{where}: `text` allows no other keys")
        try:
            return fields_of(model.text)
        except IcdError as error:
            raise IcdError(f"{where}: {error}") from None

    def _add_single(self, model: FieldModel, where: str, suffix: str, number: int | None) -> None:
        if model.type is None:
            raise IcdError(f"{where}: needs `type`, or `repeat`")
        if model.type.startswith("bits"):
            self._add_bits(model, suffix, number)
            return
        if model.bits:
            raise IcdError(f"{where}: only types bits8, bits16 and bits32 have bits")
        if model.type in ("bytes", "text"):
            if model.size is None:
                raise IcdError(f"{where}: type {model.type} needs a size")
        elif model.size is not None:
            raise IcdError(f"{where}: type {model.type} has a fixed size; remove `size`")
        self._append(self._field(model, model.type, where, suffix, number))

    def _field(self, model: FieldModel, type_: str, where: str, suffix: str, number: int | None) -> Field:
        if type_ in ("bytes", "text"):
            slot = self._slot("bytes", model.size or 0)
        else:
            slot = self._scalar_slot(type_, model.order)
        self._check_numbers(model, where)
        enum, aliases = self._enumeration(model, where, named=type_.startswith("enum"))
        return Field(
            name=model.name + suffix if model.name else "",
            kind=_kind(model, type_, enum),
            slot=slot,
            unit=model.unit,
            scale=model.scale,
            bias=model.offset,
            minimum=model.min if model.const is None else model.const,
            maximum=model.max if model.const is None else model.const,
            enum=enum,
            default=_default(model.default, enum, where),
            parameter=self._definitions.check_parameter(model.parameter, model.unit, where),
            provenance=model.provenance or self._provenance,
            doc=model.doc,
            wrap=model.wrap,
            value=_numbered(model.value, number, where),
            argument=_numbered(model.argument, number, where),
            const=model.const,
            aliases=aliases,
        )

    def _enumeration(
        self, model: FieldModel | BitModel, where: str, *, named: bool
    ) -> tuple[EnumDefinition | None, Mapping[str, str]]:
        """Return the enumeration of a field, by name or in its `map`, and its aliases."""
        if model.name is None:
            return None, {}
        if model.map is None:
            return (self._definitions.enum_of(model.enum, where) if named else None), {}
        if model.enum is not None:
            raise IcdError(f"{where}: has both `map` and `enum`")
        return mapped(model.map, where)

    def _add_bits(self, model: FieldModel, suffix: str, number: int | None) -> None:
        where = f"{self._where}: field {model.name or 'unused'}"
        if not model.bits or (model.count is not None):
            raise IcdError(f"{where}: type {model.type} needs `bits` and takes no count")
        slot = self._scalar_slot(str(model.type), model.order)
        shift = 0
        for bit in model.bits:
            here = f"{self._where}: field {bit.name or 'unused'}"
            self._append(self._bit(model, bit, slot, shift, here, suffix, number))
            shift += bit.width
        if shift != 8 * slot.size:
            raise IcdError(f"{where}: the bits add up to {shift}, must be {8 * slot.size}")

    def _bit(
        self,
        model: FieldModel,
        bit: BitModel,
        slot: Slot,
        shift: int,
        where: str,
        suffix: str,
        number: int | None,
    ) -> Field:
        enum, aliases = self._enumeration(bit, where, named=bit.enum is not None)
        if enum is not None and max(enum.values.values()) >= 2**bit.width:
            raise IcdError(f"{where}: enumeration {enum.name} does not fit {bit.width} bits")
        if bit.const is not None and not (isinstance(bit.const, int) and 0 <= bit.const < 2**bit.width):
            raise IcdError(f"{where}: const {bit.const:g} does not fit {bit.width} bits")
        kind: FieldKind = "flag" if bit.width == 1 else "bits"
        return Field(
            name=bit.name + suffix if bit.name else "",
            kind="unused" if bit.name is None else "enum" if enum is not None else kind,
            slot=slot,
            shift=shift,
            width=bit.width,
            enum=enum,
            default=_default(bit.default, enum, where),
            parameter=self._definitions.check_parameter(bit.parameter, "", where),
            provenance=model.provenance or self._provenance,
            doc=bit.doc,
            value=_numbered(bit.value, number, where),
            argument=_numbered(bit.argument, number, where),
            const=bit.const,
            aliases=aliases,
        )

    def _scalar_slot(self, type_: str, order: Order | None) -> Slot:
        """Return the slot of a number, an enumeration or a bit field."""
        scalar = type_.replace("enum", "u").replace("bits", "u")
        return self._slot(scalar, SCALAR_SIZES[scalar], order)

    def _slot(self, scalar: str, size: int, order: Order | None = None) -> Slot:
        slot = Slot(len(self.slots), scalar, self.size, size, order or self._definitions.byte_order)
        self.slots.append(slot)
        self.size += size
        return slot

    def _append(self, item: Field) -> None:
        if item.name and any(other.name == item.name for other in self.fields):
            raise IcdError(f"{self._where}: field {item.name}: name used twice in the row")
        if not item.name and (item.value or item.argument or item.const is not None):
            raise IcdError(
                f"{self._where}: field unused: a field with a value, argument or const needs a name"
            )
        self.fields.append(item)

    @staticmethod
    def _check_numbers(model: FieldModel, where: str) -> None:
        if model.scale == 0.0:
            raise IcdError(f"{where}: scale is 0")
        if model.min is not None and model.max is not None and model.min > model.max:
            raise IcdError(f"{where}: min {model.min:g} is above max {model.max:g}")
        if model.wrap and not str(model.type).startswith("u"):
            raise IcdError(f"{where}: wrap: only unsigned integers wrap")
        if model.wrap and (model.min, model.max) != (None, None):
            raise IcdError(f"{where}: wrap: a field that wraps has no min and max")
        limits = INTEGER_RANGES.get(str(model.type))
        if limits is None:
            return
        for name, value in (("min", model.min), ("max", model.max), ("const", model.const)):
            if (
                value is not None
                and not limits[0] <= round((value - model.offset) / model.scale) <= limits[1]
            ):
                raise IcdError(f"{where}: {name} {value:g} does not fit type {model.type} with its scale")


def mapped(
    table: Mapping[str, Scalar | list[Scalar]], where: str
) -> tuple[EnumDefinition, Mapping[str, str]]:
    """Return the enumeration of a `map`, and the values that are sent as another member."""
    values: dict[str, int] = {}
    aliases: dict[str, str] = {}
    for wire, given in table.items():
        try:
            number = int(wire, 0)
        except ValueError:
            raise IcdError(
                f'{where}: map: {wire!r} is not a number on the wire; write "1" = "tracking"'
            ) from None
        names = [text_of(value) for value in (given if isinstance(given, list) else [given])]
        if not names or any(name in values or name in aliases for name in names):
            raise IcdError(f"{where}: map: {wire}: no value, or a duplicate one")
        values[names[0]] = number
        aliases |= dict.fromkeys(names[1:], names[0])
    return EnumDefinition("map", "", values), aliases


def text_of(value: object) -> str:
    """Return the name of a value as a member of a `map`."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _kind(model: FieldModel, type_: str, enum: EnumDefinition | None) -> FieldKind:
    if model.name is None:
        return "unused"
    if enum is not None:
        return "enum"
    kinds: dict[str, FieldKind] = {"f32": "float", "f64": "float", "bytes": "bytes", "text": "text"}
    return kinds.get(type_, "integer")


def _numbered(name: str | None, number: int | None, where: str) -> str | None:
    """Replace `[n]` in the name of a quantity or argument by the number of a repetition."""
    if name is None or NUMBER not in name:
        return name
    if number is None:
        raise IcdError(f"{where}: {name}: [n] is only allowed with count, repeat or last_id")
    return name.replace(NUMBER, f"[{number}]")


def _default(value: Scalar | None, enum: EnumDefinition | None, where: str) -> Scalar | None:
    if enum is not None and value is not None and value not in enum.values:
        raise IcdError(f"{where}: default {value!r} is not in enumeration {enum.name}")
    return value
