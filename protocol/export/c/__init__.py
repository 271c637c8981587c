"""The interface definition as C99: a header and a source with a codec for each row and the OBC's side of serial link and CAN.

The text needs nothing but the standard library's headers and allocates nothing. `rows` writes the codecs, the
files `*.h` and `*.c` of this folder hold the links; their `unit_` and `UNIT_` become the prefix of the unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.export.c import rows
from starhil.protocol.export.c.composed import link_parts
from starhil.protocol.export.row_key import key_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.serial_interface import SerialStack
from starhil.protocol.serial_stack import build_serial_stack

_FUNCTION: Final = re.compile(r"^static .*?\b(\w+)\(", re.MULTILINE)


def render_folder(icd: InterfaceDefinition) -> Mapping[str, str]:
    """Return header and source by file name.

    Raises IcdError for a unit without a serial link, and for one whose link is code of a plugin.
    """
    return files(icd, build_serial_stack(icd))


def files(icd: InterfaceDefinition, stack: SerialStack) -> Mapping[str, str]:
    """Return header and source of a definition with a serial link."""
    prefix = prefix_of(icd)
    if isinstance(stack, ComposedStack):
        link_header, helpers, link_source = link_parts(stack)
        key_type = "uint32_t"
    else:
        parts = ["cubespace", "cubespace_can"] if icd.link.can is not None else ["cubespace"]
        link_header, helpers = "\n".join(_part(f"{part}.h") for part in parts), ""
        link_source = "\0" + "\n".join(_part(f"{part}.c") for part in parts)
        key_type = "uint8_t"
    header = "\n".join(_header(icd, prefix, link_header))
    source = "\n".join(_source(icd, prefix, helpers, link_source, key_type))
    return {f"{prefix}.h": _named(header, prefix), f"{prefix}.c": _named(source, prefix)}


def prefix_of(icd: InterfaceDefinition) -> str:
    """Return what every name in the text begins with."""
    return re.sub(r"\W", "_", icd.name.lower())


def _header(icd: InterfaceDefinition, prefix: str, link: str) -> Iterator[str]:
    yield rows.comment(f"{icd.name} {icd.version}: {icd.doc}", _USE.format(prefix=prefix))
    yield "#ifndef UNIT_H\n#define UNIT_H\n"
    yield "#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>\n"
    yield '#ifdef __cplusplus\nextern "C" {\n#endif\n'
    yield _part("codec.h")
    for name, enum in rows.enumerations(icd).items():
        yield from rows.enumeration(name, enum)
    for row in icd.rows:
        yield from rows.declaration(row, key_of(icd, row))
    yield link
    yield "#ifdef __cplusplus\n}\n#endif\n\n#endif"
    yield ""


def _source(
    icd: InterfaceDefinition, prefix: str, link_helpers: str, link: str, key_type: str
) -> Iterator[str]:
    head, _, link_code = link.partition("\0")
    code = [line for row in icd.rows for line in rows.definition(row)]
    code += [*rows.telemetry_size(icd.telemetry.values(), key_type), link_code]
    members = (rows.membership(name, enum) for name, enum in rows.enumerations(icd).items())
    yield rows.comment(f"{icd.name} {icd.version}: codec and serial link. Made by starhil; do not edit.")
    yield f'#include "{prefix}.h"\n\n#include <float.h>\n#include <string.h>\n'
    yield head
    yield from _used("\n\n".join((_part("codec.c"), *members, link_helpers)), "\n".join(code))
    yield from code


def _used(helpers: str, code: str) -> Iterator[str]:
    """Yield those static functions of a text that the code calls, directly or through each other."""
    needed: list[str] = []
    for function in reversed(helpers.split("\n\n")):  # a function calls only those above it
        name = _FUNCTION.search(function)
        if name is not None and re.search(rf"\b{name[1]}\(", "".join([code, *needed])):
            needed.append(function)
    yield from (f"{function.strip()}\n" for function in reversed(needed))


def _named(text: str, prefix: str) -> str:
    text = re.sub(r"\bunit_", f"{prefix}_", text)
    return re.sub(r"\bUNIT_", f"{prefix.upper()}_", text)


def _part(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


_USE: Final = (
    "Made by starhil from the interface definition; do not edit. docs/c-export.md shows its use.\n\n"
    "A row has an identifier, a size and, if it carries values, a structure with {prefix}_..._encode and\n"
    "{prefix}_..._decode. Values are physical: scaled by the row's scale, in the unit named at the member. `float` and\n"
    "`double` must be those of IEEE 754. Nothing here keeps state, allocates or waits."
)
