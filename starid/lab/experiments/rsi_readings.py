"""Interpretations of the side of the search region, and of the distances on which it depends."""

from __future__ import annotations

import math

import numpy as np

from starid.arrays import Array


def side_as_printed(mean_distance_deg: float, sigma_distance_deg: float, gamma_min_deg: float) -> float:
    """Side with the printed factor 110, degrees; it falls as the distances grow."""
    power: float = 110.0 ** (-0.5 * math.log10(mean_distance_deg)) * 110.0 ** (
        -0.5 * math.log10(sigma_distance_deg)
    )
    return gamma_min_deg + power * sigma_distance_deg * mean_distance_deg


def nearest_distances(transformed: Array, seen: Array) -> Array:
    """Distance of each transformed object (n, 2) to the nearest object seen (m, 2): the printed "min"."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(seen).query(transformed)
    return np.asarray(distances, dtype=np.float64)
