"""Shape of the stars in an image, estimated from its brightest peaks.

What is found with other values of a constant: `python tools/vary_constant.py imaging.star_shape.STARS_FOR_SHAPE 15 60`.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices32
from starid.imaging.candidates import Candidates
from starid.imaging.peaks import Peaks
from starid.imaging.scene import Scene
from starid.imaging.spot_shape import MOMENT_COLUMNS, SpotShape, moments_of, shape_from_moments
from starid.imaging.spot_width import spot_widths
from starid.imaging.trail_flow import FLOW_TERMS
from starid.imaging.windows import LARGEST_HALF_WIDTH

STARS_FOR_SHAPE: Final = 30
"""Number of stars to which a flow of five numbers is fitted, and with fewer of which it may be chance. With 15 or 60, one and
three more of 9505 stars are found."""

_STARS_FOR_A_GLANCE: Final = 12
"""Number of stars that show whether there are trails. With 6 or 24 the same stars are found; 30 take 0.7 ms more."""

_PEAKS_FOR_SHAPE: Final = 4 * STARS_FOR_SHAPE
"""Number of peaks among which the stars are sought. With half, one star in hard skies is lost, with twice none is won."""

_STARS_FOR_WIDTH: Final = 15
"""Number of stars whose median width is that of the spot. With 7, four stars of 312 in hard skies are lost, and five more are
false; with 30, three of 9505 are lost."""

_LEAST_FOR_WIDTH: Final = 3
"""Number of stars for a width from peaks that may be noise: with 1, an enlarged image of noise has five stars
(`tests/starid/photograph/test_photographs.py`). Of those that stand out of an even sky, one is enough."""


def shape_of_stars(scene: Scene, found: Peaks, assumed_px: float) -> SpotShape:
    """Estimate spot and trails from peaks of several pixels that stand out of an even sky.

    Others may be hot pixels and edges of bodies: in an image with few stars they would be most of the objects, and the spot would
    seem too narrow. Without such peaks, all count.
    """
    candidates = Candidates(scene, found.xy, found.heights, assumed_px, np.zeros(FLOW_TERMS))
    for most in (STARS_FOR_SHAPE, _PEAKS_FOR_SHAPE):
        tries = candidates.standing_out(found.several, most)
        shape, complete = _estimate(scene, tries, assumed_px, 1)
        if complete or len(tries) < most:
            break
    if shape.stars == 0:
        shape, _ = _estimate(scene, found.xy[found.several], assumed_px, _LEAST_FOR_WIDTH)
    if shape.stars == 0:
        shape, _ = _estimate(scene, found.xy, assumed_px, _LEAST_FOR_WIDTH)
    return shape


def _estimate(scene: Scene, peaks: Indices32, assumed_px: float, least: int) -> tuple[SpotShape, bool]:
    """Estimate spot and trails from the brightest unsaturated stars, the spot from at least `least`.

    Also return whether more peaks would not change the estimate, because as many stars as it takes were measured.
    """
    known_px = scene.settings.psf_sigma_px
    start_px = assumed_px if known_px is None else known_px
    tries = peaks[:_PEAKS_FOR_SHAPE]
    # a few stars show whether there are trails at all; more are needed only to follow them
    for star_count in (_STARS_FOR_A_GLANCE, STARS_FOR_SHAPE):
        table = moments(scene, tries, start_px, star_count)
        shape = shape_from_moments(table, *scene.size, known_px, assumed_px)
        complete = len(table) == star_count
        if shape.trail_px == 0.0 or not complete:
            break
    if not scene.settings.follow_trails:
        shape = dataclasses.replace(shape, flow=np.zeros_like(shape.flow), trail_px=0.0)
    if known_px is None and shape.trail_px == 0.0:
        widths = np.empty(_STARS_FOR_WIDTH)
        growth = scene.settings.psf_growth
        fitted = spot_widths(scene.counts, tries, *scene.grids, start_px, scene.saturation, growth, widths)
        complete &= fitted == widths.size
        if fitted >= least:
            shape = dataclasses.replace(shape, sigma_px=float(np.median(widths[:fitted])), stars=fitted)
    return shape, complete


def moments(scene: Scene, peaks: Indices32, sigma_px: float, most: int) -> Array:
    """Return the moments (n, 5) of the first measurable peaks, `most` of them."""
    table = np.empty((most, MOMENT_COLUMNS))
    count = moments_of(
        scene.counts, peaks, *scene.level, sigma_px, LARGEST_HALF_WIDTH, scene.saturation, table
    )
    return table[:count]
