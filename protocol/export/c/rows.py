"""The rows of a definition as C code: IDs, structures of physical values, and codecs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

from starhil.protocol.export.describe import meaning
from starhil.protocol.export.packets import key_of
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row, Slot
from starhil.protocol.icd.quoting import Scope, c_comment, c_member, c_string, identifier, one_line
from starhil.protocol.icd.values import INTEGER_RANGES, EnumDefinition, Value, representable

FLOAT_STEPS: Final = 2.0**18
"""Most steps between zero and the ends of a scaled integer whose member is a `float`: each step is 64 times its rounding."""

MAP: Final = "map"
"""Name of every enumeration that a field has by its `map`."""


class RowCode:
    """Writes the C code of the rows of a definition; every declared name begins with `prefix`, and is claimed in `scope`."""

    def __init__(self, icd: InterfaceDefinition, prefix: str, scope: Scope) -> None:
        self._prefix = prefix
        self.scope = scope
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
            declared = (name, f"{name}_t", f"{name}_encode", f"{name}_decode", f"{name}_check")
            macros = (f"{name}_{part}".upper() for part in ("ID", "SIZE", "INIT"))
            for claimed in (*declared, *macros):
                scope.claim(claimed, f"{row.kind} {row.name}")

    def _add_enumeration(self, name: str, enum: EnumDefinition, owner: str) -> None:
        self.scope.claim(f"is_in_{name}", owner)
        for member in enum.values:
            self.scope.claim(self._constant(name, member), f"{owner}: {one_line(member)!r}")
        self.enumerations[name] = enum

    def fill(self, icd: InterfaceDefinition, key_type: str) -> tuple[str, str]:
        values: dict[str, Any] = {
            "prefix": self._prefix.upper(),
            "rows": [(row, self._name(row), key_of(icd, row)) for row in icd.rows],
            "telemetry": [self._name(row) for row in icd.telemetry.values()],
            "enumerations": self.enumerations,
            "constant": self._constant,
            "integer": lambda value: _integer(value, signed=value < 0),
            "comment": c_comment,
            "about": lambda row, field: c_comment(": ".join(filter(None, (field.unit, meaning(row, field))))),
            "declarator": _declarator,
            "initial": self._initials,
            "checks": _checks,
            "encoded": lambda row: [line for slot in row.slots for line in _encode(row, slot)],
            "decoded": _decode,
            "key_type": key_type,
        }
        return fill("c/rows.h.j2", **values), fill("c/rows.c.j2", **values)

    def membership(self, name: str) -> str:
        """Return a function that tests whether a number is in an enumeration."""
        cases = "\n".join(f"    case {value}:" for value in self.enumerations[name].values.values())
        return (
            f"static bool is_in_{name}(int64_t value)\n{{\n    switch (value) {{\n{cases}\n        return true;\n"
            "    default:\n        return false;\n    }\n}"
        )

    def _name(self, row: Row) -> str:
        return f"{self._prefix}_{'tc' if row.kind == 'telecommand' else 'tlm'}_{row.name}"

    def _constant(self, enum: str, member: str) -> str:
        return identifier(f"{self._prefix}_{enum}_{member}").upper()

    def _initials(self, row: Row) -> str:
        return ", ".join(
            f".{c_member(name)} = {self._initial(row, field, row.example()[name])}"
            for name, field in row.named_fields.items()
        )

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
                return _literal(field, float(value))
            case _:
                return _integer(int(value), signed=_signed(field))


def enum_name(row: Row, field: Field) -> str:
    """Return the name of a field's enumeration; one defined in the field itself has the field's name."""
    if field.enum is None or field.enum.name == MAP:
        return f"{row.name}_{field.name}"
    return field.enum.name


def is_single(field: Field) -> bool:
    """Whether the member of a number with a fraction is a `float`, which distinguishes all its values."""
    if field.kind == "float":
        return field.type == "f32" and not field.scaled
    offset = abs(field.bias / field.scale)
    return field.scaled and max(map(abs, field.raw_limits)) + offset < FLOAT_STEPS


def _literal(field: Field, value: float) -> str:
    return f"{value!r}f" if is_single(field) else repr(value)


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
        case _ if is_single(field):
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


def _checks(row: Row) -> list[tuple[int, str]]:
    """Return the tests of the members against their limits, each with the number of its member."""
    tests = ((index, _check(row, field)) for index, field in enumerate(row.named_fields.values(), 1))
    return [(index, test) for index, test in tests if test]


def _check(row: Row, field: Field) -> str:
    """Return the test whether a member exceeds its limits; empty if its type cannot."""
    value = f"values->{c_member(field.name)}"
    match field.kind:
        case "enum" if field.enum is not None:
            return f"!is_in_{enum_name(row, field)}({value})"
        case "float":
            return _check_float(field, value)
        case "integer" | "bits" if field.scaled:
            return f"!{_to_raw(field, value)}"
        case "integer" | "bits":
            low, high = field.raw_limits
            type_ = _declarator(field).split("_t ")[0].replace("int", "i").replace("ui", "u")
            least, greatest = INTEGER_RANGES[type_]
            tests = [f"{value} < {_integer(low, signed=_signed(field))}"] * (low > least)
            tests += [f"{value} > {_integer(high, signed=_signed(field))}"] * (high < greatest)
            return " || ".join(f"({test})" for test in tests) if len(tests) > 1 else "".join(tests)
        case _:
            return ""


def _check_float(field: Field, value: str) -> str:
    """Return the test whether a number is not finite or exceeds its limits; a comparison with what is no number is false."""
    low, high = representable(*field.physical_limits, field.type)
    largest = "FLT_MAX" if is_single(field) else "DBL_MAX"
    lowest = _literal(field, low) if math.isfinite(low) else f"-{largest}"
    highest = _literal(field, high) if math.isfinite(high) else largest
    return f"!(({value} >= {lowest}) && ({value} <= {highest}))"


def _to_raw(field: Field, value: str) -> str:
    low, high = (_literal(field, float(limit)) for limit in field.raw_limits)
    function = "to_raw_single" if is_single(field) else "to_raw"
    return f"{function}({_unscaled(field, value)}, {low}, {high}, &raw)"


def _unscaled(field: Field, value: str) -> str:
    unbiased = f"({value} - {_literal(field, field.bias)})" if field.bias else value
    return f"{unbiased} / {_literal(field, field.scale)}"


# --- encoding and decoding ---


def _encode(row: Row, slot: Slot) -> Iterator[str]:
    fields = [field for field in row.fields if field.slot is slot and field.name]
    where = f"&data[{slot.offset}]"
    if not fields:
        yield f"(void)memset({where}, 0, {slot.size}u);"
        return
    if fields[0].width:
        plain = " | ".join(
            _shifted(f"(uint64_t)values->{c_member(field.name)}", "<<", field)
            for field in fields
            if not field.scaled
        )
        scaled = [field for field in fields if field.scaled]
        if scaled:
            yield f"bits = {plain or '0u'};"
        for field in scaled:
            yield f"(void){_to_raw(field, f'values->{c_member(field.name)}')};"
            yield f"bits |= {_shifted('raw', '<<', field)};"
        yield _put_statement(slot, "bits" if scaled else plain)
        return
    (field,) = fields
    value = f"values->{c_member(field.name)}"
    match field.kind:
        case "bytes":
            yield f"(void)memcpy({where}, {value}, {slot.size}u);"
        case "text":
            index = list(row.named_fields).index(field.name) + 1
            yield f"if (!put_text({where}, {slot.size}u, {value})) {{\n    return {index};\n}}"
        case "float":
            raw = _unscaled(field, value) if field.scaled else value
            convert = "float_bits((float)({}))" if field.type == "f32" else "double_bits({})"
            yield _put_statement(slot, convert.format(raw))
        case _ if field.scaled:
            yield f"(void){_to_raw(field, value)};"
            yield _put_statement(slot, "raw")
        case _:
            yield _put_statement(slot, f"(uint64_t){value}")


def _shifted(value: str, operator: str, field: Field) -> str:
    """Return a value shifted to the bits of a field, or from them."""
    return f"({value} {operator} {field.shift})" if field.shift else value


def _put_statement(slot: Slot, value: str) -> str:
    return f"put_{_suffix(slot)}(&data[{slot.offset}], {slot.size}u, {value});"


def _suffix(slot: Slot) -> str:
    return "le" if slot.order == "little" else "be"


def _decode(field: Field) -> str:
    value = f"values->{c_member(field.name)}"
    place = f"&data[{field.offset}], {field.size}u"
    raw = f"get_{_suffix(field.slot)}({place})"
    if field.kind == "bytes":
        return f"(void)memcpy({value}, {place});"
    if field.kind == "text":
        return f"get_text({place}, {value});"
    if field.kind == "float":
        raw = f"to_float({raw})" if field.type == "f32" else f"to_double({raw})"
        return f"{value} = {_scaled(field, raw)};"
    if field.width:
        raw = f"({_shifted(raw, '>>', field)} & {2**field.width - 1:#x}u)"
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
    factor = f"/ {_literal(field, float(divisor))}" if divisor else f"* {_literal(field, field.scale)}"
    scaled = f"({'float' if is_single(field) else 'double'}){raw} {factor}"
    return f"({scaled}) + {_literal(field, field.bias)}" if field.bias else scaled
