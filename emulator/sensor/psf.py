"""Star light on the pixels: a Gaussian spot integrated over each pixel and along its path during an exposure."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, elementwise
from starid.arithmetic.elementary import cos, log, square
from starid.imaging.normal_table import normal
from starid.kernels.jit import compiled_ieee, inner

MAX_GAUSS_NODES: Final = 200
MAX_NODES: Final = 20_000
MAX_RADIUS_SIGMA: Final = 7.0
_NODES_PER_SIGMA: Final = 0.85
_MIN_NODES: Final = 3
_NEWTON_STEPS: Final = 6
_STILL_SIGMA: Final = 1e-3
_CUT_E: Final = 0.01


@lru_cache(maxsize=64)
def _rule(count: int) -> tuple[Array, Array]:
    """Return nodes on (−1, 1) and weights that sum to 1: Gauss–Legendre, or midpoints for very many nodes."""
    if count > MAX_GAUSS_NODES:
        nodes = np.linspace(-1.0, 1.0, count, endpoint=False, dtype=np.float64) + 1.0 / count
        return nodes, np.full(count, 1.0 / count, dtype=np.float64)
    nodes = elementwise(cos, math.pi * (np.arange(count) + 0.75) / (count + 0.5))
    for _ in range(_NEWTON_STEPS):
        value, slope = _legendre(nodes, count)
        nodes = nodes - value / slope
    _, slope = _legendre(nodes, count)
    return nodes, 1.0 / ((1.0 - square(nodes)) * square(slope))


def _legendre(x: Array, degree: int) -> tuple[Array, Array]:
    """Return the Legendre polynomial of a degree and its derivative, −1 < x < 1."""
    before, value = np.ones_like(x), x
    for k in range(2, degree + 1):
        before, value = value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * before) / k
    return value, degree * (before - x * value) / (1.0 - square(x))


def path_rule(longest_px: float, sigma_px: float) -> tuple[Array, Array]:
    """Return the quadrature rule that sums a spot, moving along a path of up to `longest_px` pixels, to a smooth trail.

    It has nodes (n,), times from −1 (start of the exposure) to 1 (its end), and weights (n,) that sum to 1. A path
    below a thousandth of the spot width gets one node. Otherwise nodes are closer than the sigma of the spot;
    Gauss–Legendre quadrature of a Gaussian is then accurate to about 1e-5 of its peak.
    """
    lengths = longest_px / sigma_px
    if lengths < _STILL_SIGMA:
        return _rule(1)
    return _rule(
        min(_MIN_NODES + math.ceil(_NODES_PER_SIGMA * lengths + 2.0 * math.sqrt(lengths)), MAX_NODES)
    )


@inner
def _bell(edge: float, sigma: float, out: Array, count: int) -> None:
    """Compute the fractions of a Gaussian around 0 in `count` unit cells; the first cell starts at `edge`."""
    scale = 1.0 / sigma
    before, _ = normal(edge * scale)
    for k in range(count):
        after, _ = normal((edge + k + 1.0) * scale)
        out[k] = after - before
        before = after


@compiled_ieee
def add_spots(
    image: Array32,
    sensitivity: Array32,
    path: Array,
    electrons: Array,
    sigma: Array,
    nodes: Array,
    weights: Array,
) -> None:
    """Add the light of stars to an image (h, w) of mean electrons, in place.

    A path (n, 6) is x0, y0, x1, y1, x2, y2, pixels: at time t, −1…1 over the exposure, x = x0 + x1·t + x2·t², and the
    same for y. `electrons` (n,) is the mean of each star in the whole exposure, `sigma` (n, 2) the standard deviation
    of its spot along x and y, pixels. Sensitivity (h, w) is the relative signal of each pixel; nodes and weights are
    from `path_rule`.
    """
    height, width = image.shape
    across = np.empty(width)
    down = np.empty(height)
    for i in range(electrons.size):
        total = electrons[i]
        if not total > 0.0:
            continue
        sigma_x, sigma_y = sigma[i, 0], sigma[i, 1]
        radii = math.sqrt(2.0 * log(max(total / _CUT_E, 2.0)))
        radii = min(radii, MAX_RADIUS_SIGMA)
        for m in range(nodes.size):
            t = nodes[m]
            x = path[i, 0] + t * (path[i, 2] + t * path[i, 4])
            y = path[i, 1] + t * (path[i, 3] + t * path[i, 5])
            left = max(math.floor(x - radii * sigma_x + 0.5), 0)
            right = min(math.floor(x + radii * sigma_x + 0.5), width - 1)
            top = max(math.floor(y - radii * sigma_y + 0.5), 0)
            bottom = min(math.floor(y + radii * sigma_y + 0.5), height - 1)
            if left > right or top > bottom:
                continue
            columns = right - left + 1
            _bell(left - 0.5 - x, sigma_x, across, columns)
            _bell(top - 0.5 - y, sigma_y, down, bottom - top + 1)
            share = total * weights[m]
            for row in range(top, bottom + 1):
                light = share * down[row - top]
                for k in range(columns):
                    image[row, left + k] += np.float32(light * across[k] * sensitivity[row, left + k])
