"""The thesis's three methods as printed, with scikit-learn: the reference for the compiled code.

Nearest neighbour, LASSO and density-based clustering follow their equations. The compiled code
(`starid.identification.thesis.cell_search`, `.lasso`, `.matlab_lasso`, `.fsf`) gives the same answers a hundred times
faster; the tests compare the two. Read this module to see what the thesis does, or use it to check an answer
of the compiled code with `LostInSpace(database, solver="sklearn")`, `solver = "sklearn"` in the table
`[identifier]` of a profile, the solver `lsi-sklearn` of `starid bench`, or `ReferenceFilter` as the
filter of `starid.identification.thesis.rsi`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.errors import StaridError
from starid.identification.thesis.database import FeatureDatabase
from starid.identification.thesis.false_stars import FilterResult, ObservedFrame
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.fsf import EPSILON, MIN_SAMPLES_SHARE
from starid.identification.thesis.lasso import LAMBDAS

CODES_PER_UNIT: Final = 2.55
"""Code steps of a stored feature per unit of the normalised scale."""

NO_STAR: Final = 255
"""Stored polar angle of a cell without stars."""


@dataclass(frozen=True, eq=False)
class ReferenceAnswer:
    """The result of `ReferenceLostInSpace` for one frame.

    Attributes
    ----------
    right_ascension_deg, declination_deg, theta_rad
        Boresight F·ω, eq. 2.36, and polar angle, degrees and radians.
    nearest, distance
        Nearest cell, numbered from 0, and its distance on the normalised scale.
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
    omega: Array
    penalty: float
    error_psi: float


class ReferenceSearch:
    """Search for the nearest cells of a database with scikit-learn's `NearestNeighbors` on the stored codes.

    Parameters
    ----------
    database
        Feature database; cells without stars are ignored.
    """

    def __init__(self, database: FeatureDatabase) -> None:
        try:
            from sklearn.neighbors import NearestNeighbors
        except ModuleNotFoundError:
            raise StaridError(
                "solver = 'sklearn' needs scikit-learn; run: pip install 'starhil[lab]'"
            ) from None

        self._database = database
        self._cells = np.flatnonzero(database.theta != NO_STAR)
        self._tree: Any = NearestNeighbors().fit(database.features[self._cells] / CODES_PER_UNIT)

    def nearest(self, observation: Array, count: int) -> tuple[Array, Indices]:
        """Increasing distances of the nearest cells, and these cells, (count,); ∞ and −1 if fewer."""
        most = min(count, self._cells.size)
        found = self._tree.kneighbors(observation[None, :], n_neighbors=most)
        distances, cells = np.full(count, np.inf), np.full(count, -1, dtype=np.int64)
        distances[:most], cells[:most] = found[0][0], self._cells[found[1][0]]
        return distances, cells

    def exact_nearest(self, observation: Array) -> tuple[int, float]:
        """Nearest cell in full precision, eqs 2.12 and 2.29, and its distance."""
        distances, _ = self.nearest(observation, 1)
        # a code is off by at most half a step in each of five features, and so are both distances compared
        reach = distances[0] + 2.0 * np.sqrt(5.0) * (0.5 / CODES_PER_UNIT) + 1e-9
        rows = self._tree.radius_neighbors(observation[None, :], radius=reach, return_distance=False)[0]
        cells = np.sort(self._cells[rows])
        vectors = [self._database.normalise(self._database.exact_features(int(cell))) for cell in cells]
        exact = np.linalg.norm(np.array(vectors) - observation, axis=1)
        best = int(np.argmin(exact))
        return int(cells[best]), float(exact[best])


def reference_path(dictionary: Array, observation: Array, *, intercept: bool = False) -> Array:
    """Weights ω of eq. 2.34 for each λ in `LAMBDAS`, (k, 9), by scikit-learn's coordinate descent.

    With nearly equal columns it does not reach the last digit of the minimum; its warning is suppressed.

    Parameters
    ----------
    dictionary, observation
        T, (5, 9), and ψ̂, (5,).
    intercept
        False: eq. 2.34 as printed. True: the columns are standardised first, as in MATLAB's `lasso`.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import lasso_path

    deviation = np.ones(dictionary.shape[1])
    if intercept:
        deviation = dictionary.std(axis=0)
        dictionary, observation = dictionary - dictionary.mean(axis=0), observation - observation.mean()
    falling = np.argsort(-LAMBDAS, kind="stable")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        _, weights, _ = lasso_path(
            dictionary / deviation, observation, alphas=LAMBDAS[falling], tol=1e-8, max_iter=100_000
        )
    path = np.empty((LAMBDAS.size, deviation.size))
    path[falling] = (weights / deviation[:, None]).T
    return path


@dataclass(frozen=True, eq=False)
class ReferenceLostInSpace:
    """Algorithm 1: nearest neighbour, dictionary of nine cells, LASSO, weighted boresight.

    Attributes
    ----------
    database
        Planar database.
    intercept
        See `reference_path`; unlike MATLAB's, the descent runs to convergence.
    """

    database: FeatureDatabase
    intercept: bool = False

    @cached_property
    def _search(self) -> ReferenceSearch:
        return ReferenceSearch(self.database)

    def solve(self, features: FeatureVector) -> ReferenceAnswer:
        """Estimate boresight and polar angle from the features of a frame."""
        observation = self.database.normalise(features)
        nearest, distance = self._search.exact_nearest(observation)  # eqs 2.12, 2.29
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
            distance,
            omega,
            penalty,
            float(np.linalg.norm(observation - dictionary @ omega)),  # eq. 2.20
        )

    def regularise(self, dictionary: Array, observation: Array) -> tuple[Array, float]:
        """Return the ω (9,) of least mean squared error among the λ of eq. 2.34, and its λ."""
        path = reference_path(dictionary, observation, intercept=self.intercept)
        residuals = observation - path @ dictionary.T
        if self.intercept:
            residuals -= residuals.mean(axis=1, keepdims=True)
        best = int(np.argmin(np.mean(residuals**2, axis=1)))
        return path[best], float(LAMBDAS[best])


@dataclass(frozen=True, slots=True)
class ReferenceFilter:
    """Algorithm 2 up to the false stars: pairs, disparities, scikit-learn's DBSCAN, main cluster.

    Attributes
    ----------
    epsilon, share
        ε, and min_samples as a share of the number of objects in the later frame.
    """

    epsilon: float = EPSILON
    share: float = MIN_SAMPLES_SHARE

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two frames; every object in the main cluster is a star."""
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


def _pairs(frame: ObservedFrame) -> tuple[Array, Indices]:
    """Mean brightness, separation and slope of all pairs (n, 3), eqs 3.3–3.6, and their objects (n, 2)."""
    i, j = np.triu_indices(len(frame), 1)
    away = frame.positions[j] - frame.positions[i]
    slope = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 180.0
    brightness = 0.5 * (frame.brightness[i] + frame.brightness[j])
    return np.column_stack([brightness, np.hypot(*away.T), slope]), np.column_stack([i, j])
