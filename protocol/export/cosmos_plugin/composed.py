"""The constants and functions of a composed serial link, as Python code for the plugin's protocol."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pprint import pformat
from typing import Any, Final

from starhil.protocol.export.packets import CLASS_SHIFT, check_one_format, row_key
from starhil.protocol.export.templates import part_of, text_of
from starhil.protocol.icd.link_schema import DelimitedFraming, EscapedFraming, NoCheck, SlipFraming
from starhil.protocol.serial.headers import HeaderCodec
from starhil.protocol.serial.stack import SerialStack

_NAMES: Final = {"init": "INITIAL", "poly": "POLYNOMIAL", "xor": "XOR_OUT"}
"""Names of the constants for settings of a check; others are the setting in capitals."""


def link_text(stack: SerialStack) -> str:
    """Return the code of a link: constants, check, framing and the class Link.

    Raises IcdError for a framing or check from a plugin.
    """
    check_one_format(stack, "a COSMOS plugin")
    kind = "counted" if stack.link.framing.kind in ("length", "fixed") else stack.link.framing.kind
    constants = {
        **_framing(stack), **_check(stack), **_headers(stack), "ROWS": dict(_rows(stack)),
        "LONGEST": 2 * stack.max_size + 16,
    }  # fmt: skip
    functions = (
        part_of("cosmos_plugin/checks.py.in", stack.link.check.kind),
        part_of("cosmos_plugin/framings.py.in", kind),
        text_of("cosmos_plugin/composed_link.py.in"),
    )
    head = "".join(
        f"{name} = {pformat(value, width=110, sort_dicts=False)}\n"
        for name, value in constants.items()
        if any(re.search(rf"\b{name}\b", text) for text in functions)
    )
    return "\n\n".join((head, *(text.strip("\n") + "\n" for text in functions)))


def _framing(stack: SerialStack) -> dict[str, Any]:
    constants: dict[str, Any] = {"START": stack.requests.framing.start, "END": stack.requests.framing.end}
    model = stack.link.framing
    if isinstance(model, SlipFraming | EscapedFraming):
        constants["ESCAPE"] = bytes((model.escape,))
    if isinstance(model, SlipFraming):
        constants |= {"SUBSTITUTES": bytes(model.escaped), "LEADING_END": model.leading_end}
    if isinstance(model, DelimitedFraming):
        constants["HEX"] = model.encoding == "hex"
    return constants


def _check(stack: SerialStack) -> dict[str, Any]:
    model = stack.link.check
    order = stack.byte_order if isinstance(model, NoCheck) else model.order or stack.byte_order
    settings = {_NAMES.get(name, name.upper()): value for name, value in model.model_dump().items()}
    return {
        "CHECK_SIZE": stack.requests.check.size,
        "CHECK_COVERS": sorted(stack.requests.check.covers),
        "CHECK_ORDER": order,
        **settings,
    }


def _headers(stack: SerialStack) -> dict[str, Any]:
    classes = stack.icd.classes
    codes = {item.name: item.code or 0 for item in classes}
    coded = [item for item in classes if item.code is not None]
    reply = {item.reply_code: item.code for item in coded}
    unsolicited = {item.unsolicited: item.code for item in coded if item.unsolicited is not None}
    length = [field for field in stack.replies.header.fields if field.role == "length"]
    return {
        "CLASS_SHIFT": CLASS_SHIFT,
        "ADDRESS": stack.replies.header.defaults.get("address"),
        "REPLY_CLASSES": reply | unsolicited,
        "UNSOLICITED": sorted(unsolicited),
        "LENGTH_INCLUDES": sorted(length[0].includes) if length else [],
        "LENGTH_OFFSET": length[0].offset if length else 0,
        "REQUEST_HEADER": list(_fields(stack.requests.header, codes)),
        "REPLY_HEADER": list(_fields(stack.replies.header, codes)),
    }


def _fields(header: HeaderCodec, codes: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    for field in header.fields:
        yield {
            "role": field.role,
            "size": field.size,
            "order": field.order or header.byte_order,
            "const": None if field.role == "address" else field.const,
            "default": 0 if field.bits else field.initial,
            "classes": None if field.classes is None else sorted(codes[name] for name in field.classes),
            "includes": sorted(field.includes) if field.role == "length" else [],
            "offset": field.offset,
            "bits": [(bit.role, bit.width, bit.initial) for bit in field.bits],
        }


def _rows(stack: SerialStack) -> Iterator[tuple[int, dict[str, Any]]]:
    for row in stack.rows:
        yield (
            row_key(stack.classes, row.message_class, row.id),
            {
                "telemetry": row.kind == "telemetry",
                "request_size": row.request_size,
                "reply_size": row.reply_size,
                "answers": [answer for answer in row.answers if answer in ("echo", "reply")],
            },
        )
