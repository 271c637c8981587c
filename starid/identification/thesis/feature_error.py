"""How far an attitude from features alone is off, measured on simulated fields of the same camera and database.

The answer of algorithm 1 is either right to a fraction of a cell, or somewhere else in the sky: a star on the wrong side
of the brightness limit changes all five features. The smaller ε_ψ is, the rarer is the second. The covariance of an
answer is the mean of both, weighted with the probability of the second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from starid.arithmetic.arrays import Array, elementwise
from starid.arithmetic.elementary import exp, hypot, log, square
from starid.attitude import Attitude, random_attitude
from starid.catalog.photometry import flux_ratio
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.features import FeatureVector

FIELDS: Final = 800
"""Number of simulated fields."""

RIGHT_DEG: Final = 1.5
"""Error of the boresight up to which an answer is at the right place of the sky, degrees."""

_SEED: Final = 20_221_017
_CLASSES: Final = 8
_SLOPE_MAG: Final = 0.2
"""Width of the magnitudes over which the share of stars found falls from 90 to 50 %."""
_FLOOR_MAG: Final = 0.03
"""Error of a bright star's magnitude: blends, variability and the catalogue."""


@dataclass(frozen=True, slots=True)
class Photometry:
    """What a detector finds.

    Attributes
    ----------
    limit
        Magnitude at which 90 % of the stars are found.
    sigma
        One-sigma error of a magnitude there; that of a brighter star is smaller in proportion to its flux.
    """

    limit: float
    sigma: float

    def measured(self, rng: np.random.Generator, magnitude: Array) -> Array:
        """Magnitudes as measured, infinite for stars that are not found."""
        sigma = np.sqrt(square(_FLOOR_MAG) + square(self.sigma * flux_ratio(self.limit - magnitude)))
        slope = log(9.0) / _SLOPE_MAG
        found = 1.0 / (1.0 + elementwise(exp, slope * (magnitude - self.limit - _SLOPE_MAG)))
        seen = rng.uniform(size=magnitude.size) < found
        return np.asarray(
            np.where(seen, magnitude + sigma * rng.normal(size=magnitude.size), np.inf), dtype=np.float64
        )


@dataclass(frozen=True, eq=False)
class FeatureErrors:
    """Errors of an attitude from features, by classes of ε_ψ.

    Attributes
    ----------
    upper
        Largest ε_ψ of each class, (k,).
    wrong
        Share of answers from the whole database at another place of the sky, (k,).
    right
        Mean square rotation of the others about an axis across the boresight, and about the boresight, rad², (k, 2).
    gross
        The same for those at another place, (2,).
    ratio
        How much more often the region around an answer at another place has such an ε_ψ, after a motion by about a cell,
        than the region around an answer at the right place, (k,).
    """

    upper: Array
    wrong: Array
    right: Array
    gross: Array
    ratio: Array

    def row(self, error_psi: float) -> int:
        """The class of an ε_ψ."""
        return min(int(np.searchsorted(self.upper, error_psi)), self.upper.size - 1)

    def covariance(self, error_psi: float, wrong: float) -> Array:
        """Covariance of the rotation vector in the sensor frame, rad², (3, 3); `wrong` is the probability of another place."""
        across, about = (1.0 - wrong) * self.right[self.row(error_psi)] + wrong * self.gross
        return np.diag([across, across, about])

    @classmethod
    def of_search(cls, search: FeatureSearch, photometry: Photometry, side_deg: float) -> Self:
        """Measure the errors on simulated fields, in the whole database and in regions of a side in degrees."""
        rng = np.random.default_rng(_SEED)
        psi, errors = [], []
        here: list[float] = []
        elsewhere: list[float] = []
        for _ in range(FIELDS):
            somewhere = random_attitude(rng)
            truth = Attitude.from_radec_roll(somewhere.ra_deg, somewhere.dec_deg, 0.0)
            features = _features_at(search, photometry, rng, truth)
            if features is None:
                continue
            answer = search.answer(features)
            psi.append(answer.error_psi)
            errors.append(answer.attitude.error_to(truth).rotation_vector_rad)
            step = search.database.grid.step_deg * rng.normal(size=2)
            move = (*np.radians(step), 0.0)
            later = _features_at(search, photometry, rng, truth.rotated(move))
            local = (
                None
                if later is None
                else search.answer_in_region(later, answer.attitude.rotated(move), side_deg)
            )
            if local is not None:
                errors_psi = elsewhere if hypot(*errors[-1][:2]) > math.radians(RIGHT_DEG) else here
                errors_psi.append(local.error_psi)
        squares = square(np.array(errors))
        upper = np.quantile(psi, np.arange(1, _CLASSES + 1) / _CLASSES)
        upper[-1] = math.inf
        rows = np.searchsorted(upper, psi)
        lost = np.sqrt(squares[:, 0] + squares[:, 1]) > math.radians(RIGHT_DEG)
        right = np.array([_mean_squares(squares[(rows == row) & ~lost]) for row in range(_CLASSES)])
        count = np.bincount(rows, minlength=_CLASSES)
        wrong = (np.bincount(rows[lost], minlength=_CLASSES) + 0.5) / (count + 1.0)
        likely, unlikely = (
            (np.bincount(np.searchsorted(upper, errors_psi), minlength=_CLASSES) + 0.5)
            / (len(errors_psi) + 0.5 * _CLASSES)
            for errors_psi in (here, elsewhere)
        )
        return cls(upper, wrong, right, _mean_squares(squares[lost]), unlikely / likely)


def _features_at(
    search: FeatureSearch, photometry: Photometry, rng: np.random.Generator, attitude: Attitude
) -> FeatureVector | None:
    """Features of the field at an attitude as the detector sees it; None with too few stars."""
    brightness, offsets, _ = search.stars.stars_in_frame(attitude.ra_deg, attitude.dec_deg)
    return search.features(search.field_of(offsets, photometry.measured(rng, brightness)))


def _mean_squares(squares: Array) -> Array:
    """Mean of squared rotations (n, 3) across and about the boresight, (2,); that of a degree if there are none."""
    if len(squares) == 0:
        return np.full(2, square(math.radians(RIGHT_DEG)))
    return np.array([squares[:, :2].mean(), squares[:, 2].mean()])
