"""Smooth light on a coarse grid of the image, and its interpolation in every pixel."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from starid.jit import compiled_ieee

Image = npt.NDArray[np.float32]

GLARE_STEP: Final = 8
"""Pixels between the points at which smooth light is computed."""


@compiled_ieee
def expand(row: npt.NDArray[np.float32], line: npt.NDArray[np.float32]) -> None:
    """Interpolate a row of the glare's grid at every column."""
    whole = line.size // GLARE_STEP
    for i in range(whole):
        first, slope = row[i], (row[i + 1] - row[i]) * np.float32(1.0 / GLARE_STEP)
        for k in range(GLARE_STEP):
            line[i * GLARE_STEP + k] = first + slope * np.float32(k)
    for x in range(whole * GLARE_STEP, line.size):
        slope = (row[whole + 1] - row[whole]) * np.float32(1.0 / GLARE_STEP)
        line[x] = row[whole] + slope * np.float32(x - whole * GLARE_STEP)


@compiled_ieee
def add_glare(out: Image, still: Image, sensitivity: Image, grid: Image, exposure_s: float) -> None:
    """Fill (h, w) with `still` plus smooth light, interpolated linearly between the points of its grid."""
    upper, lower = np.empty(out.shape[1], dtype=np.float32), np.empty(out.shape[1], dtype=np.float32)
    expand(grid[0], lower)
    for y in range(out.shape[0]):
        if y % GLARE_STEP == 0:
            upper, lower = lower, upper
            expand(grid[y // GLARE_STEP + 1], lower)
        share = np.float32(y % GLARE_STEP) * np.float32(exposure_s / GLARE_STEP)
        rest = np.float32(exposure_s) - share
        to, base, gain = out[y], still[y], sensitivity[y]
        for x in range(to.size):
            to[x] = base[x] + gain[x] * (rest * upper[x] + share * lower[x])
