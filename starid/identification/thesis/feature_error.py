"""How far an attitude from features alone is off, measured on simulated fields of the same camera and database.

The answer of algorithm 1 is either right to a fraction of a cell, or somewhere else in the sky: a star on the wrong side
of the brightness limit changes all five features. The smaller ε_ψ is, the rarer is the second. The mean square of the
errors of simulated fields with a similar ε_ψ, gross ones included, is therefore the covariance that an answer has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from starid.arrays import Array
from starid.attitude import Attitude, random_attitude
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.frame_sky import FrameSky

FIELDS: Final = 800
"""Number of simulated fields."""

_SEED: Final = 20_221_017
_BINS: Final = 8
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
        sigma = np.hypot(_FLOOR_MAG, self.sigma * 10.0 ** (0.4 * (magnitude - self.limit)))
        slope = math.log(9.0) / _SLOPE_MAG
        found = 1.0 / (1.0 + np.exp(slope * (magnitude - self.limit - _SLOPE_MAG)))
        seen = rng.uniform(size=magnitude.size) < found
        return np.asarray(
            np.where(seen, magnitude + sigma * rng.normal(size=magnitude.size), np.inf), dtype=np.float64
        )


@dataclass(frozen=True, eq=False)
class FeatureErrors:
    """Covariance of an attitude from features, by ε_ψ.

    Attributes
    ----------
    upper
        Largest ε_ψ of each class, (k,).
    across, about
        Mean square rotation about each axis across the boresight, and about the boresight, rad², (k,).
    """

    upper: Array
    across: Array
    about: Array

    def covariance(self, error_psi: float) -> Array:
        """Covariance of the rotation vector in the sensor frame, rad², (3, 3)."""
        row = min(int(np.searchsorted(self.upper, error_psi)), self.upper.size - 1)
        return np.diag([self.across[row], self.across[row], self.about[row]])

    @classmethod
    def of_search(
        cls, search: FeatureSearch, sky: FrameSky, photometry: Photometry, side_deg: float | None = None
    ) -> Self:
        """Measure the errors on simulated fields of stars from `sky`.

        With `side_deg` the search is that of a region of this side, whose centre is off by up to a quarter of it.
        """
        rng = np.random.default_rng(_SEED)
        psi, errors = [], []
        for _ in range(FIELDS):
            truth = Attitude.from_radec_roll(*_place(rng), 0.0)
            brightness, offsets, _ = sky.stars_in_frame(truth.ra_deg, truth.dec_deg)
            magnitude = photometry.measured(rng, brightness)
            field = search.field_of(offsets, magnitude)
            features = search.features(field)
            if features is None:
                continue
            if side_deg is None:
                answer = search.answer(features)
            else:
                shift = np.radians(rng.uniform(-0.25 * side_deg, 0.25 * side_deg, 2))
                found = search.answer_in_region(features, truth.rotated((*shift, 0.0)), side_deg)
                if found is None:
                    continue
                answer = found
            psi.append(answer.error_psi)
            errors.append(answer.attitude.error_to(truth).rotation_vector_rad)
        order = np.argsort(psi)
        classes = np.array_split(order, _BINS)
        squares = np.array(errors) ** 2
        return cls(
            np.array([np.array(psi)[rows].max() for rows in classes]),
            np.array([squares[rows, :2].mean() for rows in classes]),
            np.array([squares[rows, 2].mean() for rows in classes]),
        )


def _place(rng: np.random.Generator) -> tuple[float, float]:
    """A random boresight, uniform on the sphere, degrees."""
    attitude = random_attitude(rng)
    return attitude.ra_deg, attitude.dec_deg
