"""Units of measure of quantities and fields, and the factors between compatible units."""

from __future__ import annotations

import math
from typing import Final

PER_SI_UNIT: Final[dict[str, dict[str, float]]] = {
    "time": {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9},
    "angle": {
        "rad": 1.0,
        "deg": 180.0 / math.pi,
        "arcmin": 10_800.0 / math.pi,
        "arcsec": 648_000.0 / math.pi,
    },
    "rate": {"rad/s": 1.0, "deg/s": 180.0 / math.pi, "arcsec/s": 648_000.0 / math.pi},
    "frequency": {"Hz": 1.0, "mHz": 1e3},
    "fraction": {"1": 1.0, "%": 100.0},
    "voltage": {"V": 1.0, "mV": 1e3},
    "current": {"A": 1.0, "mA": 1e3},
    "power": {"W": 1.0, "mW": 1e3},
}
"""Number of each unit in one SI unit, by kind."""


def convertible(unit: str) -> list[str]:
    """Return the units that a value in this unit can be converted to, itself included."""
    return next((list(units) for units in PER_SI_UNIT.values() if unit in units), [unit])


def factor(unit: str, target: str) -> float | None:
    """Return the factor that converts a value from one unit to another, or None if they are incompatible."""
    if unit == target:
        return 1.0
    for units in PER_SI_UNIT.values():
        if unit in units and target in units:
            return units[target] / units[unit]
    return None
