"""Fits of single and double stars to the candidates of an image.

The noise of starlight follows from the gain. Where that is not known, it is estimated from the fits: noise without it leaves
them a χ² that grows with the light of a star, and states too small errors of bright stars.

What is found with other values of a constant: `python tools/vary_constant.py imaging.fits._MISFIT_SIGMA 6`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, Array32, Indices32, Mask, Records
from starid.arithmetic.elementary import square
from starid.imaging.candidates import Candidates
from starid.imaging.centroid import FIT, GOOD, NO_FIT
from starid.imaging.measurement import (
    BAD_FIT,
    FIRST_ROUND,
    FIRST_ROUNDS,
    FIT_PARAMETERS,
    NOT_A_STAR,
    REFIT_ROUNDS,
    SATURATED,
    find_neighbours,
    measure,
)
from starid.imaging.pairs import split_pairs

_MISFITS_FOR_TRAILS: Final = 8
_MISFIT_SHARE: Final = 0.1
"""Misfits are many from this number and this share of the stars: of those of the default sensor, at rest, 3 % are misfits.
With half or twice of either, the same stars are found."""

_MISFIT_SIGMA: Final = 3.0
"""Excess of χ² over its mean, in standard deviations, from which a fit states wider errors: 0.2 to 1 % of good fits have more.
With 6, the squared errors of stars at rest are 2.24 times the stated ones instead of 2.06 times."""

_RELAXED_SHARE: Final = 0.8
"""Signal of a fitted star at least, as a share of the threshold: noise that made a peak higher is not in its fit. With 1, two
of 9505 stars are lost, with 0.6 one is won, and four more are false."""

_STARS_FOR_NOISE: Final = 50
"""Number of stars, brightest first, from which the noise of starlight is estimated."""

_LEAST_FOR_NOISE: Final = 4
"""Number of them at least: fewer may all be unresolved pairs."""

_LEAST_RATIO: Final = 10.0
"""Signal-to-noise ratio of a typical one of these stars at least, by the noise of its light alone. What explains less is not this noise:
JPEG of quality 50, or many hot pixels, give 3 to 5."""

_NOISE_HALVINGS: Final = 9
"""These leave 5 % of the estimate, less than its error from so few stars."""

_MAX_NEIGHBOURS: Final = 64
"""Room for the neighbours of a candidate, on average; with 16 or 128 the same stars are found."""


@dataclass(frozen=True)
class Fits:
    """Candidates with their windows and pixels, neighbours, fits and flags.

    `sensor`, `lit` and `size` are arguments of `starid.imaging.measurement.measure`.
    """

    candidates: Candidates
    windows: Records
    pixels: Array32
    first: Indices32
    neighbours: Indices32
    sensor: tuple[float, float, float, float]
    lit: tuple[float, float, float]
    size: tuple[int, int]
    stars: Records
    flags: npt.NDArray[np.uint8]

    @property
    def light_variance(self) -> float:
        """Variance of a star's light, counts² per count."""
        return self.sensor[0]

    def measure(self, todo: Mask, turns: tuple[int, int]) -> None:
        """Fit the candidates of a mask (n,) in the given rounds."""
        measure(
            self.windows,
            self.pixels,
            self.first,
            self.neighbours,
            self.sensor,
            self.lit,
            self.size,
            todo,
            turns,
            self.stars,
            self.flags,
        )

    def explained(self, objects: Array, reach_px: float) -> float:
        """Sum of ``(flux/σ)²`` of the stars near objects, whose first columns are their positions, less two for each parameter of a fit."""
        good = self.stars[self.stars["state"] == GOOD]
        off = np.column_stack([good["x"], good["y"]])[:, None] - objects[None, :, :2]
        near = np.any(np.sum(square(off), axis=2) <= square(reach_px), axis=1)
        return float(np.sum(square(good["flux"][near]) / good["var_flux"][near] - 2.0 * FIT_PARAMETERS))

    @property
    def suspicious(self) -> bool:
        """Whether many candidates do not have the shape of a star."""
        good = self.stars[self.stars["state"] == GOOD]
        misfit = np.count_nonzero(misfits(good)[1]) + np.count_nonzero(self.stars["state"] == NOT_A_STAR)
        return bool(misfit >= max(_MISFITS_FOR_TRAILS, _MISFIT_SHARE * len(good)))

    def with_light_noise(self) -> Fits:
        """Fit again with the variance of light that explains the χ² of the brightest stars.

        It is the variance, in counts² per count, with which stars of half of their light have more than the mean of χ², and those of
        the other half less: a few bright stars of another shape do not count for more than their light. Compression and hot pixels
        are not noise of light, and change nothing. A star that is none with other weights keeps its fit.
        """
        good = self.stars["state"] == GOOD
        used = np.flatnonzero(good & ((self.flags & SATURATED) == 0))
        used = used[np.argsort(-self.stars["flux"][used], kind="stable")][:_STARS_FOR_NOISE]
        if used.size < _LEAST_FOR_NOISE:
            return self
        flux = self.stars["flux"][used]
        todo = np.zeros(len(self.stars), dtype=bool)
        todo[used] = True

        def is_more(variance: float) -> bool:
            tried = self._with_variance(variance)
            tried.measure(todo, FIRST_ROUND)
            stars = tried.stars[used]
            excess = np.where(stars["state"] == GOOD, stars["chi2"] - stars["pixels"] + FIT_PARAMETERS, 0.0)
            return bool(np.sum(flux * np.sign(excess)) > 0.0)

        # from the noise of one pixel for all light of a star, which does not show
        typical = float(np.median(flux))
        low, high = (
            square(float(np.median(self.windows["noise"][used]))) / typical,
            typical / square(_LEAST_RATIO),
        )
        if not is_more(low) or is_more(high):
            return self
        for _ in range(_NOISE_HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if is_more(middle) else (low, middle)
        fits = self._with_variance(math.sqrt(low * high))
        fits.measure(good, FIRST_ROUNDS)
        lost = good & (fits.stars["state"] != GOOD)
        fits.stars[lost] = self.stars[lost]
        return fits

    def _with_variance(self, light_variance: float) -> Fits:
        """Return the fits with another variance of light, to be measured again."""
        sensor = (light_variance, *self.sensor[1:])
        return dataclasses.replace(self, sensor=sensor, stars=self.stars.copy(), flags=self.flags.copy())

    def with_companions(self) -> Fits:
        """Fit bad candidates as pairs and add their companions."""
        stars = self.stars
        bad = (stars["state"] == GOOD) & (stars["chi2"] > BAD_FIT * (stars["pixels"] - FIT_PARAMETERS))
        if not bad.any():
            return self
        suspects = np.flatnonzero(bad & ((self.flags & SATURATED) == 0))
        partners, owners = np.empty(len(suspects), FIT), np.empty(len(suspects), dtype=np.int64)
        near = (self.first, self.neighbours)
        blend_px = self.candidates.scene.settings.blend_px
        pair_count = split_pairs(
            self.windows,
            self.pixels,
            *near,
            self.sensor[:2],
            stars,
            suspects,
            blend_px,
            partners,
            owners,
            bad,
        )
        self.measure(bad, REFIT_ROUNDS)
        owners = owners[:pair_count]
        return dataclasses.replace(
            self,
            windows=np.concatenate([self.windows, self.windows[owners]]),
            stars=np.concatenate([stars, partners[:pair_count]]),
            flags=np.concatenate([self.flags, self.flags[owners]]),
        )


def fit_candidates(candidates: Candidates) -> Fits:
    """Fit the highest candidates, each as a single star."""
    scene = candidates.scene
    settings = scene.settings
    windows, pixels = candidates.cut(2 * settings.max_stars)
    count = len(windows)
    first = np.empty(count + 1, dtype=np.int32)
    neighbours = np.empty(_MAX_NEIGHBOURS * count, dtype=np.int32)
    find_neighbours(windows, np.argsort(windows["start_y"], kind="stable"), first, neighbours)
    per_dn = 0.0 if settings.gain_e_per_dn is None else 1.0 / settings.gain_e_per_dn
    ratio = _RELAXED_SHARE * settings.threshold_sigma
    stars = np.zeros(count, FIT)
    stars["state"] = NO_FIT
    fits = Fits(
        candidates,
        windows,
        pixels,
        first,
        neighbours,
        (per_dn, settings.model_error, ratio, scene.saturation - scene.background.median_level),
        (settings.pixel_sigma, float(settings.min_star_pixels), float(settings.max_star_pixels)),
        scene.size,
        stars,
        np.zeros(count, dtype=np.uint8),
    )
    fits.measure(np.ones(count, dtype=bool), FIRST_ROUNDS)
    return fits


def misfits(fits: Records) -> tuple[Array, Mask]:
    """Reduced χ² (n,) of the fits, and which of them do not have the shape of a star."""
    freedom = np.maximum(fits["pixels"] - FIT_PARAMETERS, 1.0)
    misfit = fits["chi2"] / freedom
    return misfit, misfit > 1.0 + _MISFIT_SIGMA * np.sqrt(2.0 / freedom)
