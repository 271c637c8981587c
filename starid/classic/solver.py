"""What the published algorithms share: guide stars, detections, an attitude from the matches, its verification.

An algorithm derives from `ClassicIdentifier`, builds its database from the guide stars (`_build`) and says which
observed star may be which guide star (`_match`). Everything before and after stands here.

own choices for all of them:

- Guide stars are the brightest of the sky, as many as give a field `stars_per_field` of them on the average, and
  none fainter than the sensor sees. The papers thin them out to be evenly spread as well; here the sky is left as it is.
- The papers assume a calibrated detection threshold. Where the magnitude of one unit of flux is known
  (`zero_point`) it is used; where it is not, as many of the brightest detections are taken as a field has guide stars.
- One tolerance, for the difference of two distances, is given in pixels (of the coarsest scale in the field), or
  follows from the errors given with the positions: so many standard deviations of a distance as the algorithm asks for.
- The attitude is that of the largest group of matches that agree in all their distances (`starid.classic.agreement`).
"""

from __future__ import annotations

import dataclasses
import math
import time
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arrays import Array, Indices
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.classic.agreement import MIN_GROUP, largest_group
from starid.errors import StaridError
from starid.geometric.identifier import Identifier
from starid.geometric.index_choice import pixels_per_radian
from starid.geometric.pattern_index import field_solid_angle, seen_stars
from starid.geometric.verified import VerifiedIdentifier
from starid.single_camera import Measured
from starid.solution import Reason, Solution
from starid.wahba import covariance, solve_wahba

Database = tuple[NDArray[np.generic], ...]

BLEND_PX: Final = 2.0
"""Stars closer than this are seen as one."""

MIN_GUIDE_STARS: Final = 20
"""Guide stars of the whole sky without which there is nothing to identify."""

_VERIFY_WINDOW_PX: Final = 20.0
_MIN_TOLERANCE_PX: Final = 0.5


@dataclass(frozen=True)
class ClassicOptions:
    """What a published algorithm can be given.

    Attributes
    ----------
    stars_per_field : float or None
        Guide stars in a field on the average; by default the algorithm's own.
    limiting_magnitude : float or None
        Faintest V that the sensor sees.
    zero_point : float or None
        Magnitude V of one unit of flux, where it is known.
    tolerance_px : float or None
        Largest difference of two distances, pixels, where no position errors are given; by default the algorithm's own.
    verify : bool
        Hold the answer to what the geometric identifier demands of its own (True), or return the algorithm's raw
        answer, right or wrong: valid then means no more than that there is one, and aberration is not corrected.
    cache : bool
        Keep the index of the verification in the cache folder. (Databases are made in memory: each takes less
        than ten seconds.)
    """

    stars_per_field: float | None = None
    limiting_magnitude: float | None = None
    zero_point: float | None = None
    tolerance_px: float | None = None
    verify: bool = True
    cache: bool = True

    def __post_init__(self) -> None:
        for name in ("stars_per_field", "tolerance_px"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise StaridError(f"classic {name}: must be a positive number, not {value}")


@dataclass(frozen=True, eq=False)
class GuideStars:
    """Stars of the database, brightest first.

    Attributes
    ----------
    vectors : ndarray (N, 3)
        Unit vectors, ICRS.
    magnitude : ndarray (N,)
        V.
    row : ndarray (N,) int64
        Row of each in the identifier's catalogue.
    """

    vectors: Array
    magnitude: Array
    row: Indices

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, eq=False)
class Observed:
    """Detections that take part, brightest first.

    Attributes
    ----------
    directions : ndarray (n, 3)
        Unit vectors in the sensor frame.
    magnitude : ndarray (n,)
        Magnitude, or instrumental magnitude where the zero point is unknown.
    row : ndarray (n,) int64
        Row of each among the detections given.
    tolerance : float
        Largest difference of two chords.
    """

    directions: Array
    magnitude: Array
    row: Indices
    tolerance: float


class ClassicIdentifier(VerifiedIdentifier):
    """Star identification by a published algorithm, for one camera against one catalogue.

    Parameters
    ----------
    camera : Camera
        What the detections were taken with.
    catalog : StarCatalog, optional
        Default: the whole of Hipparcos at its default epoch.
    options : ClassicOptions, optional
        Default: those of `ClassicOptions`.
    **changes
        Fields of `ClassicOptions` that differ from it.

    Raises
    ------
    StaridError
        A value is out of its range, or there are too few guide stars.
    """

    stars_per_field: ClassVar[float] = 25.0
    """Guide stars in a field on the average."""

    tolerance_px: ClassVar[float] = 3.0
    """Largest difference of two distances, pixels, where no position errors are given."""

    sigmas: ClassVar[float] = 3.0
    """The same in standard deviations of a distance, where they are."""

    least_group: ClassVar[int] = MIN_GROUP
    """Matches with agreeing distances that an answer needs."""

    least_stars: ClassVar[int] = MIN_GROUP
    """Observed stars without which the algorithm has nothing to work with."""

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        options: ClassicOptions | None = None,
        **changes: Any,
    ) -> None:
        self.options = dataclasses.replace(options or ClassicOptions(), **changes)
        super().__init__(camera, catalog)
        self._px_per_rad = pixels_per_radian(camera)
        self._area_sr = field_solid_angle(camera)
        per_field = self.options.stars_per_field or self.stars_per_field
        self._detections = math.ceil(per_field)
        self.guide = self._guide_stars(per_field)
        begin = time.perf_counter()
        self._database = self._build()
        self.build_seconds = time.perf_counter() - begin

    @abstractmethod
    def _build(self) -> Database:
        """Return the arrays that the search reads, made from the guide stars."""

    @abstractmethod
    def _match(self, observed: Observed) -> Indices:
        """Return proposed matches (m, 2): row of an observed star, row of a guide star."""

    @property
    def database_bytes(self) -> int:
        """Size of the database with the directions of the guide stars, bytes."""
        return self.guide.vectors.nbytes + sum(part.nbytes for part in self._database)

    @property
    def width_rad(self) -> float:
        """Width of the field: the square root of its solid angle."""
        return math.sqrt(self._area_sr)

    @property
    def longest_chord(self) -> float:
        """Largest distance of two stars in the field, as a chord."""
        return 2.0 * math.sin(min(self._camera.field_radius_rad, 0.5 * math.pi))

    @cached_property
    def verifier(self) -> Identifier:
        """What verifies and tracks."""
        return Identifier(self._camera, self._catalog, cache=self.options.cache)

    def _guide_stars(self, per_field: float) -> GuideStars:
        """Brightest stars as seen, so many a field."""
        wanted = math.ceil(per_field * 4.0 * math.pi / self._area_sr)
        magnitudes = np.sort(self._catalog.v)
        if magnitudes.size < MIN_GUIDE_STARS:
            raise StaridError(f"classic catalog: {magnitudes.size} stars, at least {MIN_GUIDE_STARS} needed")
        limit = float(magnitudes[min(wanted, magnitudes.size) - 1])
        if self.options.limiting_magnitude is not None:
            limit = min(limit, self.options.limiting_magnitude)
        stars = seen_stars(self._catalog, limit, BLEND_PX / self._px_per_rad)
        if len(stars) < MIN_GUIDE_STARS:
            raise StaridError(
                f"classic limiting_magnitude: {limit:g} leaves {len(stars)} guide stars, at least {MIN_GUIDE_STARS} needed"
            )
        row = self._catalog.index_of(stars.hip).astype(np.int64)
        return GuideStars(np.ascontiguousarray(stars.vectors), stars.v.copy(), row)

    def _identify(self, measured: Measured) -> Solution:
        observed = self._observed(measured.xy, measured.flux, measured.given_sigmas)
        if len(observed.row) < self.least_stars:
            return Solution.invalid(Reason.TOO_FEW_STARS)
        proposed = self._match(observed)
        pairs = largest_group(observed.directions, self.guide.vectors, proposed, observed.tolerance)
        if len(pairs) < self.least_group:
            return Solution.invalid(Reason.NO_MATCH)
        solution = self._raw(measured.xy, observed, pairs)
        if self.options.verify:
            solution = self.verify(measured, solution.attitude, _VERIFY_WINDOW_PX)
        return dataclasses.replace(solution, mode="lost_in_space")

    def warm_up(self) -> None:
        """Compile, or load, the kernels, so that the first real frame is not late."""
        xy, _ = self._camera.project(Attitude.identity().to_sensor(self.guide.vectors))
        inside = np.flatnonzero(np.isfinite(xy[:, 0]))[: self._detections]
        self._match(self._observed(xy[inside], 10.0 ** (-0.4 * self.guide.magnitude[inside]), None))
        if self.options.verify:
            self.verifier.warm_up()

    def _observed(self, xy: Array, flux: Array, sigmas: Array | None) -> Observed:
        """Detections that take part: no fainter than the guide stars, or as many as a field has of them."""
        directions = self._camera.back_project(xy)
        usable = np.flatnonzero((flux > 0.0) & np.isfinite(directions).all(axis=1))
        usable = usable[np.argsort(-flux[usable], kind="stable")]
        magnitude = -2.5 * np.log10(flux[usable])
        if self.options.zero_point is None:
            count = self._detections
        else:
            magnitude = magnitude + self.options.zero_point
            seen = int(np.searchsorted(magnitude, self.guide.magnitude[-1], side="right"))
            count = min(max(seen, self.least_stars), 2 * self._detections)
        rows = usable[:count]
        tolerance_px = self.options.tolerance_px or self.tolerance_px
        if sigmas is not None and rows.size:
            deviation = math.sqrt(2.0 * float(np.mean(sigmas[rows] ** 2)))
            tolerance_px = max(self.sigmas * deviation, _MIN_TOLERANCE_PX)
        return Observed(
            np.ascontiguousarray(directions[rows]), magnitude[:count], rows, tolerance_px / self._px_per_rad
        )

    def _raw(self, xy: Array, observed: Observed, pairs: Indices) -> Solution:
        """Attitude by least squares of the matched stars, unverified."""
        seen, stars = observed.directions[pairs[:, 0]], self.guide.vectors[pairs[:, 1]]
        attitude = solve_wahba(seen, stars)
        expected, _ = self._camera.project(attitude.to_sensor(stars))
        found, rows = observed.row[pairs[:, 0]], self.guide.row[pairs[:, 1]]
        square = float(np.mean(np.sum((expected - xy[found]) ** 2, axis=1)))
        freedom = max(2 * len(pairs) - 3, 1)
        sigma_px = math.sqrt(max(square * len(pairs) / freedom, 1e-12))
        return Solution(
            valid=True,
            reason=Reason.OK,
            quaternion_xyzw=attitude.quaternion_xyzw,
            detection_index=found,
            catalog_index=rows,
            hip=self._catalog.hip[rows],
            covariance=covariance(seen, sigma_px / self._px_per_rad),
            rms_px=math.sqrt(square),
            sigma_px=sigma_px,
        )
