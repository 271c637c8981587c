"""From the fields of a definition to the fields of a row: expanded, named, and placed in bytes one after another.

One field of the definition can be several of the row: `count` and `repeat` number them, `bits` share a slot, and a
text is short for one line of an ICD table. `TYPE NAME [UNIT] [SCALE]` is a number, `enumN NAME ENUMERATION` an
enumeration, `bytes NAME SIZE` and `text NAME SIZE` a string, and `bits NAME[:WIDTH] …` flags and groups of bits,
lowest first, which fill whole bytes. `-` means no name or no unit. Braces repeat the field as in a shell:
`i16 mag{0,1}_{x,y,z} uT 0.01` is six fields, `u8 css{0..9}` is ten.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, Final, Protocol

from pydantic import ValidationError

from starhil.protocol.codec import Field, FieldKind, Row, Slot
from starhil.protocol.conventions import Order
from starhil.protocol.icd_schema import BitModel, FieldKeys, FieldModel, Provenance, RepeatModel
from starhil.protocol.messages import RequestKind
from starhil.protocol.validation_messages import wording
from starhil.protocol.values import INTEGER_RANGES, SCALAR_SIZES, EnumDefinition, IcdError, Scalar

NUMBER: Final = "[n]"
_KINDS: Final[dict[str, FieldKind]] = {"f32": "float", "f64": "float", "bytes": "bytes", "text": "text"}
_UNPLACED: Final = Field.model_construct(name="", kind="unused", slot=Slot(0, "u8", 0, 0))
"""The defaults of a field."""
SMALLEST_SCALE: Final = 1e-100
"""Smallest magnitude of a scale."""
MAX_NAMES: Final = 256
"""Maximum number of fields that one text may expand to."""

_BRACES: Final = re.compile(r"\{([^{}]*)\}")


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
        self,
        definitions: Definitions,
        where: str,
        kind: RequestKind,
        provenance: Provenance,
        number: int | None,
    ) -> None:
        self._definitions = definitions
        self._where = where
        self._kind = kind
        self._provenance = provenance
        self._number = number
        self._names: set[str] = set()
        self.fields: list[Field] = []
        self.slots: list[Slot] = []
        self.size = 0

    def include(self, row: Row) -> None:
        """Append the fields of another row; fields of a telecommand report the last accepted values."""
        moved = {slot.index: self._slot(slot.type, slot.size, slot.order) for slot in row.slots}
        for item in row.fields:
            field = item.changed(slot=moved[item.slot.index])
            if row.kind != self._kind:
                source = row.name if field.parameter is None and field.const is None else None
                field = field.changed(value=None, argument=None, telecommand=source)
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
            self._names = {item.name for item in self.fields} - {""}
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
        string = model.type in ("bytes", "text")
        if string and model.size is None:
            raise IcdError(f"{where}: type {model.type} needs a size")
        if not string and model.size is not None:
            raise IcdError(f"{where}: type {model.type} has a fixed size; remove `size`")
        slot = self._slot("bytes", model.size or 0) if string else self._scalar_slot(model.type, model.order)
        self._append(self._field(model, slot, where, suffix, number))

    def _add_bits(self, model: FieldModel, suffix: str, number: int | None) -> None:
        where = f"{self._where}: field {model.name or 'unused'}"
        if not model.bits or (model.count is not None):
            raise IcdError(f"{where}: type {model.type} needs `bits` and takes no count")
        slot = self._scalar_slot(str(model.type), model.order)
        shift = 0
        for bit in model.bits:
            here = f"{self._where}: field {bit.name or 'unused'}"
            field = self._field(bit, slot, here, suffix, number)
            provenance = bit.provenance or model.provenance or self._provenance
            self._append(field.changed(shift=shift, width=bit.width, provenance=provenance))
            shift += bit.width
        if shift != 8 * slot.size:
            raise IcdError(f"{where}: the bits add up to {shift}, must be {8 * slot.size}")

    def _field(
        self, model: FieldModel | BitModel, slot: Slot, where: str, suffix: str, number: int | None
    ) -> Field:
        """Return a field that is a whole slot; the place of bits is still to be set."""
        kind: FieldKind
        limits: tuple[int, int] | None
        if isinstance(model, BitModel):
            kind = "flag" if model.width == 1 else "bits"
            limits, described = (0, 2**model.width - 1), f"{model.width} bits"
        else:
            kind = _KINDS.get(str(model.type), "integer")
            limits, described = INTEGER_RANGES.get(slot.type), f"type {model.type}"
        faults = list(_wrong_numbers(model, limits, described, where))
        try:
            parameter = self._definitions.check_parameter(model.parameter, model.unit, where)
        except IcdError as error:
            faults.insert(0, str(error))
        if faults:
            raise IcdError(*faults)
        enum, aliases = self._enumeration(model, where)
        if enum is not None:
            kind = "enum"
            low, high = limits or (0, -1)
            if not all(low <= value <= high for value in enum.values.values()):
                raise IcdError(f"{where}: enumeration {enum.name} does not fit {described}")
        if kind not in ("integer", "float", "bits") and (model.scale, model.bias) != (1.0, 0.0):
            raise IcdError(f"{where}: scale and offset need a number of at least 2 bits")
        given = vars(model)
        keys = {key: given[key] for key in FieldKeys.model_fields if key in given}
        if model.const is not None:
            keys |= {"minimum": model.const, "maximum": model.const}
        keys |= {
            "name": model.name + suffix if model.name else "",
            "kind": "unused" if model.name is None else kind,
            "slot": slot,
            "enum": enum,
            "aliases": aliases,
            "default": _default(model.default, enum, where),
            "parameter": parameter,
            "value": _numbered(model.value, number, where),
            "argument": _numbered(model.argument, number, where),
            "provenance": model.provenance or self._provenance,
        }
        return _UNPLACED.model_copy(update=keys)

    def _enumeration(
        self, model: FieldModel | BitModel, where: str
    ) -> tuple[EnumDefinition | None, Mapping[str, str]]:
        """Return the enumeration of a field, by name or in its `map`, and its aliases."""
        if model.name is None:
            return None, {}
        is_number = isinstance(model, FieldModel) and not str(model.type).startswith("enum")
        if isinstance(model, FieldModel) and is_number and model.enumeration is not None:
            bits = str(model.type).removeprefix("u")
            types = f"enum{bits}" if bits in ("8", "16", "32") else "enum8, enum16 or enum32"
            raise IcdError(f"{where}: `enum` needs type {types}, not {model.type}")
        if model.map is not None:
            if model.enumeration is not None:
                raise IcdError(f"{where}: has both `map` and `enum`")
            return mapped(model.map, where)
        if is_number or (isinstance(model, BitModel) and model.enumeration is None):
            return None, {}
        return self._definitions.enum_of(model.enumeration, where), {}

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
        if item.name in self._names:
            raise IcdError(f"{self._where}: field {item.name}: name used twice in the row")
        if not item.name and (item.value or item.argument or item.const is not None):
            raise IcdError(
                f"{self._where}: field unused: a field with a value, argument or const needs a name"
            )
        self.fields.append(item)
        self._names |= {item.name} - {""}


def _wrong_numbers(
    model: FieldModel | BitModel, limits: tuple[int, int] | None, described: str, where: str
) -> Iterator[str]:
    """Yield what is wrong with the numbers of a field."""
    if abs(model.scale) < SMALLEST_SCALE:
        yield f"{where}: scale {model.scale:g} is smaller than {SMALLEST_SCALE:g}"
        return
    if model.minimum is not None and model.maximum is not None and model.minimum > model.maximum:
        yield f"{where}: min {model.minimum:g} is above max {model.maximum:g}"
    if model.wrap and isinstance(model, FieldModel) and not str(model.type).startswith("u"):
        yield f"{where}: wrap: only unsigned integers wrap"
    if model.wrap and (model.minimum, model.maximum) != (None, None):
        yield f"{where}: wrap: a field that wraps has no min and max"
    if limits is None:
        return
    numbers = {"min": model.minimum, "max": model.maximum, "const": model.const, "default": model.default}
    for name, value in numbers.items():
        if (
            isinstance(value, int | float)
            and not limits[0] <= round((value - model.bias) / model.scale) <= limits[1]
        ):
            yield f"{where}: {name} {value:g} does not fit {described} with its scale"


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
    return EnumDefinition.model_construct(name="map", doc="", values=values), aliases


def text_of(value: object) -> str:
    """Return the name of a value as a member of a `map`."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _numbered(name: str | None, number: int | None, where: str) -> str | None:
    """Replace `[n]` in the name of a quantity or argument by the number of a repetition."""
    if name is None or NUMBER not in name:
        return name
    if number is None:
        raise IcdError(f"{where}: {name}: [n] is only allowed with count, repeat or last_id")
    return name.replace(NUMBER, f"[{number}]")


def _default(value: Scalar | None, enum: EnumDefinition | None, where: str) -> Scalar | None:
    if enum is None or value is None:
        return value
    name = text_of(value)
    if name not in enum.values:
        raise IcdError(f"{where}: default {value!r} is not in enumeration {enum.name}")
    return name


def fields_of(text: str) -> list[FieldModel]:
    """Expand a text to fields.

    Raises IcdError, whose text does not name row and file.
    """
    type_, *words = text.split() or [""]
    if not words:
        raise IcdError("needs a type and a name, such as 'u16 counter'")
    tables = _bits(words) if type_ == "bits" else _scalars(type_, *words)
    try:
        return [FieldModel.model_validate(table) for table in tables]
    except ValidationError as error:
        first = error.errors()[0]
        raise IcdError(f"{first['loc'][-1]}: {wording(first)}") from None


def _scalars(type_: str, name: str, *words: str) -> list[dict[str, Any]]:
    kinds = {"enum": ("enum",), "byte": ("size",), "text": ("size",)}
    keys = kinds.get(type_[:4], ("unit", "scale"))
    if len(words) > len(keys):
        raise IcdError(f"only {' and '.join(keys)} may follow the name")
    table: dict[str, Any] = {"type": type_}
    for key, word in zip(keys, words, strict=False):
        if word != "-":
            table[key] = word if key in ("enum", "unit") else _number(key, word)
    return [table | _named(item) for item in _names(name)]


def _bits(words: list[str]) -> list[dict[str, Any]]:
    filled: list[list[dict[str, Any]]] = []
    room = 0
    for word in words:
        name, _, given = word.partition(":")
        width = int(_number("width", given)) if given else 1
        for item in _names(name):
            if room == 0:
                filled.append([])
                room = 8
            if not 1 <= width <= room:
                raise IcdError(f"{item}: {width} bits do not fit into the remaining {room} bits of the byte")
            filled[-1].append(_named(item) | {"width": width})
            room -= width
    if room:
        filled[-1].append({"width": room})
    return [{"type": "bits8", "bits": bits} for bits in filled]


def _named(name: str) -> dict[str, Any]:
    return {} if name == "-" else {"name": name}


def _number(key: str, word: str) -> int | float:
    try:
        return float(word) if key == "scale" else int(word)
    except ValueError:
        raise IcdError(f"{key}: {word!r} is not a number") from None


def _names(pattern: str) -> list[str]:
    """Expand a pattern with braces to names; the last braces vary fastest."""
    parts = [
        [part] if index % 2 == 0 else _choices(part) for index, part in enumerate(_BRACES.split(pattern))
    ]
    if not 1 <= math.prod(map(len, parts)) <= MAX_NAMES:
        raise IcdError(f"{pattern}: must be 1 to {MAX_NAMES} fields")
    return ["".join(chosen) for chosen in product(*parts)]


def _choices(text: str) -> list[str]:
    first, _, last = text.partition("..")
    if first.isdecimal() and last.isdecimal():
        return [str(number) for number in range(int(first), int(last) + 1)[: MAX_NAMES + 1]]
    return text.split(",")
