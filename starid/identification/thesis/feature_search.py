"""From the features of a circular field to attitudes worth verifying: neighbours in the database, and votes.

The circle is centred on the boresight of the camera, or elsewhere in the image (`FeatureSearch.turn`): a divided
field is searched in several narrower circles, of which some contain no covered and no missing star.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arrays import Array, Indices
from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba
from starid.camera import Camera
from starid.identification.thesis.coarse_match import next_candidate
from starid.identification.thesis.database import FeatureDatabase
from starid.identification.thesis.features import FeatureVector, extract_features
from starid.identification.thesis.frame_sky import UX, UZ
from starid.identification.thesis.lsi import LostInSpace

MIN_STARS: Final = 5
"""Fewest stars of a field that has features."""

# The search is this project's, and so are its constants; the thesis takes the nearest cell.
_MAGNITUDE_GATE: Final = 0.8
"""Largest difference between a detection and the catalogue star for which it votes, mag."""
_MAX_VOTERS: Final = 60
"""Number of detections that vote, the brightest first."""
_VOTE_SHARE: Final = 0.25
"""Share that must vote for one rotation, of the detections or the catalogue stars, whichever are fewer."""
_MIN_VOTES: Final = 6.0
"""Least number of votes for one rotation."""
_OFFSET_SHARE: Final = 0.055
"""Largest error of a boresight that is worth a vote, as a share of the half-width of the circle."""
_SPREAD: Final = 0.8
"""Side of the spots, each of which is tried once, as a share of that error."""
_SPOTS_PER_BAND: Final = 100_000.0
"""Numbers reserved for the spots of one band of declination, more than there are."""
_STAGES: Final = (200, 3000)
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
    """

    camera: Camera
    lost_in_space: LostInSpace
    neighbours: int
    turn: Array

    @property
    def database(self) -> FeatureDatabase:
        """The database."""
        return self.lost_in_space.database

    @property
    def offset_px(self) -> float:
        """Largest error of a boresight that is worth a vote, pixels."""
        return _OFFSET_SHARE * self.database.parameters.half_width_px

    def field_stars(self, xy: Array, flux: Array, zero_point: float) -> FieldStars:
        """Detections with flux in the circular field of the features, brightest first."""
        rows = np.flatnonzero(flux > 0.0)
        directions = self.camera.back_project(xy[rows]) @ self.turn.T
        with np.errstate(invalid="ignore", divide="ignore"):
            place = self.database.parameters.focal_px * directions[:, :2] / directions[:, 2:3]
            inside = np.sum(place**2, axis=1) <= self.database.parameters.half_width_px**2
        inside &= directions[:, 2] > 0.0
        magnitude = zero_point - 2.5 * np.log10(flux[rows[inside]])
        order = np.argsort(magnitude, kind="stable")
        return FieldStars(place[inside][order], magnitude[order], rows[inside][order])

    def features(self, field: FieldStars) -> FeatureVector | None:
        """Feature vector of the stars above the brightness limit; None if there are too few."""
        bright = field.magnitude <= self.database.parameters.kappa
        if np.count_nonzero(bright) < MIN_STARS:
            return None
        return extract_features(field.magnitude[bright], field.place[bright])

    def coarse(self, features: FeatureVector) -> tuple[Attitude, Array]:
        """Attitude as in the thesis, from one neighbour and LASSO, and its boresight (1, 2) in degrees."""
        solution = self.lost_in_space.solve(features).mse
        x, y = math.cos(features.theta_rad), math.sin(features.theta_rad)
        across = np.cross(solution.boresight, solution.pointer)
        rows = [x * solution.pointer - y * across, y * solution.pointer + x * across, solution.boresight]
        place = np.array([[solution.right_ascension_deg, solution.declination_deg]])
        return Attitude.from_matrix(self.turn.T @ np.stack(rows)), place

    def _candidates(self, features: FeatureVector) -> Iterator[Array]:
        """Yield boresights (k, 2), degrees: centres of growing numbers of nearest cells, none twice."""
        observation = self.database.normalise(features)
        most = min(self.neighbours, self.database.cells)
        tried = np.empty(0)
        for count in sorted({min(stage, most) for stage in (*_STAGES, most)}):
            distances, cells = self.lost_in_space.neighbours(observation, count)
            order = np.lexsort((cells, distances))
            centres = self.cell_centres(cells[order][cells[order] >= 0])
            spots = self._spots(centres)
            first = np.sort(np.unique(spots, return_index=True)[1])
            new = first[~np.isin(spots[first], tried)]
            tried = np.concatenate([tried, spots[new]])
            yield centres[new]

    def _spots(self, places: Array) -> Array:
        """Number the cells, of a grid just fine enough for the votes, that contain positions (n, 2)."""
        step = math.degrees(_SPREAD * self.offset_px / self.database.parameters.focal_px)
        band = np.floor((places[:, 1] + 90.0) / step)
        columns = np.maximum(np.rint(360.0 * np.cos(np.radians((band + 0.5) * step - 90.0)) / step), 1.0)
        return np.asarray(band * _SPOTS_PER_BAND + np.floor(places[:, 0] / 360.0 * columns), dtype=np.float64)

    def attitudes_of(
        self, field: FieldStars, place: Array, features: FeatureVector
    ) -> Iterator[tuple[Attitude | None, int]]:
        """The same from a first boresight (1, 2), degrees, and then from growing numbers of nearest cells."""
        yield from self.attitudes(field, place)
        for places in self._candidates(features):
            yield from self.attitudes(field, places)

    def cell_centres(self, cells: Indices) -> Array:
        """Right ascension and declination of cells, degrees, (n, 2)."""
        grid = self.database.grid
        row = np.searchsorted(grid.row_start, cells, side="right") - 1
        ra = grid.first_ra_deg + (cells - grid.row_start[row]) * grid.row_ra_step_deg[row]
        return np.column_stack([ra % 360.0, grid.row_dec_deg[row]])

    def attitudes(self, field: FieldStars, candidates: Array) -> Iterator[tuple[Attitude | None, int]]:
        """Yield attitudes with enough votes, from boresights (k, 2), and the number tried since the last.

        The last item has no attitude unless the last candidate has one.
        """
        voters = min(field.magnitude.size, _MAX_VOTERS)
        observed = np.column_stack([field.place[:voters], field.magnitude[:voters]])
        sky = self.database.sky
        settings = np.array([self.offset_px, _MAGNITUDE_GATE, _VOTE_SHARE, _MIN_VOTES])
        matched = np.empty((voters, 2), dtype=np.int64)
        start = 0
        while start < len(candidates):
            place, count = next_candidate(sky.arrays, observed, candidates, start, settings, matched)
            if place < 0:
                yield None, len(candidates) - start
                return
            seen = field.place[matched[:count, 0]]
            body = np.column_stack([seen, np.full(count, self.database.parameters.focal_px)])
            yield solve_wahba(body @ self.turn, sky.stars[matched[:count, 1], UX : UZ + 1]), place + 1 - start
            start = place + 1
