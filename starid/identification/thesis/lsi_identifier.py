"""The LSI algorithm for a real sensor (algorithm 1 of the thesis), in two stages.

*Thesis*: the features of the field give the nearest cell, the cell its dictionary, and LASSO the boresight and roll.
*Refinement*: from such attitudes detections are paired with stars, and the geometric identifier fits and verifies.

On a real sky the nearest cell is the right one in a part of the fields only, since a star near the brightness limit is
now within it and now not, with the noise of its magnitude. Three choices make it as large as it can be: the limit leaves
some ten stars a field and is never fainter than what the sensor finds (`LsiOptions.feature_limit`); the magnitudes are
those of the sensor, with its zero point and colour term; and the refinement also tries the cells nearest to the features
with a star or two fewer or more (`FeatureSearch.doubtful_features`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array, Mask, elementwise
from starid.arithmetic.elementary import cos, log10, sin, tan
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.pattern_index import resolved_stars
from starid.identification.geometric.verified import VerifiedIdentifier
from starid.identification.options import REGION_DEG, LsiOptions
from starid.identification.single_camera import CheckedDetections
from starid.identification.solution import FeatureReport, Reason, Search, Solution
from starid.identification.thesis.answer_sequence import AnswerSequence, KeptAnswer
from starid.identification.thesis.database import DatabaseParameters, sky_of
from starid.identification.thesis.database_choice import given_database, obtain_database
from starid.identification.thesis.feature_error import FIELDS, RANDOM, FeatureErrors, Photometry
from starid.identification.thesis.feature_search import (
    ESTIMATE_SHARE,
    MIN_STARS,
    FeatureAnswer,
    FeatureSearch,
    FieldStars,
)
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.parts import Parts
from starid.kernels.kernel_cache import kernels_key
from starid.storage.cache import Tables, cached_tables

_log = logging.getLogger(__name__)

STARS_PER_FIELD: Final = 10
"""Number of stars per field for the default brightness limit of the features: fewer make fields alike, and with more
some are always on the wrong side of the limit."""

STARS_PER_MATCH: Final = 60
"""Number of stars per field that are paired with detections."""

WINDOW_PX: Final = 12.0
"""Window in which a candidate is verified, pixels."""

SOLAR_COLOUR_B_V: Final = 0.65
"""B−V of a star for which the colour term is zero; also taken for stars of unknown colour."""

_DEEPER_MAG: Final = 0.5
_ZERO_POINT_STEPS: Final = (0.0, 0.15, -0.15, 0.3, -0.3, 0.5, -0.5)
_ZERO_POINT_STAR: Final = 25
_BLEND_PX: Final = 2.0
_CIRCLE_SHARE: Final = 0.5
"""Width of a circle of a divided field, and distance of the outer ones from the centre, as shares of the field's."""


@dataclass(frozen=True, slots=True)
class LsiReport:
    """Statistics of the last call.

    Attributes
    ----------
    coarse
        Attitude of the first stage for the whole field; None if it had too few stars.
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
    parts
        The parts of the algorithm; by default those of the thesis.
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
        parts: Parts | None = None,
        **changes: Any,
    ) -> None:
        options = dataclasses.replace(options or LsiOptions(), **changes)
        super().__init__(camera, catalog)
        if len(self._catalog) == 0:
            raise StaridError("identifier catalog: contains no stars")
        self.options, self._parts = options, parts or Parts()
        self._sensor_magnitudes = _sensor_magnitudes(self._catalog, options.colour_term)
        probe = DatabaseParameters.for_camera(camera, overlap=options.overlap, kappa=0.0)
        share = 0.5 * (1.0 - cos(math.radians(0.5 * probe.fov_deg)))
        parameters = dataclasses.replace(probe, kappa=self._feature_limit(share))
        deep = max(self._limit_for(STARS_PER_MATCH, share), parameters.kappa)
        if options.detected_limit is not None:
            deep = min(deep, max(options.detected_limit + _DEEPER_MAG, parameters.kappa))
        sensor_stars = self._sensor_stars(deep + 1.0)
        self.database = (
            obtain_database(sensor_stars, parameters, cache=options.cache)
            if options.database is None
            else given_database(
                Path(options.database), parameters, (self._catalog.identity, sensor_stars.identity)
            )
        )
        stars = sky_of(sensor_stars, dataclasses.replace(parameters, kappa=deep))
        self.search = FeatureSearch(
            camera,
            LostInSpace(self.database, solver=options.solver, weights=self._parts.weights),
            options.neighbours,
            np.identity(3),
            stars,
            self._parts.features,
        )
        self._circles = self._divided(sensor_stars, deep) if options.divided else []
        self._given_zero_point = options.zero_point
        self._zero_point = options.zero_point
        self._star_magnitude = self._magnitude_of_rank(share)
        self._verifier = (
            Identifier(
                camera,
                self._catalog,
                limiting_magnitude=options.limiting_magnitude,
                largest_error_deg=options.largest_error_deg,
                cache=options.cache,
            )
            if options.refinement
            else None
        )
        self._errors = (
            None if options.refinement else self._feature_errors(sensor_stars.identity, parameters, deep)
        )
        self.last_report = LsiReport(None, 0, 0, math.nan)

    def _feature_errors(self, *stars: object) -> FeatureErrors:
        """Return the errors of features alone, which are measured once for what they depend on: `stars` and the options."""
        limit = self.options.detected_limit
        photometry = Photometry(
            self.database.parameters.kappa + 1.0 if limit is None else limit, self.options.magnitude_sigma
        )
        options = self.options
        limits = REGION_DEG, options.threshold, options.largest_error_psi

        def measured() -> Tables:
            _log.warning(
                "measuring the uncertainty of features in %d simulated sequences of images, which takes tens of seconds%s",
                FIELDS,
                "; later starts with this camera and these options use the result" if options.cache else "",
            )
            return FeatureErrors.of_search(self.search, photometry, *limits).arrays

        if not options.cache or options.database is not None or self._parts != Parts():
            return FeatureErrors.of_arrays(measured())
        what = stars, self._camera.identity, options.solver, options.neighbours, photometry, limits
        digest = hashlib.sha256(f"{kernels_key()} {what}".encode())
        for file in sorted(Path(__file__).parent.glob("*.py")):
            digest.update(file.read_bytes())
        return FeatureErrors.of_arrays(cached_tables(f"features-{digest.hexdigest()[:16]}", measured))

    def _sensor_stars(self, limit: float) -> StarCatalog:
        """Stars to a magnitude as the sensor sees them: unresolved ones merged, with its own magnitudes as `v`."""
        resolved = resolved_stars(self._catalog, limit, _BLEND_PX / self._camera.focal_px[0])
        magnitudes = _sensor_magnitudes(resolved, self.options.colour_term)
        order = np.argsort(magnitudes, kind="stable")
        return dataclasses.replace(resolved.subset(order), v=magnitudes[order])

    def _divided(self, sensor_stars: StarCatalog, deep: float) -> list[FeatureSearch]:
        """The searches of nine circles of the field, which share a database: the middle, and eight around it."""
        whole = self.database.parameters
        half = _CIRCLE_SHARE * math.radians(0.5 * whole.fov_deg)
        share = 0.5 * (1.0 - cos(half))
        parameters = dataclasses.replace(
            whole,
            fov_deg=_CIRCLE_SHARE * whole.fov_deg,
            half_width_px=whole.focal_px * tan(half),
            overlap=1.0 - (1.0 - whole.overlap) / _CIRCLE_SHARE,
            kappa=self._feature_limit(share),
        )
        deep = max(deep, parameters.kappa)
        database = obtain_database(sensor_stars, parameters, cache=self.options.cache)
        lost_in_space = LostInSpace(database, solver=self.options.solver, weights=self._parts.weights)
        stars = sky_of(sensor_stars, dataclasses.replace(parameters, kappa=deep))
        ring = [half * np.array([sin(turn), -cos(turn), 0.0]) for turn in np.arange(8) * math.pi / 4.0]
        return [
            dataclasses.replace(
                self.search,
                lost_in_space=lost_in_space,
                turn=Attitude.identity().rotated(-away).matrix,
                stars=stars,
            )
            for away in (np.zeros(3), *ring)
        ]

    @property
    def verifier(self) -> Identifier:
        """The geometric identifier that refines and verifies answers."""
        if self._verifier is None:
            raise StaridError("lsi refinement: is off, so there is no verification")
        return self._verifier

    @property
    def errors(self) -> FeatureErrors:
        """Errors of attitudes of features alone."""
        if self._errors is None:
            raise StaridError("lsi refinement: is on, so the errors of features alone were not measured")
        return self._errors

    @property
    def zero_point(self) -> float | None:
        """Magnitude of unit flux, as given or as learned from the last answer; None if neither."""
        return self._zero_point

    @property
    def database_bytes(self) -> int:
        """Size of the feature databases (five bytes per cell) and of the index for verification, bytes."""
        cells = sum(search.database.cells for search in (self.search, *self._circles[:1]))
        return 5 * cells + (0 if self._verifier is None else self._verifier.database_bytes)

    def reset(self) -> None:
        """Forget the learned zero point; the given one, if any, is used again."""
        self._zero_point = self._given_zero_point

    def _feature_limit(self, share: float) -> float:
        """Brightness limit κ of a circle that is a share of the sky."""
        if self.options.feature_limit is not None:
            return self.options.feature_limit
        found = math.inf if self.options.detected_limit is None else self.options.detected_limit
        return min(self._limit_for(STARS_PER_FIELD, share), found)

    def _limit_for(self, stars: int, share: float) -> float:
        v = np.sort(self._sensor_magnitudes)
        row = min(int(stars / share), v.size) - 1
        return math.ceil(10.0 * float(v[row])) / 10.0

    def _magnitude_of_rank(self, share: float) -> float:
        """Magnitude of the star of rank `_ZERO_POINT_STAR` in an average field."""
        v = np.sort(self._sensor_magnitudes)
        return float(v[min(int(_ZERO_POINT_STAR / share), v.size - 1)])

    def warm_up(self) -> None:
        """Compile or load the kernels, so that the first frame is not late."""
        if self._verifier is not None:
            self._verifier.warm_up()
        xy = self._camera.border(4)[: MIN_STARS + 3] * 0.25 + 0.375 * np.array(
            [self._camera.width, self._camera.height]
        )
        self._solution(CheckedDetections.of(xy, np.ones(len(xy))), [0.0])

    def _identify(self, measured: CheckedDetections) -> Solution:
        return self._solution(measured, self.zero_points(measured.flux))

    def _solution(self, measured: CheckedDetections, zero_points: Sequence[float]) -> Solution:
        if self.options.refinement:
            return self.solve(measured, zero_points)
        fields = self.fields(measured, zero_points)
        sequence = AnswerSequence(self.options.threshold, self.options.largest_error_psi)
        kept = sequence.next(None, [partial(self.answer, fields)], None, first=True)
        return self.by_features_alone(kept, "lsi", fields)

    def _track(self, measured: CheckedDetections, predicted: Attitude, window_px: float | None) -> Solution:
        """Find the attitude from the features, as `identify`: the algorithm uses no prediction."""
        del predicted, window_px
        return self._identify(measured)

    def solve(
        self,
        measured: CheckedDetections,
        zero_points: Sequence[float],
        first: Sequence[FeatureAnswer] = (),
        kept: Mask | None = None,
    ) -> Solution:
        """Search the whole database with refinement: stage one, and stage two.

        `first` are answers to compare with that of the whole database, and `kept` is a mask of the detections from which
        features are computed; by default all.
        """
        solution = self._first_verified(measured, zero_points, first, kept)
        if solution.valid:
            self.learn(solution, measured.flux)
        return solution

    def _fields(
        self, measured: CheckedDetections, search: FeatureSearch, zero_point: float, kept: Mask | None
    ) -> FieldStars:
        field = search.field_stars(measured.xy, measured.flux, zero_point)
        return field if kept is None else field.only(kept)

    def fields(
        self, measured: CheckedDetections, zero_points: Sequence[float]
    ) -> list[tuple[float, FieldStars]]:
        """Each zero point, with the stars of the field."""
        return [(each, self._fields(measured, self.search, each, None)) for each in zero_points]

    def answer(
        self, fields: Sequence[tuple[float, FieldStars]], true_stars: Mask | None = None
    ) -> FeatureAnswer | None:
        """Answer of the whole database at the first zero point for which there are features; None if there is none.

        `true_stars` is a mask of the detections from which features are computed; by default all.
        """
        for zero_point, field in fields:
            features = self.search.features(field if true_stars is None else field.only(true_stars))
            if features is not None:
                answer = self.search.answer(features)
                self.last_report = LsiReport(answer.attitude, 0, 0, zero_point)
                return answer
        self.last_report = LsiReport(None, 0, 0, math.nan)
        return None

    def by_features_alone(
        self,
        kept: KeptAnswer | None,
        search: Search,
        fields: Sequence[tuple[float, FieldStars]],
        moved: float = 0.0,
    ) -> Solution:
        """The solution of the first stage.

        `search` says where the answer was found, and `moved` is the motion since the last image as a share of the width of the
        field. The error is that of a random attitude if the image does not show stars down to the brightness limit.
        """
        if kept is None:
            return Solution.invalid(Reason.TOO_FEW_STARS)
        report = report_of(kept.answer, search)
        if not kept.valid:
            return dataclasses.replace(Solution.invalid(Reason.RESIDUAL), features=report)
        stated = self.errors.of(kept, moved)
        if self.zero_point is not None and not self.search.reaches_limit(fields[0][1]):
            stated = RANDOM
        return Solution(
            valid=True,
            reason=Reason.OK,
            quaternion_xyzw=kept.answer.attitude.quaternion_xyzw,
            covariance=stated.covariance,
            probability_false=stated.wrong,
            features=report,
        )

    def _first_verified(
        self,
        measured: CheckedDetections,
        zero_points: Sequence[float],
        first: Sequence[FeatureAnswer],
        kept: Mask | None,
    ) -> Solution:
        """Try the zero points in order, each in the whole field and then in the circles; return the first verified answer."""
        tried = verified = 0
        coarse: FeatureAnswer | None = None
        enough = False
        for zero_point, search in itertools.product(zero_points, (self.search, *self._circles)):
            field = self._fields(measured, search, zero_point, kept)
            observations = search.doubtful_features(field)
            features = search.features(field)
            if not observations:
                continue
            enough = True
            answers: list[FeatureAnswer] = []
            if features is not None:
                answer = search.answer(features)
                coarse = coarse or answer
                answers = sorted((*first, answer), key=lambda each: each.error_psi)
            usable = [each.place for each in answers if each.error_psi <= self.options.largest_error_psi]
            candidates = itertools.chain(
                *(search.attitudes(field, place, ESTIMATE_SHARE) for place in usable),
                search.attitudes_of(field, observations),
            )
            for attitude, attempts in candidates:
                tried += attempts
                if attitude is None:
                    continue
                verified += 1
                solution = self.verify(measured, attitude, WINDOW_PX)
                if solution.valid:
                    self._report(coarse, tried, verified, zero_point)
                    return dataclasses.replace(
                        solution, mode="lost_in_space", features=report_of(coarse, "lsi", refined=True)
                    )
        self._report(coarse, tried, verified, math.nan)
        failed = Solution.invalid(Reason.NO_MATCH if enough else Reason.TOO_FEW_STARS)
        return dataclasses.replace(failed, features=report_of(coarse, "lsi"))

    def _report(self, coarse: FeatureAnswer | None, tried: int, verified: int, zero_point: float) -> None:
        attitude = None if coarse is None else coarse.attitude
        self.last_report = LsiReport(attitude, tried, verified, zero_point)

    def zero_points(self, flux: Array) -> list[float]:
        """Zero points to try: the given one, or the learned one and then guesses from the frame."""
        if self._given_zero_point is not None:
            return [self._given_zero_point]
        shown = [] if self._zero_point is None else [self._zero_point]
        bright = np.sort(flux[flux > 0.0])[::-1]
        if bright.size < MIN_STARS:
            return shown
        rank = min(_ZERO_POINT_STAR, bright.size) - 1
        guess = self._star_magnitude + 2.5 * log10(float(bright[rank]))
        return shown + [guess + step for step in _ZERO_POINT_STEPS]

    def learn(self, solution: Solution, flux: Array) -> None:
        """Learn the zero point from the matched stars of a valid answer, if none was given."""
        if self._given_zero_point is None and solution.star_count >= MIN_STARS:
            magnitudes = self._sensor_magnitudes[solution.catalog_index]
            found = magnitudes + 2.5 * elementwise(log10, np.maximum(flux[solution.detection_index], 1e-30))
            self._zero_point = float(np.median(found))


def report_of(answer: FeatureAnswer | None, search: Search, **others: Any) -> FeatureReport:
    """What the first stage did, for `Solution.features`."""
    if answer is None:
        return FeatureReport(search, **others)
    solution = answer.solution
    return FeatureReport(
        search,
        error_psi=answer.error_psi,
        cell=solution.nearest,
        weights=int(np.count_nonzero(answer.estimate.omega)),
        observed=_five(solution.observation),
        of_cell=_five(solution.dictionary[:, solution.cells == solution.nearest][:, 0]),
        **others,
    )


def _five(values: Array) -> tuple[float, float, float, float, float]:
    a, b, c, d, e = values.tolist()
    return a, b, c, d, e


def _sensor_magnitudes(catalog: StarCatalog, colour_term: float) -> Array:
    """Magnitudes (n,) as a sensor with a colour term measures them."""
    colour = np.nan_to_num(catalog.b_v - SOLAR_COLOUR_B_V, nan=0.0)
    return np.asarray(catalog.v - colour_term * colour, dtype=np.float64)
