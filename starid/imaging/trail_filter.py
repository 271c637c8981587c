"""First half of the matched filter for trails: the image is summed along the paths of its stars.

The sum is taken in integers before smoothing with the round spot (`starid.imaging.matched_filter.find_peaks`). The
result does not depend on the order, but this one is faster.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, GreyImage
from starid.arithmetic.elementary import hypot, square
from starid.imaging.matched_filter import spot_taps
from starid.imaging.trail_flow import trail_at
from starid.kernels.jit import compiled_ieee

_TILE_COLUMNS: Final = 128
_TILE_ROWS: Final = 32
_TILE_PIXELS: Final = _TILE_COLUMNS * _TILE_ROWS
_MAX_STEPS: Final = 96


@compiled_ieee
def _sum_along(
    image: GreyImage,
    flow: Array,
    steps: int,
    shift: int,
    sums: npt.NDArray[np.uint16] | npt.NDArray[np.uint32],
    out: npt.NDArray[np.uint16],
) -> None:
    """Sum of the image at `steps` positions along the trail of each tile, shifted right; `sums` is a tile.

    Indices are unsigned: without the case of negative ones the loops become vector instructions.
    """
    height, width = image.shape
    pixels, target = image.reshape(image.size), out.reshape(out.size)
    for top in range(0, height, _TILE_ROWS):
        for left in range(0, width, _TILE_COLUMNS):
            bottom, columns = min(top + _TILE_ROWS, height), min(_TILE_COLUMNS, width - left)
            middle_x, middle_y = left + 0.5 * (columns - 1), 0.5 * (top + bottom - 1)
            trail_x, trail_y = trail_at(flow, middle_x, middle_y, width, height)
            sums[:] = 0
            for step in range(steps):
                part = (step + 0.5) / steps - 0.5
                start, down = left + round(part * trail_x), round(part * trail_y)
                first = min(max(0, -start), columns)
                count = np.uint64(max(min(columns, width - start) - first, 0))
                for y in range(top, bottom):
                    row = min(max(y + down, 0), height - 1)
                    to = np.uint64((y - top) * _TILE_COLUMNS + first)
                    source = np.uint64(row * width + start + first)
                    for k in range(count):
                        sums[to + k] += pixels[source + k]
            for y in range(top, bottom):
                begin, place = np.uint64(y * width + left), np.uint64((y - top) * _TILE_COLUMNS)
                for k in range(np.uint64(columns)):
                    target[begin + k] = sums[place + k] >> shift


def trail_steps(flow: Array, width: int, height: int) -> int:
    """Number of positions along a trail, about a pixel apart on the longest trail in the field."""
    corners = [(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)]
    lengths = [hypot(*trail_at(flow, x * (width - 1), y * (height - 1), width, height)) for x, y in corners]
    return min(max(math.ceil(max(lengths)), 1), _MAX_STEPS)


def sum_along_trails(image: GreyImage, flow: Array, steps: int) -> tuple[npt.NDArray[np.uint16], float]:
    """Sum an image (h, w) along the trails of a flow (`starid.imaging.trail_flow`).

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    flow : ndarray (5,)
        Trails.
    steps : int
        From `trail_steps`.

    Returns
    -------
    sums : ndarray (h, w), uint16
        Pixels beyond the left and right edges count as 0.
    scale : float
        Sum for an image whose every count is 1.
    """
    out = np.empty(image.shape, dtype=np.uint16)
    if image.dtype == np.uint8:
        _sum_along(image, flow, steps, 0, np.empty(_TILE_PIXELS, np.uint16), out)
        return out, float(steps)
    shift = (steps - 1).bit_length()
    _sum_along(image, flow, steps, shift, np.empty(_TILE_PIXELS, np.uint32), out)
    return out, math.ldexp(steps, -shift)


def trail_noise_factor(sigma_px: float, trail_px: float, steps: int) -> float:
    """Noise after summing along a trail and smoothing, relative to `steps` times the noise of a pixel."""
    taps = spot_taps(sigma_px).astype(np.float64)
    spot = np.concatenate([taps[:0:-1], taps])
    offsets = np.rint(((np.arange(steps) + 0.5) / steps - 0.5) * trail_px).astype(int)
    line = np.bincount(offsets - offsets.min()) / steps
    smeared = np.zeros(spot.size + line.size - 1)
    for k, share in enumerate(line):
        smeared[k : k + spot.size] += share * spot
    return float(np.sqrt(np.sum(square(smeared)) * np.sum(square(spot))))
