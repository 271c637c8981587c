"""Fields of plain records, with limits that are checked when they are read from a file (`config_model.model_of`)."""

from __future__ import annotations

import dataclasses
from typing import Any


def limited(
    low: float, high: float, default: Any = dataclasses.MISSING, *, unit: str = "", most: int | None = None
) -> Any:
    """Return a field of a dataclass with the limits of each number in it.

    Parameters
    ----------
    unit:
        Unit, for the documentation, if the name does not end with it.
    most:
        Largest number of items of a list.
    """
    return dataclasses.field(default=default, metadata={"limits": (low, high, unit), "most": most})


def listed(most: int) -> Any:
    """Return a field that is a list of at most some number of items, empty by default."""
    return dataclasses.field(default=(), metadata={"most": most})
