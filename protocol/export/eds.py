"""The CANopen node's electronic data sheet."""

from __future__ import annotations

from starhil.protocol.canopen.device_dictionary import build_dictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.icd import InterfaceDefinition


def render(icd: InterfaceDefinition) -> str:
    """Return the text of the data sheet of the node that serves this definition."""
    return build_eds(build_dictionary(icd))
