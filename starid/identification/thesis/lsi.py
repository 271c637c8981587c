"""The LSI algorithm of the thesis (algorithm 1): boresight and roll from one feature vector."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import atan2, cos, hypot, sin, square
from starid.arithmetic.matrices import product
from starid.identification.options import Solver
from starid.identification.thesis.cell_search import (
    CellArrays,
    cell_arrays,
    exact_nearest,
    exact_vector,
    make_cell_index,
    stored_neighbours,
)
from starid.identification.thesis.database import DatabaseError, FeatureDatabase
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.frame_grid import DICTIONARY_SIZE, dictionary_cells
from starid.identification.thesis.lasso import LAMBDAS, choose_lambdas, lasso_path
from starid.identification.thesis.matlab_lasso import matlab_path
from starid.identification.thesis.reference import ReferenceSearch, reference_path
from starid.kernels.jit import compiled, inner_checked

Precision = Literal["exact", "stored"]
LassoPath = Callable[[Array, Array], Array]

_WHOLE_SKY_DEG: Final = 720.0
_CODES_PER_RADIAN: Final = 255.0 / (2.0 * math.pi)
_RESULT_SIZE: Final = 16
_MIN_WEIGHT: Final = 1e-3

RA, DEC, THETA, ERROR, LAMBDA, BORESIGHT, POINTER = 1, 2, 3, 4, 5, 6, 9
"""Indices in a row of results, after Σω: α, δ (°), θ (rad), ε_ψ, λ, boresight and pointer vectors."""


class SearchedCells(NamedTuple):
    """A database for the kernels: stars, stored codes, and which of the two to use.

    Attributes
    ----------
    arrays
        Stars, grid and normalisation.
    features, theta
        Stored codes, (m, 5) and (m,); a cell without stars has polar angle 255.
    exact
        Use full-precision distances and dictionaries instead of the codes.
    matlab
        Solve the LASSO as MATLAB's function `lasso` does, not exactly.
    """

    arrays: CellArrays
    features: NDArray[np.uint8]
    theta: NDArray[np.uint8]
    exact: bool
    matlab: bool


class LsiWork(NamedTuple):
    """Arrays that the kernels fill in; made by `lsi_work`.

    Attributes
    ----------
    cells, dictionary
        Cells of the dictionary (9,) and their normalised features T, (5, 9).
    places
        Right ascensions and declinations, degrees, and polar angles, radians, of these cells, (3, 9).
    weights, results
        Weights and results of the two estimates, (2, 9) and (2, 16).
    """

    cells: Indices
    dictionary: Array
    places: Array
    weights: Array
    results: Array


def lsi_work() -> LsiWork:
    """Allocate the arrays for one estimate."""
    nine = DICTIONARY_SIZE
    return LsiWork(
        np.empty(nine, dtype=np.int64),
        np.empty((5, nine)),
        np.empty((3, nine)),
        np.empty((2, nine)),
        np.empty((2, _RESULT_SIZE)),
    )


@dataclass(frozen=True, slots=True)
class LsiEstimate:
    """An estimate of the boresight and the reconstructed features.

    Attributes
    ----------
    right_ascension_deg, declination_deg
            Estimated boresight f = (α̃, δ̃), eq. 2.14: the centre of the frame, degrees. Subtract half a
            frame for the lower-left corner, which the thesis tabulates.
        theta_rad
            Estimated polar angle of the frame object for a camera with north up, eq. 2.17 with a circular
            mean of the angles. The roll is the difference between the observed and this polar angle.
    omega
        Weights ω of the nine dictionary cells, (9,).
    penalty
        The λ of these weights.
    error_psi
        Error of the reconstruction ε_ψ = ‖ψ̂ − Tω‖, eq. 2.20, on the normalised scale.
    reconstruction
        Reconstructed observation T·ω, eq. 2.19, on the normalised scale, (5,).
    boresight, pointer
        Spherical geometry: unit vectors (ICRS) of the boresight and, perpendicular to it, of the direction of
        the frame object; zeros in the planar geometry.
    """

    right_ascension_deg: float
    declination_deg: float
    theta_rad: float
    omega: Array
    penalty: float
    error_psi: float
    reconstruction: Array
    boresight: Array
    pointer: Array


@dataclass(frozen=True, eq=False)
class LsiSolution:
    """The result of the LSI algorithm for one observation.

    Attributes
    ----------
    observation
        Normalised observation ψ̂, (5,).
    nearest
        Cell of the nearest neighbour t₅, numbered from 0 (in the thesis from 1).
    distance
        Its distance on the normalised scale.
    cells
        Cells of the dictionary, (9,).
    dictionary
        T of eq. 2.13: normalised features of these cells as columns, (5, 9).
    weights, results
        Weights and results of the two estimates, (2, 9) and (2, 16).
    """

    observation: Array
    nearest: int
    distance: float
    cells: Indices
    dictionary: Array
    weights: Array
    results: Array

    @cached_property
    def mse(self) -> LsiEstimate:
        """Estimate at the λ of the least mean squared error."""
        return self._estimate(0)

    @cached_property
    def one_se(self) -> LsiEstimate:
        """Estimate at the largest λ within one standard error of the least error."""
        return self._estimate(1)

    def _estimate(self, row: int) -> LsiEstimate:
        numbers, omega = self.results[row], self.weights[row]
        return LsiEstimate(
            float(numbers[RA]),
            float(numbers[DEC]),
            float(numbers[THETA]),
            omega,
            float(numbers[LAMBDA]),
            float(numbers[ERROR]),
            product(self.dictionary, omega),
            numbers[BORESIGHT : BORESIGHT + 3],
            numbers[POINTER : POINTER + 3],
        )


@compiled
def fill_dictionary(searched: SearchedCells, cell: int, work: LsiWork) -> None:
    """Fill in the dictionary around a cell: features, boresights F of eq. 2.16 and angles Θ of eq. 2.18."""
    arrays = searched.arrays
    first_row = dictionary_cells(arrays.grid, cell, work.cells, work.places[0])
    sums = np.empty(8)
    vector = np.empty(5)
    for j in range(9):
        work.places[1, j] = arrays.grid.row_dec[first_row + j // 3]
        if searched.exact:
            work.places[2, j] = exact_vector(arrays, work.cells[j], sums, vector)
            for f in range(5):
                work.dictionary[f, j] = vector[f]
        else:
            work.places[2, j] = searched.theta[work.cells[j]] * (2.0 * math.pi / 255.0)
            for f in range(5):
                work.dictionary[f, j] = searched.features[work.cells[j], f] / 2.55


@inner_checked
def _flat_estimate(omega: Array, work: LsiWork, result: Array) -> None:
    """Combine boresights and angles in the flat plane, with weights normalised to a sum of one."""
    cos_sum = 0.0
    sin_sum = 0.0
    ra = 0.0
    dec = 0.0
    for j in range(9):
        ra += omega[j] * work.places[0, j]
        dec += omega[j] * work.places[1, j]
        cos_sum += omega[j] * cos(work.places[2, j])
        sin_sum += omega[j] * sin(work.places[2, j])
    result[1] = (ra / result[0]) % 360.0
    result[2] = dec / result[0]
    result[3] = atan2(sin_sum, cos_sum)


@inner_checked
def _sphere_estimate(omega: Array, work: LsiWork, result: Array) -> None:
    """Combine boresights and frame-object directions as vectors, without singularities."""
    boresight = np.zeros(3)
    pointer = np.zeros(3)
    for j in range(9):
        a = math.radians(work.places[0, j])
        d = math.radians(work.places[1, j])
        ca, sa, cd, sd = cos(a), sin(a), cos(d), sin(d)
        east = -cos(work.places[2, j])
        north = -sin(work.places[2, j])
        boresight[0] += omega[j] * cd * ca
        boresight[1] += omega[j] * cd * sa
        boresight[2] += omega[j] * sd
        pointer[0] += omega[j] * (-east * sa - north * sd * ca)
        pointer[1] += omega[j] * (east * ca - north * sd * sa)
        pointer[2] += omega[j] * north * cd
    boresight /= math.sqrt((square(boresight)).sum())
    pointer -= boresight * (pointer * boresight).sum()
    length = math.sqrt((square(pointer)).sum())
    level = hypot(boresight[0], boresight[1])
    ca, sa = (boresight[0] / level, boresight[1] / level) if level > 0.0 else (1.0, 0.0)
    result[1] = math.degrees(atan2(sa, ca)) % 360.0
    result[2] = math.degrees(atan2(boresight[2], level))
    if length < 1e-12:
        pointer[:] = (sa, -ca, 0.0)
        length = 1.0
    pointer /= length
    north = -pointer[0] * boresight[2] * ca - pointer[1] * boresight[2] * sa + pointer[2] * level
    east = pointer[1] * ca - pointer[0] * sa
    result[3] = atan2(-north, -east)
    result[6:9] = boresight
    result[9:12] = pointer


@compiled
def estimate_from_path(
    searched: SearchedCells,
    cell: int,
    observation: Array,
    lambdas: Array,
    path: Array,
    steps: tuple[int, int],
    work: LsiWork,
) -> None:
    """Compute the estimates from the weights at two λ of a LASSO path.

    The boresight is F·ω (eq. 2.15, printed again as eq. 2.36) and the angle Θ·ω (eq. 2.37), with weights
    normalised to a sum of one; the reconstruction is T·ω (eq. 2.35). If the weights cancel, the cell is
    taken.
    """
    for row in range(2):
        omega = work.weights[row]
        result = work.results[row]
        omega[:] = path[steps[row]]
        total = omega.sum()
        if total < _MIN_WEIGHT:
            for j in range(9):
                omega[j] = 1.0 if work.cells[j] == cell else 0.0
            total = 1.0
        square = 0.0
        for f in range(5):
            residual = observation[f]
            for j in range(9):
                residual -= work.dictionary[f, j] * omega[j]
            square += residual * residual
        result[0] = total
        result[4] = math.sqrt(square)
        result[5] = lambdas[steps[row]]
        if searched.arrays.sky.frame[0] > 0.5:
            _sphere_estimate(omega, work, result)
        else:
            _flat_estimate(omega, work, result)
            result[6:12] = 0.0


@compiled
def estimate_from_cell(
    searched: SearchedCells, cell: int, observation: Array, lambdas: Array, work: LsiWork
) -> None:
    """Compute dictionary, LASSO and estimates for a cell."""
    fill_dictionary(searched, cell, work)
    path = np.empty((lambdas.size, 9))
    error = np.empty(lambdas.size)
    if searched.matlab:
        matlab_path(work.dictionary, observation, lambdas, path)
    else:
        lasso_path(work.dictionary, observation, lambdas, path)
    chosen = choose_lambdas(work.dictionary, observation, path, error)
    estimate_from_path(searched, cell, observation, lambdas, path, chosen, work)


@inner_checked
def _angle_gap(code: float, other: float, slack: float) -> float:
    """Circular difference of two polar angles in code steps (255 per turn), minus a slack."""
    turn = (code - other) / 255.0
    return max(255.0 * abs(turn - round(turn)) - slack, 0.0)


@compiled
def region_nearest(
    searched: SearchedCells,
    observation: Array,
    ra_deg: float,
    dec_deg: float,
    side_deg: float,
    theta: float,
    outcome: Array,
) -> int:
    """Find the nearest neighbour among the cells of a square search region; −1 if the region has no cell.

    The cells are compared one by one, as in the thesis; a side of 720° includes the whole database.

    Parameters
    ----------
    ra_deg, dec_deg, side_deg
        Centre and side Γ of the square, degrees; wraps in right ascension, clipped to the grid.
    theta
        Polar angle of the frame object, radians, as a sixth feature (full turn: 100); NaN to ignore it.
    outcome
        Output (2,): distance on the normalised scale, and number of cells in the region.
    """
    arrays, grid = searched.arrays, searched.arrays.grid
    sums = np.empty(8)
    vector = np.empty(5)
    best_cell = -1
    best = math.inf
    count = 0
    half = 0.5 * side_deg
    counts_angle = not math.isnan(theta)
    theta_code = theta * _CODES_PER_RADIAN if counts_angle else 0.0
    slack = 0.5 + 1e-9 if searched.exact else 0.0
    for row in range(grid.row_dec.size):
        if abs(grid.row_dec[row] - dec_deg) > half:
            continue
        step = grid.row_ra_step[row]
        columns = grid.row_columns[row]
        width = half
        if arrays.sky.frame[0] > 0.5:
            width = half / max(cos(math.radians(grid.row_dec[row])), half / 180.0)
        first = math.ceil((ra_deg - width - grid.first_ra) / step)
        last = min(math.floor((ra_deg + width - grid.first_ra) / step), first + columns - 1)
        for place in range(first, last + 1):
            cell = grid.row_start[row] + place % columns
            if searched.theta[cell] == 255:
                continue
            count += 1
            d = 0.0
            for f in range(5):
                gap = abs(searched.features[cell, f] - observation[f] * 2.55)
                gap = max(gap - slack, 0.0)
                d += gap * gap
                if d >= best:
                    break
            if counts_angle:
                d += square(_angle_gap(searched.theta[cell], theta_code, slack))
            if d >= best:
                continue
            if searched.exact:
                angle = exact_vector(arrays, cell, sums, vector)
                d = 0.0
                for f in range(5):
                    gap = (vector[f] - observation[f]) * 2.55
                    d += gap * gap
                if counts_angle:
                    d += square(_angle_gap(angle * _CODES_PER_RADIAN, theta_code, 0.0))
            if d < best:
                best = d
                best_cell = cell
    outcome[0] = math.sqrt(best) / 2.55
    outcome[1] = count
    return best_cell


class LostInSpace:
    """The LSI algorithm on one database.

    The nearest neighbour t₅ is the cell of least distance ‖ψ̂ − t̂‖ (eq. 2.12) of all d_i (eq. 2.28),
    eq. 2.29. Its 3×3 neighbourhood is the dictionary, and the LASSO weights its cells.

    Parameters
    ----------
    database
        Feature database.
    precision
            "exact": distances and dictionaries in full precision, computed from the stars where the stored
            codes leave doubt, as for the published accuracy. "stored": the 8-bit codes only.
        solver
            "exact": the exact path of the LASSO. "matlab": as MATLAB's function `lasso` solves it by default,
            as for the published accuracy. "sklearn": nearest neighbours over the whole database and the LASSO
            of scikit-learn; the same answers, hundreds of times slower (`starid.identification.thesis.reference`).
    weights
        Another LASSO: from dictionary (5, 9) and observation (5,) to weights (k, 9), one row for each λ of `LAMBDAS`. By
        default that of the solver.

    Raises
    ------
    DatabaseError
        The precision or the solver is unknown.
    """

    def __init__(
        self,
        database: FeatureDatabase,
        *,
        precision: Precision = "exact",
        solver: Solver = "exact",
        weights: LassoPath | None = None,
    ) -> None:
        if precision not in ("exact", "stored"):
            raise DatabaseError(f"LSI: precision must be exact or stored, not {precision!r}")
        if solver not in get_args(Solver):
            raise DatabaseError(f"LSI: solver must be one of {', '.join(get_args(Solver))}, not {solver!r}")
        self.database = database
        self.index = make_cell_index(database)
        self.arrays = cell_arrays(database)
        self.searched = SearchedCells(
            self.arrays, database.features, database.theta, precision == "exact", solver == "matlab"
        )
        self._reference = ReferenceSearch(database) if solver == "sklearn" else None
        self._weights = weights or (None if self._reference is None else reference_path)

    def solve(self, features: FeatureVector) -> LsiSolution:
        """Estimate boresight and roll from the features of a frame, searching the whole database."""
        return self.solve_normalised(self.database.normalise(features))

    def solve_normalised(self, observation: Array) -> LsiSolution:
        """Estimate from a normalised observation ψ̂, (5,).

        Raises
        ------
        DatabaseError
            The observation is not five finite numbers.
        """
        return self.estimate(observation, *self.nearest(observation))

    def nearest(self, observation: Array, *, theta_rad: float = math.nan) -> tuple[int, float]:
        """Find the nearest cell of the whole database, and its distance, for a normalised observation.

        A polar angle counts as a sixth feature, with 100 for a full turn; the answer then depends on roll.
        """
        self._check(observation)
        outcome = np.empty(2)
        if not math.isnan(theta_rad):
            cell = region_nearest(self.searched, observation, 0.0, 0.0, _WHOLE_SKY_DEG, theta_rad, outcome)
            return cell, float(outcome[0])
        if self.searched.exact and self._reference is not None:
            return self._reference.exact_nearest(observation)
        if self.searched.exact:
            return exact_nearest(self.index, self.arrays, observation, outcome), float(outcome[0])
        distances, cells = self.neighbours(observation, 1)
        return int(cells[0]), float(distances[0])

    def neighbours(self, observation: Array, count: int) -> tuple[Array, Indices]:
        """Find the nearest cells by stored codes: distances and cells (count,), unordered; −1 if fewer."""
        if self._reference is not None:
            return self._reference.nearest(observation, count)
        distances, cells = np.empty(count), np.empty(count, dtype=np.int64)
        stored_neighbours(self.index, observation * 2.55, distances, cells)
        return np.sqrt(distances) / 2.55, cells

    def nearest_in_region(
        self,
        observation: Array,
        ra_deg: float,
        dec_deg: float,
        side_deg: float,
        *,
        theta_rad: float = math.nan,
    ) -> tuple[int, float, int]:
        """Find the nearest cell of a square region, or −1, its distance, and the number of cells.

        A polar angle counts as in `nearest`.
        """
        self._check(observation)
        found = np.empty(2)
        cell = region_nearest(self.searched, observation, ra_deg, dec_deg, side_deg, theta_rad, found)
        return cell, float(found[0]), int(found[1])

    def estimate(self, observation: Array, cell: int, distance: float) -> LsiSolution:
        """Compute dictionary, LASSO and estimates for a given cell."""
        self._check(observation)
        work = lsi_work()
        if self._weights is None:
            estimate_from_cell(self.searched, cell, observation, LAMBDAS, work)
        else:
            fill_dictionary(self.searched, cell, work)
            path = self._weights(work.dictionary, observation)
            chosen = choose_lambdas(work.dictionary, observation, path, np.empty(LAMBDAS.size))
            estimate_from_path(self.searched, cell, observation, LAMBDAS, path, chosen, work)
        return _solution(observation, cell, distance, work)

    def _check(self, observation: Array) -> None:
        if observation.shape != (5,) or not np.isfinite(observation).all():
            raise DatabaseError("LSI: an observation must be five finite numbers; check the stars")


def _solution(observation: Array, nearest: int, distance: float, work: LsiWork) -> LsiSolution:
    return LsiSolution(
        observation, nearest, distance, work.cells, work.dictionary, work.weights, work.results
    )
