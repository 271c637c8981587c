"""Candidate stars: local maxima, above the noise, of the image smoothed with the profile of a star.

Smoothing with the profile of a star is the linear filter with the best signal-to-noise ratio for detecting it in white
noise. One sweep keeps a few rows at a time, so that everything stays in the first-level cache.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array32, GreyImage, Indices32
from starid.arithmetic.elementary import square
from starid.imaging.background import block_position
from starid.imaging.normal_table import distribution
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import zero

INTEGER_TAPS_SUM: Final = 16
"""Sum of the integer filter's taps along one axis, so that a byte smoothed along both axes fits 16 bits."""

_SHARP_BELOW_PX: Final = 0.65
_INTEGER_UP_TO_PX: Final = 1.3
_SHARP_TAPS: Final = np.array([8, 4, 0], dtype=np.uint16)
_SOFT_TAPS: Final = np.array([6, 4, 1], dtype=np.uint16)
_LINE_STEP: Final = 4
_GROUP: Final = 32
_HALF_WIDTH_SIGMA: Final = 2.2


@lru_cache(maxsize=4)
def spot_taps(sigma_px: float) -> Array32:
    """Right half (r + 1,) of the filter along one axis, centre first: a Gaussian integrated over pixels, sum 1.

    Shared between calls: not to be changed.
    """
    reach = max(1, math.floor(_HALF_WIDTH_SIGMA * sigma_px + 0.5))
    edges = (np.arange(reach + 2) - 0.5) / sigma_px
    shares = np.diff([distribution(edge) for edge in edges.tolist()])
    taps: Array32 = (shares / (shares[0] + 2.0 * shares[1:].sum())).astype(np.float32)
    return taps


def noise_factor(taps: npt.NDArray[np.floating]) -> float:
    """Ratio of the noise of the smoothed image to the noise of a pixel."""
    return float(square(taps[0]) + 2.0 * np.sum(square(taps[1:]), dtype=np.float64))


@lru_cache(maxsize=4)
def spot_noise_factor(sigma_px: float) -> float:
    """`noise_factor` of `spot_taps`."""
    return noise_factor(spot_taps(sigma_px))


def integer_taps(sigma_px: float) -> npt.NDArray[np.uint16] | None:
    """Right half (3,) of an integer filter close to `spot_taps`, centre first; None if there is none.

    Its signal-to-noise ratio is within 4 % of the best for spots of 0.6 to 1.3 pixels.
    """
    if sigma_px > _INTEGER_UP_TO_PX:
        return None
    return _SHARP_TAPS if sigma_px < _SHARP_BELOW_PX else _SOFT_TAPS


@compiled_ieee
def _smooth_down(image: GreyImage, y: int, taps: Array32, out: Array32) -> None:
    """Smooth row y of the image across rows; the first and last rows are repeated beyond the edge."""
    height, width = image.shape
    reach = taps.size - 1
    bottom = height - 1
    centre = image[y]
    up, down = image[max(y - 1, 0)], image[min(y + 1, bottom)]
    if reach == 2:
        up2, down2 = image[max(y - 2, 0)], image[min(y + 2, bottom)]
        t0, t1, t2 = taps[0], taps[1], taps[2]
        for x in range(width):
            near = np.int32(np.int32(up[x]) + np.int32(down[x]))
            far = np.int32(np.int32(up2[x]) + np.int32(down2[x]))
            out[x] = t0 * np.float32(centre[x]) + t1 * np.float32(near) + t2 * np.float32(far)
        return
    for x in range(width):
        out[x] = taps[0] * np.float32(centre[x])
    for k in range(1, reach + 1):
        up, down = image[max(y - k, 0)], image[min(y + k, bottom)]
        tap = taps[k]
        for x in range(width):
            out[x] += tap * np.float32(np.int32(up[x]) + np.int32(down[x]))


@compiled_ieee
def _smooth_along(padded: Array32, taps: Array32, out: Array32) -> None:
    """Smooth a row that is padded at both ends, by the reach of the filter, with its end values."""
    width = out.size
    reach = taps.size - 1
    for k in range(reach):
        padded[k] = padded[reach]
        padded[reach + width + k] = padded[reach + width - 1]
    if reach == 2:
        t0, t1, t2 = taps[0], taps[1], taps[2]
        for x in range(width):
            out[x] = (
                t0 * padded[x + 2] + t1 * (padded[x + 1] + padded[x + 3]) + t2 * (padded[x] + padded[x + 4])
            )
        return
    for x in range(width):
        out[x] = taps[0] * padded[reach + x]
    for k in range(1, reach + 1):
        tap = taps[k]
        left = padded[reach - k : reach - k + width]
        right = padded[reach + k : reach + k + width]
        for x in range(width):
            out[x] += tap * (left[x] + right[x])


@compiled_ieee
def _grid_line(grid: Array32, i: int, block: float, out: Array32) -> None:
    """Interpolate row i of a grid of blocks at every image column."""
    columns = grid.shape[1]
    width = out.size
    start = 0
    for j in range(max(columns - 1, 1)):
        # from the centre of block j to the next; the first and last extend to the edges
        end = width if j >= columns - 2 else min(math.ceil((j + 1.5) * block - 0.5), width)
        low = grid[i, j]
        slope = (grid[i, min(j + 1, columns - 1)] - low) / np.float32(block)
        origin = np.float32((j + 0.5) * block - 0.5)
        for x in range(start, end):
            out[x] = low + slope * (np.float32(x) - origin)
        start = max(end, start)


@compiled_ieee
def _threshold_row(lines: Array32, q: np.float32, limit: Array32) -> None:
    """Interpolate the threshold of a row between two grid lines."""
    upper, lower = lines[0], lines[1]
    for x in range(limit.size):
        limit[x] = upper[x] + q * (lower[x] - upper[x])


@compiled_ieee
def _flag_groups(
    row: Array32, limit: Array32, above: npt.NDArray[np.uint8], flags: npt.NDArray[np.uint8]
) -> None:
    """Mark groups of 32 pixels with any above its limit; `above` is workspace of 32 zero bytes per group."""
    for x in range(row.size):
        above[x] = row[x] > limit[x]
    words = above.view(np.uint64)
    for group in range(flags.size):
        first = 4 * group
        any_above = words[first] | words[first + 1] | words[first + 2] | words[first + 3]
        flags[group] = any_above != np.uint64(0)


@compiled_ieee
def _flag_groups_integer(
    row: npt.NDArray[np.uint16], limit: npt.NDArray[np.uint16], flags: npt.NDArray[np.uint8]
) -> None:
    """As `_flag_groups`, for 16-bit integers."""
    whole = row.size // _GROUP
    for group in range(whole):
        start = group * _GROUP
        most = np.uint16(0)
        for k in range(_GROUP):
            value, least = row[start + k], limit[start + k]
            most = max(most, np.uint16(value - least) if value > least else np.uint16(0))
        flags[group] = most > np.uint16(0)
    if whole < flags.size:
        flags[whole] = 1


@compiled_ieee
def _peaks_of_row(
    y: int,
    row: Array32 | npt.NDArray[np.uint16],
    before: Array32 | npt.NDArray[np.uint16],
    after: Array32 | npt.NDArray[np.uint16],
    limit: Array32 | npt.NDArray[np.uint16],
    flags: npt.NDArray[np.uint8],
    count: int,
    peaks: Indices32,
    heights: Array32,
) -> int:
    """Append the peaks of row y above its limit, in the marked groups, to the list; return its length.

    A peak has no higher neighbour, nor an earlier equal one. The three rows have an extra zero at each end.
    """
    is_top = np.empty(_GROUP, np.bool_)
    for group in range(flags.size):
        if flags[group] == 0:
            continue
        start = group * _GROUP
        size = min(_GROUP, limit.size - start)
        for k in range(size):
            x = start + k
            value = row[x + 1]
            is_top[k] = (
                (value > limit[x])
                & (row[x] < value)
                & (row[x + 2] <= value)
                & (before[x] < value)
                & (before[x + 1] < value)
                & (before[x + 2] < value)
                & (after[x] <= value)
                & (after[x + 1] <= value)
                & (after[x + 2] <= value)
            )
        for k in range(size):
            if not is_top[k]:
                continue
            if count == peaks.shape[0]:
                return count
            peaks[count, 0] = start + k
            peaks[count, 1] = y
            heights[count] = np.float32(row[start + k + 1])
            count += 1
    return count


@compiled_ieee
def _update_grid_lines(
    grid: Array32, block: float, y: int, current: int, lines: Array32
) -> tuple[int, np.float32]:
    """Update the two grid lines on either side of row y; return the first, and the fraction between them."""
    i, i2, q = block_position(float(y), block, grid.shape[0])
    if i != current:
        _grid_line(grid, i, block, lines[0])
        _grid_line(grid, i2, block, lines[1])
    return i, np.float32(q)


@compiled_ieee
def find_peaks(
    image: GreyImage, threshold: Array32, block: float, taps: Array32, peaks: Indices32, heights: Array32
) -> int:
    """Find the local maxima of the smoothed image above a threshold.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    threshold : ndarray (rows, columns), float32
        Smallest smoothed value of a peak, on the grid of blocks.
    block : float
        Side of a block, pixels.
    taps : ndarray (r + 1,)
        From `spot_taps`.
    peaks : ndarray (m, 2), int32
        Filled with the column and row of each peak.
    heights : ndarray (m,), float32
        Filled with the smoothed value.

    Returns
    -------
    int
        Number of peaks; m means that the list is full and later rows were not searched.
    """
    height, width = image.shape
    reach = taps.size - 1
    padded = np.empty(width + 2 * reach, np.float32)
    smooth = np.zeros((3, width + 2), np.float32)
    lines = np.empty((2, width), np.float32)
    limit = np.empty(width, np.float32)
    flags = np.empty(-(-width // _GROUP), np.uint8)
    above = np.zeros(_GROUP * flags.size, np.uint8)
    count = zero()
    line = -1
    for y in range(height + 1):
        if y < height:
            _smooth_down(image, y, taps, padded[reach : reach + width])
            _smooth_along(padded, taps, smooth[y % 3, 1 : width + 1])
        else:
            smooth[y % 3] = 0.0
        if y > 0:
            # now both neighbours of row y − 1 are available
            line, q = _update_grid_lines(threshold, block, y - 1, line, lines)
            row, before, after = smooth[(y - 1) % 3], smooth[(y + 1) % 3], smooth[y % 3]
            _threshold_row(lines, q, limit)
            _flag_groups(row[1 : width + 1], limit, above, flags)
            count = _peaks_of_row(y - 1, row, before, after, limit, flags, count, peaks, heights)
    return count


@compiled_ieee
def _smooth_down_integer(
    image: npt.NDArray[np.uint8], y: int, taps: npt.NDArray[np.uint16], out: npt.NDArray[np.uint16]
) -> None:
    """As `_smooth_down`, in 16-bit integers."""
    bottom = image.shape[0] - 1
    centre = image[y]
    up, down = image[max(y - 1, 0)], image[min(y + 1, bottom)]
    up2, down2 = image[max(y - 2, 0)], image[min(y + 2, bottom)]
    t0, t1, t2 = taps[0], taps[1], taps[2]
    for x in range(out.size):
        near = np.uint16(np.uint16(up[x]) + np.uint16(down[x]))
        far = np.uint16(np.uint16(up2[x]) + np.uint16(down2[x]))
        out[x] = np.uint16(np.uint16(np.uint16(centre[x]) * t0) + np.uint16(near * t1) + np.uint16(far * t2))


@compiled_ieee
def _smooth_along_integer(
    padded: npt.NDArray[np.uint16], taps: npt.NDArray[np.uint16], out: npt.NDArray[np.uint16]
) -> None:
    """As `_smooth_along`, in 16-bit integers; `padded` has two extra values at each end."""
    width = out.size
    padded[0] = padded[1] = padded[2]
    padded[width + 2] = padded[width + 3] = padded[width + 1]
    t0, t1, t2 = taps[0], taps[1], taps[2]
    for x in range(width):
        near = np.uint16(padded[x + 1] + padded[x + 3])
        far = np.uint16(padded[x] + padded[x + 4])
        out[x] = np.uint16(np.uint16(padded[x + 2] * t0) + np.uint16(near * t1) + np.uint16(far * t2))


@compiled_ieee
def find_peaks_in_bytes(
    image: npt.NDArray[np.uint8],
    threshold: Array32,
    block: float,
    taps: npt.NDArray[np.uint16],
    peaks: Indices32,
    heights: Array32,
) -> int:
    """As `find_peaks`, several times faster, with the taps of `integer_taps`."""
    height, width = image.shape
    padded = np.empty(width + 4, np.uint16)
    smooth = np.zeros((3, width + 2), np.uint16)
    lines = np.empty((2, width), np.float32)
    limit = np.empty(width, np.uint16)
    flags = np.empty(-(-width // _GROUP), np.uint8)
    scale = np.float32(square(INTEGER_TAPS_SUM))
    highest = np.int32(65535)
    count = zero()
    line = -1
    for y in range(height + 1):
        if y < height:
            _smooth_down_integer(image, y, taps, padded[2 : 2 + width])
            _smooth_along_integer(padded, taps, smooth[y % 3, 1 : width + 1])
        else:
            smooth[y % 3] = 0
        if y > 0:
            if (y - 1) % _LINE_STEP == 0:
                line, q = _update_grid_lines(threshold, block, y - 1 + _LINE_STEP // 2, line, lines)
                upper, lower = lines[0], lines[1]
                for x in range(width):
                    value = np.int32(scale * (upper[x] + q * (lower[x] - upper[x])))
                    limit[x] = np.uint16(min(max(value, np.int32(0)), highest))
            row, before, after = smooth[(y - 1) % 3], smooth[(y + 1) % 3], smooth[y % 3]
            _flag_groups_integer(row[1 : width + 1], limit, flags)
            count = _peaks_of_row(y - 1, row, before, after, limit, flags, count, peaks, heights)
    for k in range(count):
        heights[k] /= scale
    return count
