"""Reading of a unit from its folder: parsing, layout, checks, and example exchanges."""

from starhil.protocol.unit.reader import load_unit, read_definition

__all__ = ["load_unit", "read_definition"]
