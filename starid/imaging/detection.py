"""Detection of stars with sub-pixel positions, fluxes and calibrated uncertainties.

What is found with other values of a constant: `python tools/vary_constant.py imaging.detection._OTHER_WIDTH 0.15 0.6`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, GreyImage, Mask
from starid.arithmetic.elementary import log, square
from starid.errors import StaridError
from starid.imaging.background import Background, estimate_background
from starid.imaging.candidates import Candidates
from starid.imaging.centroid import FAINT, GOOD
from starid.imaging.fits import Fits, fit_candidates, misfits
from starid.imaging.measurement import AT_EDGE, SATURATED, TWICE
from starid.imaging.pairs import doubt_close_pairs
from starid.imaging.peaks import Peaks, find_spots, find_trails
from starid.imaging.scene import DetectionSettings, Scene
from starid.imaging.spot_shape import MIN_LONG, SpotShape, long_trails, trails_among_round
from starid.imaging.star_shape import STARS_FOR_SHAPE, moments, shape_of_stars
from starid.imaging.trail_flow import FLOW_TERMS, trail_shifts
from starid.imaging.unmodelled_light import shift_by_edge, trail_variances
from starid.imaging.windows import DUPLICATE

__all__ = ["MIN_SIDE_PX", "DetectionSettings", "Detections", "detect"]

MIN_SIDE_PX: Final = 16
"""Room for the window of a faint star, 7 px wide, and for 3 px of sky on each side."""

_ASSUMED_SIGMA_PX: Final = 0.9
"""Standard deviation of an unknown spot: one of 0.8 px, the smallest that can be fitted without pixel-phase error, sampled by
pixels. With half or twice, 0.2 % more stars are found in a quarter more time: the image is searched again with the measured width."""

_PEAKS_FOR_TRAILS: Final = 10 * STARS_FOR_SHAPE
"""Number of peaks among which trails are sought if many are not stars. With half or twice the same stars are found; with 30, no
trails among more and brighter points (`tests/starid/imaging/test_detection.py`)."""

_FEW_TRAILS: Final = 2
"""Number of trails that can agree, where most objects have trails. With 4, they are found in 10 instead of 22 of 30 images of five
faint trails."""

_LOG_CHANCE: Final = 6.9
"""Minus the log of the probability that noise makes trails of round stars: 0.1 %."""

_TRAIL_FILTER_PX: Final = 1.5
"""Shortest trail along which pixels are summed: with the filter for round spots of 0.8 px, a trail of 1.5 px loses 0.3 % of its
signal-to-noise ratio, one of 3 px 3 %."""

_OTHER_WIDTH: Final = 0.3
"""Relative error of the assumed width from which the image is searched again: by 30 % it costs 3 to 6 % of the signal-to-noise
ratio. With 0.6, three of 1376 stars of 0.45 px are lost."""


@dataclass(frozen=True)
class Detections:
    """Stars found in an image, brightest first.

    Attributes
    ----------
    xy_px : ndarray (n, 2)
        Positions (middle of a trail); pixel centres are integers.
    flux, flux_sigma : ndarray (n,)
        Flux and its one-sigma error, in electrons if the gain is given, else in counts.
    xy_sigma_px : ndarray (n, 2)
        One-sigma errors of the position along x and y, pixels.
    correlation : ndarray (n,)
        Correlation of these errors: along a trail they are larger than across it.
    saturated, edge : ndarray (n,) of bool
        The star has saturated pixels; its light is cut off by the edge of the image.
    background, noise : float
        Typical sky level and noise of a pixel, counts.
    psf_sigma_px : float
        Standard deviation of the spot, as used.
    trail_px : float
        Median length of the trails; 0 if the stars are round.
    rejected : int
        Number of candidates above the noise that are not stars: hot pixels, bodies, edges.
    reason : str
        Why no star was found; otherwise empty.
    searchable : bool
        False only if the whole image is saturated, so that it cannot be searched.
    """

    xy_px: Array
    flux: Array
    flux_sigma: Array
    xy_sigma_px: Array
    correlation: Array
    saturated: Mask
    edge: Mask
    background: float
    noise: float
    psf_sigma_px: float
    trail_px: float
    rejected: int
    reason: str
    searchable: bool = True

    @property
    def sigma_px(self) -> Array:
        """Errors (n,) of the position, root mean square of both axes."""
        variance = square(self.xy_sigma_px)
        return np.asarray(np.sqrt(0.5 * (variance[:, 0] + variance[:, 1])), dtype=np.float64)

    @property
    def position_errors(self) -> Array:
        """Errors for an identifier: `sigma_px` (n,) of round stars, covariances (n, 2, 2) of trails, pixels²."""
        if self.trail_px == 0.0:
            return self.sigma_px
        covariance = self.xy_sigma_px[:, :, None] * self.xy_sigma_px[:, None, :]
        covariance[:, 0, 1] *= self.correlation
        covariance[:, 1, 0] *= self.correlation
        return covariance

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.flux)


def detect(image: npt.NDArray[np.generic], settings: DetectionSettings | None = None) -> Detections:
    """Find the stars of an image.

    Parameters
    ----------
    image : ndarray (h, w), uint8 or uint16
        Counts, one channel, at least 16 × 16 pixels.
    settings : DetectionSettings, optional
        Known properties of the image.

    Returns
    -------
    Detections
        Empty, with a reason, if no star is found.

    Raises
    ------
    StaridError
        The image has an unsupported type or shape.
    """
    options = DetectionSettings() if settings is None else settings
    counts = _checked_image(image)
    saturation = (
        options.saturation_dn if options.saturation_dn is not None else int(np.iinfo(counts.dtype).max)
    )
    background = estimate_background(counts, options.block_px)
    if background.median_level >= saturation:
        empty = _no_detections(background, "image is saturated all over: shorten the exposure")
        return dataclasses.replace(empty, searchable=False)
    scene = Scene(counts, background, options, float(saturation))
    sigma = options.psf_sigma_px if options.psf_sigma_px is not None else _ASSUMED_SIGMA_PX
    found = find_spots(scene, sigma)
    shape = shape_of_stars(scene, found, _ASSUMED_SIGMA_PX)
    if options.psf_sigma_px is None and abs(shape.sigma_px / sigma - 1.0) > _OTHER_WIDTH:
        found = find_spots(scene, shape.sigma_px)
        shape = shape_of_stars(scene, found, shape.sigma_px)
    turning = shape if shape.trail_px > 0.0 and shape.stars < STARS_FOR_SHAPE else None
    if turning is not None:
        shape = shape_of_stars(scene.at_rest, found, shape.sigma_px)
    spots, hot = found.parted(shape.sigma_px)
    peaks, heights = spots.xy, spots.heights
    if shape.trail_px > _TRAIL_FILTER_PX:
        peaks, heights = find_trails(scene, shape, hot)
    if len(peaks) + len(hot.xy) == 0:
        flat = float(counts.min()) == float(counts.max())
        return _no_detections(
            background, "image is flat: no light reaches it" if flat else "no star stands out of the noise"
        )
    # hot pixels as saturated ones have no weight in the fits of stars beside them
    bare = scene.with_values(hot.xy, np.iinfo(counts.dtype).max)
    fits = fit_candidates(Candidates(bare, peaks, heights, shape.sigma_px, shape.flow))
    if options.follow_trails and shape.trail_px == 0.0:
        fits, shape = _trails_or_spots(scene, len(peaks), hot, fits, shape, turning)
    if options.gain_e_per_dn is None:
        fits = fits.with_light_noise()
    return _stars_of(fits, shape, len(hot.xy))


def _checked_image(image: npt.NDArray[np.generic]) -> GreyImage:
    """Validate a grey image of counts; return it contiguous and in native byte order."""
    if not isinstance(image, np.ndarray):
        raise StaridError(f"image: must be an array (h, w) of uint8 or uint16, not a {type(image).__name__}")
    if image.ndim != 2:
        colour = " (colour: convert it to grey first)" if image.ndim == 3 else ""
        raise StaridError(f"image: shape must be (h, w), not {image.shape}{colour}")
    if image.dtype.kind != "u" or image.dtype.itemsize > 2:
        raise StaridError(f"image: type must be uint8 or uint16, not {image.dtype}; scale it to counts first")
    if min(image.shape) < MIN_SIDE_PX:
        raise StaridError(f"image: must be at least 16×16 pixels, not {image.shape[1]}×{image.shape[0]}")
    return np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("="))


def _no_detections(background: Background, reason: str, rejected: int = 0) -> Detections:
    none = np.zeros(0)
    pairs = np.zeros((0, 2))
    no = np.zeros(0, dtype=bool)
    level, noise = background.median_level, background.median_noise
    return Detections(pairs, none, none, pairs, none, no, no, level, noise, 0.0, 0.0, rejected, reason)


def _trails_or_spots(
    scene: Scene, spots: int, hot: Peaks, fits: Fits, shape: SpotShape, turning: SpotShape | None
) -> tuple[Fits, SpotShape]:
    """Follow trails that too few of the brightest objects show to exclude chance, if trails explain the light better than round spots.

    Each fit lowers the sum of squares of its pixels by ``(flux/σ)²``, so that the difference of both models' sums is twice the
    logarithm of the ratio of their likelihoods; as one trail may look like several spots, it is compared by Akaike's criterion.

    Parameters
    ----------
    scene : Scene
        The image, whose hot pixels have a weight.
    spots, hot : int, Peaks
        Number of candidates, and the hot pixels.
    turning : SpotShape or None
        The shape by the brightest stars, if that has trails.
    """
    most_are_hot = len(hot.xy) > spots
    count = _PEAKS_FOR_TRAILS if most_are_hot or fits.suspicious else STARS_FOR_SHAPE
    bright = np.ones(spots, dtype=np.bool_)
    if not most_are_hot:
        bright[: len(fits.stars)] = fits.stars["state"] != FAINT
    tries = fits.candidates.standing_out(bright, count)
    table = moments(scene, tries, shape.sigma_px, len(tries))
    longest = table[long_trails(table, shape.sigma_px)]
    if turning is None:
        least = _FEW_TRAILS if 2 * len(longest) >= len(table) else MIN_LONG
        turning = trails_among_round(longest, *scene.size, shape, least)
    if turning.trail_px == 0.0 or len(longest) == 0:
        return fits, shape
    peaks, heights = find_trails(scene, turning, hot)
    trails = fit_candidates(Candidates(fits.candidates.scene, peaks, heights, turning.sigma_px, turning.flow))
    reach = turning.trail_px
    more = trails.explained(longest, reach) - fits.explained(longest, reach)
    return (trails, turning) if more > _more_by_chance(len(table), len(longest)) else (fits, shape)


def _more_by_chance(objects: int, longest: int) -> float:
    """How much more light, as in `Fits.explained`, the trails of the longest of some round objects explain by chance at most.

    The flow is fitted to noise: χ² with as many degrees of freedom as it has terms, whose tail is at most
    ``P(χ² ≥ k + 2 √(k x) + 2 x) ≤ exp(−x)`` (Laurent & Massart 2000, lemma 1), in the best of all choices of so many objects.
    """
    x = _LOG_CHANCE + log(math.comb(objects, longest))
    return FLOW_TERMS + 2.0 * math.sqrt(FLOW_TERMS * x) + 2.0 * x


def _stars_of(fits: Fits, shape: SpotShape, hot: int) -> Detections:
    """Keep the candidates that are stars; `hot` others were rejected before."""
    scene = fits.candidates.scene
    background, settings = scene.background, scene.settings
    fits = fits.with_companions()
    states = fits.stars["state"]
    good = np.flatnonzero(states == GOOD)
    again = (states == TWICE) | (fits.windows["columns"] == DUPLICATE)
    rejected = len(states) - good.size - int(np.count_nonzero(again)) + hot
    if good.size == 0:
        return _no_detections(background, "nothing on the image has the shape of a star", rejected)
    good = good[np.argsort(-fits.stars["flux"][good], kind="stable")][: settings.max_stars]
    stars, marks = fits.stars[good], fits.flags[good]
    misfit, is_bad = misfits(stars)
    for variance in ("var_x", "var_y", "cov_xy", "var_flux"):
        stars[variance] *= np.where(is_bad, misfit, 1.0)
    doubt_close_pairs(stars, np.argsort(-stars["y"], kind="stable"), settings.blend_px)
    windows = fits.windows[good]
    step = shift_by_edge(windows, fits.pixels, stars["flux"], background, fits.light_variance)
    uneven = square(step)
    stars["var_x"] += uneven
    stars["var_y"] += uneven
    unit = 1.0 if settings.gain_e_per_dn is None else settings.gain_e_per_dn
    middle = np.column_stack([stars["x"], stars["y"]])
    if shape.trail_px > 0.0:
        shifts, trails = trail_shifts(shape.flow, middle, scene.size, shape.sigma_px, shape.trail_px)
        middle -= shifts
        cut_off = (marks & AT_EDGE) != 0
        var_x, var_y, cov_xy = trail_variances(trails, stars["flux"], cut_off, shape.sigma_px, scene.size)
        stars["var_x"] += var_x
        stars["var_y"] += var_y
        stars["cov_xy"] += cov_xy
    sigmas = np.sqrt(np.column_stack([stars["var_x"], stars["var_y"]]))
    return Detections(
        middle,
        stars["flux"] * unit,
        np.sqrt(stars["var_flux"]) * unit,
        sigmas,
        stars["cov_xy"] / (sigmas[:, 0] * sigmas[:, 1]),
        (marks & SATURATED) != 0,
        (marks & AT_EDGE) != 0,
        background.median_level,
        background.median_noise,
        shape.sigma_px,
        shape.trail_px,
        rejected,
        "",
    )
