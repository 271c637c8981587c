"""From the stars of a circular field to boresights and attitudes, by their features.

The circle is centred on the boresight of the camera, or elsewhere in the image (`FeatureSearch.turn`): a divided
field is searched in several narrower circles, of which some contain no covered and no missing star.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask, elementwise
from starid.arithmetic.elementary import cos, log10, sin, square
from starid.arithmetic.matrices import product
from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba
from starid.camera import Camera
from starid.identification.thesis.coarse_match import next_candidate
from starid.identification.thesis.database import FeatureDatabase
from starid.identification.thesis.features import FeatureVector, extract_features
from starid.identification.thesis.frame_sky import UX, UZ, FrameSky
from starid.identification.thesis.lsi import LostInSpace, LsiEstimate, LsiSolution
from starid.identification.thesis.search_spots import Spots, places_not_tried

MIN_STARS: Final = 3
"""Fewest stars of a field that has features."""

# The search beyond the nearest cell is this project's, and so are its constants.
_COUNT_CHANGES: Final = (0, -1, 1, -2, 2, -3, 3)
"""How many stars nearest the brightness limit may be on its wrong side, because of the errors of their magnitudes."""
_MAGNITUDE_GATE: Final = 0.5
"""Largest difference between a detection and the catalogue star for which it votes, mag."""
_MAX_VOTERS: Final = 60
"""Number of detections that vote, the brightest first."""
_VOTE_SHARE: Final = 0.25
"""Share that must vote for one rotation, of the detections or the catalogue stars, whichever are fewer."""
_MIN_VOTES: Final = 4.0
"""Least number of votes for one rotation."""
CELL_SHARE: Final = 0.055
"""Largest error of a neighbour's boresight that is worth a vote, as a share of the half-width of the circle."""
ESTIMATE_SHARE: Final = 0.02
"""The same for a boresight that the LASSO has interpolated."""
_SPREAD: Final = 0.8
"""Side of the spots, each of which is tried once, as a share of the error of a neighbour's boresight."""
_STAGES: Final = (30, 300)
"""Numbers of nearest cells tried before all are."""


@dataclass(frozen=True, eq=False)
class FieldStars:
    """The detections used for the features.

    Attributes
    ----------
    place
        Gnomonic offsets from the boresight in pixels, +x right, +y down, (n, 2).
    magnitude
        Magnitudes, (n,), brightest first.
    row
        Row of each star in the detections given, (n,).
    """

    place: Array
    magnitude: Array
    row: Indices

    def only(self, wanted: Mask) -> FieldStars:
        """The stars that a mask of the detections selects."""
        chosen = wanted[self.row]
        return FieldStars(self.place[chosen], self.magnitude[chosen], self.row[chosen])


@dataclass(frozen=True, eq=False)
class FeatureAnswer:
    """What features say: algorithm 1 for one observation.

    Attributes
    ----------
    solution
        Nearest cell, dictionary, weights.
    estimate
        The estimate of least mean squared error.
    attitude
        Boresight and roll.
    """

    solution: LsiSolution
    estimate: LsiEstimate
    attitude: Attitude

    @property
    def error_psi(self) -> float:
        """Error ε_ψ of the reconstruction."""
        return self.estimate.error_psi

    @property
    def place(self) -> Array:
        """Right ascension and declination of the boresight of the circle, degrees, (1, 2)."""
        return np.array([[self.estimate.right_ascension_deg, self.estimate.declination_deg]])


@dataclass(frozen=True, eq=False)
class FeatureSearch:
    """Search of a spherical database for the stars in a circle of the image.

    Attributes
    ----------
    camera
        The camera of the positions.
    lost_in_space
        The LSI algorithm on a database with the width of the circle.
    neighbours
        Largest number of neighbours tried, nearest first.
    turn
        Rotation (3, 3) that carries the centre of the circle to the boresight.
    stars
        The stars with which the detections of a candidate are paired, fainter ones than those of the features too.
    extract
        Features of magnitudes (n,) and offsets from the centre of the circle (n, 2), pixels.
    """

    camera: Camera
    lost_in_space: LostInSpace
    neighbours: int
    turn: Array
    stars: FrameSky
    extract: Callable[[Array, Array], FeatureVector] = extract_features

    @property
    def database(self) -> FeatureDatabase:
        return self.lost_in_space.database

    @property
    def _half_width_px(self) -> float:
        return self.database.parameters.half_width_px

    def field_stars(self, xy: Array, flux: Array, zero_point: float) -> FieldStars:
        """Detections with flux in the circular field of the features, brightest first."""
        rows = np.flatnonzero(flux > 0.0)
        directions = product(self.camera.back_project(xy[rows]), self.turn.T)
        with np.errstate(invalid="ignore", divide="ignore"):
            place = self.database.parameters.focal_px * directions[:, :2] / directions[:, 2:3]
            inside = np.sum(square(place), axis=1) <= square(self._half_width_px)
        inside &= directions[:, 2] > 0.0
        return self.field_of(
            place[inside], zero_point - 2.5 * elementwise(log10, flux[rows[inside]]), rows[inside]
        )

    def field_of(self, place: Array, magnitude: Array, row: Indices | None = None) -> FieldStars:
        """The same from offsets (n, 2), pixels, and magnitudes (n,); stars of infinite magnitude are left out."""
        order = np.argsort(magnitude, kind="stable")
        order = order[np.isfinite(magnitude[order])]
        rows = np.arange(magnitude.size) if row is None else row
        return FieldStars(place[order], magnitude[order], rows[order])

    def bright(self, field: FieldStars) -> int:
        """Number of stars of the field within the brightness limit of the features."""
        return int(np.searchsorted(field.magnitude, self.database.parameters.kappa, side="right"))

    def reaches_limit(self, field: FieldStars) -> bool:
        """Whether stars as faint as the brightness limit are seen; the faintest detection may be a false star."""
        return field.magnitude.size > 1 and bool(field.magnitude[-2] > self.database.parameters.kappa)

    def features(self, field: FieldStars) -> FeatureVector | None:
        """Feature vector of the stars within the brightness limit; None if there are too few."""
        count = self.bright(field)
        return None if count < MIN_STARS else self.extract(field.magnitude[:count], field.place[:count])

    def doubtful_features(self, field: FieldStars) -> list[FeatureVector]:
        """Feature vectors with some stars fewer or more, those nearest the brightness limit; the likeliest first."""
        count = self.bright(field)
        counts = [count + change for change in _COUNT_CHANGES]
        return [
            self.extract(field.magnitude[:n], field.place[:n])
            for n in counts
            if MIN_STARS <= n <= field.magnitude.size
        ]

    def answer(self, features: FeatureVector) -> FeatureAnswer:
        """Algorithm 1: the nearest cell of the whole database, LASSO, boresight and roll."""
        return self.answer_of(self.lost_in_space.solve(features), features)

    def answer_in_region(
        self, features: FeatureVector, centre: Attitude, side_deg: float
    ) -> FeatureAnswer | None:
        """The same with the nearest cell of a region; None if the region has no cell."""
        lsi, observation = self.lost_in_space, self.database.normalise(features)
        middle = Attitude.from_matrix(product(self.turn, centre.matrix))
        cell, distance, _ = lsi.nearest_in_region(observation, middle.ra_deg, middle.dec_deg, side_deg)
        if cell < 0:
            return None
        return self.answer_of(lsi.estimate(observation, cell, distance), features)

    def answer_of(self, solution: LsiSolution, features: FeatureVector) -> FeatureAnswer:
        """Boresight and roll of a solution: the pointers of features and estimate are laid on each other."""
        estimate = solution.mse
        x, y = cos(features.theta_rad), sin(features.theta_rad)
        across = np.cross(estimate.boresight, estimate.pointer)
        rows = [x * estimate.pointer - y * across, y * estimate.pointer + x * across, estimate.boresight]
        return FeatureAnswer(solution, estimate, Attitude.from_matrix(product(self.turn.T, np.stack(rows))))

    def attitudes_of(
        self, field: FieldStars, observations: Sequence[FeatureVector]
    ) -> Iterator[tuple[Attitude | None, int]]:
        """The same as `attitudes`, from growing numbers of cells nearest to each of several feature vectors."""
        spots, grid = self._spots, self.database.grid.arrays
        tried = spots.none_tried()
        most = min(self.neighbours, self.database.cells)
        normalised = [self.database.normalise(features) for features in observations]
        for count in sorted({min(stage, most) for stage in (*_STAGES, most)}):
            places = np.empty((count, 2))
            for observation in normalised:
                distances, cells = self.lost_in_space.neighbours(observation, count)
                new = places_not_tried(grid, spots, distances, cells, tried, places)
                yield from self.attitudes(field, places[:new], CELL_SHARE)

    @cached_property
    def _spots(self) -> Spots:
        return Spots.of_side(
            math.degrees(_SPREAD * CELL_SHARE * self._half_width_px / self.database.parameters.focal_px)
        )

    def attitudes(
        self, field: FieldStars, candidates: Array, share: float
    ) -> Iterator[tuple[Attitude | None, int]]:
        """Yield attitudes with enough votes, from boresights (k, 2), and the number tried since the last.

        `share` is the largest error of a boresight, as a share of the half-width of the circle. The last item has no
        attitude unless the last candidate has one.
        """
        voters = min(field.magnitude.size, _MAX_VOTERS)
        observed = np.column_stack([field.place[:voters], field.magnitude[:voters]])
        settings = np.array([share * self._half_width_px, _MAGNITUDE_GATE, _VOTE_SHARE, _MIN_VOTES])
        matched = np.empty((voters, 2), dtype=np.int64)
        start = 0
        while start < len(candidates):
            place, count = next_candidate(self.stars.arrays, observed, candidates, start, settings, matched)
            if place < 0:
                yield None, len(candidates) - start
                return
            seen = field.place[matched[:count, 0]]
            body = np.column_stack([seen, np.full(count, self.database.parameters.focal_px)])
            icrs = self.stars.stars[matched[:count, 1], UX : UZ + 1]
            yield solve_wahba(product(body, self.turn), icrs), place + 1 - start
            start = place + 1
