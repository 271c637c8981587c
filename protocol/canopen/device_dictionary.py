"""The object dictionary of a device, built from communication profile and interface definition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NoReturn

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import Application, GreyImage, StandInApplication, abort_of
from starhil.protocol.canopen.communication import (
    MappedPdo,
    add_communication,
    add_record,
    set_limits,
    variable,
)
from starhil.protocol.canopen.dictionary import Deferred, Dictionary, Writer, decode, encode, type_size
from starhil.protocol.canopen_schema import (
    CanopenModel,
    PackedField,
    PdoModel,
    PlacedMember,
    PlacedObject,
)
from starhil.protocol.codec import Field, Row, Slot
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.values import IcdError, MessageError, Parameter, Value, to_f32

DATA_TYPES: Final[dict[str, int]] = {
    "u8": datatypes.UNSIGNED8,
    "i8": datatypes.INTEGER8,
    "u16": datatypes.UNSIGNED16,
    "i16": datatypes.INTEGER16,
    "u24": datatypes.UNSIGNED24,
    "i24": datatypes.INTEGER24,
    "u32": datatypes.UNSIGNED32,
    "i32": datatypes.INTEGER32,
    "u48": datatypes.UNSIGNED48,
    "u64": datatypes.UNSIGNED64,
    "i64": datatypes.INTEGER64,
    "f32": datatypes.REAL32,
    "f64": datatypes.REAL64,
    "bool": datatypes.UNSIGNED8,
    "enum8": datatypes.UNSIGNED8,
    "bytes": datatypes.OCTET_STRING,
}
"""Type in the interface definition → CANopen data type; bool is a byte, as BOOLEAN takes one bit in PDOs."""

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


class DeviceDictionary(Dictionary):
    """Object dictionary of a device, built from its interface definition.

    Parameters
    ----------
    icd
        The interface definition.
    layout
        Indices of its rows, fields and parameters.
    application
        Device behind the dictionary; by default it is a stand-in.

    Attributes
    ----------
    readings
        Key of an entry → the part of a telemetry row that it reads.
    sources
        Telemetry row → keys of the entries that contain it.
    parameters
        Parameter → key of its entry.
    """

    def __init__(
        self, icd: InterfaceDefinition, layout: CanopenModel, application: Application | None = None
    ) -> None:
        self.icd = icd
        self.layout = layout
        self.application: Application = application or StandInApplication(icd)
        self.readings: dict[Key, Reading] = {}
        self.sources: dict[str, set[Key]] = {}
        self.parameters: dict[str, Key] = {}
        self._readers: dict[Key, Callable[[], bytes]] = {}
        self._writers: dict[Key, Writer] = {}
        self._sizes: dict[Key, int] = {}
        self._names: dict[str, Key] = {}
        self._placed: dict[tuple[str, str, int | None], Key] = {}
        """Kind, name and slot of a row → key of its entry; the slot is None for the whole row."""
        self._cache: dict[str, bytes] = {}
        self._cached_at = -1
        objects = ObjectDictionary()  # type: ignore[no-untyped-call]
        for placed in layout.object:
            self._add_object(objects, placed)
        rpdos = [self._mapped(objects, model) for model in layout.rpdo]
        tpdos = [self._mapped(objects, model) for model in layout.tpdo]
        add_communication(objects, layout, rpdos, tpdos)
        super().__init__(objects)
        for key, reader in self._readers.items():
            self.entries[key].reader = reader
        for key, writer in self._writers.items():
            self.entries[key].writer = writer
        for key, size in self._sizes.items():
            self.entries[key].maximum_size = size

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

        Raises
        ------
        IcdError
            No entry holds the row, or some slot of it.
        """
        whole = self._placed.get((row.kind, row.name, None))
        if whole is not None:
            return [(whole, None)]
        slots = [slot for slot, _ in _slots(row)]
        held = [(key, slot) for slot in slots if (key := self._placed.get((row.kind, row.name, slot.index)))]
        if len(held) < max(1, len(slots)):
            raise IcdError(f"unit {self.icd.name}: no entry of its object dictionary holds {row.name}")
        return list(held)

    def _add_object(self, objects: ObjectDictionary, placed: PlacedObject) -> None:
        if placed.index in objects.indices:
            raise IcdError(f"canopen.toml: index {placed.index:04X}h is used twice")
        if placed.requests:
            self._place_requests(objects, placed)
        elif placed.telemetry is not None:
            self._place_telemetry(objects, placed, self.icd.telemetry[placed.telemetry])
        elif placed.parameters:
            self._place_parameters(objects, placed)
        elif placed.image is not None:
            self._place_image(objects, placed, placed.image)
        elif placed.packed:
            self._place_packed(objects, placed)
        elif placed.members:
            self._place_members(objects, placed)
        else:
            key = (placed.index, 0)
            member = self._value_variable(placed.name, key, placed.value, placed.telecommand, placed.type)
            objects.add_object(member)
            self._names[f"{placed.index:04x}"] = key

    def _place_requests(self, objects: ObjectDictionary, placed: PlacedObject) -> None:
        members: list[ODVariable] = []
        for row in self.icd.rows:
            key = (placed.index, row.id)
            if row.kind == "telemetry":
                member = variable(row.name, *key, datatypes.OCTET_STRING, "ro")
                self._bind_reader(key, Reading(row), row.name, partial(self.row_bytes, row))
                self._placed[row.kind, row.name, None] = key
            else:
                member = self._telecommand_variable(row.name, key, row)
            member.description = row.doc
            members.append(member)
        add_record(objects, placed.name, members)

    def _place_telemetry(self, objects: ObjectDictionary, placed: PlacedObject, row: Row) -> None:
        members: list[ODVariable] = []
        for slot, fields in _slots(row):
            key = (placed.index, len(members) + 1)
            name = " ".join(field.name for field in fields)
            member = variable(name, *key, DATA_TYPES[slot.type], "ro", mappable=slot.type != "bytes")
            _describe(member, fields)
            for field in fields:
                self._bind_reader(
                    key, Reading(row, slot, fields), field.name, partial(self._read_slot, row, slot)
                )
            self._placed[row.kind, row.name, slot.index] = key
            if placed.telecommand is not None:
                member.access_type = "rw"
                command = self._setter_of(placed, row)
                self._writers[key] = partial(self._execute_field, command, row, slot)
                self._placed[command.kind, command.name, slot.index] = key
            members.append(member)
        add_record(objects, placed.name, members)

    def _setter_of(self, placed: PlacedObject, row: Row) -> Row:
        """Return the telecommand that sets a record, whose telemetry row must include it alone."""
        command = self.icd.telecommands[str(placed.telecommand)]
        reported = {field.telecommand for field in row.named_fields.values()}
        if reported != {command.name} or row.size != command.size:
            raise IcdError(
                f"canopen.toml: {placed.index:04X}h: telemetry {row.name} must include {command.name} alone"
            )
        return command

    def _execute_field(self, command: Row, row: Row, slot: Slot, payload: bytes) -> Deferred | None:
        """Execute a telecommand with the values reported by its telemetry row and one changed value."""
        data = bytearray(self.row_bytes(row))
        data[span_of(slot)] = in_order(slot, payload)
        return self._execute(command, bytes(data))

    def _value_variable(
        self, name: str, key: Key, value: str | None, telecommand: str | None, type_: str | None = None
    ) -> ODVariable:
        """Return the variable that reads a field, executes a telecommand when written, or both."""
        if telecommand is not None:
            member = self._telecommand_variable(name, key, self.icd.telecommands[telecommand], type_)
        if value is not None:
            row, slot, fields = self._slot_of(value)
            if telecommand is None:
                member = variable(name, *key, _data_type(slot, fields), "ro", mappable=slot.type != "bytes")
                _describe(member, fields)
            elif member.data_type != _data_type(slot, fields):
                raise IcdError(f"canopen.toml: {key[0]:04X}h: {value} and {telecommand} differ in type")
            else:
                member.access_type = "rw"
            read = partial(self._read_slot, row, slot)
            text = fields[0].kind == "text"
            self._bind_reader(
                key, Reading(row, slot, fields), name, (lambda: read().rstrip(b"\0")) if text else read
            )
            self._placed[row.kind, row.name, slot.index] = key
        return member

    def _place_members(self, objects: ObjectDictionary, placed: PlacedObject) -> None:
        members: list[ODVariable] = []
        subindex = 0
        for model in placed.members:
            subindex = subindex + 1 if model.subindex is None else model.subindex
            members.append(self._member_variable(model, (placed.index, subindex)))
            self._names[f"{placed.index:04x}.{model.name.lower()}"] = (placed.index, subindex)
        add_record(objects, placed.name, members)

    def _member_variable(self, model: PlacedMember, key: Key) -> ODVariable:
        if model.domain is not None:
            self._readers[key] = self._writers[key] = _no_data
            return variable(model.name, *key, datatypes.DOMAIN, model.domain)
        if model.parameter is None:
            return self._value_variable(model.name, key, model.value, model.telecommand)
        return self._parameter_variable(model.name, key, self.icd.parameters[model.parameter])

    def _place_parameters(self, objects: ObjectDictionary, placed: PlacedObject) -> None:
        members: list[ODVariable] = []
        for number, parameter in sorted(self.icd.parameters_by_id.items()):
            key = (placed.index, number)
            self._names[f"{placed.index:04x}.{parameter.name}"] = key
            members.append(self._parameter_variable(parameter.name, key, parameter))
        add_record(objects, placed.name, members)

    def _parameter_variable(self, name: str, key: Key, parameter: Parameter) -> ODVariable:
        """Return the variable that reads and sets a parameter."""
        default = parameter.to_number(parameter.default)
        if parameter.type not in {"f32", "f64"}:
            default = int(default)
        data_type = DATA_TYPES[parameter.type]
        member = variable(name, *key, data_type, "rw", default, mappable=True)
        set_limits(member, *_representable_limits(parameter.type, parameter.minimum, parameter.maximum))
        member.unit = parameter.unit
        member.description = parameter.doc
        if parameter.enum is not None:
            member.value_descriptions = dict(parameter.enum.names)
        self.parameters[parameter.name] = key
        self._readers[key] = lambda: encode(
            data_type, parameter.to_number(self.application.parameter(parameter.name))
        )
        self._writers[key] = partial(self._write_parameter, parameter, data_type)
        return member

    def _write_parameter(self, parameter: Parameter, data_type: int, data: bytes) -> None:
        try:
            value = parameter.check(decode(data_type, data))
        except MessageError as error:
            raise abort_of(error) from None
        self.application.set_parameter(parameter.name, value)

    def _place_image(self, objects: ObjectDictionary, placed: PlacedObject, name: str) -> None:
        index = placed.index
        readers: list[tuple[str, int, Callable[[GreyImage], bytes]]] = [
            ("pixels", datatypes.DOMAIN, lambda image: image.pixels),
            ("width", datatypes.UNSIGNED16, lambda image: image.width.to_bytes(2, "little")),
            ("height", datatypes.UNSIGNED16, lambda image: image.height.to_bytes(2, "little")),
            ("frame counter", datatypes.UNSIGNED32, lambda image: image.frame.to_bytes(4, "little")),
        ]
        members: list[ODVariable] = []
        for name_in_record, data_type, extract in readers:
            member = variable(name_in_record, index, len(members) + 1, data_type, "ro")
            self._readers[index, member.subindex] = partial(self._read_image, name, extract)
            members.append(member)
        members[0].description = "8 bits a pixel, row by row from the top"
        if name == "frame":
            member = variable("take", index, len(members) + 1, datatypes.UNSIGNED8, "wo", limits=(1, 1))
            member.description = "write 1 to take the frame; the answer comes when it can be read"
            self._writers[index, member.subindex] = lambda _data: self.application.take_image(name)
            members.append(member)
        add_record(objects, placed.name, members)

    def _read_image(self, name: str, extract: Callable[[GreyImage], bytes]) -> bytes:
        return extract(self.application.image(name))

    def _place_packed(self, objects: ObjectDictionary, placed: PlacedObject) -> None:
        members: list[ODVariable] = []
        for model in placed.packed:
            key = (placed.index, len(members) + 1)
            row, slot, fields = self._slot_of(model.source)
            name = model.name or model.source.partition(".")[2]
            member = variable(name, *key, DATA_TYPES[model.type], "ro", mappable=True)
            _describe(member, fields)
            member.min = member.max = None
            member.factor = model.scale
            packer = _Packer(self, row, slot, fields, model)
            self._bind_reader(key, Reading(row, slot, fields, model), name, packer)
            members.append(member)
        add_record(objects, placed.name, members)

    def _telecommand_variable(self, name: str, key: Key, row: Row, type_: str | None = None) -> ODVariable:
        """Return the variable whose write executes a telecommand.

        The client writes the only field, all bytes (as a number if a type is given), or 1 if the telecommand
        has no data.
        """
        text = type_ is None and [field.kind for field in row.fields] == ["text"]
        scalar = text or (type_ is None and len(row.slots) == 1 and row.slots[0].type != "bytes")
        self._placed[row.kind, row.name, row.slots[0].index if scalar else None] = key
        if type_ is not None:
            if type_size(DATA_TYPES[type_]) != row.size:
                raise IcdError(
                    f"canopen.toml: {key[0]:04X}h: {row.name} has {row.size} bytes, not the size of {type_}"
                )
            member = variable(name, *key, DATA_TYPES[type_], "wo", mappable=True)
            self._writers[key] = partial(self._execute, row)
        elif row.size == 0:
            member = variable(name, *key, datatypes.UNSIGNED8, "wo", limits=(1, 1))
            self._writers[key] = lambda _data: self._execute(row, b"")
        elif text:
            member = variable(name, *key, datatypes.VISIBLE_STRING, "wo")
            self._sizes[key] = row.size
            self._writers[key] = lambda payload: self._execute(row, payload.ljust(row.size, b"\0"))
        elif scalar:
            slot, fields = _slots(row)[0]
            member = variable(name, *key, DATA_TYPES[slot.type], "wo", mappable=True)
            _describe(member, fields)
            self._writers[key] = lambda data: self._execute(row, in_order(slot, data))
        else:
            member = variable(name, *key, datatypes.OCTET_STRING, "wo")
            self._sizes[key] = row.size
            self._writers[key] = partial(self._execute, row)
        member.description = row.doc
        return member

    def _execute(self, row: Row, payload: bytes) -> Deferred | None:
        if len(payload) < row.size:
            raise SdoAbortError(AbortCode.LENGTH_LOW, f"{row.name}: {len(payload)} bytes, {row.size} needed")
        try:
            row.decode(payload)
        except MessageError as error:
            raise abort_of(error) from None
        return self.application.telecommand(row, payload)

    def _read_slot(self, row: Row, slot: Slot) -> bytes:
        return in_order(slot, self.row_bytes(row)[span_of(slot)])

    def _bind_reader(self, key: Key, reading: Reading, name: str, reader: Callable[[], bytes]) -> None:
        self.readings[key] = reading
        self._readers[key] = reader
        self.sources.setdefault(reading.row.name, set()).add(key)
        self._names[f"{key[0]:04x}.{name}"] = key

    def _slot_of(self, reference: str) -> tuple[Row, Slot, list[Field]]:
        row_name, _, field_name = reference.partition(".")
        row = self.icd.telemetry[row_name]
        if field_name not in row.named_fields:
            raise IcdError(f"canopen.toml: telemetry {row_name} has no field {field_name!r}")
        slot = row.named_fields[field_name].slot
        return row, slot, [field for field in row.named_fields.values() if field.slot.index == slot.index]

    def _mapped(self, objects: ObjectDictionary, model: PdoModel) -> MappedPdo:
        mapping = []
        for name in model.objects:
            index, subindex = self.key_of(name)
            item = objects[index]
            member = item if isinstance(item, ODVariable) else item[subindex]
            mapping.append(index << 16 | subindex << 8 | (type_size(member.data_type) or 0) * 8)
        return model, mapping


class _Packer:
    """Reads a field of a telemetry row as a narrower integer."""

    def __init__(
        self, dictionary: DeviceDictionary, row: Row, slot: Slot, fields: list[Field], model: PackedField
    ) -> None:
        self._dictionary = dictionary
        self._row = row
        self._slot = slot
        self._field = fields[0] if fields[0].width == 0 else None
        self._model = model
        data_type = DATA_TYPES[model.type]
        self._data_type = data_type
        bits = (type_size(data_type) or 0) * 8
        self._bits = bits
        signed = model.type.startswith("i")
        self._limits = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)

    def __call__(self) -> bytes:
        data = self._dictionary.row_bytes(self._row)
        if self._field is None:
            raw = int.from_bytes(data[span_of(self._slot)], self._slot.order)
        else:
            value = self._row.decode(data)[self._field.name]
            number = value if isinstance(value, int | float) else self._raw(value)
            raw = round(number / self._model.scale)
        if self._model.wrap:
            raw &= (1 << self._bits) - 1
        low, high = self._limits
        return encode(self._data_type, min(max(raw, low), high))

    def _raw(self, value: Value) -> int:
        enum = None if self._field is None else self._field.enum
        if enum is None or not isinstance(value, str):
            raise SdoAbortError(AbortCode.GENERAL, f"{self._model.source}: {value!r} is not a number")
        return enum.values[value]


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


def _data_type(slot: Slot, fields: list[Field]) -> int:
    return datatypes.VISIBLE_STRING if fields[0].kind == "text" else DATA_TYPES[slot.type]


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
        limits = first.physical_limits if first.kind == "float" else first.raw_limits
        set_limits(member, *_representable_limits(first.slot.type, *limits))


def _representable_limits(kind: str, low: float, high: float) -> tuple[float, float]:
    """Widen limits to values that the type can represent: the nearest f32 may be just outside."""
    return (min(low, to_f32(low)), max(high, to_f32(high))) if kind == "f32" else (low, high)
