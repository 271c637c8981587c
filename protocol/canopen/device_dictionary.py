"""The object dictionary of a device, built from communication profile and interface definition.

An object of `[canopen]` becomes entries, each with the functions that read and write it in the device: a row or one of
its slots, a telecommand, a parameter, an image.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final, NoReturn, cast

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import Application, Sample, abort_of
from starhil.protocol.canopen.communication import (
    DATA_TYPES,
    MappedPdo,
    add_communication,
    add_record,
    set_limits,
    variable,
)
from starhil.protocol.canopen.dictionary import Deferred, Dictionary, Entry, Value, encode, type_size
from starhil.protocol.canopen.pdo_mapping import Direction, resolve_all
from starhil.protocol.errors import IcdError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.canopen_schema import PackedField, PdoModel, PlacedMember, PlacedObject
from starhil.protocol.icd.codec import Field, Row, Slot
from starhil.protocol.icd.values import MessageError, Parameter, representable

LARGEST_SUBINDEX: Final = 254
"""Highest sub-index of a member (CiA 301: 255 is reserved)."""

Key = tuple[int, int]
"""Index and sub-index."""
Named = tuple[Entry, Sequence[str]]
"""An entry, and the names in its object by which a PDO maps it."""


class DeviceDictionary(Dictionary):
    """Object dictionary of a device, built from its interface definition and the layout in it.

    Without an application it is only described: nothing may read or write the entries of a device. Raises IcdError for
    a definition without `[canopen]`, and for a layout that does not fit its rows.
    """

    def __init__(self, icd: InterfaceDefinition, application: Application | None = None) -> None:
        if icd.canopen is None:
            raise IcdError(f"unit {icd.name}: has no CANopen node: its definition lacks the table [canopen]")
        self.icd = icd
        self.layout = layout = icd.canopen
        self.application = cast("Application", application)
        self.sources: dict[str, set[Key]] = {}
        """Telemetry row → keys of the entries that contain it."""
        self.parameters: dict[str, Key] = {}
        self._names: dict[str, Entry] = {}
        """Entry by "INDEX.NAME" or "INDEX", in lower case."""
        self._holders: dict[tuple[str, str, int | None], Key] = {}
        """Kind, name and slot of a row → key of its entry; the slot is None for the whole row."""
        self._sample: tuple[int, Sample] | None = None
        """The last sample of the device, with the number of its instant."""
        self._rows: dict[str, bytes] = {}
        """Rows that have been read from it."""
        objects = ObjectDictionary()  # type: ignore[no-untyped-call]
        entries = [entry for placed in layout.object for entry in self._place(objects, placed)]
        rpdos = [self._mapped(model) for model in layout.rpdo]
        tpdos = [self._mapped(model) for model in layout.tpdo]
        add_communication(objects, layout, rpdos, tpdos)
        super().__init__(objects, entries)
        for direction, pdos in ((Direction.RECEIVE, rpdos), (Direction.TRANSMIT, tpdos)):
            for model, mapping in pdos:
                try:
                    resolve_all(self, mapping, direction)
                except SdoAbortError as refusal:
                    raise IcdError(f"canopen.toml: PDO {model.name}: {refusal}") from None

    def row_bytes(self, row: Row) -> bytes:
        """Return the bytes of a telemetry row in this sampling instant."""
        sample = self.sample()
        data = self._rows.get(row.name)
        if data is None:
            data = self._rows[row.name] = sample.telemetry(row)
        return data

    def sample(self) -> Sample:
        """Return the device in this sampling instant: it is sampled once."""
        if self._sample is None or self._sample[0] != self.instant:
            self._sample = self.instant, self.application.sample()
            self._rows.clear()
        return self._sample[1]

    def entries_of(self, row: Row) -> list[tuple[Key, Slot | None]]:
        """Return the entries that hold a row: one per slot, or one for the whole row, with None for its slot.

        Raises IcdError if no entry holds the row, or some slot of it.
        """
        whole = self._holders.get((row.kind, row.name, None))
        if whole is not None:
            return [(whole, None)]
        slots = [slot for slot, _ in _slots(row)]
        held = [(key, slot) for slot in slots if (key := self._holders.get((row.kind, row.name, slot.index)))]
        if len(held) < max(1, len(slots)):
            raise IcdError(f"unit {self.icd.name}: no entry of its object dictionary holds {row.name}")
        return list(held)

    # --- from the layout to entries ---

    def _place(self, objects: ObjectDictionary, placed: PlacedObject) -> list[Entry]:
        """Add an object, and return its entries."""
        index = placed.index
        if index in objects.indices:
            raise IcdError(f"canopen.toml: index {index:04X}h is used twice")
        found = list(self._entries(placed))
        for entry, names in found:
            self._names |= {f"{index:04x}.{name.lower()}": entry for name in names}
        entries = [entry for entry, _ in found]
        if [entry.key for entry in entries] == [(index, 0)]:
            self._names[f"{index:04x}"] = entries[0]
            objects.add_object(entries[0].variable)
            return entries
        taken: dict[int, str] = {}
        for entry in entries:
            name, subindex = entry.variable.name, entry.key[1]
            if not 1 <= subindex <= LARGEST_SUBINDEX:
                raise IcdError(
                    f"canopen.toml: {index:04X}h: {name} would be sub-index {subindex}, not 1 to 254"
                )
            if subindex in taken:
                raise IcdError(
                    f"canopen.toml: {index:04X}h: {taken[subindex]} and {name} are both sub-index {subindex}"
                )
            taken[subindex] = name
        add_record(objects, placed.name, [entry.variable for entry in entries])
        return entries

    def _mapped(self, model: PdoModel) -> MappedPdo:
        mapping = []
        for name in model.objects:
            entry = self._names.get(name.lower())
            if entry is None:
                raise IcdError(f"canopen.toml: no object {name!r} to map")
            index, subindex = entry.key
            mapping.append(index << 16 | subindex << 8 | (entry.size or 0) * 8)
        return model, mapping

    def _entries(self, placed: PlacedObject) -> Iterator[Named]:
        index, icd = placed.index, self.icd
        row = None if placed.telemetry is None else icd.telemetry[placed.telemetry]
        if placed.requests:
            for each in icd.rows:
                make = self._whole if each.kind == "telemetry" else self._command
                yield make(each.name, (index, each.id), each)
        elif row is not None and placed.type is None:
            yield from self._record(placed, row)
        elif row is not None:
            yield self._whole(placed.name, (index, 0), row, placed.type, placed.telecommand)
        elif placed.parameters:
            for number, parameter in sorted(icd.parameters_by_id.items()):
                yield self._parameter(parameter.name, (index, number), parameter)
        elif placed.image is not None:
            yield from self._image(index, placed.image)
        elif placed.packed:
            for subindex, model in enumerate(placed.packed, 1):
                yield self._packed((index, subindex), model)
        elif placed.members:
            subindex = 0
            for member in placed.members:
                subindex = subindex + 1 if member.subindex is None else member.subindex
                yield self._member((index, subindex), member)
        else:
            yield self._value(placed.name, (index, 0), placed.value, placed.telecommand, placed.type)

    def _whole(
        self, name: str, key: Key, row: Row, type_: str | None = None, telecommand: str | None = None
    ) -> Named:
        """Return the entry that holds all data of a telemetry row, and executes a telecommand when written."""
        _check_size(key, row, type_)
        if telecommand is None:
            data_type = datatypes.OCTET_STRING if type_ is None else DATA_TYPES[type_]
            entry = Entry(variable(name, *key, data_type, "ro", mappable=type_ is not None))
            if type_ is None:
                entry.variable.description = row.doc
        else:
            entry, _ = self._command(name, key, self.icd.telecommands[telecommand], type_)
            entry.variable.access_type = "rw"
        self._hold(entry, row)
        entry.reader = partial(self.row_bytes, row)
        return entry, (name,)

    def _record(self, placed: PlacedObject, row: Row) -> Iterator[Named]:
        """Yield an entry for each slot of a row; a write changes one value of the telecommand that the row includes."""
        command = None if placed.telecommand is None else self.icd.telecommands[placed.telecommand]
        reported = {field.telecommand for field in row.named_fields.values()}
        if command is not None and (reported != {command.name} or row.size != command.size):
            raise IcdError(
                f"canopen.toml: {placed.index:04X}h: telemetry {row.name} must include {command.name} alone"
            )
        for subindex, (slot, fields) in enumerate(_slots(row), 1):
            names = [field.name for field in fields]
            entry = _slot_entry(
                " ".join(names), (placed.index, subindex), DATA_TYPES[slot.type], slot, fields
            )
            if command is not None:
                entry.variable.access_type = "rw"
                self._execute_by(entry, command, slot, row)
            self._read_slot(entry, row, slot)
            yield entry, names

    def _value(
        self, name: str, key: Key, value: str | None, telecommand: str | None, type_: str | None = None
    ) -> Named:
        """Return the entry that reads a field, executes a telecommand when written, or both."""
        entry = None
        if telecommand is not None:
            entry, _ = self._command(name, key, self.icd.telecommands[telecommand], type_)
        if value is not None:
            row, slot, fields = self._slot_of(value)
            text = fields[0].kind == "text"
            data_type = datatypes.VISIBLE_STRING if text else DATA_TYPES[slot.type]
            read = _slot_entry(name, key, data_type, slot, fields)
            if entry is None:
                entry = read
            elif entry.variable.data_type != read.variable.data_type:
                raise IcdError(f"canopen.toml: {key[0]:04X}h: {value} and {telecommand} differ in type")
            else:
                entry.variable.access_type = "rw"
            self._read_slot(entry, row, slot)
        return cast("Entry", entry), (name,)

    def _member(self, key: Key, model: PlacedMember) -> Named:
        if model.domain is not None:
            item = variable(model.name, *key, datatypes.DOMAIN, model.domain)
            return Entry(item, reader=_no_data, writer=_no_data), (model.name,)
        if model.parameter is not None:
            return self._parameter(model.name, key, self.icd.parameters[model.parameter])
        return self._value(model.name, key, model.value, model.telecommand)

    def _parameter(self, name: str, key: Key, parameter: Parameter) -> Named:
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
        self.parameters[parameter.name] = key

        def read() -> bytes:
            return encode(item, parameter.to_number(self.sample().parameter(parameter.name)))

        def write(data: bytes) -> None:
            try:
                value = parameter.check(cast("Value", item.decode_raw(data)))
            except MessageError as error:
                raise abort_of(error) from None
            self.application.set_parameter(parameter.name, value)

        return Entry(item, reader=read, writer=write), (name,)

    def _image(self, index: int, name: str) -> Iterator[Named]:
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
            yield Entry(item, reader=partial(self._read_image, item, name, attribute)), ()
        if name == "frame":
            item = variable("take", index, len(parts) + 1, datatypes.UNSIGNED8, "wo", limits=(1, 1))
            item.description = "write 1 to take the frame; the answer comes when it can be read"
            yield Entry(item, writer=lambda _data: self.application.take_image(name)), ()

    def _packed(self, key: Key, model: PackedField) -> Named:
        row, slot, fields = self._slot_of(model.source)
        name = model.name or model.source.partition(".")[2]
        item = variable(name, *key, DATA_TYPES[model.type], "ro", mappable=True)
        _describe(item, fields)
        item.min = item.max = None
        item.factor = model.scale
        self.sources.setdefault(row.name, set()).add(key)
        return Entry(item, reader=lambda: encode(item, self._narrowed(model, row, slot, fields[0]))), (name,)

    def _command(self, name: str, key: Key, row: Row, type_: str | None = None) -> Named:
        """Return the entry whose write executes a telecommand; a PDO maps it only by the index of its object.

        The client writes the only field, all bytes (as a number if a type is given), or 1 if the telecommand has no data.
        """
        _check_size(key, row, type_)
        text = type_ is None and [field.kind for field in row.fields] == ["text"]
        scalar = text or (type_ is None and len(row.slots) == 1 and row.slots[0].type != "bytes")
        if type_ is not None:
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
        entry = Entry(item)
        self._execute_by(entry, row, row.slots[0] if scalar else None)
        return entry, ()

    def _slot_of(self, reference: str) -> tuple[Row, Slot, list[Field]]:
        """Return row, slot and fields of the slot of a field, `ROW.FIELD`."""
        row_name, _, field_name = reference.partition(".")
        row = self.icd.telemetry[row_name]
        for slot, fields in _slots(row):
            if any(field.name == field_name for field in fields):
                return row, slot, fields
        raise IcdError(f"canopen.toml: telemetry {row_name} has no field {field_name!r}")

    # --- what reads and writes the device ---

    def _hold(self, entry: Entry, row: Row, slot: Slot | None = None) -> None:
        """Note that an entry reads a telemetry row, or a slot of it."""
        self.sources.setdefault(row.name, set()).add(entry.key)
        self._holders[row.kind, row.name, None if slot is None else slot.index] = entry.key

    def _read_slot(self, entry: Entry, row: Row, slot: Slot) -> None:
        is_text = entry.variable.data_type == datatypes.VISIBLE_STRING

        def read() -> bytes:
            value = in_order(slot, self.row_bytes(row)[span_of(slot)])
            return value.rstrip(b"\0") if is_text else value

        entry.reader = read
        self._hold(entry, row, slot)

    def _execute_by(self, entry: Entry, row: Row, part: Slot | None, reported: Row | None = None) -> None:
        """Let a write to an entry execute a telecommand: all its data, or a part beside the values that a row reports."""
        if entry.size is None:
            entry.maximum_size = row.size
        entry.writer = partial(self._execute, row, part, reported)
        self._holders[row.kind, row.name, None if part is None else part.index] = entry.key

    def _execute(self, row: Row, part: Slot | None, reported: Row | None, data: bytes) -> Deferred | None:
        payload = data
        if row.size == 0:
            payload = b""
        elif part is not None:
            whole = bytearray(row.size if reported is None else self.row_bytes(reported))
            whole[span_of(part)] = in_order(part, data).ljust(part.size, b"\0")
            payload = bytes(whole)
        if len(payload) < row.size:
            raise SdoAbortError(AbortCode.LENGTH_LOW, f"{row.name}: {len(payload)} bytes, {row.size} needed")
        try:
            row.decode(payload)
        except MessageError as error:
            raise abort_of(error) from None
        return self.application.telecommand(row, payload)

    def _read_image(self, item: ODVariable, name: str, attribute: str) -> bytes:
        return encode(item, getattr(self.application.image(name), attribute))

    def _narrowed(self, packed: PackedField, row: Row, slot: Slot, field: Field) -> int:
        data = self.row_bytes(row)
        if field.width:
            raw = int.from_bytes(data[span_of(slot)], slot.order)
        else:
            value = row.decode(data)[field.name]
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


def _slots(row: Row) -> list[tuple[Slot, list[Field]]]:
    """Return the slots of a row that have named fields, each with its fields."""
    slots = []
    for slot in row.slots:
        fields = [field for field in row.named_fields.values() if field.slot.index == slot.index]
        if fields:
            slots.append((slot, fields))
    return slots


def _check_size(key: Key, row: Row, type_: str | None) -> None:
    """Reject a type that does not hold exactly the data of a row."""
    if type_ is not None and type_size(DATA_TYPES[type_]) != row.size:
        raise IcdError(
            f"canopen.toml: {key[0]:04X}h: {row.name} has {row.size} bytes, not the size of {type_}"
        )


def _no_data(_data: bytes = b"") -> NoReturn:
    raise SdoAbortError(AbortCode.NO_DATA, "no file")


def span_of(slot: Slot) -> slice:
    return slice(slot.offset, slot.offset + slot.size)


def in_order(slot: Slot, data: bytes) -> bytes:
    """Convert bytes between the byte order of a slot and CANopen's, little-endian."""
    return data[::-1] if slot.order == "big" and slot.type != "bytes" else data


def _slot_entry(name: str, key: Key, data_type: int, slot: Slot, fields: list[Field]) -> Entry:
    item = variable(name, *key, data_type, "ro", mappable=slot.type != "bytes")
    _describe(item, fields)
    return Entry(item)


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
