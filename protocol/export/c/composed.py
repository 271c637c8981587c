"""A serial link composed of framing, check and headers, as C code."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby
from operator import attrgetter
from typing import Any, Final

from starhil.protocol.errors import IcdError
from starhil.protocol.export.packets import check_one_format, row_key
from starhil.protocol.export.templates import fill, part_of, text_of
from starhil.protocol.icd.conventions import Order
from starhil.protocol.icd.link_schema import (
    CrcCheck,
    DelimitedFraming,
    EscapedFraming,
    FletcherCheck,
    HeaderFieldModel,
    SlipFraming,
    SumCheck,
    XorCheck,
    XxHashCheck,
)
from starhil.protocol.serial.checks import reversed_bits
from starhil.protocol.serial.headers import HeaderCodec
from starhil.protocol.serial.stack import SerialStack

_MARKS: Final = 8
"""Maximum size of the start and end marks of a message, in bytes, apart from those in a definition."""


def link_parts(stack: SerialStack) -> tuple[str, str, str]:
    """Return the declarations of the link, its helper functions, and its source.

    Raises IcdError for a part of the link that is Python code or not supported.
    """
    check_one_format(stack, "C")
    framing = "counted" if stack.link.framing.kind in ("length", "fixed") else stack.link.framing.kind
    header = max(stack.requests.header.size(name) for name in ("", *stack.classes))
    marks = len(stack.requests.framing.start) + len(stack.requests.framing.end) + _MARKS
    sizes = {
        "MAX_MESSAGE": stack.max_size,
        "BUFFER": (2 if framing == "delimited" else 1) * stack.max_size + marks,
        "OVERHEAD": header + stack.requests.check.size,
        "MARKS": marks,
        "HEADER": max(header, 1),
        "CHECK": max(stack.requests.check.size, 1),
    }
    helpers = fill("c/composed_helpers.c.j2", **_rows(stack), **_headers(stack), **_check(stack)).strip("\n")
    source = "\n".join(
        (
            text_of("c/composed_reply.c"),
            part_of("c/framings.c", framing),
            text_of("c/composed.c"),
            text_of("c/composed_receive.c").rstrip("\n"),
        )
    )
    constants = [
        text for name, text in _constants(stack).items() if re.search(rf"\b{name}\b", helpers + source)
    ]
    head = "\n".join((*constants, "", text_of("c/composed_types.c")))

    def sized(text: str) -> str:
        return re.sub(r"@(\w+)@", lambda match: str(sizes[match[1]]), text)

    return sized(text_of("c/composed.h")), helpers, sized(f"{head}\0{source}")


def _constants(stack: SerialStack) -> dict[str, str]:
    """Return the declarations of the constants that the code uses, by name."""
    constants = {
        "START_SIZE": f"static const size_t START_SIZE = {len(stack.requests.framing.start)}u;",
        "END_SIZE": f"static const size_t END_SIZE = {len(stack.requests.framing.end)}u;",
        "CHECK_SIZE": f"static const size_t CHECK_SIZE = {stack.requests.check.size}u;",
        "start_bytes": f"static const uint8_t start_bytes[] = {{{_bytes(stack.requests.framing.start)}}};",
        "end_bytes": f"static const uint8_t end_bytes[] = {{{_bytes(stack.requests.framing.end)}}};",
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
    if isinstance(stack.link.check, FletcherCheck):
        macros["MODULUS"] = stack.link.check.modulus
    if isinstance(stack.link.check, CrcCheck):
        bits = 8 * stack.requests.check.size
        poly = stack.link.check.poly
        macros |= {
            "CRC_BITS": bits, "CRC_MASK": (1 << bits) - 1, "CRC_REFLECTED": int(stack.link.check.reflect),
            "CRC_POLYNOMIAL": reversed_bits(poly, bits) if stack.link.check.reflect else poly,
        }  # fmt: skip
    return constants | {name: f"#define {name} {_number(value)}" for name, value in macros.items()}


def _rows(stack: SerialStack) -> dict[str, Any]:
    """Return the functions of a row's key: tests of its kind, and its sizes."""
    rows = {row_key(stack.classes, row.message_class, row.id): row for row in stack.rows}
    headers = {key: stack.requests.header.size(row.message_class) for key, row in rows.items()}
    requests = {key: headers[key] + row.request_size + stack.requests.check.size for key, row in rows.items()}
    return {
        "tests": {
            "is_row": list(rows),
            "is_telecommand": [key for key, row in rows.items() if row.kind == "telecommand"],
            "has_echo": [key for key, row in rows.items() if "echo" in row.answers],
            "has_reply": [key for key, row in rows.items() if "reply" in row.answers],
        },
        "lookups": (
            ("size_t", "request_body_size", requests, 0),
            ("long", "reply_size", {key: row.reply_size for key, row in rows.items()}, -1),
            ("size_t", "header_size", headers, 0),
        ),
    }


def _headers(stack: SerialStack) -> dict[str, Any]:
    classes = stack.classes
    coded = "class" in stack.requests.header.roles

    def role(name: str | None, default: int, mask: int = -1) -> str:
        if name == "id":
            return "id & 0xFFu" if coded else "id"
        return "id >> 8" if name == "class" else _number(default & mask)

    def packed(field: HeaderFieldModel) -> str:
        if field.bits:
            return " | ".join(
                f"(uint64_t)({role(bit.role, bit.initial)}) << {shift}" for bit, shift in field.placed_bits
            )
        if field.role == "length":
            return "request_length(header_size(id), size)"
        return role(field.role, field.initial, (1 << 8 * field.size) - 1)

    def class_test(names: list[str], code: str) -> str:
        return " || ".join(f"({code}) == {classes[name].code or 0}u" for name in sorted(names))

    def by_classes(
        fields: Iterable[HeaderFieldModel],
    ) -> list[tuple[list[str] | None, list[HeaderFieldModel]]]:
        """Return the fields in groups of neighbours that the same classes have, None if all have them."""
        return [(names, list(group)) for names, group in groupby(fields, key=attrgetter("classes"))]

    replies = []
    for item in classes.values():
        if item.code is not None:
            replies.append((item.reply_code, item.code, False))
            if item.unsolicited is not None:
                replies.append((item.unsolicited, item.code, True))
    return {
        "number": _number,
        "packed": packed,
        "by_classes": by_classes,
        "class_test": class_test,
        "suffix": lambda field: _suffix(field.order or stack.byte_order),
        "requests": stack.requests.header,
        "replies": stack.replies.header,
        "reply_classes": replies,
        "address": stack.replies.header.defaults.get("address"),
        "coded": coded,
        "lengths": {
            "request_length": _length(stack.requests.header),
            "length_of": _length(stack.replies.header),
        },
    }


def _length(header: HeaderCodec) -> str:
    """Return the value of the length field in a header, as an expression."""
    sizes = {"header": "header", "data": "size"}
    sizes |= {part: str(size) for part, size in header.overhead.items()}
    fields = [field for field in header.fields if field.role == "length"]
    if not fields:
        return "0u"
    counted = " + ".join(sizes[part] for part in sorted(fields[0].includes)) or "0u"
    offset = fields[0].offset
    return f"{counted} {'-' if offset < 0 else '+'} {abs(offset)}u" if offset else counted


def _check(stack: SerialStack) -> dict[str, Any]:
    model, check = stack.link.check, stack.requests.check
    initial, result = "0u", "state"
    order: Order = getattr(model, "order", None) or stack.byte_order
    kind: str = model.kind
    suffix = _suffix(order)
    match model:
        case SumCheck():
            result = {"none": "state", "ones": "~state", "twos": "~state + 1u"}[model.complement]
        case XorCheck():  # the first byte of a word is the first of the checksum
            initial = _number(int.from_bytes(model.init.to_bytes(check.size, order), "big"))
            kind = "xor16" if check.size > 1 else "xor"
            suffix = "be"
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
    return {
        "check_function": part_of("c/checks.c", kind),
        "check_initial": initial,
        "check_result": result,
        "check_size": check.size,
        "check_suffix": suffix,
        "covered": used,
    }


def _suffix(order: str) -> str:
    return "le" if order == "little" else "be"


def _number(value: int) -> str:
    return f"{value:#x}u" if value < 2**32 else f"UINT64_C({value:#x})"


def _bytes(data: bytes) -> str:
    return ", ".join(f"{byte:#04x}" for byte in data or b"\0")
