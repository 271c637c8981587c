"""The RSI algorithm for a real sensor (algorithm 3 of the thesis): filter, motion, region of search, and LSI.

The false-star filter (FSF) compares each image with those before it. The motion of its true stars (CME) carries the last
attitude to the present image; the cells of a region around it are searched for the features of the true
stars. If ε_ψ > τ, the whole database is searched as well, and the answer with the smaller ε_ψ is kept; one with
ε_ψ > K·τ is invalid. While the answer kept has ε_ψ > τ, only the whole database is searched (section 6.3.2);
`answer_sequence` holds these rules.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array, Mask, elementwise
from starid.arithmetic.elementary import atan2, hypot, log10
from starid.arithmetic.matrices import lengths, product
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.identification.options import RsiOptions
from starid.identification.single_camera import CheckedDetections, SingleCameraIdentifier
from starid.identification.solution import FeatureReport, Solution
from starid.identification.thesis.answer_sequence import AnswerSequence
from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.feature_search import ESTIMATE_SHARE, FeatureAnswer, FieldStars
from starid.identification.thesis.lsi_identifier import (
    WINDOW_PX,
    LsiIdentifier,
    report_of,
)
from starid.identification.thesis.parts import Parts
from starid.identification.thesis.rsi import RsiSettings, region_side
from starid.identification.thesis.scalable_filter import MAX_OBJECTS, TrackFilterSettings, rays

_MIN_MATCHES: Final = 3
_ENOUGH_MATCHES: Final = 8
"""Number of matches that two images of different fields do not have by chance."""


@dataclass(frozen=True, slots=True)
class RsiStatistics:
    """Counts since the identifier was made or reset.

    Attributes
    ----------
    frames
        Number of calls of `track`.
    in_region
        Number of frames answered from the search region.
    triggers
        Number of frames for which the whole database was searched because the region's answer was not good enough.
    invalid
        Number of frames without an answer.
    region_sum_deg
        Sum of the sides of the regions, of which there are `in_region` + `triggers`.
    """

    frames: int = 0
    in_region: int = 0
    triggers: int = 0
    invalid: int = 0
    region_sum_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Preprocessed:
    """What filter and motion estimation say about an image.

    Attributes
    ----------
    true_stars
        Which detections are stars, by previous images, (n,); all if nothing is known.
    rotation
        Rotation of the sky from the previous image to this one in the sensor frame, (3, 3); None if it is unknown.
    rotation_deg, translation_deg
        The same as rotation γ̃ about the boresight, and as translation ρ̃, the angle by which the boresight moved, degrees;
        0 if unknown.
    side_deg
        Side of the region of search (`rsi.py`), degrees.
    """

    true_stars: Mask
    rotation: Array | None
    rotation_deg: float
    translation_deg: float
    side_deg: float

    @property
    def removed_index(self) -> tuple[int, ...]:
        """Rows of the detections that are not stars."""
        return tuple(np.flatnonzero(~self.true_stars).tolist())

    def add_to(self, report: FeatureReport | None, **others: Any) -> FeatureReport:
        """Add filter and motion to the report of the features."""
        return dataclasses.replace(
            FeatureReport("lsi") if report is None else report,
            stars=int(np.count_nonzero(self.true_stars)),
            removed_index=self.removed_index,
            rotation_deg=self.rotation_deg,
            translation_deg=self.translation_deg,
            **others,
        )


class RsiIdentifier(SingleCameraIdentifier):
    """Star identification by the recursive algorithm, for one camera against one catalogue.

    Parameters
    ----------
    camera, catalog
        See `LsiIdentifier`.
    options
        By default `RsiOptions()`.
    parts
        The parts of the algorithm; by default those of the thesis.
    **changes
        Fields of `RsiOptions` to change.
    """

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        options: RsiOptions | None = None,
        parts: Parts | None = None,
        **changes: Any,
    ) -> None:
        options = dataclasses.replace(options or RsiOptions(), **changes)
        self._parts = parts or Parts()
        self.lsi = LsiIdentifier(camera, catalog, options, self._parts)
        super().__init__(camera, self.lsi.catalog)
        self.options = options
        self._settings = RsiSettings(
            tau=options.threshold,
            invalid_factor=options.invalid_factor,
            gamma_min_deg=options.gamma_min_deg,
            gamma_scale=options.gamma_scale,
        )
        scale = math.degrees(1.0 / camera.focal_px[0])
        half_field = 0.5 * self.lsi.database.parameters.fov_deg
        self._filter = (
            self._parts.false_star_filter(
                TrackFilterSettings(
                    position_sigma_deg=options.position_sigma_px * scale,
                    brightness_sigma=0.3,
                    max_rotation_deg=15.0,
                    max_shift_deg=0.5 * half_field,
                    geometry="spherical",
                )
            )
            if options.filter_false_stars
            else None
        )
        self._before: ObservedFrame | None = None
        self._last: Attitude | None = None
        self._sequence = AnswerSequence(options.threshold, options.largest_error_psi)
        self.statistics = RsiStatistics()

    @property
    def database_bytes(self) -> int:
        """Size of the feature database and of the index for verification, bytes."""
        return self.lsi.database_bytes

    def warm_up(self) -> None:
        """Compile or load the kernels, so that the first frame is not late."""
        self.lsi.warm_up()
        xy = self.camera.border(8) * 0.25 + 0.375 * np.array([self.camera.width, self.camera.height])
        for _ in range(2):
            self.track(xy, np.linspace(1.0, 2.0, len(xy)), Attitude.identity())
        self.reset()

    def reset(self) -> None:
        """Forget previous frames, the learned zero point and the statistics."""
        self.lsi.reset()
        self._before = self._last = None
        self._sequence.reset()
        self.statistics = RsiStatistics()

    def _identify(self, measured: CheckedDetections) -> Solution:
        """Find the attitude in the whole database, from the stars that the filter keeps."""
        prior = self.preprocess(measured.xy, measured.flux)
        if self.options.refinement:
            solution = self._refined(measured, prior, None)
        else:
            solution = self._by_features(measured, prior, None, first=not self._sequence.exceeded)
        self._last = solution.attitude if solution.valid else None
        return dataclasses.replace(solution, features=prior.add_to(solution.features))

    def _whole_sky(
        self, measured: CheckedDetections, prior: Preprocessed, first: Sequence[FeatureAnswer] = ()
    ) -> Solution:
        """LSI, line 12 of algorithm 3: from the true stars and, if that fails, from all detections."""
        zero_points = self.lsi.zero_points(measured.flux)
        solution = self.lsi.solve(measured, zero_points, first, prior.true_stars)
        if solution.valid or prior.true_stars.all():
            return solution
        unfiltered = self.lsi.solve(measured, zero_points)
        return unfiltered if unfiltered.valid else solution

    def _track(self, measured: CheckedDetections, predicted: Attitude, window_px: float | None) -> Solution:
        """Find the attitude in the region of search, or in the whole sky if that is not good enough.

        The centre of the region is the last attitude, carried by the measured motion. Only without it, as after a
        missing image, is it the prediction given; the region is then at least as wide as the window.
        """
        prior = self.preprocess(measured.xy, measured.flux)
        side, carried = prior.side_deg, self._carried(prior)
        centre = carried or predicted
        if carried is None and window_px is not None:
            side = max(side, math.degrees(2.0 * window_px / self.camera.focal_px[0]))
        region = centre, min(side, self.lsi.database.parameters.fov_deg)
        searched = None if self._sequence.exceeded else region
        if self.options.refinement:
            solution = self._refined(measured, prior, searched)
        else:
            solution = self._by_features(measured, prior, searched, first=False)
        report = prior.add_to(solution.features)
        if searched is not None:
            report = dataclasses.replace(
                report,
                triggered=solution.mode != "tracking",
                region_deg=region[1],
                region_at_deg=(centre.ra_deg, centre.dec_deg),
            )
        self._last = solution.attitude if solution.valid else None
        self._count(solution, report)
        return dataclasses.replace(solution, features=report)

    def _by_features(
        self,
        measured: CheckedDetections,
        prior: Preprocessed,
        region: tuple[Attitude, float] | None,
        *,
        first: bool,
    ) -> Solution:
        """The solution without refinement, from a region of search if one is given, or from the whole database.

        The features are those of the true stars and, if these have no attitude, of all detections.
        """
        fields = self.lsi.fields(measured, self.lsi.zero_points(measured.flux))
        local: FeatureAnswer | None = None
        if region is not None and self.lsi.zero_point is not None:
            features = self.lsi.search.features(fields[0][1].only(prior.true_stars))
            local = None if features is None else self._parts.region(self.lsi.search, features, *region)
        masks = [prior.true_stars] if prior.true_stars.all() else [prior.true_stars, None]
        everywhere = [partial(self.lsi.answer, fields, mask) for mask in masks]
        kept = self._sequence.next(local, everywhere, self._carried(prior), first=first)
        is_local = kept is not None and kept.answer is local
        solution = self.lsi.by_features_alone(kept, "rsi" if is_local else "lsi", fields, self._moved(prior))
        if kept is None or kept.kind != "region":
            return solution
        return dataclasses.replace(solution, mode="tracking")

    def _moved(self, prior: Preprocessed) -> float:
        """Motion since the last image as a share of the width of the field."""
        return prior.translation_deg / self.lsi.database.parameters.fov_deg

    def _carried(self, prior: Preprocessed) -> Attitude | None:
        """The last attitude, carried by the measured motion; None if either is unknown."""
        if self._last is None or prior.rotation is None:
            return None
        return Attitude.from_matrix(product(prior.rotation, self._last.matrix))

    def _count(self, solution: Solution, report: FeatureReport) -> None:
        old = self.statistics
        self.statistics = RsiStatistics(
            old.frames + 1,
            old.in_region + (report.region_deg > 0.0 and not report.triggered),
            old.triggers + report.triggered,
            old.invalid + (not solution.valid),
            old.region_sum_deg + report.region_deg,
        )

    def preprocess(self, xy: Array, flux: Array) -> Preprocessed:
        """FSF and CME, lines 6 to 8 of algorithm 3."""
        unknown = Preprocessed(
            np.ones(flux.size, dtype=np.bool_), None, 0.0, 0.0, self._settings.gamma_min_deg
        )
        if self._filter is None:
            return unknown
        usable = np.flatnonzero(flux > 0.0)[:MAX_OBJECTS]
        directions = self.camera.back_project(xy[usable])
        ahead = np.isfinite(directions).all(axis=1) & (directions[:, 2] > 0.0)
        usable = usable[ahead]
        positions = np.degrees(directions[ahead, :2] / directions[ahead, 2:3])
        frame = ObservedFrame(-2.5 * elementwise(log10, flux[usable]), positions)
        before, self._before = self._before, frame
        if before is None:
            return unknown
        result = self._filter(before, frame)
        needed = min(_ENOUGH_MATCHES, 0.5 * min(len(before), len(frame)))
        if result.matches.shape[0] < max(_MIN_MATCHES, needed):
            return unknown
        motion = matched_motion(before, frame, result.matches)
        if motion is None:
            return unknown
        true_stars = np.zeros(flux.size, dtype=np.bool_)
        true_stars[usable] = result.true_now
        pairs = result.matches[motion.inliers]
        if len(pairs) < _MIN_MATCHES:
            return unknown
        then, now = _directions(before.positions[pairs[:, 0]]), _directions(frame.positions[pairs[:, 1]])
        rotation = self._parts.motion(then, now)
        distance_deg = np.degrees(lengths(product(then, rotation.T) - now))
        return Preprocessed(
            true_stars,
            rotation,
            math.degrees(atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])),
            math.degrees(atan2(hypot(rotation[0, 2], rotation[1, 2]), rotation[2, 2])),
            region_side(float(distance_deg.mean()), float(distance_deg.std(ddof=1)), self._settings),
        )

    def _refined(
        self, measured: CheckedDetections, prior: Preprocessed, region: tuple[Attitude, float] | None
    ) -> Solution:
        """The solution with refinement, from a region of search if one is given, or from the whole database."""
        answers: list[FeatureAnswer] = []
        local: Solution | None = None
        zero_point = self.lsi.zero_point
        if region is not None and zero_point is not None:
            field = self.lsi.search.field_stars(measured.xy, measured.flux, zero_point).only(prior.true_stars)
            answers = self._in_region(field, region)
            local = self._verified(measured, field, answers)
        return self._sequence.next_refined(local, lambda: self._whole_sky(measured, prior, answers[:1]))

    def _verified(
        self, measured: CheckedDetections, field: FieldStars, answers: Sequence[FeatureAnswer]
    ) -> Solution | None:
        """The first verified answer of the region with ε_ψ ≤ τ; None without one."""
        for answer in answers:
            if answer.error_psi > self._settings.tau:
                continue
            for attitude, _ in self.lsi.search.attitudes(field, answer.place, ESTIMATE_SHARE):
                if attitude is None:
                    continue
                solution = self.lsi.verify(measured, attitude, WINDOW_PX)
                if solution.valid:
                    self.lsi.learn(solution, measured.flux)
                    report = report_of(answer, "rsi", refined=True)
                    return dataclasses.replace(solution, mode="tracking", features=report)
        return None

    def _in_region(self, field: FieldStars, region: tuple[Attitude, float]) -> list[FeatureAnswer]:
        """Answers of the cells of the region that are nearest to the features of a field.

        The first is that of the features as measured; those of features with a star or two fewer or more follow, the smallest
        ε_ψ first.
        """
        search = self.lsi.search
        if search.features(field) is None:
            return []
        nearest = [
            self._parts.region(search, features, *region) for features in search.doubtful_features(field)
        ]
        answers = [answer for answer in nearest if answer is not None]
        return [*answers[:1], *sorted(answers[1:], key=lambda answer: answer.error_psi)]


def _directions(positions_deg: Array) -> Array:
    """Unit vectors (n, 3) of gnomonic positions in degrees."""
    found = rays(positions_deg)
    return np.asarray(found / lengths(found)[:, None], dtype=np.float64)
