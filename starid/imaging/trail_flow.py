"""The trails of a rotating sensor as one flow over the whole field.

For a lens without distortion, and (u, v) measured from the centre of the image, trails follow

    dx = t_x + a·u² + b·u·v − r·v,    dy = t_y + a·u·v + b·v² + r·u,

and nearly so for any other: t is the rotation across the boresight, r the rotation about it, a and b the perspective. The
five numbers are fitted to the trails of bright stars, whose directions are known up to sign.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import hypot
from starid.imaging.normal_table import normal
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import copy_values, median

FLOW_TERMS: Final = 5
_TRANSLATION_TERMS: Final = 2
_ROLL_TERMS: Final = 3
_MIN_FOR_ROLL: Final = 5
_MIN_FOR_FLOW: Final = 12
_START_STARS: Final = 7
_CLIP: Final = 3.0
_MIN_CLIP_PX: Final = 0.1
_ROUNDS: Final = 4
_SINGULAR: Final = 1e-12
_SHARE_STEP: Final = 0.1
_SHARE_REACH: Final = 6.0


@compiled_ieee
def _flow_trail(flow: Array, u: float, v: float) -> tuple[float, float]:
    inward = flow[3] * u + flow[4] * v
    return flow[0] + u * inward - flow[2] * v, flow[1] + v * inward + flow[2] * u


@compiled_ieee
def trail_at(flow: Array, x: float, y: float, width: int, height: int) -> tuple[float, float]:
    """Trail (dx, dy) in pixels at an image position, up to its sign.

    Parameters
    ----------
    flow : ndarray (5,)
        t_x, t_y, r, a, b in pixels, for (u, v) in halves of the image's longer side.
    x, y : float
        Position, pixels.
    width, height : int
        Size of the image.
    """
    half = 0.5 * max(width, height)
    return _flow_trail(flow, (x - 0.5 * (width - 1)) / half, (y - 0.5 * (height - 1)) / half)


@compiled_ieee
def _shares(length: float) -> tuple[float, float]:
    """Shift of the fitted spot along a trail and across it, as a share of the acceleration a in p + d·t + a·t²/2, −½ < t < ½.

    The light at time t lies a·t²/2 off, and least squares find the shifts ``a ∫ M' P' / ∫ M'²`` along and ``a ∫ M P / ∫ M²``
    across, where M is the light along the uniform trail and P that weighted with t²/2. Short trails shift with the mean of
    the light, by 1/24, long ones along it with their ends, by 1/8. `length` is in standard deviations of the spot.
    """
    along = slopes = across = lights = 0.0
    for k in range(math.ceil((0.5 * length + _SHARE_REACH) / _SHARE_STEP)):
        x = (k + 0.5) * _SHARE_STEP
        ahead, ahead_bell = normal(x + 0.5 * length)
        behind, behind_bell = normal(x - 0.5 * length)
        light, slope = ahead - behind, ahead_bell - behind_bell
        tilt = (x + 0.5 * length) * ahead_bell - (x - 0.5 * length) * behind_bell
        along += slope * (x * light + slope)
        slopes += slope * slope
        across += light * ((x * x + 1.0) * light + 2.0 * x * slope - tilt)
        lights += light * light
    square = length * length
    return 0.125 + along / (square * slopes), 0.5 * across / (square * lights)


def trail_shifts(
    flow: Array, positions: Array, size: tuple[int, int], sigma_px: float, trail_px: float
) -> tuple[Array, Array]:
    """Shifts (n, 2), pixels, of straight, uniform trails that are fitted to trails from where the stars were at mid-exposure.

    The trails (n, 2) are returned too.

    A trail is curved, and faster at one end: with the trail d(p) at a position p the path is p + d·t + (∇d)d·t²/2,
    −½ < t < ½. Across the trail the fit follows the mean of the light, along it more and more its ends.

    Parameters
    ----------
    flow : ndarray (5,)
        As in `trail_at`.
    positions : ndarray (n, 2)
        Pixels.
    size : (int, int)
        Columns and rows of the image.
    sigma_px, trail_px : float
        Standard deviation of the spot, and typical length of the trails.
    """
    half = 0.5 * max(size)
    u, v = ((positions - 0.5 * np.array([size[0] - 1, size[1] - 1])) / half).T
    inward = flow[3] * u + flow[4] * v
    dx = flow[0] + u * inward - flow[2] * v
    dy = flow[1] + v * inward + flow[2] * u
    change = flow[3] * dx + flow[4] * dy
    trail = np.column_stack([dx, dy])
    curve = (
        np.column_stack([dx * inward + u * change - flow[2] * dy, dy * inward + v * change + flow[2] * dx])
        / half
    )
    share_along, share_across = _shares(trail_px / sigma_px)
    along = np.sum(curve * trail, axis=1) / np.maximum(np.sum(trail * trail, axis=1), _SINGULAR)
    return share_across * curve + (share_along - share_across) * along[:, None] * trail, trail


@compiled_ieee
def _rows(u: float, v: float, rows: Array) -> None:
    """Coefficients (2, 5) of the flow terms in dx and dy at a position."""
    rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3], rows[0, 4] = 1.0, 0.0, -v, u * u, u * v
    rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3], rows[1, 4] = 0.0, 1.0, u, u * v, v * v


@compiled_ieee
def _mismatch(flow: Array, positions: Array, trails: Array, k: int) -> tuple[float, float]:
    """Distance between the measured trail k and the flow's, and the sense (±1) that minimises it."""
    dx, dy = _flow_trail(flow, positions[k, 0], positions[k, 1])
    forth = hypot(trails[k, 0] - dx, trails[k, 1] - dy)
    back = hypot(trails[k, 0] + dx, trails[k, 1] + dy)
    return (forth, 1.0) if forth <= back else (back, -1.0)


@compiled_ieee
def _solve(matrix: Array, right: Array, used: int, out: Array) -> bool:
    """Solve the first `used` equations of a positive definite system by elimination; False if it is singular."""
    for column in range(used):
        pivot = column
        for row in range(column + 1, used):
            if abs(matrix[row, column]) > abs(matrix[pivot, column]):
                pivot = row
        if abs(matrix[pivot, column]) < _SINGULAR:
            return False
        for k in range(used):
            matrix[column, k], matrix[pivot, k] = matrix[pivot, k], matrix[column, k]
        right[column], right[pivot] = right[pivot], right[column]
        for row in range(column + 1, used):
            factor = matrix[row, column] / matrix[column, column]
            for k in range(column, used):
                matrix[row, k] -= factor * matrix[column, k]
            right[row] -= factor * right[column]
    out[:] = 0.0
    for row in range(used - 1, -1, -1):
        value = right[row]
        for k in range(row + 1, used):
            value -= matrix[row, k] * out[k]
        out[row] = value / matrix[row, row]
    return True


@compiled_ieee
def _least_squares(
    positions: Array,
    trails: Array,
    senses: Array,
    used: int,
    matrix: Array,
    right: Array,
    rows: Array,
    out: Array,
) -> bool:
    """Fit a flow of `used` terms to the trails, each with its sign (0: left out)."""
    matrix[:] = 0.0
    right[:] = 0.0
    for k in range(positions.shape[0]):
        if senses[k] == 0.0:
            continue
        _rows(positions[k, 0], positions[k, 1], rows)
        for axis in range(2):
            seen = senses[k] * trails[k, axis]
            for i in range(used):
                right[i] += rows[axis, i] * seen
                for j in range(used):
                    matrix[i, j] += rows[axis, i] * rows[axis, j]
    return _solve(matrix, right, used, out)


@compiled_ieee
def _mean_mismatch(flow: Array, positions: Array, trails: Array) -> float:
    """Mean distance between the measured trails and the flow, each limited to half its length."""
    total = 0.0
    for k in range(positions.shape[0]):
        off, _ = _mismatch(flow, positions, trails, k)
        total += min(off, 0.5 * hypot(trails[k, 0], trails[k, 1]))
    return float(total / positions.shape[0])


@compiled_ieee
def fit_flow(positions: Array, trails: Array, flow: Array) -> None:
    """Fit a flow (5,) to trails (n, 2) at positions (n, 2), of unknown sign.

    Starting points are translations along the trail of a bright star, and translation with roll through two such trails
    with either relative sign; the best is refined by least squares without outliers. Few stars determine
    fewer terms: fewer than 5 only the translation, fewer than 12 no perspective.
    """
    count = positions.shape[0]
    senses = np.zeros(count)
    matrix = np.empty((FLOW_TERMS, FLOW_TERMS))
    right = np.empty(FLOW_TERMS)
    rows = np.empty((2, FLOW_TERMS))
    start = np.zeros(FLOW_TERMS)
    few = min(count, _START_STARS)
    flow[:] = 0.0
    least = math.inf
    for i in range(few):
        for j in range(i, few):
            for sense in (1.0, -1.0):
                senses[:] = 0.0
                senses[i] = 1.0
                if j > i:
                    senses[j] = sense
                terms = _ROLL_TERMS if j > i else _TRANSLATION_TERMS
                if not _least_squares(positions, trails, senses, terms, matrix, right, rows, start):
                    continue
                left = _mean_mismatch(start, positions, trails)
                if left < least:
                    least = left
                    copy_values(start, flow)
    used = (
        _TRANSLATION_TERMS if count < _MIN_FOR_ROLL else _ROLL_TERMS if count < _MIN_FOR_FLOW else FLOW_TERMS
    )
    off, ordered = np.empty(count), np.empty(count)
    for _ in range(_ROUNDS):
        for k in range(count):
            off[k], senses[k] = _mismatch(flow, positions, trails, k)
            ordered[k] = off[k]
        limit = max(_CLIP * median(ordered, count), _MIN_CLIP_PX)
        kept = 0
        for k in range(count):
            if off[k] > limit:
                senses[k] = 0.0
            else:
                kept += 1
        if kept < used or not _least_squares(positions, trails, senses, used, matrix, right, rows, start):
            return
        copy_values(start, flow)


@compiled_ieee
def lengths_and_mismatches(flow: Array, positions: Array, trails: Array) -> tuple[Array, Array]:
    """Lengths (n,) of a flow's trails at positions (n, 2), and their distances (n,) from the measured ones (n, 2), pixels."""
    lengths = np.empty(positions.shape[0])
    off = np.empty(positions.shape[0])
    for k in range(positions.shape[0]):
        dx, dy = _flow_trail(flow, positions[k, 0], positions[k, 1])
        lengths[k] = hypot(dx, dy)
        off[k], _ = _mismatch(flow, positions, trails, k)
    return lengths, off
