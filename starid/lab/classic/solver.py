"""Base of the published algorithms: guide stars, detections, attitude from the matches, verification.

An algorithm derives from `ClassicIdentifier`, builds its database from the guide stars (`_build`) and
proposes which observed star may be which guide star (`_match`). Everything before and after is done here.

own choices for all of them:

- Guide stars are the brightest stars of the sky: as many as put `stars_per_field` into a field on average,
  and none fainter than the sensor sees. The papers also thin them out to be evenly spread; here only on
  request (`even`).
- The papers assume a calibrated detection threshold. Where the magnitude of unit flux is known (`zero_point`)
  it is used; otherwise as many of the brightest detections are taken as a field has guide stars.
- There is one tolerance, for the difference of two distances. It is given in pixels (at the coarsest scale in
  the field), or follows from the errors given with the positions, in standard deviations of a distance.
- The attitude is computed from the largest consistent group of matches (`starid.lab.classic.agreement`).
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

from starid.arithmetic.arrays import Array, Indices
from starid.attitude import Attitude
from starid.attitude.wahba import covariance, solve_wahba
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.index_choice import pixels_per_radian
from starid.identification.geometric.pattern_index import field_solid_angle, resolved_stars
from starid.identification.geometric.pattern_stars import select_pattern_stars
from starid.identification.geometric.verified import VerifiedIdentifier
from starid.identification.options import UNLIMITED_DEG
from starid.identification.single_camera import CheckedDetections
from starid.identification.solution import Reason, Solution
from starid.lab.classic.agreement import MIN_GROUP, largest_group

Database = tuple[NDArray[np.generic], ...]

BLEND_PX: Final = 2.0
"""Stars closer than this are merged."""

MIN_GUIDE_STARS: Final = 20
"""Smallest number of guide stars in the whole sky."""

EVEN_PER_FIELD: Final = 12
"""Largest number of evenly spread guide stars in the solid angle of a field around any of them."""

_VERIFY_WINDOW_PX: Final = 20.0
_MIN_TOLERANCE_PX: Final = 0.5


@dataclass(frozen=True)
class ClassicOptions:
    """Options of a published algorithm.

    Attributes
    ----------
    stars_per_field : float or None
        Mean number of guide stars per field; the default depends on the algorithm.
    limiting_magnitude : float or None
        Faintest V that the sensor sees.
    zero_point : float or None
        V magnitude of unit flux, where it is known.
    tolerance_px : float or None
        Largest difference of two distances, pixels, without position errors; default: the algorithm's.
    even : bool
        Thin the guide stars out to be evenly spread: at most `EVEN_PER_FIELD` in the solid angle of a field
        around any of them, the brightest.
    verify : bool
        Verify the answer as strictly as the geometric identifier does its own (True), or return the raw
        answer, right or wrong, without correction for aberration.
    cache : bool
        Keep the verification's index in the cache folder. (Databases are built in memory, in seconds.)
    """

    stars_per_field: float | None = None
    limiting_magnitude: float | None = None
    zero_point: float | None = None
    tolerance_px: float | None = None
    even: bool = False
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
        Row of each star in the identifier's catalogue.
    """

    vectors: Array
    magnitude: Array
    row: Indices

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, eq=False)
class Observed:
    """The detections used, brightest first.

    Attributes
    ----------
    directions : ndarray (n, 3)
        Unit vectors in the sensor frame.
    magnitude : ndarray (n,)
        Magnitude, or instrumental magnitude where the zero point is unknown.
    row : ndarray (n,) int64
        Row of each star in the detections given.
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
        The camera that took the image.
    catalog : StarCatalog, optional
        By default all of Hipparcos at its default epoch.
    options : ClassicOptions, optional
        By default those of `ClassicOptions`.
    **changes
        Fields of `ClassicOptions` to change.

    Raises
    ------
    StaridError
        A value is out of range, or there are too few guide stars.
    """

    stars_per_field: ClassVar[float] = 25.0
    """Mean number of guide stars per field."""

    tolerance_px: ClassVar[float] = 3.0
    """Largest difference of two distances, pixels, where no position errors are given."""

    clutter: ClassVar[float] = 2.0
    """Largest number of detections used, as a multiple of the stars per field."""

    sigmas: ClassVar[float] = 3.0
    """The same in standard deviations of a distance, where position errors are given."""

    min_group: ClassVar[int] = MIN_GROUP
    """Smallest number of matches, agreeing in distance, for an answer."""

    min_stars: ClassVar[int] = MIN_GROUP
    """Smallest number of observed stars that the algorithm can use."""

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
        """Build the arrays that the search reads from the guide stars."""

    @abstractmethod
    def _match(self, observed: Observed) -> Indices:
        """Return proposed matches (m, 2): row of an observed star, row of a guide star."""

    @property
    def database_bytes(self) -> int:
        """Size in bytes of the database, including the directions of the guide stars."""
        return self.guide.vectors.nbytes + sum(part.nbytes for part in self._database)

    @property
    def width_rad(self) -> float:
        """Width of the field, radians: the square root of its solid angle."""
        return math.sqrt(self._area_sr)

    @property
    def longest_chord(self) -> float:
        """Largest distance between two stars in the field, as a chord."""
        return 2.0 * math.sin(min(self._camera.field_radius_rad, 0.5 * math.pi))

    @cached_property
    def verifier(self) -> Identifier:
        """The geometric identifier that verifies answers and tracks."""
        return Identifier(
            self._camera, self._catalog, largest_error_deg=UNLIMITED_DEG, cache=self.options.cache
        )

    def _guide_stars(self, per_field: float) -> GuideStars:
        """Choose the brightest stars, as the camera resolves them, with a mean number per field."""
        on_sky = math.ceil(per_field * 4.0 * math.pi / self._area_sr)
        magnitudes = np.sort(self._catalog.v)
        if magnitudes.size < MIN_GUIDE_STARS:
            raise StaridError(f"classic catalog: {magnitudes.size} stars, at least {MIN_GUIDE_STARS} needed")
        limit = float(magnitudes[-1 if self.options.even else min(on_sky, magnitudes.size) - 1])
        if self.options.limiting_magnitude is not None:
            limit = min(limit, self.options.limiting_magnitude)
        stars = resolved_stars(self._catalog, limit, BLEND_PX / self._px_per_rad)
        if self.options.even:
            stars = stars.subset(select_pattern_stars(stars.vectors, self._area_sr, EVEN_PER_FIELD))
        if len(stars) < MIN_GUIDE_STARS:
            raise StaridError(
                f"classic limiting_magnitude: {limit:g} leaves {len(stars)} guide stars, at least {MIN_GUIDE_STARS} needed"
            )
        row = self._catalog.index_of(stars.hip).astype(np.int64)
        return GuideStars(np.ascontiguousarray(stars.vectors), stars.v.copy(), row)

    def _identify(self, measured: CheckedDetections) -> Solution:
        sigmas = measured.sigmas[:, :2] if measured.sigmas_known else None
        observed = self._observed(measured.xy, measured.flux, sigmas)
        if len(observed.row) < self.min_stars:
            return Solution.invalid(Reason.TOO_FEW_STARS)
        proposed = self._match(observed)
        pairs = largest_group(observed.directions, self.guide.vectors, proposed, observed.tolerance)
        if len(pairs) < self.min_group:
            return Solution.invalid(Reason.NO_MATCH)
        solution = self._raw(measured.xy, observed, pairs)
        if self.options.verify:
            solution = self.verify(measured, solution.attitude, _VERIFY_WINDOW_PX)
        return dataclasses.replace(solution, mode="lost_in_space")

    def warm_up(self) -> None:
        """Compile or load the kernels, so that the first frame is not late."""
        xy, _ = self._camera.project(Attitude.identity().to_sensor(self.guide.vectors))
        inside = np.flatnonzero(np.isfinite(xy[:, 0]))[: self._detections]
        self._match(self._observed(xy[inside], 10.0 ** (-0.4 * self.guide.magnitude[inside]), None))
        if self.options.verify:
            self.verifier.warm_up()

    def _observed(self, xy: Array, flux: Array, sigmas: Array | None) -> Observed:
        """Choose the detections no fainter than the guide stars, or as many as a field has of them."""
        directions = self._camera.back_project(xy)
        usable = np.flatnonzero((flux > 0.0) & np.isfinite(directions).all(axis=1))
        usable = usable[np.argsort(-flux[usable], kind="stable")]
        magnitude = -2.5 * np.log10(flux[usable])
        if self.options.zero_point is None:
            count = self._detections
        else:
            magnitude = magnitude + self.options.zero_point
            seen = int(np.searchsorted(magnitude, self.guide.magnitude[-1], side="right"))
            count = min(max(seen, self.min_stars), math.ceil(self.clutter * self._detections))
        rows = usable[:count]
        tolerance_px = self.options.tolerance_px or self.tolerance_px
        if sigmas is not None and rows.size:
            deviation = math.sqrt(2.0 * float(np.mean(sigmas[rows] ** 2)))
            tolerance_px = max(self.sigmas * deviation, _MIN_TOLERANCE_PX)
        directions = np.ascontiguousarray(directions[rows])
        # read-only as those of the guide stars, so that kernels are compiled for both at once
        directions.setflags(write=False)
        return Observed(directions, magnitude[:count], rows, tolerance_px / self._px_per_rad)

    def _raw(self, xy: Array, observed: Observed, pairs: Indices) -> Solution:
        """Fit the attitude to the matched stars by least squares, without verification."""
        directions, stars = observed.directions[pairs[:, 0]], self.guide.vectors[pairs[:, 1]]
        attitude = solve_wahba(directions, stars)
        expected, _ = self._camera.project(attitude.to_sensor(stars))
        detections, rows = observed.row[pairs[:, 0]], self.guide.row[pairs[:, 1]]
        square = float(np.mean(np.sum((expected - xy[detections]) ** 2, axis=1)))
        freedom = max(2 * len(pairs) - 3, 1)
        sigma_px = math.sqrt(max(square * len(pairs) / freedom, 1e-12))
        return Solution(
            valid=True,
            reason=Reason.OK,
            quaternion_xyzw=attitude.quaternion_xyzw,
            detection_index=detections,
            catalog_index=rows,
            hip=self._catalog.hip[rows],
            covariance=covariance(directions, sigma_px / self._px_per_rad),
            rms_px=math.sqrt(square),
            sigma_px=sigma_px,
        )
