"""The thesis's three methods as printed, on scikit-learn: short, slow, and what the compiled code is checked against.

Nearest neighbour, LASSO and density-based clustering stand here in the words of their equations. The compiled code
(`starid.thesis.cell_search`, `.lasso`, `.matlab_lasso`, `.fsf`) gives the same answers a hundred times faster; the tests
compare the two. Use this module to read what the thesis does, or in the place of the compiled code where an answer is
doubted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starid.thesis.database import FeatureDatabase
from starid.thesis.false_stars import FilterResult, ObservedFrame
from starid.thesis.features import FeatureVector
from starid.thesis.fsf import EPSILON, MIN_SAMPLES_SHARE
from starid.thesis.lasso import LAMBDAS


@dataclass(frozen=True, eq=False)
class ReferenceAnswer:
    """What `ReferenceLostInSpace` makes of one frame.

    Attributes
    ----------
    right_ascension_deg, declination_deg, theta_rad
        Boresight F·ω, eq. 2.36, and polar angle, degrees and radians.
    nearest, distance
        Nearest cell, counted from 0, and its distance on the normalised scale.
    omega, penalty
        Weights ω, (9,), and their λ.
    error_psi
        ε_ψ, eq. 2.20.
    """

    right_ascension_deg: float
    declination_deg: float
    theta_rad: float
    nearest: int
    distance: float
    omega: NDArray[np.float64]
    penalty: float
    error_psi: float


@dataclass(frozen=True, eq=False)
class ReferenceLostInSpace:
    """Algorithm 1: nearest neighbour, dictionary of nine cells, LASSO, weighted boresight.

    Attributes
    ----------
    database
        Planar database of a size that fits into memory at full precision (p up to about 99 %).
    intercept
        False: eq. 2.34 as printed. True: means and deviations of the columns taken out first, as MATLAB's `lasso` does,
        but solved to the end.
    """

    database: FeatureDatabase
    intercept: bool = False

    @cached_property
    def cells(self) -> NDArray[np.int64]:
        """Cells that hold a star, (m,)."""
        return np.flatnonzero(self.database.theta != 255)

    @cached_property
    def vectors(self) -> NDArray[np.float64]:
        """Normalised features τ̂ of these cells in full precision, eq. 2.11, (m, 5)."""
        rows = [self.database.normalise(self.database.exact_features(int(cell))) for cell in self.cells]
        return np.array(rows)

    @cached_property
    def _neighbours(self) -> Any:
        from sklearn.neighbors import NearestNeighbors

        return NearestNeighbors(n_neighbors=1).fit(self.vectors)

    def solve(self, features: FeatureVector) -> ReferenceAnswer:
        """Estimate boresight and polar angle from the features of one frame."""
        observation = self.database.normalise(features)
        distance, row = self._neighbours.kneighbors(observation[None, :])
        nearest = int(self.cells[row[0, 0]])  # eqs 2.12, 2.29
        grid = self.database.grid
        dictionary_cells = grid.dictionary(nearest)  # eq. 2.30
        frames = [self.database.exact_features(int(cell)) for cell in dictionary_cells]
        dictionary = np.array([self.database.normalise(frame) for frame in frames]).T  # T, eq. 2.13
        omega, penalty = self.regularise(dictionary, observation)
        weights = omega / omega.sum()
        centres = np.array([grid.centre(int(cell)) for cell in dictionary_cells])  # F, eq. 2.16
        middle = centres[int(np.flatnonzero(dictionary_cells == nearest)[0])]
        centres[:, 0] = middle[0] + (centres[:, 0] - middle[0] + 180.0) % 360.0 - 180.0
        boresight = weights @ centres  # eq. 2.36
        angles = np.array([frame.theta_rad for frame in frames])  # Θ, eq. 2.18
        theta = np.arctan2(weights @ np.sin(angles), weights @ np.cos(angles))  # eq. 2.37, on the circle
        return ReferenceAnswer(
            float(boresight[0] % 360.0),
            float(boresight[1]),
            float(theta),
            nearest,
            float(distance[0, 0]),
            omega,
            penalty,
            float(np.linalg.norm(observation - dictionary @ omega)),  # eq. 2.20
        )

    def regularise(
        self, dictionary: NDArray[np.float64], observation: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """ω of least mean squared error among the λ of eq. 2.34, (9,), and its λ."""
        from sklearn.linear_model import Lasso

        deviation = dictionary.std(axis=0) if self.intercept else np.ones(dictionary.shape[1])
        fits: list[tuple[float, NDArray[np.float64], float]] = []
        for penalty in LAMBDAS:
            model = Lasso(alpha=penalty, fit_intercept=self.intercept, tol=1e-8, max_iter=100_000)
            fitted = model.fit(dictionary / deviation, observation)
            error = float(np.mean((observation - fitted.predict(dictionary / deviation)) ** 2))
            fits.append((error, np.asarray(fitted.coef_ / deviation, dtype=np.float64), float(penalty)))
        _, omega, penalty = min(fits, key=lambda fit: fit[0])
        return omega, penalty


@dataclass(frozen=True, slots=True)
class ReferenceFilter:
    """Algorithm 2 up to the false stars: pairs, disparities, scikit-learn's DBSCAN, objects of the main cluster.

    Attributes
    ----------
    epsilon, share
        ε, and min_samples as a share of the objects of the later frame.
    """

    epsilon: float = EPSILON
    share: float = MIN_SAMPLES_SHARE

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two frames; whoever appears in the main cluster is a star."""
        from sklearn.cluster import DBSCAN

        votes = np.zeros((len(before), len(now)), dtype=np.int64)
        if min(len(before), len(now)) > 1:
            first, second = _pairs(before), _pairs(now)
            disparities = (first[0][:, None] - second[0][None, :]).reshape(-1, 3)  # eq. 3.9
            turn = disparities[:, 2]
            disparities[:, 2] = turn - 180.0 * np.ceil(turn / 180.0 - 0.5)
            least = int(np.ceil(self.share * len(now)))
            labels = DBSCAN(eps=self.epsilon, min_samples=max(least, 1)).fit(disparities).labels_
            if labels.max(initial=-1) >= 0:
                main = int(np.argmax(np.bincount(labels[labels >= 0])))
                for k in np.flatnonzero(labels == main):
                    i, j = divmod(int(k), len(second[1]))
                    votes[np.ix_(first[1][i], second[1][j])] += 1
        matches = [
            (i, j)
            for i in range(len(before))
            if len(now)
            and votes[i, (j := int(np.argmax(votes[i])))] >= 2
            and int(np.argmax(votes[:, j])) == i
        ]
        return FilterResult(
            np.any(votes, axis=1), np.any(votes, axis=0), np.array(matches, dtype=np.int64).reshape(-1, 2)
        )


def _pairs(frame: ObservedFrame) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean brightness, separation and slope of all pairs, eqs 3.3 to 3.6, (n, 3), and their objects, (n, 2)."""
    i, j = np.triu_indices(len(frame), 1)
    away = frame.positions[j] - frame.positions[i]
    slope = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 180.0
    brightness = 0.5 * (frame.brightness[i] + frame.brightness[j])
    return np.column_stack([brightness, np.hypot(*away.T), slope]), np.column_stack([i, j])
