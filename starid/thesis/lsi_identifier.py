"""The LSI algorithm for a real sensor: features on the sphere, many neighbours, and only verified answers.

Outside the plane of the thesis its nearest neighbour is right in only a third of the frames, because stars
near the brightness limit come and go with the noise of their magnitudes. The nearest neighbours are therefore
tried one after the other: the stars of each vote for a roll (`starid.thesis.coarse_match`), a clear peak is
paired star by star, and the resulting attitude is refined and verified by the geometric identifier.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.arrays import Array, Indices
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.geometric.identifier import Identifier
from starid.geometric.pattern_index import resolved_stars
from starid.geometric.verified import VerifiedIdentifier
from starid.single_camera import CheckedDetections
from starid.solution import Reason, Solution
from starid.thesis.coarse_match import next_candidate
from starid.thesis.database import DatabaseParameters
from starid.thesis.database_choice import given_database, obtain_database
from starid.thesis.features import FeatureVector, extract_features
from starid.thesis.frame_sky import UX, UZ
from starid.thesis.lsi import LostInSpace, Solver
from starid.wahba import solve_wahba

STARS_PER_FIELD: Final = 60
"""Number of stars per field for the default brightness limit of the features."""

WINDOW_PX: Final = 12.0
"""Window in which a candidate is verified, pixels."""

_MIN_STARS: Final = 5
_MAGNITUDE_GATE: Final = 0.8
_MAX_VOTERS: Final = 60
_ZERO_POINT_STEPS: Final = (0.0, 0.15, -0.15, 0.3, -0.3, 0.5, -0.5)
_ZERO_POINT_STAR: Final = 25
_BLEND_PX: Final = 2.0
_VOTE_SHARE: Final = 0.25
_SPREAD: Final = 0.8
_SPOTS_PER_BAND: Final = 100_000.0
_STAGES: Final = (200, 3000)
_OFFSET_SHARE: Final = 0.055
_MIN_VOTES: Final = 6.0


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


@dataclass(frozen=True, slots=True)
class LsiReport:
    """Statistics of the last call.

    Attributes
    ----------
    coarse
        Attitude as in the thesis: one nearest neighbour, LASSO, roll from the polar angle; or None.
    tried
        Number of candidates for which the stars voted.
    verified
        Number of candidates passed to the verification.
    zero_point
        Magnitude of unit flux, as used.
    """

    coarse: Attitude | None
    tried: int
    verified: int
    zero_point: float


@dataclass(frozen=True)
class LsiOptions:
    """Settings of an LSI identifier.

    Attributes
    ----------
    feature_limit
        Faintest V of the stars in the features; default: for about 60 per field. The sensor must see deeper.
    overlap
        Overlap ratio of the database.
    neighbours
        Largest number of neighbours tried, nearest first.
    zero_point
        V magnitude of unit flux, if it is known. Otherwise it is learned: each answer determines it, and for
        the next frame that value is tried first, and then guesses from the frame.
    limiting_magnitude
        Faintest V of the verification (see `Identifier`).
    database
        Feature database to use instead of the cached one.
    cache
        Keep the database and the index in the cache folder.
    solver
        Solver of nearest neighbour and LASSO: "exact", "matlab" or "sklearn" (see `LostInSpace`).
    """

    feature_limit: float | None = None
    overlap: float = 0.99
    neighbours: int = 30_000
    zero_point: float | None = None
    limiting_magnitude: float | None = None
    database: str | Path | None = None
    cache: bool = True
    solver: Solver = "exact"

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise StaridError(f"lsi neighbours: must be at least 1, not {self.neighbours}")


class LsiIdentifier(VerifiedIdentifier):
    """Star identification by the LSI algorithm, for one camera against one catalogue.

    Parameters
    ----------
    camera
        The camera that took the image.
    catalog
        By default all of Hipparcos at its default epoch.
    options
        By default `LsiOptions()`.
    **changes
        Fields of `LsiOptions` to change.

    Raises
    ------
    DatabaseError
        The database given belongs to another camera, catalogue, band or geometry.
    StaridError
        The catalogue is empty.
    """

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        options: LsiOptions | None = None,
        **changes: Any,
    ) -> None:
        options = dataclasses.replace(options or LsiOptions(), **changes)
        super().__init__(camera, catalog)
        if len(self._catalog) == 0:
            raise StaridError("identifier catalog: contains no stars")
        probe = DatabaseParameters.for_camera(camera, overlap=options.overlap, kappa=0.0)
        share = 0.5 * (1.0 - math.cos(math.radians(0.5 * probe.fov_deg)))
        limit = self._limit_for(share) if options.feature_limit is None else options.feature_limit
        parameters = dataclasses.replace(probe, kappa=limit)
        seen = resolved_stars(self._catalog, limit + 1.0, _BLEND_PX / camera.focal_px[0])
        self.database = (
            obtain_database(seen, parameters, cache=options.cache)
            if options.database is None
            else given_database(Path(options.database), parameters, (self._catalog.identity, seen.identity))
        )
        self.lost_in_space = LostInSpace(self.database, solver=options.solver)
        self._offset_px = _OFFSET_SHARE * self.database.parameters.half_width_px
        self._neighbours = options.neighbours
        self._given_zero_point = options.zero_point
        self._zero_point = options.zero_point
        self._star_magnitude = self._magnitude_of_rank(share)
        self._verifier = Identifier(
            camera, self._catalog, limiting_magnitude=options.limiting_magnitude, cache=options.cache
        )
        self.last_report = LsiReport(None, 0, 0, math.nan)

    @property
    def verifier(self) -> Identifier:
        """The geometric identifier that verifies answers and tracks."""
        return self._verifier

    @property
    def zero_point(self) -> float | None:
        """V magnitude of unit flux, as given or as learned from the last answer; None if neither."""
        return self._zero_point

    @property
    def database_bytes(self) -> int:
        """Size of the feature database (five bytes per cell) and of the index for verification, bytes."""
        return 5 * self.database.cells + self.verifier.database_bytes

    def reset(self) -> None:
        """Forget the learned zero point; the given one, if any, is used again."""
        self._zero_point = self._given_zero_point

    def _limit_for(self, share: float) -> float:
        v = np.sort(self._catalog.v)
        row = min(int(STARS_PER_FIELD / share), v.size) - 1
        return math.ceil(10.0 * float(v[row])) / 10.0

    def _magnitude_of_rank(self, share: float) -> float:
        """V magnitude of the star of rank `_ZERO_POINT_STAR` in an average field."""
        v = np.sort(self._catalog.v)
        return float(v[min(int(_ZERO_POINT_STAR / share), v.size - 1)])

    def warm_up(self) -> None:
        """Compile or load the kernels, so that the first frame is not late."""
        self.verifier.warm_up()
        xy = self._camera.border(4)[:_MIN_STARS] * 0.25 + 0.375 * np.array(
            [self._camera.width, self._camera.height]
        )
        self._first_verified(CheckedDetections.of(xy, np.ones(len(xy))), [0.0])

    def _identify(self, measured: CheckedDetections) -> Solution:
        solution = self._first_verified(measured, self._zero_points(measured.flux))
        if solution.valid:
            self.learn(solution, measured.flux)
        return solution

    def _first_verified(self, measured: CheckedDetections, zero_points: Sequence[float]) -> Solution:
        """Try the zero points in order; return the first verified answer."""
        tried = verified = 0
        coarse: Attitude | None = None
        enough = False
        for zero_point in zero_points:
            field = self.field_stars(measured.xy, measured.flux, zero_point)
            features = self.features(field)
            if features is None:
                continue
            enough = True
            first, place = self._coarse(features)
            coarse = coarse or first
            for attitude, attempts in self._attitudes_of(field, place, features):
                tried += attempts
                if attitude is None:
                    continue
                verified += 1
                solution = self.verify(measured, attitude, WINDOW_PX)
                if solution.valid:
                    self.last_report = LsiReport(coarse, tried, verified, zero_point)
                    return dataclasses.replace(solution, mode="lost_in_space")
        self.last_report = LsiReport(coarse, tried, verified, math.nan)
        return Solution.invalid(Reason.NO_MATCH if enough else Reason.TOO_FEW_STARS)

    def _zero_points(self, flux: Array) -> list[float]:
        """Zero points to try: the given one, or the learned one and then guesses from the frame."""
        if self._given_zero_point is not None:
            return [self._given_zero_point]
        shown = [] if self._zero_point is None else [self._zero_point]
        bright = np.sort(flux[flux > 0.0])[::-1]
        if bright.size < _MIN_STARS:
            return shown
        rank = min(_ZERO_POINT_STAR, bright.size) - 1
        guess = self._star_magnitude + 2.5 * math.log10(float(bright[rank]))
        return shown + [guess + step for step in _ZERO_POINT_STEPS]

    def learn(self, solution: Solution, flux: Array) -> None:
        """Learn the zero point from the matched stars of a valid answer, if none was given."""
        if self._given_zero_point is None and solution.star_count >= _MIN_STARS:
            magnitudes = self._catalog.v[solution.catalog_index]
            found = magnitudes + 2.5 * np.log10(np.maximum(flux[solution.detection_index], 1e-30))
            self._zero_point = float(np.median(found))

    def field_stars(self, xy: Array, flux: Array, zero_point: float) -> FieldStars:
        """Detections with flux in the circular field of the features, brightest first."""
        rows = np.flatnonzero(flux > 0.0)
        directions = self._camera.back_project(xy[rows])
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
        if np.count_nonzero(bright) < _MIN_STARS:
            return None
        return extract_features(field.magnitude[bright], field.place[bright])

    def _coarse(self, features: FeatureVector) -> tuple[Attitude, Array]:
        """Attitude as in the thesis, from one neighbour and LASSO, and its boresight (1, 2) in degrees."""
        solution = self.lost_in_space.solve(features).mse
        x, y = math.cos(features.theta_rad), math.sin(features.theta_rad)
        across = np.cross(solution.boresight, solution.pointer)
        rows = [x * solution.pointer - y * across, y * solution.pointer + x * across, solution.boresight]
        place = np.array([[solution.right_ascension_deg, solution.declination_deg]])
        return Attitude.from_matrix(np.stack(rows)), place

    def _candidates(self, features: FeatureVector) -> Iterator[Array]:
        """Yield boresights (k, 2), degrees: centres of growing numbers of nearest cells, none twice."""
        observation = self.database.normalise(features)
        most = min(self._neighbours, self.database.cells)
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
        step = math.degrees(_SPREAD * self._offset_px / self.database.parameters.focal_px)
        band = np.floor((places[:, 1] + 90.0) / step)
        columns = np.maximum(np.rint(360.0 * np.cos(np.radians((band + 0.5) * step - 90.0)) / step), 1.0)
        return np.asarray(band * _SPOTS_PER_BAND + np.floor(places[:, 0] / 360.0 * columns), dtype=np.float64)

    def _attitudes_of(
        self, field: FieldStars, place: Array, features: FeatureVector
    ) -> Iterator[tuple[Attitude | None, int]]:
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
        settings = np.array([self._offset_px, _MAGNITUDE_GATE, _VOTE_SHARE, _MIN_VOTES])
        matched = np.empty((voters, 2), dtype=np.int64)
        start = 0
        while start < len(candidates):
            place, count = next_candidate(sky.arrays, observed, candidates, start, settings, matched)
            if place < 0:
                yield None, len(candidates) - start
                return
            seen = field.place[matched[:count, 0]]
            body = np.column_stack([seen, np.full(count, self.database.parameters.focal_px)])
            yield solve_wahba(body, sky.stars[matched[:count, 1], UX : UZ + 1]), place + 1 - start
            start = place + 1
