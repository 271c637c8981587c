"""Detection of stars with sub-pixel positions, fluxes and calibrated uncertainties."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices32, Mask, Records
from starid.arithmetic.elementary import log, square
from starid.errors import StaridError
from starid.imaging.background import Background, estimate_background
from starid.imaging.centroid import (
    FAINT,
    FIT,
    GOOD,
    NO_FIT,
)
from starid.imaging.matched_filter import (
    INTEGER_TAPS_SUM,
    find_peaks,
    find_peaks_in_bytes,
    integer_taps,
    noise_factor,
    spot_noise_factor,
    spot_taps,
)
from starid.imaging.measurement import (
    AT_EDGE,
    BAD_FIT,
    FIRST_ROUNDS,
    FIT_PARAMETERS,
    NOT_A_STAR,
    REFIT_ROUNDS,
    SATURATED,
    TWICE,
    find_neighbours,
    measure,
)
from starid.imaging.pairs import doubt_close_pairs, split_pairs
from starid.imaging.spot_shape import (
    MIN_LONG,
    MOMENT_COLUMNS,
    SpotShape,
    long_trails,
    moments_of,
    shape_from_moments,
    trails_among_round,
)
from starid.imaging.spot_width import spot_widths
from starid.imaging.trail_filter import sum_along_trails, trail_noise_factor, trail_steps
from starid.imaging.trail_flow import FLOW_TERMS, trail_shifts
from starid.imaging.unmodelled_light import shift_by_edge, trail_variances
from starid.imaging.windows import (
    DUPLICATE,
    MIN_SPREAD_PX,
    WINDOW,
    cut_windows,
    lay_windows,
    sky_under_lone_pixels,
)

Grid: TypeAlias = Array32
Table: TypeAlias = Array

MIN_SIDE_PX: Final = 16
_ASSUMED_SIGMA_PX: Final = 0.9
_MAX_PEAKS: Final = 8192
_THRESHOLD_STEP: Final = 1.5
_STARS_FOR_A_GLANCE: Final = 12
_STARS_FOR_SHAPE: Final = 30
_PEAKS_FOR_SHAPE: Final = 120
_PEAKS_FOR_TRAILS: Final = 300
_MISFITS_FOR_TRAILS: Final = 8
_MISFIT_SHARE: Final = 0.1
_EVEN_NOISE: Final = 1.5
_FEW_TRAILS: Final = 2
_LOG_CHANCE: Final = 6.9
"""Minus the log of the probability that noise makes trails of round stars: 0.1 %."""

_SHAPE_WINDOW_PX: Final = 40
_STARS_FOR_WIDTH: Final = 15
_MIN_FOR_WIDTH: Final = 3
_MIN_SCREENED: Final = 1
_TRAIL_FILTER_PX: Final = 1.5
_OTHER_WIDTH: Final = 0.3
_MISFIT_SIGMA: Final = 3.0
_RELAXED_SHARE: Final = 0.8
_MAX_NEIGHBOURS: Final = 64
_AT_REST: Final = np.zeros(FLOW_TERMS)


@dataclass(frozen=True)
class DetectionSettings:
    """Known properties of the image, and detection thresholds.

    Attributes
    ----------
    threshold_sigma : float
        Smallest ratio of the smoothed peak to its noise.
    psf_sigma_px : float or None
        Standard deviation of a star's spot, its mean over the image; estimated from the image if None.
    psf_growth : float
        Growth of the spot, relative to that in the centre, up to the middle of an edge; twice as much in the corners.
    gain_e_per_dn : float or None
        Electrons per count; if given, errors include shot noise and fluxes are in electrons.
    saturation_dn : int or None
        Smallest count of a saturated pixel; if None, the largest value of the image type.
    model_error : float
        Relative error of the model of the spot in a pixel.
    max_stars : int
        Largest number of stars returned, brightest first.
    block_px : int
        Side of the blocks in which the background is estimated.
    follow_trails : bool
        Whether to search for the trails of a rotating sensor.
    blend_px : float
        Stars closer than this are reported as one, at the position where a single spot fits.
    pixel_sigma : float
        Smallest excess over the sky of a lit pixel, in sigmas of the noise.
    min_star_pixels, max_star_pixels : int
        Smallest and largest number of lit pixels of a star; other candidates are rejected.
    """

    threshold_sigma: float = 5.5
    psf_sigma_px: float | None = None
    psf_growth: float = 0.0
    gain_e_per_dn: float | None = None
    saturation_dn: int | None = None
    model_error: float = 0.01
    max_stars: int = 500
    block_px: int = 32
    follow_trails: bool = True
    blend_px: float = 2.0
    pixel_sigma: float = 3.0
    min_star_pixels: int = 1
    max_star_pixels: int = 10000

    def __post_init__(self) -> None:
        ranges = {
            "threshold_sigma": (1.0, 1000.0),
            "psf_sigma_px": (0.3, 12.0),
            "psf_growth": (0.0, 10.0),
            "gain_e_per_dn": (1e-6, 1e9),
            "saturation_dn": (1, 65535),
            "model_error": (0.0, 1.0),
            "max_stars": (1, 5000),
            "block_px": (8, 1024),
            "blend_px": (0.0, 100.0),
            "pixel_sigma": (0.0, 1000.0),
            "min_star_pixels": (0, 1000000),
            "max_star_pixels": (1, 1000000),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise StaridError(f"detection {name}: must be {low:g}…{high:g}, not {value!r}")


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
        return np.asarray(np.sqrt(np.mean(square(self.xy_sigma_px), axis=1)), dtype=np.float64)

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


@dataclass(frozen=True)
class _Scene:
    """An image (h, w) with its background, the settings, and the smallest saturated count."""

    counts: GreyImage
    background: Background
    settings: DetectionSettings
    saturation: float

    @property
    def level(self) -> tuple[Grid, float]:
        """Background on the grid of blocks, and the side of a block."""
        return self.background.level, float(self.background.block_px)

    @property
    def grids(self) -> tuple[Grid, Grid, float]:
        """Background and noise on the grid of blocks, and the side of a block."""
        return self.background.level, self.background.noise, float(self.background.block_px)


class _Peaks(NamedTuple):
    """Candidates (n, 2), highest first, their smoothed heights (n,) above the background, and the sky (n,) under peaks of one pixel.

    The sky is NaN under the others.
    """

    peaks: Indices32
    heights: Grid
    sky: Array


@dataclass(frozen=True)
class _Fits:
    """Candidates with their windows and pixels, neighbours, fits and flags.

    `sensor`, `lit` and `size` are arguments of `starid.imaging.measurement.measure`.
    """

    windows: Records
    pixels: Grid
    first: Indices32
    neighbours: Indices32
    sensor: tuple[float, float, float, float]
    lit: tuple[float, float, float]
    size: tuple[int, int]
    stars: Records
    flags: npt.NDArray[np.uint8]

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

    def explained(self, objects: Table, reach_px: float) -> float:
        """Sum of ``(flux/σ)²`` of the stars near objects, whose first columns are their positions, less two for each parameter of a fit."""
        good = self.stars[self.stars["state"] == GOOD]
        off = np.column_stack([good["x"], good["y"]])[:, None] - objects[None, :, :2]
        near = np.any(np.sum(square(off), axis=2) <= square(reach_px), axis=1)
        return float(np.sum(square(good["flux"][near]) / good["var_flux"][near] - 2.0 * FIT_PARAMETERS))

    @property
    def suspicious(self) -> bool:
        """Whether many candidates do not have the shape of a star."""
        good = self.stars[self.stars["state"] == GOOD]
        misfits = np.count_nonzero(_misfits(good)[1]) + np.count_nonzero(self.stars["state"] == NOT_A_STAR)
        return bool(misfits >= max(_MISFITS_FOR_TRAILS, _MISFIT_SHARE * len(good)))


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
    sigma = options.psf_sigma_px if options.psf_sigma_px is not None else _ASSUMED_SIGMA_PX
    scene = _Scene(counts, background, options, float(saturation))
    found = _peaks(scene, sigma)
    shape = _shape_of_stars(scene, found)
    if options.psf_sigma_px is None and abs(shape.sigma_px / sigma - 1.0) > _OTHER_WIDTH:
        found = _peaks(scene, shape.sigma_px)
        shape = _shape_of_stars(scene, found, shape.sigma_px)
    turning = shape if shape.trail_px > 0.0 and shape.stars < _STARS_FOR_SHAPE else None
    if turning is not None:
        shape = _shape_of_stars(_at_rest(scene), found, shape.sigma_px)
    peaks, heights, hot = _without_hot_pixels(found, shape.sigma_px)
    if shape.trail_px > _TRAIL_FILTER_PX:
        peaks, heights = _trail_peaks(scene, shape, hot)
    if len(peaks) + len(hot) == 0:
        flat = float(counts.min()) == float(counts.max())
        return _no_detections(
            background, "image is flat: no light reaches it" if flat else "no star stands out of the noise"
        )
    fits = _fit_candidates(_without_weight(scene, hot), peaks, heights, shape)
    if options.follow_trails and shape.trail_px == 0.0:
        fits, shape = _trails_or_spots(scene, (peaks, heights, hot), fits, shape, turning)
    return _stars_of(scene, fits, shape, len(hot))


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


def _peaks(scene: _Scene, sigma_px: float) -> _Peaks:
    peaks, heights = _smoothed_peaks(scene, sigma_px)
    sky = np.empty(len(peaks))
    sky_under_lone_pixels(scene.counts, peaks, *scene.grids, sky)
    return _Peaks(peaks, heights, sky)


def _smoothed_peaks(scene: _Scene, sigma_px: float) -> tuple[Indices32, Grid]:
    """Candidates (n, 2), highest first, and their smoothed heights above the background."""
    counts, background = scene.counts, scene.background
    bytes_taps = integer_taps(sigma_px)
    if counts.dtype == np.uint8 and bytes_taps is not None:
        taps8, image8 = bytes_taps, counts.view(np.uint8)

        def search_bytes(threshold: Grid, peaks: Indices32, heights: Grid) -> int:
            return find_peaks_in_bytes(image8, threshold, background.block_px, taps8, peaks, heights)

        factor = noise_factor(taps8 / INTEGER_TAPS_SUM)
        return _search(search_bytes, background, scene.settings.threshold_sigma * factor)
    taps = spot_taps(sigma_px)
    image16 = counts.astype(np.uint16, copy=False)  # as the sums along trails, so one kernel does for both

    def search(threshold: Grid, peaks: Indices32, heights: Grid) -> int:
        return find_peaks(image16, threshold, background.block_px, taps, peaks, heights)

    return _search(search, background, scene.settings.threshold_sigma * spot_noise_factor(sigma_px))


def _without_hot_pixels(found: _Peaks, sigma_px: float) -> tuple[Indices32, Grid, Table]:
    """Drop hot pixels: return candidates, heights, and (n, 3) the hot pixels with the sky under them."""
    peaks, heights, sky = found
    if sigma_px < MIN_SPREAD_PX:
        return peaks, heights, np.zeros((0, 3))
    hot = ~np.isnan(sky)
    return peaks[~hot], heights[~hot], np.column_stack([peaks[hot], sky[hot]])


def _without_weight(scene: _Scene, hot: Table) -> _Scene:
    """Return the scene in which hot pixels are saturated, so that they have no weight in the fits of stars beside them."""
    if not len(hot):
        return scene
    counts = scene.counts.copy()
    columns, rows = hot[:, :2].astype(np.int64).T
    counts[rows, columns] = np.iinfo(counts.dtype).max
    return dataclasses.replace(scene, counts=counts)


def _trail_peaks(scene: _Scene, shape: SpotShape, hot: Table) -> tuple[Indices32, Grid]:
    """As `_peaks`, with the filter for trails, and without the hot pixels, which it would smear."""
    background, counts = scene.background, scene.counts.copy()
    columns, rows = hot[:, :2].astype(np.int64).T
    counts[rows, columns] = hot[:, 2]
    steps = trail_steps(shape.flow, counts.shape[1], counts.shape[0])
    sums, scale = sum_along_trails(counts, shape.flow, steps)
    taps = spot_taps(shape.sigma_px)

    def search(threshold: Grid, peaks: Indices32, heights: Grid) -> int:
        count = find_peaks(sums, np.float32(scale) * threshold, background.block_px, taps, peaks, heights)
        heights[:count] /= np.float32(scale)
        return count

    factor = trail_noise_factor(shape.sigma_px, shape.trail_px, steps)
    return _search(search, background, scene.settings.threshold_sigma * factor)


def _search(
    search: Callable[[Grid, Indices32, Grid], int], background: Background, factor: float
) -> tuple[Indices32, Grid]:
    """Search for peaks above `factor` times the noise, or above a higher threshold if there are too many."""
    peaks = np.empty((_MAX_PEAKS, 2), dtype=np.int32)
    heights = np.empty(_MAX_PEAKS, dtype=np.float32)
    while True:
        threshold = (background.level + np.float32(factor) * background.noise).astype(np.float32)
        count = search(threshold, peaks, heights)
        if count < _MAX_PEAKS:
            break
        factor *= _THRESHOLD_STEP
    peaks, heights = peaks[:count], heights[:count]
    heights -= _level_of_block(background, peaks)
    order = np.argsort(-heights, kind="stable")
    return peaks[order], heights[order]


def _shape_of_stars(scene: _Scene, found: _Peaks, assumed: float = _ASSUMED_SIGMA_PX) -> SpotShape:
    """Estimate spot and trails from peaks of several pixels that stand out of an even sky.

    Others may be hot pixels and edges of bodies: in an image with few stars they would be most of the objects, and the spot would
    seem too narrow. Without such peaks, all count.
    """
    peaks, heights, sky = found
    several = np.isnan(sky)
    for most in (_STARS_FOR_SHAPE, _PEAKS_FOR_SHAPE):
        some = _that_stand_out(scene, peaks, heights, several, most, assumed)
        shape, complete = _estimate_shape(scene, some, assumed, _MIN_SCREENED)
        if complete or len(some) < most:
            break
    for kept in (peaks[several], peaks):
        if shape.stars == 0:
            shape, _ = _estimate_shape(scene, kept, assumed, _MIN_FOR_WIDTH)
    return shape


def _at_rest(scene: _Scene) -> _Scene:
    """Return the scene, without a search for trails."""
    return dataclasses.replace(scene, settings=dataclasses.replace(scene.settings, follow_trails=False))


def _that_stand_out(
    scene: _Scene,
    peaks: Indices32,
    heights: Grid,
    among: Mask,
    most: int,
    sigma_px: float,
    windows: Records | None = None,
) -> Indices32:
    """Return the brightest peaks among some that stand out, `most` of them; only as many are examined as it takes.

    Given `windows` of the first peaks are not laid again.
    """
    if windows is None:
        tried = most + most // 4
        windows, _ = _windows_of(scene, peaks[:tried], heights[:tried], sigma_px, _AT_REST)
    while True:
        tried = len(windows)
        stand_out = among[:tried] & _stand_out(scene, peaks[:tried], heights[:tried], windows, sigma_px)
        if tried >= len(peaks) or np.count_nonzero(stand_out) >= most:
            return peaks[:tried][stand_out][:most]
        windows, _ = _windows_of(scene, peaks[: 2 * tried], heights[: 2 * tried], sigma_px, _AT_REST)


def _windows_of(
    scene: _Scene, peaks: Indices32, heights: Grid, sigma_px: float, flow: Array
) -> tuple[Records, int]:
    """Windows (n,) around peaks, and how many pixels they have together."""
    windows = np.zeros(len(peaks), WINDOW)
    flux = heights / np.float32(square(spot_noise_factor(sigma_px)))
    spot = (sigma_px, scene.settings.psf_growth, scene.saturation, scene.background.median_noise)
    return windows, lay_windows(scene.counts, peaks, flux, *scene.grids, spot, flow, windows)


def _stand_out(scene: _Scene, peaks: Indices32, heights: Grid, windows: Records, sigma_px: float) -> Mask:
    """Which peaks (n,) are above the threshold over the sky in a ring around them, if it is even."""
    background = scene.background
    factor = spot_noise_factor(sigma_px)
    above = heights + _level_of_block(background, peaks) - windows["base"]
    even = windows["noise"] <= _EVEN_NOISE * background.median_noise
    threshold = scene.settings.threshold_sigma * factor * windows["noise"]
    return np.asarray(even & (above >= threshold), dtype=np.bool_)


def _level_of_block(background: Background, peaks: Indices32) -> Grid:
    """Level (n,) of the blocks in which peaks lie."""
    rows, columns = background.level.shape
    blocks = peaks // background.block_px
    return np.asarray(
        background.level[np.minimum(blocks[:, 1], rows - 1), np.minimum(blocks[:, 0], columns - 1)]
    )


def _estimate_shape(scene: _Scene, peaks: Indices32, assumed: float, least: int) -> tuple[SpotShape, bool]:
    """Estimate spot and trails from the brightest unsaturated stars, the spot from at least `least`.

    Also return whether more peaks would not change the estimate, because as many stars as it takes were measured.
    """
    settings = scene.settings
    height, width = scene.counts.shape
    start = settings.psf_sigma_px if settings.psf_sigma_px is not None else assumed
    tries = peaks[:_PEAKS_FOR_SHAPE]
    # a few stars show whether there are trails at all; more are needed only to follow them
    for star_count in (_STARS_FOR_A_GLANCE, _STARS_FOR_SHAPE):
        table = np.empty((star_count, MOMENT_COLUMNS))
        count = moments_of(
            scene.counts, tries, *scene.level, start, _SHAPE_WINDOW_PX, scene.saturation, table
        )
        shape = shape_from_moments(table[:count], width, height, settings.psf_sigma_px, assumed)
        complete = count == star_count
        if shape.trail_px == 0.0 or not complete:
            break
    if not settings.follow_trails:
        shape = dataclasses.replace(shape, flow=np.zeros_like(shape.flow), trail_px=0.0)
    if settings.psf_sigma_px is None and shape.trail_px == 0.0:
        widths = np.empty(_STARS_FOR_WIDTH)
        fitted = spot_widths(
            scene.counts, tries, *scene.grids, start, scene.saturation, settings.psf_growth, widths
        )
        complete &= fitted == widths.size
        if fitted >= least:
            shape = dataclasses.replace(shape, sigma_px=float(np.median(widths[:fitted])), stars=fitted)
    return shape, complete


def _moments(scene: _Scene, peaks: Indices32, shape: SpotShape) -> Table:
    """Return the moments (n, 5) of the measurable peaks."""
    table = np.empty((len(peaks), MOMENT_COLUMNS))
    limits = (_SHAPE_WINDOW_PX, scene.saturation)
    return table[: moments_of(scene.counts, peaks, *scene.level, shape.sigma_px, *limits, table)]


def _trails_or_spots(
    scene: _Scene,
    objects: tuple[Indices32, Grid, Table],
    fits: _Fits,
    shape: SpotShape,
    turning: SpotShape | None,
) -> tuple[_Fits, SpotShape]:
    """Follow trails that too few of the brightest objects show to exclude chance, if trails explain the light better than round spots.

    Each fit lowers the sum of squares of its pixels by ``(flux/σ)²``, so that the difference of both models' sums is twice the
    logarithm of the ratio of their likelihoods; as one trail may look like several spots, it is compared by Akaike's criterion.

    Parameters
    ----------
    objects : (peaks, heights, hot pixels)
        From `_without_hot_pixels`.
    turning : SpotShape or None
        The shape by the brightest stars, if that has trails.
    """
    peaks, heights, hot = objects
    height, width = scene.counts.shape
    most_are_hot = len(hot) > len(peaks)
    count = _PEAKS_FOR_TRAILS if most_are_hot or fits.suspicious else _STARS_FOR_SHAPE
    bright = np.ones(len(peaks), dtype=np.bool_)
    if not most_are_hot:
        bright[: len(fits.stars)] = fits.stars["state"] != FAINT
    tries = _that_stand_out(scene, peaks, heights, bright, count, shape.sigma_px, fits.windows)
    table = _moments(scene, tries, shape)
    longest = table[long_trails(table, shape.sigma_px)]
    if turning is None:
        least = _FEW_TRAILS if 2 * len(longest) >= len(table) else MIN_LONG
        turning = trails_among_round(longest, width, height, shape, least)
    if turning.trail_px == 0.0 or len(longest) == 0:
        return fits, shape
    trails = _fit_candidates(_without_weight(scene, hot), *_trail_peaks(scene, turning, hot), turning)
    reach = turning.trail_px
    more = trails.explained(longest, reach) - fits.explained(longest, reach)
    return (trails, turning) if more > _more_by_chance(len(table), len(longest)) else (fits, shape)


def _more_by_chance(objects: int, longest: int) -> float:
    """How much more light, as in `_Fits.explained`, the trails of the longest of some round objects explain by chance at most.

    The flow is fitted to noise: χ² with as many degrees of freedom as it has terms, whose tail is at most
    ``P(χ² ≥ k + 2 √(k x) + 2 x) ≤ exp(−x)`` (Laurent & Massart 2000, lemma 1), in the best of all choices of so many objects.
    """
    x = _LOG_CHANCE + log(math.comb(objects, longest))
    return FLOW_TERMS + 2.0 * math.sqrt(FLOW_TERMS * x) + 2.0 * x


def _fit_candidates(scene: _Scene, peaks: Indices32, heights: Grid, shape: SpotShape) -> _Fits:
    """Fit the highest candidates, each as a single star."""
    counts, background, settings = scene.counts, scene.background, scene.settings
    peaks, heights = peaks[: 2 * settings.max_stars], heights[: 2 * settings.max_stars]
    per_dn = 0.0 if settings.gain_e_per_dn is None else 1.0 / settings.gain_e_per_dn
    count = len(peaks)
    windows, total = _windows_of(scene, peaks, heights, shape.sigma_px, shape.flow)
    pixels = np.empty(total, dtype=np.float32)
    cut_windows(counts, windows, *scene.level, scene.saturation, pixels)
    first = np.empty(count + 1, dtype=np.int32)
    neighbours = np.empty(_MAX_NEIGHBOURS * count, dtype=np.int32)
    find_neighbours(windows, np.argsort(windows["start_y"], kind="stable"), first, neighbours)
    ratio = _RELAXED_SHARE * settings.threshold_sigma
    stars = np.zeros(count, FIT)
    stars["state"] = NO_FIT
    fits = _Fits(
        windows,
        pixels,
        first,
        neighbours,
        (per_dn, settings.model_error, ratio, scene.saturation - background.median_level),
        (settings.pixel_sigma, float(settings.min_star_pixels), float(settings.max_star_pixels)),
        (counts.shape[1], counts.shape[0]),
        stars,
        np.zeros(count, dtype=np.uint8),
    )
    fits.measure(np.ones(count, dtype=bool), FIRST_ROUNDS)
    return fits


def _with_companions(fits: _Fits, blend_px: float) -> _Fits:
    """Fit bad candidates as pairs and add their companions."""
    stars = fits.stars
    bad = (stars["state"] == GOOD) & (stars["chi2"] > BAD_FIT * (stars["pixels"] - FIT_PARAMETERS))
    if not bad.any():
        return fits
    suspects = np.flatnonzero(bad & ((fits.flags & SATURATED) == 0))
    partners, owners = np.empty(len(suspects), FIT), np.empty(len(suspects), dtype=np.int64)
    near = (fits.first, fits.neighbours)
    pair_count = split_pairs(
        fits.windows, fits.pixels, *near, fits.sensor[:2], stars, suspects, blend_px, partners, owners, bad
    )
    fits.measure(bad, REFIT_ROUNDS)
    owners = owners[:pair_count]
    return dataclasses.replace(
        fits,
        windows=np.concatenate([fits.windows, fits.windows[owners]]),
        stars=np.concatenate([stars, partners[:pair_count]]),
        flags=np.concatenate([fits.flags, fits.flags[owners]]),
    )


def _misfits(fits: Records) -> tuple[Array, Mask]:
    """Reduced χ² (n,) of the fits, and which of them do not have the shape of a star."""
    freedom = np.maximum(fits["pixels"] - FIT_PARAMETERS, 1.0)
    misfit = fits["chi2"] / freedom
    return misfit, misfit > 1.0 + _MISFIT_SIGMA * np.sqrt(2.0 / freedom)


def _stars_of(scene: _Scene, fits: _Fits, shape: SpotShape, hot: int) -> Detections:
    """Keep the candidates that are stars; `hot` others were rejected before."""
    background, settings = scene.background, scene.settings
    fits = _with_companions(fits, settings.blend_px)
    states = fits.stars["state"]
    good = np.flatnonzero(states == GOOD)
    again = (states == TWICE) | (fits.windows["columns"] == DUPLICATE)
    rejected = len(states) - good.size - int(np.count_nonzero(again)) + hot
    if good.size == 0:
        return _no_detections(background, "nothing on the image has the shape of a star", rejected)
    good = good[np.argsort(-fits.stars["flux"][good], kind="stable")][: settings.max_stars]
    stars, marks = fits.stars[good], fits.flags[good]
    misfit, is_bad = _misfits(stars)
    for variance in ("var_x", "var_y", "cov_xy", "var_flux"):
        stars[variance] *= np.where(is_bad, misfit, 1.0)
    doubt_close_pairs(stars, np.argsort(-stars["y"], kind="stable"), settings.blend_px)
    windows = fits.windows[good]
    step = shift_by_edge(windows, fits.pixels, stars["flux"], background, settings.gain_e_per_dn)
    uneven = square(step)
    stars["var_x"] += uneven
    stars["var_y"] += uneven
    unit = 1.0 if settings.gain_e_per_dn is None else settings.gain_e_per_dn
    middle = np.column_stack([stars["x"], stars["y"]])
    if shape.trail_px > 0.0:
        size = (scene.counts.shape[1], scene.counts.shape[0])
        shifts, trails = trail_shifts(shape.flow, middle, size, shape.sigma_px, shape.trail_px)
        middle -= shifts
        cut_off = (marks & AT_EDGE) != 0
        var_x, var_y, cov_xy = trail_variances(trails, stars["flux"], cut_off, shape.sigma_px, size)
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
