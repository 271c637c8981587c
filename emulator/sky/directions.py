"""Directions in the sky as vectors."""

from __future__ import annotations

import math

import numpy as np

from starid.arrays import Array


def icrs_vector(ra_deg: float, dec_deg: float) -> Array:
    """Unit vector (3,) of a direction."""
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
