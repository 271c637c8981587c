"""Peaks of an image that is smoothed with the profile of a star, or along trails.

What is found with other values of a constant: `python tools/vary_constant.py imaging.peaks._MAX_PEAKS 4096`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple, Self

import numpy as np

from starid.arithmetic.arrays import Array, Array32, Indices32, Mask
from starid.imaging.matched_filter import (
    INTEGER_TAPS_SUM,
    find_peaks,
    find_peaks_in_bytes,
    integer_taps,
    noise_factor,
    spot_noise_factor,
    spot_taps,
)
from starid.imaging.scene import Scene
from starid.imaging.spot_shape import SpotShape
from starid.imaging.trail_filter import sum_along_trails, trail_noise_factor, trail_steps
from starid.imaging.windows import MIN_SPREAD_PX, sky_under_lone_pixels

_MAX_PEAKS: Final = 8192
"""Room for peaks, 100 kB; with half, a fifth of the stars among 5000 hot pixels are lost (947 of 1209), with twice none is won."""

_THRESHOLD_STEP: Final = 1.5
"""Factor on the threshold while there is no room; with 1.2 or 3 the same stars are found."""


class Peaks(NamedTuple):
    """Peaks (n, 2), highest first, their smoothed heights (n,) above the background, and the sky (n,) under hot pixels.

    The sky is NaN under peaks of several pixels.
    """

    xy: Indices32
    heights: Array32
    sky: Array

    @property
    def several(self) -> Mask:
        """Which peaks (n,) have several pixels."""
        return np.isnan(self.sky)

    def parted(self, sigma_px: float) -> tuple[Self, Self]:
        """Return the candidates, and the hot pixels: none if the light of a star may fall on one pixel."""
        hot = ~self.several if sigma_px >= MIN_SPREAD_PX else np.zeros(len(self.sky), dtype=np.bool_)
        return self._of(~hot), self._of(hot)

    def _of(self, mask: Mask) -> Self:
        return type(self)(self.xy[mask], self.heights[mask], self.sky[mask])


def find_spots(scene: Scene, sigma_px: float) -> Peaks:
    """Find peaks as high as a star's, whose spot has a standard deviation."""
    xy, heights = _smoothed_peaks(scene, sigma_px)
    sky = np.empty(len(xy))
    sky_under_lone_pixels(scene.counts, xy, *scene.grids, sky)
    return Peaks(xy, heights, sky)


def _smoothed_peaks(scene: Scene, sigma_px: float) -> tuple[Indices32, Array32]:
    counts, block_px = scene.counts, scene.background.block_px
    bytes_taps = integer_taps(sigma_px)
    if counts.dtype == np.uint8 and bytes_taps is not None:
        taps8, image8 = bytes_taps, counts.view(np.uint8)

        def search_bytes(threshold: Array32, peaks: Indices32, heights: Array32) -> int:
            return find_peaks_in_bytes(image8, threshold, block_px, taps8, peaks, heights)

        return _search(search_bytes, scene, noise_factor(taps8 / INTEGER_TAPS_SUM))
    taps = spot_taps(sigma_px)
    image16 = counts.astype(np.uint16, copy=False)  # as the sums along trails, so one kernel does for both

    def search(threshold: Array32, peaks: Indices32, heights: Array32) -> int:
        return find_peaks(image16, threshold, block_px, taps, peaks, heights)

    return _search(search, scene, spot_noise_factor(sigma_px))


def find_trails(scene: Scene, shape: SpotShape, hot: Peaks) -> tuple[Indices32, Array32]:
    """Find peaks (n, 2) as high as a trail's, highest first, and their heights (n,); hot pixels would be smeared, and are left out."""
    counts, block_px = scene.with_values(hot.xy, hot.sky).counts, scene.background.block_px
    steps = trail_steps(shape.flow, *scene.size)
    sums, scale = sum_along_trails(counts, shape.flow, steps)
    taps = spot_taps(shape.sigma_px)

    def search(threshold: Array32, peaks: Indices32, heights: Array32) -> int:
        count = find_peaks(sums, np.float32(scale) * threshold, block_px, taps, peaks, heights)
        heights[:count] /= np.float32(scale)
        return count

    return _search(search, scene, trail_noise_factor(shape.sigma_px, shape.trail_px, steps))


def _search(
    search: Callable[[Array32, Indices32, Array32], int], scene: Scene, factor: float
) -> tuple[Indices32, Array32]:
    """Search for peaks above the threshold, in noise that a filter has multiplied by a factor; above a higher one if there are too many."""
    background = scene.background
    sigmas = scene.settings.threshold_sigma * factor
    xy = np.empty((_MAX_PEAKS, 2), dtype=np.int32)
    heights = np.empty(_MAX_PEAKS, dtype=np.float32)
    while True:
        threshold = (background.level + np.float32(sigmas) * background.noise).astype(np.float32)
        count = search(threshold, xy, heights)
        if count < _MAX_PEAKS:
            break
        sigmas *= _THRESHOLD_STEP
    xy, heights = xy[:count], heights[:count]
    heights -= scene.level_of_block(xy)
    order = np.argsort(-heights, kind="stable")
    return xy[order], heights[order]
