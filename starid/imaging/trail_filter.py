"""The matched filter for trails: an image smoothed along the path that its stars take during the exposure."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.imaging.jit_loops import compiled_loops
from starid.imaging.matched_filter import smooth_image, spot_taps
from starid.imaging.trail_flow import trail_at

_TILE_PX: Final = 64
_MOST_STEPS: Final = 96


@compiled_loops
def _smooth_along(
    smooth: npt.NDArray[np.float32], flow: npt.NDArray[np.float64], out: npt.NDArray[np.float32]
) -> None:
    """Mean of the image along the trail of each tile, at steps of about a pixel."""
    height, width = smooth.shape
    for top in range(0, height, _TILE_PX):
        for left in range(0, width, _TILE_PX):
            bottom, right = min(top + _TILE_PX, height), min(left + _TILE_PX, width)
            trail_x, trail_y = trail_at(
                flow, 0.5 * (left + right - 1), 0.5 * (top + bottom - 1), width, height
            )
            steps = min(max(math.ceil(math.hypot(trail_x, trail_y)), 1), _MOST_STEPS)
            share = np.float32(1.0 / steps)
            out[top:bottom, left:right] = 0.0
            for step in range(steps):
                part = (step + 0.5) / steps - 0.5
                dx, dy = round(part * trail_x), round(part * trail_y)
                first = max(left, -dx)
                last = min(right, width - dx)
                for y in range(top, bottom):
                    source = min(max(y + dy, 0), height - 1)
                    to = out[y, first:last]
                    source_row = smooth[source, first + dx : last + dx]
                    for x in range(last - first):
                        to[x] += share * source_row[x]


def smooth_along_trails(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], sigma_px: float, flow: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """Smooth an image (h, w) with the spot, and then along the trails of a flow (`starid.imaging.trail_flow`)."""
    out = np.empty(image.shape, dtype=np.float32)
    _smooth_along(smooth_image(image, spot_taps(sigma_px)), flow, out)
    return out


def trail_noise_factor(sigma_px: float, trail_px: float) -> float:
    """Noise of an image smoothed so, over that of a pixel, for trails of a length."""
    taps = spot_taps(sigma_px).astype(np.float64)
    spot = np.concatenate([taps[:0:-1], taps])
    steps = max(math.ceil(trail_px), 1)
    offsets = np.rint(((np.arange(steps) + 0.5) / steps - 0.5) * trail_px).astype(int)
    line = np.bincount(offsets - offsets.min()) / steps
    return float(np.sqrt(np.sum(np.convolve(spot, line) ** 2) * np.sum(spot**2)))
