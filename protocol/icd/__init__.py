"""The interface definition of a unit: its keys, values and rows, and the codec of the rows."""

from starhil.protocol.icd.definition import InterfaceDefinition, UnknownNameError
from starhil.protocol.icd.values import FieldError

__all__ = ["FieldError", "InterfaceDefinition", "UnknownNameError"]
