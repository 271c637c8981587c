"""The constants and functions of a composed serial link, as Python code for the plugin's protocol."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pprint import pformat
from typing import Any

from starhil.protocol.envelope import Header
from starhil.protocol.export.packets import CLASS_SHIFT, check_one_format, row_key
from starhil.protocol.export.templates import part_of, text_of
from starhil.protocol.link_schema import (
    CrcCheck,
    CustomCheck,
    CustomFraming,
    DelimitedFraming,
    EscapedFraming,
    FletcherCheck,
    NoCheck,
    SlipFraming,
    SumCheck,
    XorCheck,
    XxHashCheck,
)
from starhil.protocol.serial_stack import SerialStack
from starhil.protocol.values import IcdError


def link_text(stack: SerialStack) -> str:
    """Return the code of a link: constants, check, framing and the class Link.

    Raises IcdError for a framing or check from a plugin.
    """
    check_one_format(stack, "a COSMOS plugin")
    framing, check = stack.link.framing, stack.link.check
    for what, model in (("framing", framing), ("check", check)):
        if isinstance(model, CustomFraming | CustomCheck):
            raise IcdError(
                f"link.serial.{what}: {model.name!r} is Python code in the unit's plugin and cannot be exported"
            )
    kind = "counted" if framing.kind in ("length", "fixed") else framing.kind
    constants = {
        **_framing(stack), **_check(stack), **_headers(stack), "ROWS": dict(_rows(stack)),
        "LONGEST": 2 * stack.max_size + 16,
    }  # fmt: skip
    functions = (
        part_of("cosmos_plugin/checks.py.in", check.kind),
        part_of("cosmos_plugin/framings.py.in", kind),
        text_of("cosmos_plugin/composed_link.py.in"),
    )
    used = {
        name: value
        for name, value in constants.items()
        if any(re.search(rf"\b{name}\b", text) for text in functions)
    }
    head = "".join(
        f"{name} = {pformat(value, width=110, sort_dicts=False)}\n" for name, value in used.items()
    )
    return "\n\n".join((head, *(text.strip("\n") + "\n" for text in functions)))


def _framing(stack: SerialStack) -> dict[str, Any]:
    constants: dict[str, Any] = {"START": stack.framing.start, "END": stack.framing.end}
    match stack.link.framing:
        case SlipFraming() as model:
            constants |= {
                "ESCAPE": bytes((model.escape,)),
                "SUBSTITUTES": bytes(model.escaped),
                "LEADING_END": model.leading_end,
            }
        case EscapedFraming() as model:
            constants["ESCAPE"] = bytes((model.escape,))
        case DelimitedFraming() as model:
            constants["HEX"] = model.encoding == "hex"
        case _:
            pass
    return constants


def _check(stack: SerialStack) -> dict[str, Any]:
    model = stack.link.check
    constants: dict[str, Any] = {"CHECK_SIZE": stack.check.size, "CHECK_COVERS": sorted(stack.check.covers)}
    if not isinstance(model, NoCheck):
        constants["CHECK_ORDER"] = model.order or stack.byte_order
    match model:
        case SumCheck():
            constants["COMPLEMENT"] = model.complement
        case XorCheck():
            constants["INITIAL"] = model.init
        case FletcherCheck():
            constants["MODULUS"] = model.modulus
        case CrcCheck():
            constants |= {
                "POLYNOMIAL": model.poly,
                "INITIAL": model.init,
                "REFLECT": model.reflect,
                "XOR_OUT": model.xor,
            }
        case XxHashCheck():
            constants["SEED"] = model.seed
        case _:
            pass
    return constants


def _headers(stack: SerialStack) -> dict[str, Any]:
    classes = stack.classes.classes
    codes = {item.name: item.code or 0 for item in classes}
    coded = [item for item in classes if item.code is not None]
    reply = {item.reply_code: item.code for item in coded}
    unsolicited = {item.unsolicited: item.code for item in coded if item.unsolicited is not None}
    length = [field for field in stack.reply_header.fields if field.role == "length"]
    return {
        "CLASS_SHIFT": CLASS_SHIFT,
        "ADDRESS": stack.reply_header.defaults.get("address"),
        "REPLY_CLASSES": reply | unsolicited,
        "UNSOLICITED": sorted(unsolicited),
        "LENGTH_INCLUDES": sorted(length[0].includes) if length else [],
        "LENGTH_OFFSET": length[0].offset if length else 0,
        "REQUEST_HEADER": list(_fields(stack.request_header, codes)),
        "REPLY_HEADER": list(_fields(stack.reply_header, codes)),
    }


def _fields(header: Header, codes: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    for field in header.fields:
        yield {
            "role": field.role,
            "size": field.size,
            "order": field.order,
            "const": None if field.role == "address" else field.const,
            "default": 0 if field.bits else field.default,
            "classes": None if field.classes is None else sorted(codes[name] for name in field.classes),
            "includes": sorted(field.includes) if field.role == "length" else [],
            "offset": field.offset,
            "bits": [(bit.role, bit.mask.bit_length(), bit.default) for bit in field.bits],
        }


def _rows(stack: SerialStack) -> Iterator[tuple[int, dict[str, Any]]]:
    for row in stack.rows:
        yield (
            row_key(stack.classes.classes, row.klass, row.id),
            {
                "telemetry": row.kind == "telemetry",
                "request_size": row.request_size,
                "reply_size": row.reply_size,
                "answers": [answer for answer in row.answers if answer in ("echo", "reply")],
            },
        )
