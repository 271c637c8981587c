"""Exports of the interface definition; one module per format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any, Final, cast

from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition

FORMATS: Final = ("markdown", "html", "dbc", "eds", "xtce", "cosmos")
"""Formats that are a single text."""

FOLDER_FORMATS: Final = ("c", "cosmos-plugin")
"""Formats that consist of several files."""


def export(icd: InterfaceDefinition, name: str) -> str:
    """Return the interface definition in a format that is a single text.

    Raises ProtocolError for an unknown format, and for a definition that the format cannot hold.
    """
    return cast("Callable[[InterfaceDefinition], str]", _exporter(name, FORMATS).render)(icd)


def export_folder(icd: InterfaceDefinition, name: str, **options: Any) -> Mapping[str, str]:
    """Return the interface definition in a format of several files: texts by path within the folder.

    C takes the option `rows`, names of the rows to write code for.

    Raises ProtocolError for an unknown format, and for a definition that the format cannot hold.
    """
    render = _exporter(name, FOLDER_FORMATS).render_folder
    return cast("Callable[..., Mapping[str, str]]", render)(icd, **options)


def _exporter(name: str, formats: Sequence[str]) -> ModuleType:
    if name not in formats:
        raise ProtocolError(f"no export format {name!r}; choose one of {', '.join(formats)}")
    return import_module(f"starhil.protocol.export.{name.replace('-', '_')}")
