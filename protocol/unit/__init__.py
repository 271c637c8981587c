"""Reading of a unit from its folder: parsing, layout, checks, and example exchanges."""

from starhil.protocol.unit.reader import check_runs_no_code, load_unit, read_definition

__all__ = ["check_runs_no_code", "load_unit", "read_definition"]
