"""The LSI algorithm for a real sensor: features on the sphere, many neighbours, and only verified answers.

Outside the plane of the thesis its nearest neighbour is right in only a third of the frames, because stars
near the brightness limit come and go with the noise of their magnitudes. The nearest neighbours are therefore
tried one after the other: the stars of each vote for a roll (`starid.identification.thesis.coarse_match`), a clear peak is
paired star by star, and the resulting attitude is refined and verified by the geometric identifier.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from starid.arrays import Array
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.pattern_index import resolved_stars
from starid.identification.geometric.verified import VerifiedIdentifier
from starid.identification.single_camera import CheckedDetections
from starid.identification.solution import Reason, Solution
from starid.identification.thesis.database import DatabaseParameters
from starid.identification.thesis.database_choice import given_database, obtain_database
from starid.identification.thesis.feature_search import MIN_STARS, FeatureSearch
from starid.identification.thesis.lsi import LostInSpace, Solver

STARS_PER_FIELD: Final = 60
"""Number of stars per field for the default brightness limit of the features."""

WINDOW_PX: Final = 12.0
"""Window in which a candidate is verified, pixels."""

_ZERO_POINT_STEPS: Final = (0.0, 0.15, -0.15, 0.3, -0.3, 0.5, -0.5)
_ZERO_POINT_STAR: Final = 25
_BLEND_PX: Final = 2.0
_CIRCLE_SHARE: Final = 0.5
"""Width of a circle of a divided field, and distance of the outer ones from the centre, as shares of the field's."""
_CIRCLE_NEIGHBOURS: Final = 3000


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
    divided
        If the whole field has no answer, search nine circles of half its width (section 7.2 of the thesis): for a field
        that a body covers in part. Needs a second database; every search then tries at most 3000 neighbours.
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
    divided: bool = False
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
        neighbours = min(options.neighbours, _CIRCLE_NEIGHBOURS) if options.divided else options.neighbours
        self.search = FeatureSearch(
            camera, LostInSpace(self.database, solver=options.solver), neighbours, np.identity(3)
        )
        self._circles = self._divided(seen, options) if options.divided else []
        self._given_zero_point = options.zero_point
        self._zero_point = options.zero_point
        self._star_magnitude = self._magnitude_of_rank(share)
        self._verifier = Identifier(
            camera, self._catalog, limiting_magnitude=options.limiting_magnitude, cache=options.cache
        )
        self.last_report = LsiReport(None, 0, 0, math.nan)

    def _divided(self, seen: StarCatalog, options: LsiOptions) -> list[FeatureSearch]:
        """The searches of nine circles of the field, which share a database: the middle, and eight around it."""
        whole = self.database.parameters
        half = _CIRCLE_SHARE * math.radians(0.5 * whole.fov_deg)
        parameters = dataclasses.replace(
            whole, fov_deg=_CIRCLE_SHARE * whole.fov_deg, half_width_px=whole.focal_px * math.tan(half)
        )
        database = obtain_database(seen, parameters, cache=options.cache)
        lost_in_space = LostInSpace(database, solver=options.solver)
        ring = [
            half * np.array([math.sin(turn), -math.cos(turn), 0.0]) for turn in np.arange(8) * math.pi / 4.0
        ]
        return [
            dataclasses.replace(
                self.search, lost_in_space=lost_in_space, turn=Rotation.from_rotvec(away).as_matrix()
            )
            for away in (np.zeros(3), *ring)
        ]

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
        """Size of the feature databases (five bytes per cell) and of the index for verification, bytes."""
        cells = sum(search.database.cells for search in (self.search, *self._circles[:1]))
        return 5 * cells + self.verifier.database_bytes

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
        xy = self._camera.border(4)[:MIN_STARS] * 0.25 + 0.375 * np.array(
            [self._camera.width, self._camera.height]
        )
        self._first_verified(CheckedDetections.of(xy, np.ones(len(xy))), [0.0])

    def _identify(self, measured: CheckedDetections) -> Solution:
        solution = self._first_verified(measured, self._zero_points(measured.flux))
        if solution.valid:
            self.learn(solution, measured.flux)
        return solution

    def _first_verified(self, measured: CheckedDetections, zero_points: Sequence[float]) -> Solution:
        """Try the zero points in order, each in the whole field and then in the circles; return the first verified answer."""
        tried = verified = 0
        coarse: Attitude | None = None
        enough = False
        for zero_point, search in itertools.product(zero_points, (self.search, *self._circles)):
            field = search.field_stars(measured.xy, measured.flux, zero_point)
            features = search.features(field)
            if features is None:
                continue
            enough = True
            first, place = search.coarse(features)
            coarse = coarse or first
            for attitude, attempts in search.attitudes_of(field, place, features):
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
        if bright.size < MIN_STARS:
            return shown
        rank = min(_ZERO_POINT_STAR, bright.size) - 1
        guess = self._star_magnitude + 2.5 * math.log10(float(bright[rank]))
        return shown + [guess + step for step in _ZERO_POINT_STEPS]

    def learn(self, solution: Solution, flux: Array) -> None:
        """Learn the zero point from the matched stars of a valid answer, if none was given."""
        if self._given_zero_point is None and solution.star_count >= MIN_STARS:
            magnitudes = self._catalog.v[solution.catalog_index]
            found = magnitudes + 2.5 * np.log10(np.maximum(flux[solution.detection_index], 1e-30))
            self._zero_point = float(np.median(found))
