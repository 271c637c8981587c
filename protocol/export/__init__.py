"""Exports of the interface definition; one module per format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType, ModuleType
from typing import Final, cast

from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.errors import ProtocolError

FORMATS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "markdown": "tables for people, as Markdown",
        "html": "tables for people, as one HTML page",
        "dbc": "CAN database (cantools, canmatrix, Vector tools)",
        "eds": "electronic data sheet of the CANopen node (CiA 306)",
        "xtce": "XML Telemetric and Command Exchange 1.2 (Yamcs and others)",
        "cosmos": "command and telemetry definition of OpenC3 COSMOS",
    }
)
"""Description of each format that is a single text, by name."""

FOLDER_FORMATS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "c": "C99 codec and serial link, header and source",
        "cosmos-plugin": "plugin for OpenC3 COSMOS: target, interface and serial protocol",
    }
)
"""Description of each format that consists of several files, by name."""


def export(icd: InterfaceDefinition, name: str) -> str:
    """Return the interface definition in a format that is a single text.

    Raises ProtocolError for an unknown format, and for a definition that the format cannot hold.
    """
    return cast("Callable[[InterfaceDefinition], str]", _exporter(name, FORMATS).render)(icd)


def export_folder(icd: InterfaceDefinition, name: str) -> Mapping[str, str]:
    """Return the interface definition in a format of several files: texts by path within the folder.

    Raises ProtocolError for an unknown format, and for a definition that the format cannot hold.
    """
    render = _exporter(name, FOLDER_FORMATS).render_folder
    return cast("Callable[[InterfaceDefinition], Mapping[str, str]]", render)(icd)


def _exporter(name: str, formats: Mapping[str, str]) -> ModuleType:
    if name not in formats:
        raise ProtocolError(f"no export format {name!r}; choose one of {', '.join(formats)}")
    return import_module(f"starhil.protocol.export.{name.replace('-', '_')}")
