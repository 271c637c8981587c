"""The interface definition as the EDS of the CANopen node."""

from __future__ import annotations

from functools import lru_cache

from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.icd import InterfaceDefinition


@lru_cache(maxsize=16)
def render(icd: InterfaceDefinition) -> str:
    """Return the EDS of the node that serves this definition."""
    return build_eds(DeviceDictionary(icd))
