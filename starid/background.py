"""Background and noise of a frame: robust in blocks, interpolated between their centres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.jit_loops import compiled_loops, compiled_sums

BLOCK_PX: Final = 32
"""Side of a block; stars fill a percent of it, glare hardly bends within it."""

LEAST_NOISE_DN: Final = 12.0**-0.5
"""Rounding to whole counts alone has this standard deviation."""

_ROW_STEP: Final = 4
_FIRST_SAMPLES: Final = 32
_CLIP_SIGMA: Final = 3.5
_QUARTILE_SIGMA: Final = 1.349
_ROUNDS: Final = 3


@dataclass(frozen=True)
class Background:
    """Background on a grid of blocks.

    Attributes
    ----------
    level, noise : ndarray (rows, columns), float32
        Counts; mean and standard deviation of the pixels of a block without its stars.
    block_px : float
        Side of a block; the centre of block (i, j) lies at ((j + ½)·block − ½, (i + ½)·block − ½).
    """

    level: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    block_px: int

    @property
    def median_level(self) -> float:
        """Typical background, counts."""
        return float(np.median(self.level))

    @property
    def median_noise(self) -> float:
        """Typical noise of a pixel, counts."""
        return float(np.median(self.noise))


@compiled_sums
def _block_statistics(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    block: int,
    level: npt.NDArray[np.float32],
    noise: npt.NDArray[np.float32],
) -> None:
    """Median and quartiles of a few pixels first, then the mean and spread of all within 3.5 of those sigmas.

    The interval is widened by half a count, so that rounding to counts does not make it lopsided.
    """
    height, width = image.shape
    first = np.empty(_FIRST_SAMPLES, np.int32)
    values = np.empty(block * block, np.float32)
    for row in range(level.shape[0]):
        for column in range(level.shape[1]):
            top = min(row * block, max(height - block, 0))
            left = min(column * block, max(width - block, 0))
            bottom = min(top + block, height)
            right = min(left + block, width)
            count = 0
            for y in range(top + column % _ROW_STEP, bottom, _ROW_STEP):
                line = image[y, left:right]
                for x in range(line.size):
                    values[count + x] = np.float32(line[x])
                count += line.size
            step = max(count // _FIRST_SAMPLES, 1)
            chosen = min(count // step, _FIRST_SAMPLES)
            for k in range(chosen):
                first[k] = np.int32(values[k * step])
            ordered = first[:chosen]
            for k in range(1, chosen):
                key = ordered[k]
                j = k - 1
                while j >= 0 and ordered[j] > key:
                    ordered[j + 1] = ordered[j]
                    j -= 1
                ordered[j + 1] = key
            centre = np.float32(ordered[chosen // 2])
            sigma = np.float32(ordered[(3 * chosen) // 4] - ordered[chosen // 4]) / np.float32(
                _QUARTILE_SIGMA
            )
            sigma = max(sigma, np.float32(0.5))
            for _ in range(_ROUNDS):
                reach = np.float32(_CLIP_SIGMA) * sigma + np.float32(0.5)
                kept = np.float32(0.0)
                total = np.float32(0.0)
                squares = np.float32(0.0)
                for k in range(count):
                    off = values[k] - centre
                    inside = np.float32(1.0) if abs(off) <= reach else np.float32(0.0)
                    kept += inside
                    total += inside * off
                    squares += inside * off * off
                mean = total / kept
                sigma = np.sqrt(max(squares / kept - mean * mean, np.float32(LEAST_NOISE_DN**2)))
                centre += mean
            level[row, column] = centre
            noise[row, column] = sigma


def estimate_background(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], block_px: int = BLOCK_PX
) -> Background:
    """Background and noise of an image (h, w) on a grid of blocks.

    A block that lies over the image's edge is moved inside, so that every block is whole; images smaller than a
    block are one block.
    """
    height, width = image.shape
    rows, columns = -(-height // block_px), -(-width // block_px)
    level = np.empty((rows, columns), dtype=np.float32)
    noise = np.empty((rows, columns), dtype=np.float32)
    _block_statistics(image, block_px, level, noise)
    return Background(level, noise, block_px)


@compiled_loops
def grid_place(position: float, block: float, count: int) -> tuple[int, int, float]:
    """The two of `count` block centres that a pixel lies between, and how far towards the second.

    Beyond the outermost centres the share runs on below 0 or above 1, so that slopes go on to the image's edge.
    """
    u = (position + 0.5) / block - 0.5
    i = min(max(int(u), 0), max(count - 2, 0))
    return i, min(i + 1, count - 1), u - i


@compiled_loops
def interpolate_at(grid: npt.NDArray[np.float32], block: float, x: float, y: float) -> float:
    """Value of a grid of blocks at a pixel position, linear between block centres and on to the edges."""
    i, i2, q = grid_place(y, block, grid.shape[0])
    j, j2, p = grid_place(x, block, grid.shape[1])
    upper = grid[i, j] * (1.0 - p) + grid[i, j2] * p
    lower = grid[i2, j] * (1.0 - p) + grid[i2, j2] * p
    return float(upper * (1.0 - q) + lower * q)
