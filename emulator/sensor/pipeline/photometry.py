"""The limit of a detector: the magnitude at which it finds 90 % of the stars, and the error of a magnitude there.

The features of the thesis count stars down to a magnitude, so they must not count what the detector often misses. It is
measured as a laboratory would: fields of the sky at rest are rendered and their stars detected.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.sensor.renderer import Frame
from starid.arithmetic.arrays import Array, Mask, elementwise
from starid.arithmetic.elementary import exp, log, log10, square
from starid.arithmetic.matrices import inverse, lengths, product, sum_of_products
from starid.attitude import Attitude, random_attitude
from starid.imaging.detection import Detections

FIELDS: Final = 96
"""Number of fields rendered."""

FOUND_SHARE: Final = 0.9
"""Share of the stars found at the limit."""

_FIRST_INDEX: Final = 1 << 40
"""Numbers of these exposures, beyond those of any run, so that their noise is independent."""

_SEED: Final = 24
_MATCH_PX: Final = 3.0
_BLEND_PX: Final = 6.0
_EDGE_PX: Final = 5.0
_STEP_MAG: Final = 0.05
_LAST: Final = 200
"""Number of stars from which the error at the limit is taken."""
_UNKNOWN_SIGMA: Final = 0.1
_RENDERED_SHARE: Final = 0.99
"""Share of the stars within the faintest magnitude rendered; the others are companions of brighter stars."""
_ODDS: Final = log(FOUND_SHARE / (1.0 - FOUND_SHARE))
_STEEPEST: Final = 100.0
"""Standard deviation of the prior of the slope, 1/mag."""
_STEPS: Final = 30
_CONVERGED: Final = 1e-10
"""Change of the logit and of the slope in a step, after which the next one, squared, is below the arithmetic."""
_LEAST_WEIGHT: Final = 1e-9
_MAD_TO_SIGMA: Final = 1.4826


@dataclass(frozen=True, slots=True)
class MeasuredPhotometry:
    """The limit of a detector, on the scale of its own magnitudes."""

    limit: float
    """Magnitude at which 90 % of the stars are found."""
    sigma: float
    """One-sigma error of the magnitudes of stars there."""


def measure_photometry(
    expose: Callable[[Attitude, int], Frame], find: Callable[[Frame], Detections], zero_e: float
) -> MeasuredPhotometry:
    """Render and detect fields at random attitudes.

    `zero_e` is the number of electrons in an exposure from a star of magnitude 0. The limit is rounded to some two standard
    errors, so that most runs of a profile share a feature database.
    """
    rng = np.random.default_rng(_SEED)
    magnitudes, errors = [], []
    for field in range(FIELDS):
        frame = expose(random_attitude(rng), _FIRST_INDEX + field)
        true, error = _compared(frame, find(frame), zero_e)
        magnitudes.append(true)
        errors.append(error)
    measured = _limit_of(np.concatenate(magnitudes), np.concatenate(errors))
    return MeasuredPhotometry(round(measured.limit / _STEP_MAG) * _STEP_MAG, measured.sigma)


def _compared(frame: Frame, detections: Detections, zero_e: float) -> tuple[Array, Array]:
    """Magnitudes of the stars in an image, and the errors of those found; NaN for the others."""
    height, width = frame.image.shape
    xy = frame.stars.xy_px
    inside = frame.stars.visible & (frame.stars.electrons > 0.0)
    inside &= (np.minimum(xy, np.array([width - 1, height - 1]) - xy) > _EDGE_PX).all(axis=1)
    xy, true = xy[inside], -2.5 * elementwise(log10, frame.stars.electrons[inside] / zero_e)
    order = np.argsort(true, kind="stable")
    xy, true = xy[order], true[order]
    apart = lengths(xy[:, None] - xy[None])
    alone = ~(np.tril(apart < _BLEND_PX, -1)).any(axis=1)  # no brighter star of which it would be a part
    xy, true = xy[alone], true[alone]
    error = np.full(true.size, np.nan)
    if len(detections.flux) and len(xy):
        distance = lengths(xy[:, None] - detections.xy_px[None])
        nearest = distance.argmin(axis=1)
        seen = distance[np.arange(len(xy)), nearest] < _MATCH_PX
        flux = np.maximum(detections.flux[nearest[seen]], 1.0)
        error[seen] = -2.5 * elementwise(log10, flux / zero_e) - true[seen]
    return true, error


def _limit_of(magnitude: Array, error: Array) -> MeasuredPhotometry:
    """The magnitude at which a logistic curve, fitted to which stars were found, has 90 %, and the error of the last above it."""
    detected = np.isfinite(error)
    centre, slope = _fitted_curve(magnitude, detected)
    faintest = float(np.quantile(magnitude, _RENDERED_SHARE))
    limit = min(centre - _ODDS / slope, faintest) if slope > 0.0 else faintest
    above = np.flatnonzero(detected & (magnitude <= limit))
    last = error[above[np.argsort(magnitude[above], kind="stable")][-_LAST:]]
    sigma = float(_MAD_TO_SIGMA * np.median(np.abs(last - np.median(last)))) if last.size else _UNKNOWN_SIGMA
    return MeasuredPhotometry(limit, sigma)


def _fitted_curve(magnitude: Array, detected: Mask) -> tuple[float, float]:
    """Maximum-likelihood fit of the share found, 1/(1 + exp(slope·(m − centre))); by Newton's method.

    A weak prior on the slope keeps it finite if one magnitude parts all stars found from the others.
    """
    middle = float(magnitude.mean())
    design = np.column_stack([np.ones(magnitude.size), magnitude - middle])
    curve, prior = np.zeros(2), np.diag([0.0, 1.0 / square(_STEEPEST)])
    for _ in range(_STEPS):
        share = 1.0 / (1.0 + elementwise(exp, -product(design, curve)))
        weight = np.maximum(share * (1.0 - share), _LEAST_WEIGHT)
        slopes = np.sum(design * (detected - share)[:, None], axis=0) - product(prior, curve)
        change = product(inverse(sum_of_products(design, design * weight[:, None]) + prior), slopes)
        curve += change
        if np.abs(change).max() < _CONVERGED:
            break
    slope = -float(curve[1])
    return middle + (float(curve[0]) / slope if slope else math.inf), slope
