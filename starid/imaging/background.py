"""Background and noise of an image: robust estimates in blocks, interpolated between their centres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arrays import Array32, GreyImage
from starid.kernels.jit import compiled_ieee, compiled_sums

BLOCK_PX: Final = 32
"""Side of a block, pixels: stars cover about 1 % of it, and stray light is nearly plane within it."""

MIN_NOISE_DN: Final = 12.0**-0.5
"""Standard deviation of rounding to whole counts."""

_ROW_STEP: Final = 4
_FIRST_SAMPLES: Final = 16
_CLIP_SIGMA: Final = 3.5
_QUARTILE_SIGMA: Final = 1.349
_ROUNDS: Final = 2
_MIN_SAMPLES: Final = 8.0


def median(values: npt.NDArray[np.floating]) -> float:
    """Median of a few hundred numbers, five times as fast as ``numpy.median``."""
    ordered = np.sort(values, axis=None)
    return float(0.5 * (float(ordered[(ordered.size - 1) // 2]) + float(ordered[ordered.size // 2])))


@dataclass(frozen=True)
class Background:
    """Background on a grid of blocks.

    Attributes
    ----------
    level, noise : ndarray (rows, columns), float32
        Value at the centre of a block, and standard deviation about the plane through its pixels, both without
        stars; counts.
    block_px : float
        Side of a block; the centre of block (i, j) lies at ((j + ½)·block − ½, (i + ½)·block − ½).
    """

    level: Array32
    noise: Array32
    block_px: int

    @cached_property
    def median_level(self) -> float:
        """Typical background, counts."""
        return median(self.level)

    @cached_property
    def median_noise(self) -> float:
        """Typical noise of a pixel, counts."""
        return median(self.noise)


@compiled_sums
def _refine(values: Array32, dx: Array32, dy: Array32, start: tuple[float, float], plane: Array32) -> None:
    """Fit a plane to the samples of a block without its stars: (level, slopes along dx and dy, noise).

    Samples farther than 3.5 sigmas from the plane are left out, with half a count of allowance, so that rounding to
    counts does not make the interval asymmetric. The offsets `dx`, `dy` are relative to their mean.
    """
    level, sigma = np.float32(start[0]), np.float32(start[1])
    along = across = np.float32(0.0)
    for _ in range(_ROUNDS):
        reach = np.float32(_CLIP_SIGMA) * sigma + np.float32(0.5)
        kept = total = squares = tilt = tilt2 = lean = lean2 = np.float32(0.0)
        for k in range(values.size):
            off = values[k] - level - along * dx[k] - across * dy[k]
            inside = np.float32(1.0) if abs(off) <= reach else np.float32(0.0)
            off *= inside
            kept += inside
            total += off
            squares += off * off
            tilt += off * dx[k]
            tilt2 += inside * dx[k] * dx[k]
            lean += off * dy[k]
            lean2 += inside * dy[k] * dy[k]
        if kept < np.float32(_MIN_SAMPLES):
            break
        mean = total / kept
        explained = mean * mean
        level += mean
        if tilt2 > np.float32(0.0):
            along += tilt / tilt2
            explained += tilt * tilt / (tilt2 * kept)
        if lean2 > np.float32(0.0):
            across += lean / lean2
            explained += lean * lean / (lean2 * kept)
        sigma = np.sqrt(max(squares / kept - explained, np.float32(MIN_NOISE_DN**2)))
    plane[0], plane[1], plane[2], plane[3] = level, along, across, sigma


@compiled_ieee
def _sample_offsets(columns: int, count: int, dx: Array32, dy: Array32) -> None:
    """Offsets of the samples of a block from their mean, pixels: all columns of every fourth row."""
    middle_x, middle_y = 0.5 * (columns - 1), 0.5 * (count // columns - 1)
    for k in range(count):
        dx[k] = np.float32(k % columns - middle_x)
        dy[k] = np.float32((k // columns - middle_y) * _ROW_STEP)


@compiled_ieee
def _block_statistics(image: GreyImage, block: int, level: Array32, noise: Array32) -> None:
    """Fit a plane to every fourth row of each block, starting from the median and quartiles of a few pixels."""
    height, width = image.shape
    first = np.empty(_FIRST_SAMPLES, np.int32)
    values = np.empty(block * block, np.float32)
    dx = np.empty(block * block, np.float32)
    dy = np.empty(block * block, np.float32)
    laid = (0, 0)
    plane = np.empty(4, np.float32)
    for row in range(level.shape[0]):
        for column in range(level.shape[1]):
            top = min(row * block, max(height - block, 0))
            left = min(column * block, max(width - block, 0))
            bottom = min(top + block, height)
            columns = min(left + block, width) - left
            count = 0
            for y in range(top + column % _ROW_STEP, bottom, _ROW_STEP):
                line = image[y, left : left + columns]
                for x in range(columns):
                    values[count + x] = np.float32(line[x])
                count += columns
            step = max(count // _FIRST_SAMPLES, 1)
            chosen = min(count // step, _FIRST_SAMPLES)
            for k in range(chosen):
                key = np.int32(values[k * step])
                j = k - 1
                while j >= 0 and first[j] > key:
                    first[j + 1] = first[j]
                    j -= 1
                first[j + 1] = key
            spread = (first[(3 * chosen) // 4] - first[chosen // 4]) / _QUARTILE_SIGMA
            if laid != (columns, count):
                laid = (columns, count)
                _sample_offsets(columns, count, dx, dy)
            start = (float(first[chosen // 2]), max(spread, 0.5))
            _refine(values[:count], dx[:count], dy[:count], start, plane)
            # from the centre of the sampled pixels to the centre of the block on the grid
            first_row = top + column % _ROW_STEP
            last_row = first_row + _ROW_STEP * (count // columns - 1)
            off_y = (row + 0.5) * block - 0.5 - 0.5 * (first_row + last_row)
            off_x = (column + 0.5) * block - 0.5 - (left + 0.5 * (columns - 1))
            level[row, column] = plane[0] + plane[1] * off_x + plane[2] * off_y
            noise[row, column] = plane[3]


def estimate_background(image: GreyImage, block_px: int = BLOCK_PX) -> Background:
    """Estimate the background and noise of an image (h, w) on a grid of blocks.

    A block that would extend beyond the image is moved inside, so that every block is whole; an image smaller than a
    block is one block.
    """
    height, width = image.shape
    rows, columns = -(-height // block_px), -(-width // block_px)
    level = np.empty((rows, columns), dtype=np.float32)
    noise = np.empty((rows, columns), dtype=np.float32)
    _block_statistics(image, block_px, level, noise)
    return Background(level, noise, block_px)


@compiled_ieee
def block_position(position: float, block: float, count: int) -> tuple[int, int, float]:
    """The two block centres on either side of a pixel, and its fraction of the way to the second.

    Beyond the outermost centres the fraction is below 0 or above 1, so that slopes continue to the edge of the image.
    """
    u = (position + 0.5) / block - 0.5
    i = min(max(int(u), 0), max(count - 2, 0))
    return i, min(i + 1, count - 1), u - i


@compiled_ieee
def interpolate_at(grid: Array32, block: float, x: float, y: float) -> float:
    """Value of a grid of blocks at a pixel, interpolated linearly between centres and extrapolated to the edges."""
    i, i2, q = block_position(y, block, grid.shape[0])
    j, j2, p = block_position(x, block, grid.shape[1])
    upper = grid[i, j] * (1.0 - p) + grid[i, j2] * p
    lower = grid[i2, j] * (1.0 - p) + grid[i2, j2] * p
    return float(upper * (1.0 - q) + lower * q)
