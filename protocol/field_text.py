"""Short form of fields: one line of an ICD table as text.

`TYPE NAME [UNIT] [SCALE]` is a number, `enumN NAME ENUMERATION` an enumeration, `bytes NAME SIZE` and `text
NAME SIZE` a string, and `bits NAME[:WIDTH] …` flags and groups of bits, lowest first, which fill whole bytes.
`-` means no name or no unit. Braces repeat the field as in a shell: `i16 mag{0,1}_{x,y,z} uT 0.01` is six
fields, `u8 css{0..9}` is ten.
"""

from __future__ import annotations

import math
import re
from itertools import product
from typing import Any, Final

from pydantic import ValidationError

from starhil.protocol.icd_schema import FieldModel
from starhil.protocol.values import IcdError

MAX_NAMES: Final = 256
"""Maximum number of fields that one text may expand to."""

_BRACES: Final = re.compile(r"\{([^{}]*)\}")


def fields_of(text: str) -> list[FieldModel]:
    """Expand a text to fields.

    Raises IcdError, whose text does not name row and file.
    """
    type_, *words = text.split() or [""]
    if not words:
        raise IcdError("needs a type and a name, such as 'u16 counter'")
    tables = _bits(words) if type_ == "bits" else _scalars(type_, *words)
    try:
        return [FieldModel.model_validate(table) for table in tables]
    except ValidationError as error:
        first = error.errors()[0]
        raise IcdError(f"{first['loc'][-1]}: {first['msg']}") from None


def _scalars(type_: str, name: str, *words: str) -> list[dict[str, Any]]:
    kinds = {"enum": ("enum",), "byte": ("size",), "text": ("size",)}
    keys = kinds.get(type_[:4], ("unit", "scale"))
    if len(words) > len(keys):
        raise IcdError(f"only {' and '.join(keys)} may follow the name")
    table: dict[str, Any] = {"type": type_}
    for key, word in zip(keys, words, strict=False):
        if word != "-":
            table[key] = word if key in ("enum", "unit") else _number(key, word)
    return [table | _named(item) for item in _names(name)]


def _bits(words: list[str]) -> list[dict[str, Any]]:
    filled: list[list[dict[str, Any]]] = []
    room = 0
    for word in words:
        name, _, given = word.partition(":")
        width = int(_number("width", given)) if given else 1
        for item in _names(name):
            if room == 0:
                filled.append([])
                room = 8
            if not 1 <= width <= room:
                raise IcdError(f"{item}: {width} bits do not fit into the remaining {room} bits of the byte")
            filled[-1].append(_named(item) | {"width": width})
            room -= width
    if room:
        filled[-1].append({"width": room})
    return [{"type": "bits8", "bits": bits} for bits in filled]


def _named(name: str) -> dict[str, Any]:
    return {} if name == "-" else {"name": name}


def _number(key: str, word: str) -> int | float:
    try:
        return float(word) if key == "scale" else int(word)
    except ValueError:
        raise IcdError(f"{key}: {word!r} is not a number") from None


def _names(pattern: str) -> list[str]:
    """Expand a pattern with braces to names; the last braces vary fastest."""
    parts = [
        [part] if index % 2 == 0 else _choices(part) for index, part in enumerate(_BRACES.split(pattern))
    ]
    if not 1 <= math.prod(map(len, parts)) <= MAX_NAMES:
        raise IcdError(f"{pattern}: must be 1 to {MAX_NAMES} fields")
    return ["".join(chosen) for chosen in product(*parts)]


def _choices(text: str) -> list[str]:
    first, _, last = text.partition("..")
    if first.isdecimal() and last.isdecimal():
        return [str(number) for number in range(int(first), int(last) + 1)[: MAX_NAMES + 1]]
    return text.split(",")
