"""A serial link composed of framing, check and headers, as C code."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from starhil.protocol.checks import reversed_bits
from starhil.protocol.envelope import Header, HeaderField
from starhil.protocol.export.packets import row_key
from starhil.protocol.link_schema import (
    CrcCheck,
    DelimitedFraming,
    EscapedFraming,
    SlipFraming,
    SumCheck,
    XorCheck,
    XxHashCheck,
)
from starhil.protocol.messages import RequestKind
from starhil.protocol.serial_stack import RowShape, SerialStack
from starhil.protocol.values import IcdError

_MARKS: Final = 8
"""Maximum size of the start and end marks of a message, in bytes, apart from those in a definition."""


def link_parts(stack: SerialStack) -> tuple[str, str, str]:
    """Return the declarations of the link, its helper functions, and its source.

    Raises IcdError for a part of the link that is Python code or not supported.
    """
    framing = "counted" if stack.link.framing.kind in ("length", "fixed") else stack.link.framing.kind
    header = max(stack.request_header.size(name) for name in ("", *stack.classes.by_name))
    marks = len(stack.framing.start) + len(stack.framing.end) + _MARKS
    sizes = {
        "MAX_MESSAGE": stack.max_size,
        "BUFFER": (2 if framing == "delimited" else 1) * stack.max_size + marks,
        "OVERHEAD": header + stack.check.size,
        "MARKS": marks,
        "HEADER": max(header, 1),
        "CHECK": max(stack.check.size, 1),
    }
    writer = _Writer(stack)
    functions = (
        *writer.row_tests(), writer.header_size(), writer.lengths(), writer.pack_header(), writer.unpack_header(),
        _snippet("checks", stack.link.check.kind), writer.put_check(),
    )  # fmt: skip
    helpers = "\n\n".join((_OUTPUT, *functions))
    source = "\n".join(
        (_template("composed_reply.c"), _snippet("framings", framing), _template("composed.c"), _RECEIVE)
    )
    constants = [
        text for name, text in writer.constants().items() if re.search(rf"\b{name}\b", helpers + source)
    ]
    head = "\n".join((*constants, "", _TYPES, ""))

    def sized(text: str) -> str:
        return re.sub(r"@(\w+)@", lambda match: str(sizes[match[1]]), text)

    return sized(_template("composed.h")), helpers, sized(f"{head}\0{source}")


class _Writer:
    """Writes the functions that depend on headers, rows and check."""

    def __init__(self, stack: SerialStack) -> None:
        self._stack = stack
        self._classes = stack.classes.by_name
        self._keys = {row_key(stack.classes.classes, row.klass, row.id): row for row in stack.rows}
        self._coded = "class" in stack.request_header.roles

    def constants(self) -> dict[str, str]:
        """Declarations of the constants that the code uses, by name."""
        stack = self._stack
        found = {
            "START_SIZE": f"static const size_t START_SIZE = {len(stack.framing.start)}u;",
            "END_SIZE": f"static const size_t END_SIZE = {len(stack.framing.end)}u;",
            "CHECK_SIZE": f"static const size_t CHECK_SIZE = {stack.check.size}u;",
            "start_bytes": f"static const uint8_t start_bytes[] = {{{_bytes(stack.framing.start)}}};",
            "end_bytes": f"static const uint8_t end_bytes[] = {{{_bytes(stack.framing.end)}}};",
        }
        match stack.link.framing:
            case SlipFraming() as model:
                macros = {
                    "END_BYTE": model.end, "ESCAPE": model.escape, "ESCAPED_END": model.escaped[0],
                    "ESCAPED_ESCAPE": model.escaped[1], "LEADING_END": int(model.leading_end),
                }  # fmt: skip
            case EscapedFraming() as model:
                macros = {"ESCAPE": model.escape, "START_BYTE": model.start, "END_BYTE": model.end}
            case DelimitedFraming() as model:
                macros = {"IS_HEX": int(model.encoding == "hex")}
            case _:
                macros = {}
        if isinstance(stack.link.check, CrcCheck):
            bits = 8 * stack.check.size
            poly = stack.link.check.poly
            macros |= {
                "CRC_BITS": bits, "CRC_MASK": (1 << bits) - 1, "CRC_REFLECTED": int(stack.link.check.reflect),
                "CRC_POLYNOMIAL": reversed_bits(poly, bits) if stack.link.check.reflect else poly,
            }  # fmt: skip
        return found | {name: f"#define {name} {_number(value)}" for name, value in macros.items()}

    def row_tests(self) -> Iterator[str]:
        """Functions that test the kind of a row."""
        check = self._stack.check.size
        yield _test("is_row", self._keys)
        yield _test("is_telecommand", self._select(lambda row: row.kind is RequestKind.TELECOMMAND))
        yield _test("has_echo", self._select(lambda row: "echo" in row.answers))
        yield _test("has_reply", self._select(lambda row: "reply" in row.answers))
        yield self._lookup(
            "request_body_size", "size_t", lambda row: self._header_size(row) + row.request_size + check
        )
        yield self._lookup("reply_size", "long", lambda row: row.reply_size, -1)

    def header_size(self) -> str:
        """Function that returns the size of a request header."""
        return self._lookup("header_size", "size_t", self._header_size)

    def _header_size(self, row: RowShape) -> int:
        return self._stack.request_header.size(row.klass)

    def _select(self, test: Callable[[RowShape], bool]) -> list[int]:
        return [key for key, row in self._keys.items() if test(row)]

    def _lookup(self, name: str, kind: str, value: Callable[[RowShape], int], otherwise: int = 0) -> str:
        cases = "".join(
            f"\n    case {_number(key)}:\n        return {value(row)};" for key, row in self._keys.items()
        )
        return f"static {kind} {name}(uint32_t id)\n{{\n    switch (id) {{{cases}\n    default:\n        return {otherwise};\n    }}\n}}"

    def lengths(self) -> str:
        """Functions that return the value of the length field in a request and in a reply."""
        headers = {"request_length": self._stack.request_header, "length_of": self._stack.reply_header}
        return "\n\n".join(_length(name, self._stack, header) for name, header in headers.items())

    def pack_header(self) -> str:
        """Function that packs a request header."""
        lines = []
        for field in self._stack.request_header.fields:
            put = (
                f"put_{_suffix(field)}(out, {field.size}u, {self._packed(field)});\n    out += {field.size}u;"
            )
            lines.append(self._for_classes(field, "id >> 8", put))
        steps = "\n    ".join((*lines, "(void)id;", "(void)size;", "(void)out;"))
        return f"static void pack_header(uint32_t id, size_t size, uint8_t *out)\n{{\n    {steps}\n}}"

    def _packed(self, field: HeaderField) -> str:
        if field.bits:
            return " | ".join(
                f"(uint64_t)({self._role(bit.role, bit.default)}) << {bit.shift}" for bit in field.bits
            )
        if field.role == "length":
            return "request_length(header_size(id), size)"
        return self._role(field.role, field.default, (1 << 8 * field.size) - 1)

    def _role(self, role: str | None, default: int, mask: int = -1) -> str:
        if role == "id":
            return "id & 0xFFu" if self._coded else "id"
        return "id >> 8" if role == "class" else _number(default & mask)

    def _for_classes(self, field: HeaderField, code: str, statements: str) -> str:
        if field.classes is None:
            return statements
        tests = " || ".join(f"({code}) == {self._classes[name].code or 0}u" for name in sorted(field.classes))
        return f"if ({tests}) {{\n        " + statements.replace("\n", "\n    ") + "\n    }"

    def unpack_header(self) -> str:
        """Function that unpacks a reply header."""
        header = self._stack.reply_header
        lines = []
        for field in header.fields:
            steps = [f"if (size < at + {field.size}u) {{\n        return HEAD_SHORT;\n    }}"]
            steps.append(f"value = get_{_suffix(field)}(body + at, {field.size}u);\n    at += {field.size}u;")
            if field.const is not None and field.role != "address":
                steps.append(f"if (value != {_number(field.const)}) {{\n        return HEAD_BAD;\n    }}")
            parts = [(field.role, "value")] + [
                (bit.role, f"(value >> {bit.shift} & {_number(bit.mask)})") for bit in field.bits
            ]
            steps += [self._read(role, value) for role, value in parts if role]
            lines.append(self._for_classes(field, "klass", "\n    ".join(steps)))
        by_id = "id" in header.roles
        key = "head->id = (klass << 8) | id;" if self._coded and by_id else "head->id = id;" if by_id else ""
        if "length" in header.roles:
            size = "head->data_size = (long)head->length - (long)length_of(at, 0u);"
        else:
            size = "head->data_size = head->is_refused ? 0 : reply_size(head->id);"
        return (
            "static int unpack_header(const unit_receiver_t *receiver, const uint8_t *body, size_t size, head_t *head)\n{\n"
            "    size_t at = 0u;\n    uint64_t value = 0u;\n    uint32_t klass = 0u, id = 0u;\n"
            "    memset(head, 0, sizeof *head);\n    head->is_ours = head->is_final = true;\n    head->id = receiver->pending;\n    "
            + "\n    ".join([*lines, key])
            + f"\n    head->size = at;\n    head->has_row = is_row(head->id){'' if by_id else ' && receiver->is_pending'};\n    {size}\n"
            "    (void)body, (void)size, (void)value, (void)klass, (void)id;\n    return HEAD_WHOLE;\n}"
        )

    def _read(self, role: str, value: str) -> str:
        match role:
            case "address":
                return f"head->is_ours = {value} == {_number(self._stack.reply_header.defaults['address'])};"
            case "class":
                cases = "".join(
                    f"\n    case {code}u:\n        {steps}\n        break;"
                    for code, steps in self._reply_classes()
                )
                return f"switch ({value}) {{{cases}\n    default:\n        return HEAD_BAD;\n    }}"
            case "id":
                return f"id = (uint32_t){value};"
            case "status":
                return f"head->status = (uint32_t){value};\n    head->is_refused = head->is_refused || {value} != 0u;"
            case "ack":
                return f"head->is_refused = head->is_refused || {value} == 0u;"
            case "final":
                return f"head->is_final = {value} != 0u;"
            case "ticks" | "time" | "length":
                return f"head->{role} = {value};"
            case _:
                return ""

    def _reply_classes(self) -> Iterator[tuple[int, str]]:
        for item in self._classes.values():
            if item.code is None:
                continue
            yield (item.code if item.reply is None else item.reply), f"klass = {item.code}u;"
            if item.unsolicited is not None:
                yield item.unsolicited, f"klass = {item.code}u;\n        head->is_unsolicited = true;"

    def put_check(self) -> str:
        """Function that computes the check of a body."""
        model, check = self._stack.link.check, self._stack.check
        initial, result = "0u", "state"
        match model:
            case SumCheck():
                result = {"none": "state", "ones": "~state", "twos": "~state + 1u"}[model.complement]
            case XorCheck():
                initial = _number(model.init)
            case CrcCheck():
                bits = 8 * check.size
                initial = _number(reversed_bits(model.init, bits) if model.reflect else model.init)
                result = f"state ^ {_number(model.xor)}"
            case XxHashCheck():
                initial = _number(model.seed)
            case _:
                pass
        parts = {
            "start": "start_bytes, START_SIZE",
            "header": "body, header",
            "data": "body + header, end - header",
        }
        used = [text for name, text in parts.items() if name in check.covers]
        if {"header", "data"} <= check.covers:
            used = [*used[:-2], "body, end"]
        if isinstance(model, XxHashCheck) and len(used) != 1:
            raise IcdError(
                "link.serial.check: xxh32 over separate parts cannot be exported to C; cover header and data"
            )
        order = getattr(model, "order", None) or self._stack.byte_order
        steps = "\n    ".join(f"state = check(state, {text});" for text in used)
        return (
            "static void put_check(const uint8_t *body, size_t header, size_t end, uint8_t *tail)\n{\n"
            f"    uint64_t state = {initial};\n    {steps}\n    put_{'le' if order == 'little' else 'be'}(tail, {check.size}u, {result});\n"
            "    (void)body;\n    (void)header;\n    (void)end;\n}"
        )


def _length(name: str, stack: SerialStack, header: Header) -> str:
    sizes = {"start": str(len(stack.framing.start)), "header": "header", "data": "size", "check": str(stack.check.size), "end": str(len(stack.framing.end))}  # fmt: skip
    fields = [field for field in header.fields if field.role == "length"]
    terms = " + ".join(sizes[part] for part in sorted(fields[0].includes)) if fields else "0u"
    return f"static uint64_t {name}(size_t header, size_t size)\n{{\n    (void)header;\n    (void)size;\n    return {terms};\n}}"


def _test(name: str, keys: Iterable[int]) -> str:
    cases = "".join(f"\n    case {_number(key)}:" for key in keys)
    body = (
        f"switch (id) {{{cases}\n        return true;\n    default:\n        return false;\n    }}"
        if cases
        else "(void)id;\n    return false;"
    )
    return f"static bool {name}(uint32_t id)\n{{\n    {body}\n}}"


def _suffix(field: HeaderField) -> str:
    return "le" if field.order == "little" else "be"


def _number(value: int) -> str:
    return f"{value:#x}u" if value < 2**32 else f"UINT64_C({value:#x})"


def _bytes(data: bytes) -> str:
    return ", ".join(f"{byte:#04x}" for byte in data or b"\0")


def _template(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def _snippet(name: str, kind: str) -> str:
    """Return the part of a file under a heading."""
    found = re.search(rf"^// {kind}\n(.*?)(?=^// \w+$|\Z)", _template(f"{name}.c"), re.MULTILINE | re.DOTALL)
    if found is None:
        raise IcdError(
            f"link.serial: {name} of kind {kind!r} is Python code in the unit's plugin and cannot be exported"
        )
    return found[1].strip("\n") + "\n"


_TYPES: Final = """\
typedef struct {
    uint8_t *bytes;
    size_t capacity, size;
} output_t;

/* Content of a reply header. */
typedef struct {
    size_t size;
    long data_size; /* -1: invalid */
    bool is_ours, has_row, is_refused, is_unsolicited, is_final;
    uint32_t id, status;
    uint64_t ticks, time, length;
} head_t;

enum { HEAD_SHORT, HEAD_WHOLE, HEAD_BAD };"""

_OUTPUT: Final = """\
static void put_raw(output_t *output, uint8_t byte)
{
    output->bytes[output->size++] = byte;
}

static void put_plain(output_t *output, const uint8_t *bytes, size_t size)
{
    while (size-- > 0u) {
        put_raw(output, *bytes++);
    }
}"""

_RECEIVE: Final = """\
unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    memmove(receiver->bytes, receiver->bytes + receiver->taken, receiver->size - receiver->taken);
    receiver->size -= receiver->taken;
    receiver->taken = 0u;
    memset(message, 0, sizeof *message);
    message->kind = advance(receiver, byte, message);
    return message->kind;
}"""
