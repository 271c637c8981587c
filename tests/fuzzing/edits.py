"""Bytes that change a document: each four of them replace, delete, double or move one value of a good document."""

from __future__ import annotations

import copy
import json
import math
from typing import Any

HOSTILE: tuple[Any, ...] = (
    True, 0, -1, 1, 3, 255, 256, 65536, 2**31, 2**63 - 1, -(2**63), 0.0, -0.5, 1e-9, 360.0, 1e308, math.inf, -math.inf,
    math.nan, "", " ", "x", "a" * 300, "é\u202e", "tab\there", "line\nbreak", "../..", "/dev/zero", "id", "i16", "u8 x[99]",
    "0x1F", [], {}, [1], [[]], [1, "x"], {"x": 1}, [{}], ["", ""], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], ["x"] * 50,
)  # fmt: skip


MOST_SPOTS = 20_000
DEEPEST = 60
"""Values copied into each other could grow without limit."""


def edited(document: Any, data: bytes) -> Any:
    """Return a copy of a document with an edit for each four bytes: path (2), kind, value."""
    document = copy.deepcopy(document)
    for start in range(0, len(data) - 3, 4):
        spots = list(_spots(document))
        if not 0 < len(spots) <= MOST_SPOTS or _depth(document) > DEEPEST:
            break
        number, kind, value = data[start] << 8 | data[start + 1], data[start + 2], data[start + 3]
        holder, key = spots[number % len(spots)]
        _edit(holder, key, kind, value, spots)
    return document


def _edit(holder: Any, key: Any, kind: int, value: int, spots: list[tuple[Any, Any]]) -> None:
    match kind % 5:
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[("x", "", "é", key + "2", 'quo"te')[value % 5]] = copy.deepcopy(holder[key])
        case 2:
            other, name = spots[value % len(spots)]
            holder[key] = copy.deepcopy(other[name])
        case 3 if isinstance(holder[key], str):
            text = holder[key]
            at = value % (len(text) + 1)
            holder[key] = text[:at] + "x\"\\{}[],\n' é0-"[value % 14] + text[at + value % 2 :]
        case 3 if isinstance(holder[key], (int, float)):
            holder[key] = holder[key] * (-1, 1000, 0.5, 2)[value % 4]
        case _:
            holder[key] = copy.deepcopy(HOSTILE[value % len(HOSTILE)])


def _spots(document: Any) -> Any:
    """Yield every place in a document as its holder and its key."""
    for key, value in document.items() if isinstance(document, dict) else enumerate(document):
        yield document, key
        if isinstance(value, (dict, list)):
            yield from _spots(value)


def _depth(value: Any) -> int:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return 1 + max(map(_depth, items), default=0)


def toml(document: dict[str, Any]) -> bytes:
    """Return a document as TOML; tables within it are written inline."""
    return "".join(f"{_text(key)} = {_toml(value)}\n" for key, value in document.items()).encode()


def _toml(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case float() if not math.isfinite(value):
            return "nan" if math.isnan(value) else f"{value:+}"
        case dict():
            return "{" + ", ".join(f"{_text(key)} = {_toml(item)}" for key, item in value.items()) + "}"
        case list():
            return "[" + ", ".join(_toml(item) for item in value) + "]"
        case str():
            return _text(value)
        case _:
            return repr(value)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
