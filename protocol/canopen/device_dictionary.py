"""The object dictionary of a device, built from communication profile and interface definition.

`placements` derives from the definition, as data, what each entry of an application object reads and what a write to it
does. `DeviceDictionary` connects this to the device.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NoReturn, cast

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import Application, abort_of
from starhil.protocol.canopen.communication import (
    DATA_TYPES,
    MappedPdo,
    add_communication,
    add_record,
    set_limits,
    variable,
)
from starhil.protocol.canopen.dictionary import Deferred, Dictionary, Value, encode, type_size
from starhil.protocol.canopen_schema import CanopenModel, PackedField, PdoModel, PlacedMember, PlacedObject
from starhil.protocol.codec import Field, Row, Slot
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.values import IcdError, MessageError, Parameter, representable

Key = tuple[int, int]


@dataclass(frozen=True)
class Reading:
    """What an entry reads: a slot of a telemetry row, or all of it, as it is or as a narrower integer."""

    row: Row
    slot: Slot | None = None
    """None for the whole row."""
    fields: Sequence[Field] = ()
    """Fields of the slot."""
    packed: PackedField | None = None


@dataclass(frozen=True)
class Placement:
    """An entry of an application object: at most one of `reading`, `parameter` and `image` is what it reads."""

    variable: ODVariable
    names: Sequence[str] = ()
    """Names in its object by which a PDO maps it."""
    reading: Reading | None = None
    parameter: Parameter | None = None
    """Parameter that is read and set."""
    image: tuple[str, str] | None = None
    """Name of an image, and its attribute; a write to the entry `take` takes it."""
    telecommand: Row | None = None
    """Telecommand that a write executes."""
    part: Slot | None = None
    """Slot of the telecommand that is written; None for all of it."""

    @property
    def key(self) -> Key:
        """Index and sub-index."""
        return self.variable.index, self.variable.subindex


# --- from the definition to entries ---


def placements(icd: InterfaceDefinition, placed: PlacedObject) -> Iterator[Placement]:
    """Yield the entries of an application object. Raises IcdError for an object that does not fit the rows."""
    index = placed.index
    if placed.requests:
        for row in icd.rows:
            yield _request(row, (index, row.id))
    elif placed.telemetry is not None and placed.type is not None:
        yield _whole(icd, placed, icd.telemetry[placed.telemetry], DATA_TYPES[placed.type])
    elif placed.telemetry is not None:
        yield from _record(icd, placed, icd.telemetry[placed.telemetry])
    elif placed.parameters:
        for number, parameter in sorted(icd.parameters_by_id.items()):
            yield _parameter(parameter.name, (index, number), parameter)
    elif placed.image is not None:
        yield from _image(index, placed.image)
    elif placed.packed:
        for subindex, model in enumerate(placed.packed, 1):
            yield _packed(icd, model, (index, subindex))
    elif placed.members:
        subindex = 0
        for member in placed.members:
            subindex = subindex + 1 if member.subindex is None else member.subindex
            yield _member(icd, member, (index, subindex))
    else:
        yield _value(icd, placed.name, (index, 0), placed.value, placed.telecommand, placed.type)


def _request(row: Row, key: Key) -> Placement:
    if row.kind == "telecommand":
        return _command(row.name, key, row)
    item = variable(row.name, *key, datatypes.OCTET_STRING, "ro")
    item.description = row.doc
    return Placement(item, (row.name,), Reading(row))


def _whole(icd: InterfaceDefinition, placed: PlacedObject, row: Row, data_type: int) -> Placement:
    """Return the entry that holds all data of a telemetry row, and executes a telecommand when written."""
    if type_size(data_type) != row.size:
        raise IcdError(
            f"canopen.toml: {placed.index:04X}h: {row.name} has {row.size} bytes, not the size of {placed.type}"
        )
    key, command = (placed.index, 0), None
    item = variable(placed.name, *key, data_type, "ro", mappable=True)
    if placed.telecommand is not None:
        command = icd.telecommands[placed.telecommand]
        item = _command(placed.name, key, command, placed.type).variable
        item.access_type = "rw"
    return Placement(item, (placed.name,), Reading(row), telecommand=command)


def _record(icd: InterfaceDefinition, placed: PlacedObject, row: Row) -> Iterator[Placement]:
    """Yield an entry for each slot of a telemetry row; a write changes one value of the telecommand that it includes."""
    command = None if placed.telecommand is None else icd.telecommands[placed.telecommand]
    reported = {field.telecommand for field in row.named_fields.values()}
    if command is not None and (reported != {command.name} or row.size != command.size):
        raise IcdError(
            f"canopen.toml: {placed.index:04X}h: telemetry {row.name} must include {command.name} alone"
        )
    for subindex, (slot, fields) in enumerate(_slots(row), 1):
        names = [field.name for field in fields]
        item = variable(
            " ".join(names),
            placed.index,
            subindex,
            DATA_TYPES[slot.type],
            "ro" if command is None else "rw",
            mappable=slot.type != "bytes",
        )
        _describe(item, fields)
        yield Placement(item, names, Reading(row, slot, fields), telecommand=command, part=slot)


def _value(
    icd: InterfaceDefinition,
    name: str,
    key: Key,
    value: str | None,
    telecommand: str | None,
    type_: str | None = None,
) -> Placement:
    """Return the entry that reads a field, executes a telecommand when written, or both."""
    written = None if telecommand is None else _command(name, key, icd.telecommands[telecommand], type_)
    if value is None and written is not None:
        return written
    row, slot, fields = _slot_of(icd, str(value))
    data_type = datatypes.VISIBLE_STRING if fields[0].kind == "text" else DATA_TYPES[slot.type]
    reading = Reading(row, slot, fields)
    if written is None:
        item = variable(name, *key, data_type, "ro", mappable=slot.type != "bytes")
        _describe(item, fields)
        return Placement(item, (name,), reading)
    if written.variable.data_type != data_type:
        raise IcdError(f"canopen.toml: {key[0]:04X}h: {value} and {telecommand} differ in type")
    written.variable.access_type = "rw"
    return replace(written, names=(name,), reading=reading)


def _member(icd: InterfaceDefinition, model: PlacedMember, key: Key) -> Placement:
    if model.domain is not None:
        return Placement(variable(model.name, *key, datatypes.DOMAIN, model.domain), (model.name,))
    if model.parameter is not None:
        return _parameter(model.name, key, icd.parameters[model.parameter])
    return replace(_value(icd, model.name, key, model.value, model.telecommand), names=(model.name,))


def _parameter(name: str, key: Key, parameter: Parameter) -> Placement:
    default = parameter.to_number(parameter.default)
    whole = parameter.type not in {"f32", "f64"}
    item = variable(
        name, *key, DATA_TYPES[parameter.type], "rw", int(default) if whole else default, mappable=True
    )
    set_limits(item, *representable(parameter.minimum, parameter.maximum, parameter.type))
    item.unit = parameter.unit
    item.description = parameter.doc
    if parameter.enum is not None:
        item.value_descriptions = dict(parameter.enum.names)
    return Placement(item, (name,), parameter=parameter)


def _image(index: int, name: str) -> Iterator[Placement]:
    parts = (
        ("pixels", "pixels", datatypes.DOMAIN),
        ("width", "width", datatypes.UNSIGNED16),
        ("height", "height", datatypes.UNSIGNED16),
        ("frame counter", "frame", datatypes.UNSIGNED32),
    )
    for subindex, (label, attribute, data_type) in enumerate(parts, 1):
        item = variable(label, index, subindex, data_type, "ro")
        if attribute == "pixels":
            item.description = "8 bits a pixel, row by row from the top"
        yield Placement(item, image=(name, attribute))
    if name == "frame":
        item = variable("take", index, len(parts) + 1, datatypes.UNSIGNED8, "wo", limits=(1, 1))
        item.description = "write 1 to take the frame; the answer comes when it can be read"
        yield Placement(item, image=(name, "take"))


def _packed(icd: InterfaceDefinition, model: PackedField, key: Key) -> Placement:
    row, slot, fields = _slot_of(icd, model.source)
    name = model.name or model.source.partition(".")[2]
    item = variable(name, *key, DATA_TYPES[model.type], "ro", mappable=True)
    _describe(item, fields)
    item.min = item.max = None
    item.factor = model.scale
    return Placement(item, (name,), Reading(row, slot, fields, model))


def _command(name: str, key: Key, row: Row, type_: str | None = None) -> Placement:
    """Return the entry whose write executes a telecommand.

    The client writes the only field, all bytes (as a number if a type is given), or 1 if the telecommand has no data.
    """
    text = type_ is None and [field.kind for field in row.fields] == ["text"]
    scalar = text or (type_ is None and len(row.slots) == 1 and row.slots[0].type != "bytes")
    if type_ is not None:
        if type_size(DATA_TYPES[type_]) != row.size:
            raise IcdError(
                f"canopen.toml: {key[0]:04X}h: {row.name} has {row.size} bytes, not the size of {type_}"
            )
        item = variable(name, *key, DATA_TYPES[type_], "wo", mappable=True)
    elif row.size == 0:
        item = variable(name, *key, datatypes.UNSIGNED8, "wo", limits=(1, 1))
    elif text:
        item = variable(name, *key, datatypes.VISIBLE_STRING, "wo")
    elif scalar:
        slot, fields = _slots(row)[0]
        item = variable(name, *key, DATA_TYPES[slot.type], "wo", mappable=True)
        _describe(item, fields)
    else:
        item = variable(name, *key, datatypes.OCTET_STRING, "wo")
    item.description = row.doc
    return Placement(item, telecommand=row, part=row.slots[0] if scalar else None)


def _slot_of(icd: InterfaceDefinition, reference: str) -> tuple[Row, Slot, list[Field]]:
    row_name, _, field_name = reference.partition(".")
    row = icd.telemetry[row_name]
    if field_name not in row.named_fields:
        raise IcdError(f"canopen.toml: telemetry {row_name} has no field {field_name!r}")
    slot = row.named_fields[field_name].slot
    return row, slot, [field for field in row.named_fields.values() if field.slot.index == slot.index]


# --- entries of a running device ---


class DeviceDictionary(Dictionary):
    """Object dictionary of a device, built from its interface definition and the indices of its layout.

    Without an application it is only described: nothing may read or write the entries of a device.
    """

    def __init__(
        self, icd: InterfaceDefinition, layout: CanopenModel, application: Application | None = None
    ) -> None:
        self.icd = icd
        self.layout = layout
        self.application = cast("Application", application)
        self.readings: dict[Key, Reading] = {}
        self.sources: dict[str, set[Key]] = {}
        """Telemetry row → keys of the entries that contain it."""
        self.parameters: dict[str, Key] = {}
        self._names: dict[str, Key] = {}
        self._placed: dict[tuple[str, str, int | None], Key] = {}
        """Kind, name and slot of a row → key of its entry; the slot is None for the whole row."""
        self._cache: dict[str, bytes] = {}
        self._cached_at = -1
        objects = ObjectDictionary()  # type: ignore[no-untyped-call]
        entries = [item for placed in layout.object for item in self._place(objects, placed)]
        rpdos = [self._mapped(objects, model) for model in layout.rpdo]
        tpdos = [self._mapped(objects, model) for model in layout.tpdo]
        add_communication(objects, layout, rpdos, tpdos)
        super().__init__(objects)
        for item in entries:
            self._connect(item)

    def _place(self, objects: ObjectDictionary, placed: PlacedObject) -> list[Placement]:
        """Add an object, and index its entries."""
        if placed.index in objects.indices:
            raise IcdError(f"canopen.toml: index {placed.index:04X}h is used twice")
        items = list(placements(self.icd, placed))
        for item in items:
            for name in item.names:
                self._names[f"{placed.index:04x}.{name.lower()}"] = item.key
            self._index(item)
        if items[0].key == (placed.index, 0):
            self._names[f"{placed.index:04x}"] = items[0].key
            objects.add_object(items[0].variable)
        else:
            add_record(objects, placed.name, [item.variable for item in items])
        return items

    def _index(self, item: Placement) -> None:
        row, reading = item.telecommand, item.reading
        if row is not None:
            self._placed[row.kind, row.name, None if item.part is None else item.part.index] = item.key
        if reading is not None:
            self.readings[item.key] = reading
            self.sources.setdefault(reading.row.name, set()).add(item.key)
            if reading.packed is None:
                slot = None if reading.slot is None else reading.slot.index
                self._placed[reading.row.kind, reading.row.name, slot] = item.key
        if item.parameter is not None:
            self.parameters[item.parameter.name] = item.key

    def _connect(self, item: Placement) -> None:
        """Give an entry the functions that read and write the device."""
        entry = self.entries[item.key]
        if item.telecommand is not None:
            entry.writer = partial(self._execute, item, item.telecommand)
            if entry.size is None:
                entry.maximum_size = item.telecommand.size
        if item.reading is not None:
            entry.reader = partial(self._read, item, item.reading)
        elif item.parameter is not None:
            entry.reader = partial(self._read_parameter, item, item.parameter)
            entry.writer = partial(self._write_parameter, item, item.parameter)
        elif item.image is not None:
            name, attribute = item.image
            if attribute == "take":
                entry.writer = lambda _data: self.application.take_image(name)
            else:
                entry.reader = partial(self._read_image, item, name, attribute)
        elif item.telecommand is None:
            entry.reader = entry.writer = _no_data

    def row_bytes(self, row: Row) -> bytes:
        """Return the bytes of a telemetry row, read from the application once per sampling instant."""
        if self._cached_at != self.instant:
            self._cache.clear()
            self._cached_at = self.instant
        data = self._cache.get(row.name)
        if data is None:
            data = self._cache[row.name] = self.application.telemetry(row)
        return data

    def key_of(self, name: str) -> Key:
        """Return the key of "INDEX.NAME" or "INDEX" (hexadecimal); `IcdError` if there is none."""
        key = self._names.get(name.lower())
        if key is None:
            raise IcdError(f"canopen.toml: no object {name!r} to map")
        return key

    def entries_of(self, row: Row) -> list[tuple[Key, Slot | None]]:
        """Return the entries that hold a row: one per slot, or one for the whole row, with None for its slot.

        Raises IcdError if no entry holds the row, or some slot of it.
        """
        whole = self._placed.get((row.kind, row.name, None))
        if whole is not None:
            return [(whole, None)]
        slots = [slot for slot, _ in _slots(row)]
        held = [(key, slot) for slot in slots if (key := self._placed.get((row.kind, row.name, slot.index)))]
        if len(held) < max(1, len(slots)):
            raise IcdError(f"unit {self.icd.name}: no entry of its object dictionary holds {row.name}")
        return list(held)

    def _mapped(self, objects: ObjectDictionary, model: PdoModel) -> MappedPdo:
        mapping = []
        for name in model.objects:
            index, subindex = self.key_of(name)
            item = objects[index]
            member = item if isinstance(item, ODVariable) else item[subindex]
            mapping.append(index << 16 | subindex << 8 | (type_size(member.data_type) or 0) * 8)
        return model, mapping

    def _read(self, item: Placement, reading: Reading) -> bytes:
        data = self.row_bytes(reading.row)
        if reading.slot is None:
            return data
        if reading.packed is not None:
            return encode(item.variable, _narrowed(reading, reading.packed, reading.slot, data))
        value = in_order(reading.slot, data[span_of(reading.slot)])
        return value.rstrip(b"\0") if item.variable.data_type == datatypes.VISIBLE_STRING else value

    def _execute(self, item: Placement, row: Row, data: bytes) -> Deferred | None:
        """Execute a telecommand with the written data; in a record, its other values are those reported."""
        if row.size == 0:
            payload = b""
        elif item.part is None:
            payload = data
        elif item.reading is not None and len(row.slots) > 1:
            changed = bytearray(self.row_bytes(item.reading.row))
            changed[span_of(item.part)] = in_order(item.part, data)
            payload = bytes(changed)
        else:
            payload = in_order(item.part, data).ljust(row.size if item.part.type == "bytes" else 0, b"\0")
        if len(payload) < row.size:
            raise SdoAbortError(AbortCode.LENGTH_LOW, f"{row.name}: {len(payload)} bytes, {row.size} needed")
        try:
            row.decode(payload)
        except MessageError as error:
            raise abort_of(error) from None
        return self.application.telecommand(row, payload)

    def _read_parameter(self, item: Placement, parameter: Parameter) -> bytes:
        value = parameter.to_number(self.application.parameter(parameter.name))
        return encode(item.variable, value)

    def _write_parameter(self, item: Placement, parameter: Parameter, data: bytes) -> None:
        try:
            value = parameter.check(cast("Value", item.variable.decode_raw(data)))
        except MessageError as error:
            raise abort_of(error) from None
        self.application.set_parameter(parameter.name, value)

    def _read_image(self, item: Placement, name: str, attribute: str) -> bytes:
        return encode(item.variable, getattr(self.application.image(name), attribute))


def _narrowed(reading: Reading, packed: PackedField, slot: Slot, data: bytes) -> int:
    """Return a field of a telemetry row as a narrower integer."""
    field = reading.fields[0]
    if field.width:
        raw = int.from_bytes(data[span_of(slot)], slot.order)
    else:
        value = reading.row.decode(data)[field.name]
        if isinstance(value, str | bool) and field.enum is not None:
            value = field.enum.number(value)
        if not isinstance(value, int | float):
            raise SdoAbortError(AbortCode.GENERAL, f"{packed.source}: {value!r} is not a number")
        raw = round(value / packed.scale)
    bits = int(packed.type[1:])
    if packed.wrap:
        raw &= (1 << bits) - 1
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if packed.type[0] == "i" else (0, (1 << bits) - 1)
    return min(max(raw, low), high)


def build_dictionary(icd: InterfaceDefinition, application: Application | None = None) -> DeviceDictionary:
    """Build the object dictionary of the device that serves a definition, with the definition's layout.

    Raises IcdError for a definition without `[canopen]`, and for a layout that does not fit its rows.
    """
    if icd.canopen is None:
        raise IcdError(f"unit {icd.name}: has no CANopen node: its definition lacks the table [canopen]")
    return DeviceDictionary(icd, icd.canopen, application)


def _slots(row: Row) -> list[tuple[Slot, list[Field]]]:
    """Return the slots of a row that have named fields, each with its fields."""
    slots = []
    for slot in row.slots:
        fields = [field for field in row.named_fields.values() if field.slot.index == slot.index]
        if fields:
            slots.append((slot, fields))
    return slots


def _no_data(_data: bytes = b"") -> NoReturn:
    raise SdoAbortError(AbortCode.NO_DATA, "no file")


def span_of(slot: Slot) -> slice:
    """Return the bytes of a slot in its row."""
    return slice(slot.offset, slot.offset + slot.size)


def in_order(slot: Slot, data: bytes) -> bytes:
    """Convert bytes between the byte order of a slot and CANopen's, little-endian."""
    return data[::-1] if slot.order == "big" and slot.type != "bytes" else data


def _describe(member: ODVariable, fields: list[Field]) -> None:
    """Copy unit, scale, limits, enumeration and description of a field to its variable, and name its bits."""
    first = fields[0]
    if first.width:
        for field in fields:
            member.add_bit_definition(field.name, list(range(field.shift, field.shift + field.width)))
        member.description = "; ".join(f"{field.name}: {field.doc}" for field in fields)
        return
    member.unit = first.unit
    member.factor = first.scale
    member.description = first.doc
    if first.enum is not None:
        member.value_descriptions = dict(first.enum.names)
    elif first.minimum is not None or first.maximum is not None:
        low, high = first.physical_limits if first.kind == "float" else first.raw_limits
        set_limits(member, *representable(low, high, first.slot.type))
