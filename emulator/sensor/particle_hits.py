"""Streaks left by energetic particles in the detector."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arrays import Array, Array32

_STREAK_STEP_PX: Final = 0.2
_STREAK_MEAN_PX: Final = 8.0
_STREAK_E_PER_PX: Final = 900.0
_STREAK_SPREAD: Final = 0.6


def add_cosmic_rays(mean_e: Array32, count: int, rng: np.random.Generator) -> Array:
    """Add the charge of particles to an image, in place; return x, y of both ends of each streak (count, 4), pixels.

    Each particle leaves a streak of exponentially distributed length (mean 8 px) in a random direction, with about
    900 electrons per pixel, log-normally distributed along the streak.
    """
    height, width = mean_e.shape
    ends = np.empty((count, 4))
    for k in range(count):
        start = rng.uniform((-0.5, -0.5), (width - 0.5, height - 0.5))
        angle, length = rng.uniform(0.0, 2.0 * math.pi), rng.exponential(_STREAK_MEAN_PX)
        ends[k] = [*start, start[0] + length * math.cos(angle), start[1] + length * math.sin(angle)]
        steps = max(math.ceil(length / _STREAK_STEP_PX), 1)
        fractions = (np.arange(steps) + 0.5) / steps
        columns = np.rint(ends[k, 0] + fractions * (ends[k, 2] - ends[k, 0])).astype(np.int64)
        rows = np.rint(ends[k, 1] + fractions * (ends[k, 3] - ends[k, 1])).astype(np.int64)
        charge = _STREAK_E_PER_PX * max(length, 1.0) / steps
        charges = (charge * np.exp(_STREAK_SPREAD * rng.standard_normal(steps))).astype(np.float32)
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        np.add.at(mean_e, (rows[inside], columns[inside]), charges[inside])
    return ends
