"""Expands the fields of a definition into the fields of a row, and lays them out in bytes.

One field of a definition may expand to several: `count` and `repeat` number them, and `bits` share a slot. A text is
shorthand for one line of an ICD table. `TYPE NAME [UNIT] [SCALE]` is a number, `enumN NAME ENUMERATION` an
enumeration, `bytes NAME SIZE` and `text NAME SIZE` a string, and `bits NAME[:WIDTH] …` flags and groups of bits,
lowest first, which fill whole bytes. `-` means no name or no unit. Braces repeat the field as in a shell:
`i16 mag{0,1}_{x,y,z} uT 0.01` is six fields, `u8 css{0..9}` is ten.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, Final

from pydantic import ValidationError

from starhil.protocol.errors import IcdError, did_you_mean
from starhil.protocol.files.validation import wording
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, FieldKind, Row, Slot
from starhil.protocol.icd.conventions import Order
from starhil.protocol.icd.schema import BitModel, FieldKeys, FieldModel, Provenance
from starhil.protocol.icd.values import (
    INTEGER_RANGES,
    SCALAR_SIZES,
    EnumDefinition,
    Located,
    MissingNameError,
    Scalar,
)
from starhil.protocol.messages import RequestKind

NUMBER: Final = "[n]"
_KINDS: Final[dict[str, FieldKind]] = {"f32": "float", "f64": "float", "bytes": "bytes", "text": "text"}
_FIELD_DEFAULTS: Final = Field.model_construct(name="", kind="unused", slot=Slot(0, "u8", 0, 0))
"""The defaults of a field."""
_KEPT_KEYS: Final = tuple(FieldKeys.model_fields)
SMALLEST_SCALE: Final = 1e-100
"""Smallest magnitude of a scale."""
MAX_NAMES: Final = 256
"""Maximum number of fields that one text may expand to."""

_BRACES: Final = re.compile(r"\{([^{}]*)\}")


class Layout:
    """The fields of one row, and the bytes that they occupy.

    Parameters
    ----------
    icd
        Definition with the enumerations and parameters to which the fields refer.
    number
        Number of the row if the entry expands to several, otherwise None.
    """

    def __init__(
        self, icd: InterfaceDefinition, kind: RequestKind, provenance: Provenance, number: int | None
    ) -> None:
        self._icd = icd
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
            changes: dict[str, Any] = {"slot": moved[item.slot.index]}
            if row.kind != self._kind:
                source = row.name if item.parameter is None and item.const is None else None
                changes |= {"value": None, "argument": None, "telecommand": source}
            self._append(item.changed(**changes))

    def add(self, model: FieldModel) -> None:
        """Append a field, a series of numbered fields, a repeated group, or the bits of a bit field.

        Raises IcdError, which names the field.
        """
        for single, suffix, number in _expanded(model, self._number):
            with Located(f"field {single.name or 'unused'}"):
                slot = self._slot_of(single)
            parts: Sequence[FieldModel | BitModel] = single.bits or [single]
            shift = 0
            for part in parts:
                name = part.name + suffix if part.name else ""
                provenance = part.provenance or single.provenance or self._provenance
                with Located(f"field {name or 'unused'}"):
                    keys = self._keys(part, slot, number)
                keys |= {"name": name, "provenance": provenance, "shift": shift}
                self._append(_FIELD_DEFAULTS.model_copy(update=keys))
                shift += keys["width"]

    def _slot_of(self, model: FieldModel) -> Slot:
        """Append the bytes of a single field."""
        if model.type is None:
            raise IcdError("needs `type`, or `repeat`")
        if model.type.startswith("bits") and (not model.bits or model.count is not None):
            raise IcdError(f"type {model.type} needs `bits` and takes no count")
        if model.bits and not model.type.startswith("bits"):
            raise IcdError("only types bits8, bits16 and bits32 have bits")
        string = model.type in ("bytes", "text")
        if string and model.size is None:
            raise IcdError(f"type {model.type} needs a size")
        if not string and model.size is not None:
            raise IcdError(f"type {model.type} has a fixed size; remove `size`")
        if string:
            return self._slot("bytes", model.size or 0)
        scalar = model.type.replace("enum", "u").replace("bits", "u")
        size = SCALAR_SIZES[scalar]
        width = sum(bit.width for bit in model.bits)
        if model.bits and width != 8 * size:
            raise IcdError(f"the bits add up to {width}, must be {8 * size}")
        return self._slot(scalar, size, model.order)

    def _keys(self, model: FieldModel | BitModel, slot: Slot, number: int | None) -> dict[str, Any]:
        """Return the attributes of a field, except for its place in the slot."""
        kind: FieldKind
        limits: tuple[int, int] | None
        width = 0
        if isinstance(model, BitModel):
            width = model.width
            kind = "flag" if width == 1 else "bits"
            limits, described = (0, 2**width - 1), f"{width} bits"
        else:
            kind = _KINDS.get(str(model.type), "integer")
            limits, described = INTEGER_RANGES.get(slot.type), f"type {model.type}"
        faults = tuple(self._faults(model, limits, described))
        if faults:
            raise IcdError(*faults)
        enum, aliases = self._enumeration(model)
        if enum is not None:
            kind = "enum"
            low, high = limits or (0, -1)
            if not all(low <= value <= high for value in enum.values.values()):
                raise IcdError(f"enumeration {enum.name} does not fit {described}")
        if kind not in ("integer", "float", "bits") and (model.scale, model.bias) != (1.0, 0.0):
            raise IcdError("scale and offset need a number of at least 2 bits")
        if model.name is None and (model.value or model.argument or model.const is not None):
            raise IcdError("a field with a value, argument or const needs a name")
        given = vars(model)
        keys = {key: given[key] for key in _KEPT_KEYS}
        if model.const is not None:
            keys |= {"minimum": model.const, "maximum": model.const}
        return keys | {
            "kind": "unused" if model.name is None else kind,
            "slot": slot,
            "width": width,
            "enum": enum,
            "aliases": aliases,
            "default": _default(model.default, enum),
            "value": _numbered(model.value, number),
            "argument": _numbered(model.argument, number),
        }

    def _faults(
        self, model: FieldModel | BitModel, limits: tuple[int, int] | None, described: str
    ) -> Iterator[str]:
        """Yield what is wrong with the parameter and the numbers of a field."""
        name, parameters = model.parameter, self._icd.device_parameters
        if name is not None and name not in parameters:
            yield f"no parameter named {name!r}{did_you_mean(name, parameters)}"
        elif name is not None and parameters[name].unit != model.unit:
            yield f"unit {model.unit!r}, but parameter {name} is in {parameters[name].unit!r}; they must agree"
        if abs(model.scale) < SMALLEST_SCALE:
            yield f"scale {model.scale:g} is smaller than {SMALLEST_SCALE:g}"
            return
        if model.minimum is not None and model.maximum is not None and model.minimum > model.maximum:
            yield f"min {model.minimum:g} is above max {model.maximum:g}"
        if model.wrap and isinstance(model, FieldModel) and not str(model.type).startswith("u"):
            yield "wrap: only unsigned integers wrap"
        if model.wrap and (model.minimum, model.maximum) != (None, None):
            yield "wrap: a field that wraps has no min and max"
        if limits is None:
            return
        numbers = {"min": model.minimum, "max": model.maximum, "const": model.const, "default": model.default}
        for name, value in numbers.items():
            if (
                isinstance(value, int | float)
                and not limits[0] <= round((value - model.bias) / model.scale) <= limits[1]
            ):
                yield f"{name} {value:g} does not fit {described} with its scale"

    def _enumeration(self, model: FieldModel | BitModel) -> tuple[EnumDefinition | None, Mapping[str, str]]:
        """Return the enumeration of a field, by name or in its `map`, and its aliases."""
        if model.name is None:
            return None, {}
        is_number = isinstance(model, FieldModel) and not str(model.type).startswith("enum")
        if isinstance(model, FieldModel) and is_number and model.enumeration is not None:
            bits = str(model.type).removeprefix("u")
            types = f"enum{bits}" if bits in ("8", "16", "32") else "enum8, enum16 or enum32"
            raise IcdError(f"`enum` needs type {types}, not {model.type}")
        if model.map is not None:
            if model.enumeration is not None:
                raise IcdError("has both `map` and `enum`")
            enum, aliases = mapped(model.map)
            members = {**aliases, **{name: name for name in enum.values}}
            return enum, {**self._stand_ins(model.value, members), **aliases}
        if is_number or (isinstance(model, BitModel) and model.enumeration is None):
            return None, {}
        return enum_of(model.enumeration, self._icd), {}

    def _stand_ins(self, quantity: str | None, members: Mapping[str, str]) -> dict[str, str]:
        """Return the members that are sent in place of values of a quantity that a `map` lacks."""
        found = None if quantity is None else self._icd.model.quantity(quantity)
        if found is None or found.enum is None:
            return {}
        instead = self._icd.model.enums[found.enum].instead
        return {
            name: members[other]
            for name, other in instead.items()
            if name not in members and other in members
        }

    def _slot(self, scalar: str, size: int, order: Order | None = None) -> Slot:
        slot = Slot(len(self.slots), scalar, self.size, size, order or self._icd.conventions.byte_order)
        self.slots.append(slot)
        self.size += size
        return slot

    def _append(self, item: Field) -> None:
        if item.name in self._names:
            raise IcdError(f"field {item.name}: name used twice in the row")
        self.fields.append(item)
        self._names |= {item.name} - {""}


def enum_of(name: str | None, icd: InterfaceDefinition) -> EnumDefinition:
    """Return an enumeration of the unit or, if it has none of this name, of the device model."""
    if name is None:
        raise IcdError("type enum needs `enum`, the name of an enumeration")
    enum = icd.enums.get(name) or icd.model.enums.get(name)
    if enum is None:
        names = sorted({*icd.enums, *icd.model.enums})
        near = did_you_mean(name, names)
        raise MissingNameError(f"no enumeration named {name!r}{near} (known: {', '.join(names)})", name)
    return enum


def _expanded(model: FieldModel, number: int | None) -> Iterator[tuple[FieldModel, str, int | None]]:
    """Yield the single fields of an entry, each with the suffix of its name and the number for `[n]`."""
    if model.repeat is None and model.count is None:
        yield from ((single, "", number) for single in _of_text(model))
        return
    group, numbers = [model], range(1, (model.count or 0) + 1)
    with Located(f"field {model.text or model.name or 'unused'}"):
        if model.repeat is not None:
            numbers = range(model.repeat.first, model.repeat.first + model.repeat.count)
            group = model.repeat.fields
            if model.model_fields_set - {"repeat", "doc"}:
                raise IcdError("`repeat` allows no other keys but `doc`")
            if any(item.repeat is not None or item.count is not None for item in group):
                raise IcdError("a repeated group cannot contain `repeat` or `count`")
    group = [single for item in group for single in _of_text(item)]
    yield from ((single, f"_{each}", each) for each in numbers for single in group)


def _of_text(model: FieldModel) -> list[FieldModel]:
    """Expand the text of a field to fields; return any other field itself."""
    if model.text is None:
        return [model]
    with Located(f"field {model.text!r}"):
        if model.model_fields_set != {"text"}:
            raise IcdError("`text` allows no other keys")
        type_, *words = model.text.split() or [""]
        if not words:
            raise IcdError("needs a type and a name, such as 'u16 counter'")
        tables = _bits(words) if type_ == "bits" else _scalars(type_, *words)
        try:
            return [FieldModel.model_validate(table) for table in tables]
        except ValidationError as error:
            first = error.errors()[0]
            raise IcdError(f"{first['loc'][-1]}: {wording(first)}") from None


def mapped(table: Mapping[str, Scalar | list[Scalar]]) -> tuple[EnumDefinition, Mapping[str, str]]:
    """Return the enumeration of a `map`, and the values that are sent as another member."""
    values: dict[str, int] = {}
    aliases: dict[str, str] = {}
    for wire, targets in table.items():
        try:
            number = int(wire, 0)
        except ValueError:
            raise IcdError(f'map: {wire!r} is not a number on the wire; write "1" = "tracking"') from None
        names = [text_of(value) for value in (targets if isinstance(targets, list) else [targets])]
        if not names or any(name in values or name in aliases for name in names):
            raise IcdError(f"map: {wire}: no value, or a duplicate one")
        values[names[0]] = number
        aliases |= dict.fromkeys(names[1:], names[0])
    return EnumDefinition.model_construct(name="map", doc="", values=values), aliases


def text_of(value: object) -> str:
    """Return the name of a value as a member of a `map`."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _numbered(name: str | None, number: int | None) -> str | None:
    """Replace `[n]` in the name of a quantity or argument by the number of a repetition."""
    if name is None or NUMBER not in name:
        return name
    if number is None:
        raise IcdError(f"{name}: [n] is only allowed with count, repeat or last_id")
    return name.replace(NUMBER, f"[{number}]")


def _default(value: Scalar | None, enum: EnumDefinition | None) -> Scalar | None:
    if enum is None or value is None:
        return value
    name = text_of(value)
    if name not in enum.values:
        raise IcdError(f"default {value!r} is not in enumeration {enum.name}")
    return name


def _scalars(type_: str, name: str, *words: str) -> list[dict[str, Any]]:
    kinds = {"enum": ("enum",), "byte": ("size",), "text": ("size",)}
    keys = kinds.get(type_[:4], ("unit", "scale"))
    if len(words) > len(keys):
        raise IcdError(f"only {' and '.join(keys)} may follow the name")
    table: dict[str, Any] = {"type": type_}
    for key, word in zip(keys, words, strict=False):
        if word != "-":
            table[key] = word if key in ("enum", "unit") else _number(key, word)
    return [table | {"name": item} for item in _names(name)]


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
                raise IcdError(
                    f"{item or '-'}: {width} bits do not fit into the remaining {room} bits of the byte"
                )
            filled[-1].append({"name": item, "width": width})
            room -= width
    if room:
        filled[-1].append({"width": room})
    return [{"type": "bits8", "bits": bits} for bits in filled]


def _number(key: str, word: str) -> int | float:
    try:
        return float(word) if key == "scale" else int(word)
    except ValueError:
        raise IcdError(f"{key}: {word!r} is not a number") from None


def _names(pattern: str) -> list[str | None]:
    """Expand a pattern with braces to names; the last braces vary fastest. `-` is no name."""
    parts = [
        [part] if index % 2 == 0 else _choices(part) for index, part in enumerate(_BRACES.split(pattern))
    ]
    if not 1 <= math.prod(map(len, parts)) <= MAX_NAMES:
        raise IcdError(f"{pattern}: must be 1 to {MAX_NAMES} fields")
    names = ("".join(chosen) for chosen in product(*parts))
    return [None if name == "-" else name for name in names]


def _choices(text: str) -> list[str]:
    first, _, last = text.partition("..")
    if first.isdecimal() and last.isdecimal():
        return [str(number) for number in range(int(first), int(last) + 1)[: MAX_NAMES + 1]]
    return text.split(",")
