"""What a detector finds: the magnitude at which it still finds 90 % of the stars, and its error of a magnitude there.

The features of the thesis count stars down to a magnitude, so they must not count what the detector often misses. It is
measured as a laboratory would: fields of the sky at rest are rendered and their stars detected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.sensor.renderer import Frame
from starid.arrays import Array
from starid.attitude import Attitude, random_attitude
from starid.imaging.detection import Detections

FIELDS: Final = 24
"""Number of fields rendered."""

FOUND_SHARE: Final = 0.9
"""Share of the stars found at the limit."""

_FIRST_INDEX: Final = 1 << 40
"""Numbers of these exposures, beyond those of any run, so that their noise is independent."""

_SEED: Final = 24
_BIN_MAG: Final = 0.25
_MATCH_PX: Final = 3.0
_BLEND_PX: Final = 6.0
_EDGE_PX: Final = 5.0
_FEWEST: Final = 20
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

    `zero_e` is the number of electrons in an exposure from a star of magnitude 0.
    """
    rng = np.random.default_rng(_SEED)
    magnitudes, errors = [], []
    for field in range(FIELDS):
        frame = expose(random_attitude(rng), _FIRST_INDEX + field)
        true, error = _compared(frame, find(frame), zero_e)
        magnitudes.append(true)
        errors.append(error)
    return _limit_of(np.concatenate(magnitudes), np.concatenate(errors))


def _compared(frame: Frame, detections: Detections, zero_e: float) -> tuple[Array, Array]:
    """Magnitudes of the stars in an image, and the errors of those found; NaN for the others."""
    height, width = frame.image.shape
    xy = frame.stars.xy_px
    inside = frame.stars.visible & (frame.stars.electrons > 0.0)
    inside &= (np.minimum(xy, np.array([width - 1, height - 1]) - xy) > _EDGE_PX).all(axis=1)
    xy, true = xy[inside], -2.5 * np.log10(frame.stars.electrons[inside] / zero_e)
    order = np.argsort(true, kind="stable")
    xy, true = xy[order], true[order]
    apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    alone = ~(np.tril(apart < _BLEND_PX, -1)).any(axis=1)  # no brighter star of which it would be a part
    xy, true = xy[alone], true[alone]
    error = np.full(true.size, np.nan)
    if len(detections.flux) and len(xy):
        distance = np.hypot(*(xy[:, None] - detections.xy_px[None]).transpose(2, 0, 1))
        nearest = distance.argmin(axis=1)
        seen = distance[np.arange(len(xy)), nearest] < _MATCH_PX
        flux = np.maximum(detections.flux[nearest[seen]], 1.0)
        error[seen] = -2.5 * np.log10(flux / zero_e) - true[seen]
    return true, error


def _limit_of(magnitude: Array, error: Array) -> MeasuredPhotometry:
    """The faintest magnitude down to which each class holds 90 % of its stars, and the error in the last of them."""
    edges = np.arange(np.floor(magnitude.min()), magnitude.max() + _BIN_MAG, _BIN_MAG)
    limit, sigma = float(edges[0]), 0.1
    for low in edges:
        of_class = (magnitude >= low) & (magnitude < low + _BIN_MAG)
        if np.count_nonzero(of_class) < _FEWEST:
            continue
        detected = error[of_class & np.isfinite(error)]
        share = detected.size / np.count_nonzero(of_class)
        if share < FOUND_SHARE:
            return MeasuredPhotometry(float(low), sigma)
        limit = float(low) + _BIN_MAG
        sigma = float(_MAD_TO_SIGMA * np.median(np.abs(detected - np.median(detected))))
    return MeasuredPhotometry(limit, sigma)
