"""How far light that the fit of a star does not model may have shifted it: edges, fainter stars on its trail, the trail's own model.

A fit states the error that noise leaves. It takes the sky around a star for even, and the star for the only one on its trail;
where that is wrong, its position is wrong by more than noise, and these errors are added to its variance.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, Mask, Records
from starid.arithmetic.elementary import square
from starid.imaging.background import Background

_TRAIL_ERROR: Final = 4e-4
"""Error along a trail, as a share of its length, that its model leaves."""

_CUT_TRAIL_ERROR: Final = 0.01
"""The same, also across, of a trail that the image's edge cuts off: its length and direction are known only from other stars."""

_UNRESOLVED_SHARE: Final = 0.1
"""Flux of a star on the trail of another, as a share of it, from which χ² of the fit shows it: it then stands seven sigmas out of
the noise of the trail."""

_DARK_SIGMA: Final = 6.0
_DARK_PIXELS: Final = 3
"""A window with this many pixels so far below the sky is cut by something dark; one or two may be dead."""

_STEP_PER_SPREAD: Final = 1.349
"""Height of a step, in standard deviations by quartiles of a ring that it divides in halves."""


def shift_by_edge(
    windows: Records,
    pixels: Array32,
    flux: Array,
    background: Background,
    light_variance: float,
) -> Array:
    """Return how far (n,) an edge in the background may have shifted the fits of stars, pixels.

    Their windows (n,) lie in `pixels`, above the sky; the flux (n,) is in counts, the variance of light in counts² per count. An
    edge, as of a body in front of the sky, is not noise: all pixels on one side of it pull the same way. A step of height h through
    the middle of a spot shifts its fit by ``h ∫ M_x θ / (F ∫ M_x²)``, with the shape M and the flux F of the star: by
    8 π σ³ h / (√(2π) F) for a round one, and by 2 π σ² L h / F along a trail of length L. There is a step where some pixels of the
    window are darker than any sky, or where the ring around it varies more than noise and the light of the background explain.
    """
    explained = np.full(len(windows), square(background.median_noise))
    explained += light_variance * np.maximum(windows["base"] - background.median_level, 0.0)
    rest = square(windows["noise"]) - explained
    step = _STEP_PER_SPREAD * np.sqrt(np.where(rest > explained, rest, 0.0))
    begins = windows["offset"]
    ends = begins + windows["columns"] * windows["rows"]
    lowest = np.minimum.reduceat(np.append(pixels, np.float32(0.0)), np.column_stack([begins, ends]).ravel())[
        ::2
    ]
    dark = _DARK_SIGMA * np.sqrt(explained)
    for k in np.flatnonzero(-lowest > dark):
        darkest = -float(np.partition(pixels[begins[k] : ends[k]], _DARK_PIXELS - 1)[_DARK_PIXELS - 1])
        if darkest > dark[k]:
            step[k] = max(step[k], darkest)
    trail2 = square(windows["trail_x"]) + square(windows["trail_y"])
    sigma = windows["sigma"]
    reach = np.sqrt(trail2 + square(4.0 / math.sqrt(2.0 * math.pi) * sigma))
    return np.asarray(2.0 * math.pi * square(sigma) * reach * step / flux, dtype=np.float64)


def shift_by_hidden_stars(flux: Array, length: Array, sigma_px: float, size: tuple[int, int]) -> Array:
    """Return how far (n, 2) fainter stars on the trails of stars shift their fits along and across the trail, rms, pixels.

    A trail covers an area in which a fainter star is not resolved. One of flux f, displaced by l along and x across a trail of
    length L and flux F, shifts its fit by ``f/F · √π s · exp(−x²/4s²)`` along it if l < L, and by ``f/F · (1 − l/L) · x ·
    exp(−x²/4s²)`` across; s is the width of the spot, with the pixel's own. The mean squares, over stars as dense as those in the
    image, are ``2 π √(2π) L s³`` and ``⅔ √(2π) L s³`` times Σ f²/(F² A), where the sum is over the stars of area A that are
    faint enough.
    """
    width2 = square(sigma_px) + 1.0 / 12.0
    fainter = np.where(flux[None, :] < _UNRESOLVED_SHARE * flux[:, None], flux[None, :], 0.0)
    squares = np.sum(square(fainter), axis=1) / (square(flux) * size[0] * size[1])
    both = math.sqrt(2.0 * math.pi * width2) * width2 * np.array([2.0 * math.pi, 2.0 / 3.0])
    return np.asarray(np.sqrt((squares * length)[:, None] * both), dtype=np.float64)


def trail_variances(
    trails: Array, flux: Array, cut_off: Mask, sigma_px: float, size: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Return variances along x and y, and covariance, (n,) each, pixels², that trails (n, 2) add to the positions of stars.

    `cut_off` (n,) are those that the edge of an image of width and height `size` cuts off.
    """
    length2 = np.sum(square(trails), axis=1)
    cut = square(np.where(cut_off, _CUT_TRAIL_ERROR, 0.0)) * length2
    hidden = square(shift_by_hidden_stars(flux, np.sqrt(length2), sigma_px, size))
    # along and across: the same in all directions, and more along the trail
    across = cut + hidden[:, 1]
    more = square(_TRAIL_ERROR) + (hidden[:, 0] - hidden[:, 1]) / np.maximum(length2, 1.0)
    return (
        np.asarray(more * square(trails[:, 0]) + across),
        np.asarray(more * square(trails[:, 1]) + across),
        np.asarray(more * trails[:, 0] * trails[:, 1]),
    )
