"""Candidates of an image, and the windows around them, which are laid only around as many as are examined.

What is found with other values of a constant: `python tools/vary_constant.py imaging.candidates._EVEN_NOISE 3`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, Indices32, Mask, Records
from starid.arithmetic.elementary import square
from starid.imaging.matched_filter import spot_noise_factor
from starid.imaging.scene import Scene
from starid.imaging.windows import WINDOW, cut_windows, lay_windows

_EVEN_NOISE: Final = 1.5
"""Noise of an even sky in a ring of 48 pixels, in units of the typical noise, at most: that from quartiles has an error of
1.17/√48 = 17 %, and this is three of them. With 3, three stars of 312 in hard skies are lost, and seven more are false."""


class Candidates:
    """Peaks that may be stars, and the windows around the first of them.

    Parameters
    ----------
    scene : Scene
        The image.
    peaks, heights : ndarray (n, 2), (n,)
        Peaks, highest first, and their smoothed heights above the background.
    sigma_px : float
        Standard deviation of a spot.
    flow : ndarray (5,)
        Flow of the trails (`starid.imaging.trail_flow`).
    """

    def __init__(
        self, scene: Scene, peaks: Indices32, heights: Array32, sigma_px: float, flow: Array
    ) -> None:
        self.scene = scene
        self._peaks, self._heights = peaks, heights
        self._sigma_px, self._flow = sigma_px, flow
        self._windows, self._pixels = np.zeros(0, WINDOW), 0

    def cut(self, most: int) -> tuple[Records, Array32]:
        """Windows (n,) of the first candidates, `most` of them, and the pixels (m,) of all windows, less the sky."""
        windows = self._laid(most)
        pixels = np.empty(self._pixels, dtype=np.float32)
        cut_windows(self.scene.counts, windows, *self.scene.level, self.scene.saturation, pixels)
        return windows, pixels

    def standing_out(self, among: Mask, most: int) -> Indices32:
        """Return the highest peaks among some (n,), `most` of them, that are above the threshold over an even sky around them."""
        tried = max(most + most // 4, len(self._windows))
        while True:
            windows = self._laid(tried)
            stand_out = among[: len(windows)] & self._stand_out(windows)
            if len(windows) == len(self._peaks) or np.count_nonzero(stand_out) >= most:
                return self._peaks[: len(windows)][stand_out][:most]
            tried = 2 * len(windows)

    def _laid(self, count: int) -> Records:
        """Windows of the first candidates; of all if there are fewer."""
        peaks, heights = self._peaks[:count], self._heights[:count]
        if len(self._windows) < len(peaks):
            scene, sigma_px = self.scene, self._sigma_px
            self._windows = np.zeros(len(peaks), WINDOW)
            flux = heights / np.float32(square(spot_noise_factor(sigma_px)))
            spot = (sigma_px, scene.settings.psf_growth, scene.saturation, scene.background.median_noise)
            self._pixels = lay_windows(
                scene.counts, peaks, flux, *scene.grids, spot, self._flow, self._windows
            )
        return self._windows[: len(peaks)]

    def _stand_out(self, windows: Records) -> Mask:
        """Which of the first peaks (n,) are above the threshold over the sky in a ring around them, if it is even."""
        scene, count = self.scene, len(windows)
        above = self._heights[:count] + scene.level_of_block(self._peaks[:count]) - windows["base"]
        even = windows["noise"] <= _EVEN_NOISE * scene.background.median_noise
        threshold = scene.settings.threshold_sigma * spot_noise_factor(self._sigma_px) * windows["noise"]
        return np.asarray(even & (above >= threshold), dtype=np.bool_)
