"""The RSI algorithm for a real sensor: filter, motion, a search region on the sphere, and LSI if that fails.

It is the thesis's recursion with one difference: whether the answer from the region is good enough is decided
not by ε_ψ, which says little on the sphere and with stars near the brightness limit, but by verification.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from starid.arrays import Array, Mask
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.identification.single_camera import CheckedDetections, SingleCameraIdentifier
from starid.identification.solution import Reason, Solution
from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.feature_search import FieldStars
from starid.identification.thesis.lsi_identifier import WINDOW_PX, LsiIdentifier, LsiOptions
from starid.identification.thesis.rsi import RsiSettings, region_side
from starid.identification.thesis.scalable_filter import MAX_OBJECTS, TrackFilter, TrackFilterSettings

_MIN_MATCHES: Final = 3
_SPOT_DEG: Final = 1.0


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
        Number of frames for which the region failed and the whole database was searched.
    invalid
        Number of frames without an answer.
    region_sum_deg
        Sum of the sides of the regions; divide by `frames` for the mean.
    """

    frames: int = 0
    in_region: int = 0
    triggers: int = 0
    invalid: int = 0
    region_sum_deg: float = 0.0


@dataclass(frozen=True)
class RsiOptions(LsiOptions):
    """Settings of an RSI identifier, in addition to those of an LSI identifier.

    Attributes
    ----------
    gamma_min_deg
        Smallest side of the search region, degrees.
    gamma_scale
        Factor by which the side grows with the errors of the motion.
    filter_false_stars
        Follow the detections from frame to frame, and use only true stars for the features.
    position_sigma_px
        One-sigma error of a position per axis, pixels, as assumed by the filter.
    """

    gamma_min_deg: float = 2.0
    gamma_scale: float = 1.0
    filter_false_stars: bool = True
    position_sigma_px: float = 0.5


class RsiIdentifier(SingleCameraIdentifier):
    """Star identification by the recursive algorithm, for one camera against one catalogue.

    Parameters
    ----------
    camera, catalog
        See `LsiIdentifier`.
    options
        By default `RsiOptions()`.
    **changes
        Fields of `RsiOptions` to change.
    """

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        options: RsiOptions | None = None,
        **changes: Any,
    ) -> None:
        options = dataclasses.replace(options or RsiOptions(), **changes)
        self.lsi = LsiIdentifier(camera, catalog, options)
        super().__init__(camera, self.lsi.catalog)
        self._settings = RsiSettings(gamma_min_deg=options.gamma_min_deg, gamma_scale=options.gamma_scale)
        scale = math.degrees(1.0 / camera.focal_px[0])
        half_field = 0.5 * self.lsi.database.parameters.fov_deg
        self._filter = (
            TrackFilter(
                TrackFilterSettings(
                    position_sigma_deg=options.position_sigma_px * scale,
                    brightness_sigma=0.3,
                    max_rotation_deg=15.0,
                    max_shift_deg=0.5 * half_field,
                )
            )
            if options.filter_false_stars
            else None
        )
        self._before: ObservedFrame | None = None
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
        self._before = None
        if self._filter is not None:
            self._filter.reset()
        self.statistics = RsiStatistics()

    def _identify(self, measured: CheckedDetections) -> Solution:
        self._stars_and_region_side(measured.xy, measured.flux)
        return self._whole_sky(measured)

    def _whole_sky(self, measured: CheckedDetections) -> Solution:
        """Identify with the LSI algorithm."""
        return self.lsi.identify(
            measured.xy,
            measured.flux,
            measured.given_sigmas,
            observer_velocity=measured.observer_velocity,
        )

    def _track(self, measured: CheckedDetections, predicted: Attitude, window_px: float | None) -> Solution:
        """Find the attitude in the search region around a predicted one, or in the whole sky if that fails.

        The prediction only defines the region; its roll, and its error within the region, do not matter. If
        the window is wider than the region, the region is widened to it, up to the field of view.
        """
        true_stars, side = self._stars_and_region_side(measured.xy, measured.flux)
        if window_px is not None:
            side = max(side, math.degrees(2.0 * window_px / self.camera.focal_px[0]))
        side = min(side, self.lsi.database.parameters.fov_deg)
        solution = self._in_region(measured, true_stars, predicted, side)
        triggered = not solution.valid
        if triggered:
            solution = self._whole_sky(measured)
        old = self.statistics
        self.statistics = RsiStatistics(
            old.frames + 1,
            old.in_region + (not triggered),
            old.triggers + triggered,
            old.invalid + (not solution.valid),
            old.region_sum_deg + side,
        )
        return solution

    def _stars_and_region_side(self, xy: Array, flux: Array) -> tuple[Mask, float]:
        """Return which detections are stars, by previous frames, and the side of the search region."""
        everything = np.ones(flux.size, dtype=np.bool_)
        if self._filter is None:
            return everything, self._settings.gamma_min_deg
        usable = np.flatnonzero(flux > 0.0)[:MAX_OBJECTS]
        directions = self.camera.back_project(xy[usable])
        ahead = np.isfinite(directions).all(axis=1) & (directions[:, 2] > 0.0)
        usable = usable[ahead]
        positions = np.degrees(directions[ahead, :2] / directions[ahead, 2:3])
        frame = ObservedFrame(-2.5 * np.log10(flux[usable]), positions)
        before, self._before = self._before, frame
        if before is None:
            return everything, self._settings.gamma_min_deg
        result = self._filter(before, frame)
        if result.matches.shape[0] < _MIN_MATCHES:
            return everything, self._settings.gamma_min_deg
        motion = matched_motion(before, frame, result.matches)
        if motion is None:
            return everything, self._settings.gamma_min_deg
        true_stars = np.zeros(flux.size, dtype=np.bool_)
        true_stars[usable] = result.true_now
        side = region_side(motion.mean_distance_deg, motion.sigma_distance_deg, self._settings)
        return true_stars, side

    def _in_region(
        self, measured: CheckedDetections, true_stars: Mask, predicted: Attitude, side_deg: float
    ) -> Solution:
        """Try the cells of the region, most likely first; return the first verified answer."""
        search, zero_point = self.lsi.search, self.lsi.zero_point
        if zero_point is None:
            return Solution.invalid(Reason.NO_MATCH, mode="tracking")
        field = search.field_stars(measured.xy, measured.flux, zero_point)
        trusted = true_stars[field.row]
        chosen = FieldStars(field.place[trusted], field.magnitude[trusted], field.row[trusted])
        features = search.features(chosen)
        if features is None:
            return Solution.invalid(Reason.TOO_FEW_STARS, mode="tracking")
        observation = search.database.normalise(features)
        cell, distance, _ = search.lost_in_space.nearest_in_region(
            observation, predicted.ra_deg, predicted.dec_deg, side_deg
        )
        centres = _spots(predicted, side_deg)
        if cell >= 0:
            answer = search.lost_in_space.estimate(observation, cell, distance).mse
            centres = np.concatenate([[[answer.right_ascension_deg, answer.declination_deg]], centres])
        for attitude, _ in search.attitudes(chosen, centres):
            if attitude is None:
                continue
            solution = self.lsi.verify(measured, attitude, WINDOW_PX)
            if solution.valid:
                self.lsi.learn(solution, measured.flux)
                return dataclasses.replace(solution, mode="tracking")
        return Solution.invalid(Reason.NO_MATCH, mode="tracking")


def _spots(predicted: Attitude, side_deg: float) -> Array:
    """Boresights (k, 2) in degrees that cover the region, from the centre outwards."""
    steps = math.ceil(0.5 * side_deg / _SPOT_DEG)
    offsets = np.linspace(-0.5 * side_deg, 0.5 * side_deg, 2 * steps + 1)
    east, north = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    order = np.argsort(np.hypot(east, north), kind="stable")
    slopes = np.tan(np.radians(np.column_stack([east, north])[order]))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ predicted.matrix
    ra = np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) % 360.0
    return np.column_stack([ra, np.degrees(np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])))])
