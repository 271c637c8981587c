"""Sub-cell search: solve for the boresight between the cells, from several neighbours, and keep the best.

While no star enters or leaves the frame, n, A and σ_A do not change with the boresight, and r and σ_r are
smooth functions of it: two equations for two unknowns. Newton's method from each of the k nearest cells
therefore converges either to the frame itself or to a position whose features, computed from the stars, do
not fit; the residual of all five features decides. This removes the error of the thesis's algorithm off the
grid, where the cell with the nearest features often has another star at its rim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import cos, hypot, sin, square
from starid.identification.thesis.cell_search import CellArrays, CellIndex, exact_nearest, stored_neighbours
from starid.identification.thesis.database import DatabaseError
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.frame_grid import cell_centre
from starid.identification.thesis.frame_sky import HALF_WIDTH, cell_features, stars_near
from starid.identification.thesis.lsi import LostInSpace
from starid.kernels.jit import compiled, inner_checked

_DIFFERENCE_DEG = 1e-4
_MAX_STEPS = 8
_CONVERGED_DEG = 1e-7
_AGREEMENT = 1e-12
_MAX_STARS = 2048
_NEAR_SHARE = 0.0075
_SEEN_SHARE = 0.9
_NO_STARS = np.empty((0, 2))


@inner_checked
def _residual(
    arrays: CellArrays, observation: Array, ra: float, dec: float, sums: Array, vector: Array
) -> float:
    """Write the residual of the normalised features at (ra, dec) to `vector`; return the squared length."""
    cell_features(arrays.sky, ra % 360.0, dec, sums, vector)
    total = 0.0
    for f in range(5):
        vector[f] = (vector[f] - arrays.minimum[f]) * arrays.scale[f] - observation[f]
        total += vector[f] * vector[f]
    return total


@inner_checked
def newton_from(
    arrays: CellArrays, observation: Array, ra: float, dec: float, reach_deg: float, place: Array
) -> float:
    """Improve a boresight until r and σ_r agree; return the squared residual of all features at the best.

    Parameters
    ----------
    ra, dec
        Start, degrees.
    reach_deg
        Largest distance from the start, degrees.
    place
        Output (2,): right ascension and declination of the best position, degrees.
    """
    sums = np.empty(8)
    here = np.empty(5)
    east = np.empty(5)
    north = np.empty(5)
    best = math.inf
    a, d = ra, dec
    for _ in range(_MAX_STEPS):
        cost = _residual(arrays, observation, a, d, sums, here)
        stars = sums[0]
        if cost < best:
            best = cost
            place[0] = a
            place[1] = d
        widen = 1.0
        if arrays.sky.frame[0] > 0.5:
            widen = 1.0 / max(cos(math.radians(d)), 1e-3)
        _residual(arrays, observation, a + _DIFFERENCE_DEG * widen, d, sums, east)
        east_stars = sums[0]
        _residual(arrays, observation, a, d + _DIFFERENCE_DEG, sums, north)
        if east_stars != stars or sums[0] != stars:
            a += 3.0 * _DIFFERENCE_DEG * widen
            d -= 3.0 * _DIFFERENCE_DEG
            continue
        j00 = (east[2] - here[2]) / _DIFFERENCE_DEG
        j01 = (north[2] - here[2]) / _DIFFERENCE_DEG
        j10 = (east[4] - here[4]) / _DIFFERENCE_DEG
        j11 = (north[4] - here[4]) / _DIFFERENCE_DEG
        size = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
        damping = 1e-6 * size
        h00 = j00 * j00 + j10 * j10 + damping
        h11 = j01 * j01 + j11 * j11 + damping
        h01 = j00 * j01 + j10 * j11
        g0 = j00 * here[2] + j10 * here[4]
        g1 = j01 * here[2] + j11 * here[4]
        determinant = h00 * h11 - h01 * h01
        if determinant <= 0.0:
            break
        step_a = -(h11 * g0 - h01 * g1) / determinant
        step_d = -(h00 * g1 - h01 * g0) / determinant
        length = hypot(step_a, step_d)
        if length > 0.5 * reach_deg:
            step_a *= 0.5 * reach_deg / length
            step_d *= 0.5 * reach_deg / length
        a += step_a * widen
        d += step_d
        d = min(max(d, -90.0), 90.0)
        if hypot((a - ra) / widen, d - dec) > reach_deg:
            break
        if length < _CONVERGED_DEG:
            cost = _residual(arrays, observation, a, d, sums, here)
            if cost < best:
                best = cost
                place[0] = a
                place[1] = d
            break
    return best


@inner_checked
def share_seen(
    arrays: CellArrays, positions: Array, theta: float, ra: float, dec: float, stars: Array, rows: Indices
) -> float:
    """Share of observed stars with a catalogue star within 0.75 % of the half-width of the frame.

    Parameters
    ----------
    positions, theta
        Observed stars (n, 2) in the unit of the frame, and the polar angle of their frame object, radians.
    ra, dec
        Assumed boresight, degrees; the roll is the difference between the polar angles.
    stars, rows
        Workspace for `stars_near`.
    """
    count = stars_near(arrays.sky, ra % 360.0, dec, 0.0, stars, rows)
    sums = np.empty(8)
    vector = np.empty(5)
    turn = theta - cell_features(arrays.sky, ra % 360.0, dec, sums, vector)
    c, s = cos(turn), sin(turn)
    limit = square(_NEAR_SHARE * arrays.sky.frame[HALF_WIDTH])
    matched = 0
    for i in range(positions.shape[0]):
        x = c * positions[i, 0] + s * positions[i, 1]
        y = c * positions[i, 1] - s * positions[i, 0]
        for j in range(count):
            if square(stars[j, 0] - x) + square(stars[j, 1] - y) <= limit:
                matched += 1
                break
    return float(matched / positions.shape[0])


@compiled
def subcell_kernel(
    index: CellIndex,
    arrays: CellArrays,
    observation: Array,
    positions: Array,
    theta: float,
    reach_deg: float,
    distances: Array,
    cells: Indices,
    answer: Array,
) -> int:
    """Try the neighbours, nearest first; return the number of starting points.

    The nearest cell in full precision comes first. A start near an earlier one is skipped. Without positions,
    the search ends at the first solution that agrees in all features, and the smallest residual wins. With
    the positions of the stars (n, 2) and their polar angle, it ends at the first solution with nine in ten
    stars seen, and the largest share wins. `answer` (5,) receives right ascension, declination (degrees),
    polar angle (radians), the length of the residual and the share of stars seen.
    """
    compares = positions.shape[0] > 0
    stars = np.empty((_MAX_STARS if compares else 0, 3))
    rows = np.empty(stars.shape[0], dtype=np.int64)
    most = -1.0
    stored_neighbours(index, observation * 2.55, distances, cells)
    order = np.argsort(distances)
    first = exact_nearest(index, arrays, observation, answer)
    places = np.empty((cells.size + 1, 2))
    place = np.empty(2)
    starts = 0
    best = math.inf
    for turn in range(-1, order.size):
        if (not compares and best < _AGREEMENT) or most >= _SEEN_SHARE:
            break
        cell = first if turn < 0 else cells[order[turn]]
        if cell < 0:
            continue
        ra, dec = cell_centre(arrays.grid, cell)
        narrow = cos(math.radians(dec)) if arrays.sky.frame[0] > 0.5 else 1.0
        is_repeated = False
        for i in range(starts):
            gap = (ra - places[i, 0] + 180.0) % 360.0 - 180.0
            if hypot(gap * narrow, dec - places[i, 1]) < 0.4 * reach_deg:
                is_repeated = True
                break
        if is_repeated:
            continue
        cost = newton_from(arrays, observation, ra, dec, reach_deg, place)
        places[starts, 0] = ra
        places[starts, 1] = dec
        starts += 1
        seen = share_seen(arrays, positions, theta, place[0], place[1], stars, rows) if compares else 0.0
        if seen > most or (seen == most and cost < best):
            most = seen
            best = cost
            answer[0] = place[0] % 360.0
            answer[1] = place[1]
    if starts > 0:
        sums = np.empty(8)
        vector = np.empty(5)
        answer[2] = cell_features(arrays.sky, answer[0], answer[1], sums, vector)
        answer[3] = math.sqrt(best)
        answer[4] = most
    return starts


@dataclass(frozen=True, slots=True)
class FineEstimate:
    """A boresight between the cells.

    Attributes
    ----------
    right_ascension_deg, declination_deg
        Centre of the frame, degrees.
    theta_rad
        Polar angle of the frame object at the boresight, for a camera with north up.
    residual
        Length of the residual of the normalised features; near zero if the stars are the same.
    starts
        Number of cells tried.
    seen
        Share of the observed stars that are in the catalogue at this boresight; 0 if not compared.
    """

    right_ascension_deg: float
    declination_deg: float
    theta_rad: float
    residual: float
    starts: int
    seen: float


class SubcellSearch:
    """Improved LSI estimate from k neighbours, each solved between the cells.

    Parameters
    ----------
    lost_in_space
        The LSI algorithm whose database, index and arrays are used.
    neighbours
        Number of stored neighbours tried besides the nearest cell.
    reach_steps
        Largest distance of an answer from its start, in steps of the grid.
    """

    def __init__(self, lost_in_space: LostInSpace, *, neighbours: int = 16, reach_steps: float = 2.0) -> None:
        if neighbours < 1 or not reach_steps > 0.0:
            raise DatabaseError("LSI: must have at least one neighbour and a positive reach")
        self._lsi = lost_in_space
        self._reach = reach_steps * lost_in_space.database.grid.step_deg
        self._neighbours = neighbours

    def solve(self, features: FeatureVector, positions: Array | None = None) -> FineEstimate:
        """Estimate the boresight from the features of a frame.

        Parameters
        ----------
        features
            Features of the frame.
        positions
            Offsets of the same stars from the centre, in the unit of the frame, (n, 2). If given, the stars
            themselves are compared with the catalogue at every boresight tried, since features can be
            ambiguous.

        Raises
        ------
        DatabaseError
            The features are not finite, or the database is empty.
        """
        observation = self._lsi.database.normalise(features)
        if not np.isfinite(observation).all():
            raise DatabaseError("LSI: an observation must be five finite numbers; check the stars")
        answer = np.empty(5)
        starts = subcell_kernel(
            self._lsi.index,
            self._lsi.arrays,
            observation,
            _NO_STARS if positions is None else np.ascontiguousarray(positions, dtype=np.float64),
            features.theta_rad,
            self._reach,
            np.empty(self._neighbours),
            np.empty(self._neighbours, dtype=np.int64),
            answer,
        )
        if starts == 0:
            raise DatabaseError("LSI: the database has no frame with a star")
        ra, dec, theta, residual, seen = (float(value) for value in answer)
        return FineEstimate(ra, dec, theta, residual, starts, seen)
