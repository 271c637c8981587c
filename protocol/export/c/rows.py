"""The rows of a definition as C code: IDs, structures of physical values, and codecs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator
from typing import Final

from starhil.protocol.codec import Field, Row, Slot
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.export.describe import meaning
from starhil.protocol.quoting import Scope, c_comment, c_member, c_string, identifier, one_line
from starhil.protocol.values import INTEGER_RANGES, EnumDefinition, Value, to_f32

MAP: Final = "map"
"""Name of every enumeration that a field has by its `map`."""


class RowCode:
    """Writes the C code of the rows of a definition.

    Parameters
    ----------
    icd
        The definition.
    prefix
        Beginning of every declared name.
    scope
        Names that the rest of the code uses; those of the rows are claimed in it.
    """

    def __init__(self, icd: InterfaceDefinition, prefix: str, scope: Scope) -> None:
        self._prefix = prefix
        self._scope = scope
        self.enumerations: Final[dict[str, EnumDefinition]] = {}
        """The enumerations of the definition and of the fields of its rows, by name in C."""
        for name, enum in icd.enums.items():
            self._add_enumeration(name, enum, f"enumeration {name}")
        for row in icd.rows:
            for field in row.fields:
                if field.enum is not None and field.enum.name == MAP:
                    self._add_enumeration(
                        enum_name(row, field), field.enum, f"map of {row.name}.{field.name}"
                    )
            name = self._name(row)
            declared = (name, f"{name}_t", f"{name}_encode", f"{name}_decode", f"check_{name}")
            macros = (f"{name}_{part}".upper() for part in ("ID", "SIZE", "INIT"))
            for claimed in (*declared, *macros):
                scope.claim(claimed, f"{row.kind} {row.name}")

    def _add_enumeration(self, name: str, enum: EnumDefinition, owner: str) -> None:
        self._scope.claim(f"is_in_{name}", owner)
        for member in enum.values:
            self._scope.claim(self._constant(name, member), f"{owner}: {one_line(member)!r}")
        self.enumerations[name] = enum

    def enumeration(self, name: str) -> Iterator[str]:
        """Yield the constants of an enumeration."""
        yield from filter(None, [c_comment(self.enumerations[name].doc)])
        for member, value in self.enumerations[name].values.items():
            yield f"#define {self._constant(name, member)} {_integer(value, signed=value < 0)}"
        yield ""

    def membership(self, name: str) -> str:
        """Return a function that tests whether a number is in an enumeration."""
        cases = "\n".join(f"    case {value}:" for value in self.enumerations[name].values.values())
        return (
            f"static bool is_in_{name}(int64_t value)\n{{\n    switch (value) {{\n{cases}\n        return true;\n"
            "    default:\n        return false;\n    }\n}"
        )

    def declaration(self, row: Row, key: int) -> Iterator[str]:
        """Yield the declarations of a row: ID, size, structure and functions."""
        name = self._name(row)
        yield c_comment(f"{row.kind.capitalize()} {row.id}. {row.doc}")
        yield f"#define {name.upper()}_ID {key}u"
        yield f"#define {name.upper()}_SIZE {row.size}u"
        if row.named_fields:
            yield "typedef struct {"
            for field in row.named_fields.values():
                about = c_comment(": ".join(filter(None, (field.unit, meaning(row, field)))))
                yield from filter(None, [textwrap.indent(about, "    ")])
                yield f"    {_declarator(field)};"
            yield f"}} {name}_t;"
            if row.kind == "telecommand":
                values = ", ".join(
                    f".{c_member(field.name)} = {self._initial(row, field, row.example()[key])}"
                    for key, field in row.named_fields.items()
                )
                yield f"#define {name.upper()}_INIT {{ {values} }}"
            yield f"int {name}_encode(const {name}_t *values, uint8_t data[{name.upper()}_SIZE]);"
            yield f"int {name}_decode(const uint8_t *data, size_t size, {name}_t *values);"
        yield ""

    def definition(self, row: Row) -> Iterator[str]:
        """Yield the codec of a row."""
        if not row.named_fields:
            return
        name = self._name(row)
        ok, bad_length = (f"{self._prefix.upper()}_{result}" for result in ("OK", "BAD_LENGTH"))
        checks = [
            line
            for index, field in enumerate(row.named_fields.values(), 1)
            for line in _check(row, field, index)
        ]
        if checks:
            yield f"static int check_{name}(const {name}_t *values)\n{{"
            if any("&raw" in line for line in checks):
                yield "    uint64_t raw;"
            yield from checks
            yield f"    return {ok};\n}}\n"
        checked = f"check_{name}(values)"
        encoded = [line for slot in row.slots for line in _encode(row, slot)]
        yield f"int {name}_encode(const {name}_t *values, uint8_t data[{name.upper()}_SIZE])\n{{"
        if any("&raw" in line for line in encoded):
            yield "    uint64_t raw;"
        if checks:
            yield f"    const int result = {checked};"
            yield f"    if (result != {ok}) {{\n        return result;\n    }}"
        yield from encoded
        yield f"    return {ok};\n}}\n"
        yield f"int {name}_decode(const uint8_t *data, size_t size, {name}_t *values)\n{{"
        yield f"    if (size != {name.upper()}_SIZE) {{\n        return {bad_length};\n    }}"
        yield from (f"    {_decode(field)}" for field in row.named_fields.values())
        yield f"    return {checked if checks and row.kind == 'telecommand' else ok};\n}}\n"

    def telemetry_size(self, telemetry: Iterable[Row], key_type: str) -> Iterator[str]:
        """Yield a function that returns the size of a telemetry row."""
        yield f"int {self._prefix}_telemetry_size({key_type} id)\n{{\n    switch (id) {{"
        for row in telemetry:
            name = self._name(row).upper()
            yield f"    case {name}_ID:\n        return (int){name}_SIZE;"
        yield "    default:\n        return -1;\n    }\n}\n"

    def _name(self, row: Row) -> str:
        return f"{self._prefix}_{'tc' if row.kind == 'telecommand' else 'tlm'}_{row.name}"

    def _constant(self, enum: str, member: str) -> str:
        return identifier(f"{self._prefix}_{enum}_{member}").upper()

    def _initial(self, row: Row, field: Field, value: Value) -> str:
        if field.enum is not None and isinstance(value, str):
            return self._constant(enum_name(row, field), value)
        match value:
            case bool():
                return str(value).lower()
            case bytes():
                return "{ 0 }"
            case str():
                return c_string(value)
            case _ if field.scaled or field.kind == "float":
                return repr(float(value))
            case _:
                return _integer(int(value), signed=_signed(field))


def enum_name(row: Row, field: Field) -> str:
    """Return the name of a field's enumeration; one defined in the field itself has the field's name."""
    if field.enum is None or field.enum.name == MAP:
        return f"{row.name}_{field.name}"
    return field.enum.name


def _signed(field: Field) -> bool:
    return not field.width and field.type.startswith("i")


def _declarator(field: Field) -> str:
    """Return type and name of a member."""
    member = c_member(field.name)
    match field.kind:
        case "flag":
            return f"bool {member}"
        case "bytes":
            return f"uint8_t {member}[{field.size}]"
        case "text":
            return f"char {member}[{field.size + 1}]"
        case "float" if field.type == "f32" and not field.scaled:
            return f"float {member}"
        case _ if field.scaled or field.kind == "float":
            return f"double {member}"
        case _:
            size = next(size for size in (8, 16, 32, 64) if size >= field.bit_count)
            return f"{'int' if _signed(field) else 'uint'}{size}_t {member}"


def _integer(value: int, *, signed: bool) -> str:
    if abs(value) < 2**31:
        return f"{value}" if signed else f"{value}u"
    return f"INT64_C({value})" if signed else f"UINT64_C({value})"


# --- checks ---


def _check(row: Row, field: Field, index: int) -> Iterator[str]:
    """Yield the test of a member against its limits; none if its type cannot exceed them."""
    value = f"values->{c_member(field.name)}"
    test = ""
    match field.kind:
        case "enum" if field.enum is not None:
            test = f"!is_in_{enum_name(row, field)}({value})"
        case "float":
            test = _check_float(row, field, value)
        case "integer" | "bits" if field.scaled:
            test = f"!{_to_raw(field, value)}"
        case "integer" | "bits":
            low, high = field.raw_limits
            least, greatest = INTEGER_RANGES[
                _declarator(field).split("_t ")[0].replace("int", "i").replace("ui", "u")
            ]
            tests = []
            if low > least:
                tests.append(f"{value} < {_integer(low, signed=_signed(field))}")
            if high < greatest:
                tests.append(f"{value} > {_integer(high, signed=_signed(field))}")
            test = " || ".join(tests)
    if test:
        yield f"    if ({test}) {{\n        return {index};\n    }}"


def _check_float(row: Row, field: Field, value: str) -> str:
    low, high = field.physical_limits
    if field.type == "f32":
        low, high = min(low, to_f32(low)), max(high, to_f32(high))
    if row.kind == "telemetry":  # which may carry what is no number
        tests = [f"{value} < {low!r}"] * (field.minimum is not None)
        return " || ".join(tests + [f"{value} > {high!r}"] * (field.maximum is not None))
    lowest = repr(low) if math.isfinite(low) else "-DBL_MAX"
    return f"!({value} >= {lowest} && {value} <= {repr(high) if math.isfinite(high) else 'DBL_MAX'})"


def _to_raw(field: Field, value: str) -> str:
    low, high = field.raw_limits
    return f"to_raw({_unscaled(field, value)}, {float(low)!r}, {float(high)!r}, &raw)"


def _unscaled(field: Field, value: str) -> str:
    return f"({value} - {field.bias!r}) / {field.scale!r}"


# --- encoding and decoding ---


def _encode(row: Row, slot: Slot) -> Iterator[str]:
    fields = [field for field in row.fields if field.slot is slot and field.name]
    where = f"data + {slot.offset}"
    if not fields:
        yield f"    memset({where}, 0, {slot.size}u);"
        return
    if fields[0].width:
        bits = " | ".join(f"(uint64_t)values->{c_member(field.name)} << {field.shift}" for field in fields)
        yield f"    {_put_statement(slot, bits)}"
        return
    (field,) = fields
    value = f"values->{c_member(field.name)}"
    match field.kind:
        case "bytes":
            yield f"    memcpy({where}, {value}, {slot.size}u);"
        case "text":
            index = list(row.named_fields).index(field.name) + 1
            yield f"    if (!put_text({where}, {slot.size}u, {value})) {{\n        return {index};\n    }}"
        case "float":
            raw = _unscaled(field, value) if field.scaled else value
            convert = "float_bits((float)({}))" if field.type == "f32" else "double_bits({})"
            yield f"    {_put_statement(slot, convert.format(raw))}"
        case _ if field.scaled:
            yield f"    (void){_to_raw(field, value)};\n    {_put_statement(slot, 'raw')}"
        case _:
            yield f"    {_put_statement(slot, f'(uint64_t){value}')}"


def _put_statement(slot: Slot, value: str) -> str:
    return f"put_{_suffix(slot)}(data + {slot.offset}, {slot.size}u, {value});"


def _suffix(slot: Slot) -> str:
    return "le" if slot.order == "little" else "be"


def _decode(field: Field) -> str:
    value = f"values->{c_member(field.name)}"
    raw = f"get_{_suffix(field.slot)}(data + {field.offset}, {field.size}u)"
    if field.kind == "bytes":
        return f"memcpy({value}, data + {field.offset}, {field.size}u);"
    if field.kind == "text":
        return f"get_text(data + {field.offset}, {field.size}u, {value});"
    if field.kind == "float":
        raw = f"to_float({raw})" if field.type == "f32" else f"to_double({raw})"
        return f"{value} = {_scaled(field, raw)};"
    if field.width:
        raw = f"({raw} >> {field.shift}) & {2**field.width - 1:#x}u"
    if field.kind == "flag":
        return f"{value} = ({raw}) != 0u;"
    if _signed(field):
        raw = f"to_signed({raw}, {field.bit_count}u)"
    if field.scaled:
        return f"{value} = {_scaled(field, raw)};"
    return f"{value} = ({_declarator(field).split(' ')[0]})({raw});"


def _scaled(field: Field, raw: str) -> str:
    if not field.scaled:
        return raw
    divisor = field.divisor if field.kind != "float" else None
    scaled = f"(double){raw} / {float(divisor)!r}" if divisor else f"(double){raw} * {field.scale!r}"
    return f"{scaled} + {field.bias!r}"
