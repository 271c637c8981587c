"""Violations, and values as an oracle knows them."""

from __future__ import annotations

from starhil.protocol.codec import Field
from starhil.protocol.device_model import PARAMETER
from starhil.protocol.values import Value

Known = tuple[Value, float]
"""A value and its tolerance."""


class Violation(Exception):  # noqa: N818 (what it is called)
    """Something that a unit must never do."""


def quantity_of(field: Field) -> str:
    """Return the quantity that a field reports; empty if it reports none."""
    return PARAMETER + field.parameter if field.parameter else field.value or ""


def resolution(field: Field) -> float:
    """Return the largest difference between a value and what its field carries of it."""
    if field.kind == "float":
        return 1e-9 * abs(field.scale)
    return 0.51 * abs(field.scale)
