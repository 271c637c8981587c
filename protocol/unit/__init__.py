"""A unit read from its folder: parsed, laid out, checked, and shown by example."""

from starhil.protocol.unit.reader import load_unit, read_definition

__all__ = ["load_unit", "read_definition"]
