"""Exports of the interface definition; one module per format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Final, cast

from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition

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
"""Description of each format by name."""


def export(icd: InterfaceDefinition, name: str) -> str:
    """Return the interface definition in the named format.

    Raises ProtocolError for an unknown name.
    """
    if name not in FORMATS:
        raise ProtocolError(f"no export format {name!r}; choose one of {', '.join(FORMATS)}")
    module = import_module(f"starhil.protocol.export.{name}")
    return cast("Callable[[InterfaceDefinition], str]", module.render)(icd)
