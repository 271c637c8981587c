"""The geometric star identifier: verified triangles of bright stars, over the whole sky, for any camera.

It combines the lost-in-space search (`starid.identification.geometric.search`), tracking (`starid.identification.geometric.tracking`),
refinement (`starid.identification.geometric.refinement`) and verification (`starid.identification.geometric.verification`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, Records
from starid.arithmetic.elementary import exp, log, sin, square, tan
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.catalog.aberration import checked_beta
from starid.errors import StaridError
from starid.identification.error_risk import flagged
from starid.identification.geometric.answer import MIN_MATCHED, Answer
from starid.identification.geometric.index_choice import (
    default_limiting_magnitude,
    index_settings,
    obtain_index,
    obtain_stars,
    pixels_per_radian,
)
from starid.identification.geometric.pattern_index import IndexArrays, field_solid_angle
from starid.identification.geometric.refinement import PRIOR_FREEDOM
from starid.identification.geometric.search import identify_kernel
from starid.identification.geometric.settings import ACCEPTED, SETTINGS, TOO_FEW
from starid.identification.geometric.tracking import MIN_TRACKED, MIN_TRACKED_KNOWN, track_kernel
from starid.identification.geometric.verification import WHOLE_SKY
from starid.identification.options import GeometricOptions
from starid.identification.single_camera import CheckedDetections, SingleCameraIdentifier, near
from starid.identification.solution import Mode, Reason, Solution

TRACKING_WINDOW_PX: Final = 20.0
MAX_PART_STARS: Final = 30
_QUICK_TRIANGLES: Final = 60
"""Number of triangles tried at each focal length before any full search."""

_SCALE_ERROR: Final = 0.012
"""Largest variation of scale across the field at which triangles are still found."""


@dataclass(frozen=True)
class Effort:
    """Bounds of the search.

    Attributes
    ----------
    tolerance_px : float
        Largest error of a triangle's side, pixels.
    window_px : float
        First matching window, pixels; a third of it is the largest centroid noise accepted.
    test_window_px : float
        Window in which a candidate attitude is tested, pixels.
    magnitude_gate : float
        Largest difference between a star's catalogue magnitude and the magnitude from its flux.
    max_triangles : int
        Largest number of triangles of detections looked up over the whole field.
    part_stars : int
        Number of detections, brightest first, whose triangles are all tried afterwards in each quadrant and
        in the middle of the field; 0 skips this stage.
    max_false_probability, max_false_probability_tracking : float
        Largest accepted bound on the probability of a false solution, lost in space and in tracking.
    """

    tolerance_px: float = 4.0
    window_px: float = 12.0
    test_window_px: float = 10.0
    magnitude_gate: float = 1.5
    max_triangles: int = 1600
    part_stars: int = 8
    max_false_probability: float = 1e-5
    max_false_probability_tracking: float = 1e-5

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "part_stars":
                if not 0 <= value <= MAX_PART_STARS:
                    raise StaridError(f"identifier part_stars: must be 0…{MAX_PART_STARS}, not {value}")
            elif not 0.0 < value < math.inf:
                raise StaridError(f"identifier {field.name}: must be a positive number, not {value}")

    def numbers(self, camera: Camera, px_per_rad: float) -> Records:
        """Kernel settings (1,) for a camera of known focal length."""
        numbers = np.zeros(1, SETTINGS)
        numbers["search_tolerance"] = self.tolerance_px / px_per_rad
        numbers["magnitude_gate"] = self.magnitude_gate
        numbers["max_triangles"] = self.max_triangles
        numbers["part_stars"] = self.part_stars
        numbers["window"] = self.window_px
        numbers["test_window"] = self.test_window_px / px_per_rad
        numbers["largest_sigma"] = self.window_px / 3.0
        numbers["log_chance"] = log(self.max_false_probability)
        numbers["log_chance_tracking"] = log(self.max_false_probability_tracking)
        numbers["px_per_rad"] = px_per_rad
        numbers["field_px"] = camera.width * camera.height
        return numbers


class Identifier(SingleCameraIdentifier):
    """Star identification for one camera and one catalogue.

    In `track`, three stars can be enough, or two if their errors are given. Whether they are depends on the
    window (default `TRACKING_WINDOW_PX`): the narrower it is, the fewer stars agree by chance.

    Parameters
    ----------
    camera : Camera
        The camera that took the images.
    catalog : StarCatalog, optional
        By default all of Hipparcos at its default epoch.
    options : GeometricOptions, optional
        By default `GeometricOptions()`.
    effort : Effort
        Bounds of the search.
    index_camera : Camera, optional
        Camera whose index is used, so that similar cameras share one; by default the camera itself.
    **changes
        Fields of `GeometricOptions` to change.

    Raises
    ------
    StaridError
        A value is out of range, or the catalogue has too few stars for the field.
    """

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        options: GeometricOptions | None = None,
        *,
        effort: Effort | None = None,
        index_camera: Camera | None = None,
        **changes: Any,
    ) -> None:
        options = dataclasses.replace(options or GeometricOptions(), **changes)
        super().__init__(camera, catalog)
        if len(self._catalog) == 0:
            raise StaridError("identifier catalog: contains no stars")
        effort = effort or Effort()
        typical = camera if index_camera is None else index_camera
        limiting_magnitude = options.limiting_magnitude
        if limiting_magnitude is None:
            limiting_magnitude = default_limiting_magnitude(self._catalog, field_solid_angle(typical))
        settings = index_settings(
            typical, self._catalog, limiting_magnitude, options.blend_px, effort.window_px
        )
        self._stars = obtain_stars(self._catalog, settings, options.cache)
        self._rows = self._catalog.index_of(self._stars.hip).astype(np.int64)
        self._set_index(obtain_index(self._stars, settings, options.cache))
        self._largest_error_deg = options.largest_error_deg
        self._configure(camera, options.fov_tolerance, effort)

    def _set_index(self, index: IndexArrays) -> None:
        self._index = index
        self._identify_kernel: Callable[..., Answer] = functools.partial(identify_kernel, index)
        self._track_kernel: Callable[..., Answer] = functools.partial(track_kernel, index)

    def _configure(self, camera: Camera, fov_tolerance: float, effort: Effort) -> None:
        """Set what depends on the camera and the bounds of the search."""
        self._camera = camera
        self._fov_tolerance = fov_tolerance
        self._effort = effort
        self._px_per_rad = pixels_per_radian(camera)
        self._numbers = effort.numbers(camera, self._px_per_rad)
        self._numbers_with_errors = self._numbers.copy()
        self._numbers_with_errors["sigmas_known"] = 1

    @property
    def stars(self) -> StarCatalog:
        """The stars of the index, brightest first, with unresolved doubles merged."""
        return self._stars

    @property
    def database_bytes(self) -> int:
        """Size of the index, bytes."""
        return sum(part.nbytes for part in self._index)

    def _identify(self, measured: CheckedDetections) -> Solution:
        if self._fov_tolerance > 0.0:
            return self._identify_any_scale(measured)
        numbers = self._numbers_for(measured)
        return self._solution(self._search(self._camera, measured, numbers), numbers, "lost_in_space")

    def _search(self, camera: Camera, measured: CheckedDetections, numbers: Records) -> Answer:
        """Search the whole sky with a given camera and kernel settings."""
        detections = measured.xy, measured.flux, measured.sigmas
        return self._identify_kernel(camera.params, *detections, numbers, MIN_MATCHED, WHOLE_SKY)

    def _numbers_for(self, measured: CheckedDetections) -> Records:
        """Kernel settings for one call."""
        numbers = self._numbers_with_errors if measured.sigmas_known else self._numbers
        if measured.observer_velocity is None:
            return numbers
        numbers = numbers.copy()
        numbers["beta_x"], numbers["beta_y"], numbers["beta_z"] = checked_beta(measured.observer_velocity)
        return numbers

    def _identify_any_scale(self, measured: CheckedDetections) -> Solution:
        """Try focal lengths from the nominal one outward, each with its share of the tolerance.

        A short search at every focal length precedes the full one. Each search bounds its own probability of
        a false solution; the total bound is the sum over the focal lengths.
        """
        steps = math.ceil(self._fov_tolerance * _scale_variation(self._camera) / _SCALE_ERROR)
        share = self._fov_tolerance / (2 * steps - 1)
        numbers = self._numbers_for(measured).copy()
        numbers["scale_tolerance"] = share
        cameras = [
            scaled_camera(self._camera, 1.0 + 2.0 * share * step)
            for step in sorted(range(1 - steps, steps), key=abs)
        ]
        numbers["log_chance"] -= log(len(cameras))
        solution = Solution.invalid(Reason.NO_MATCH)
        for triangles, part_stars in (
            (_QUICK_TRIANGLES, 0),
            (self._effort.max_triangles, self._effort.part_stars),
        ):
            numbers["max_triangles"], numbers["part_stars"] = triangles, part_stars
            for camera in cameras:
                answer = self._search(camera, measured, numbers)
                solution = self._solution(answer, numbers, "lost_in_space")
                if solution.valid:
                    found = scaled_camera(camera, 1.0 / float(answer.numbers[3]))
                    false = min(solution.probability_false * len(cameras), 1.0)
                    return dataclasses.replace(solution, camera=found, probability_false=false)
        return solution

    def verify(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        candidate: Attitude | ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        window_px: float,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Verify an attitude that was selected from the whole sky, as strictly as `identify` does.

        Parameters and errors are as in `track`, but agreement with the candidate is not taken as evidence.
        """
        search = functools.partial(self._track, anywhere=True)
        return near(xy_px, flux, candidate, xy_sigma_px, window_px, observer_velocity, search)

    def _track(
        self,
        measured: CheckedDetections,
        predicted: Attitude,
        window_px: float | None,
        *,
        anywhere: bool = False,
    ) -> Solution:
        """Find the attitude near another, which is a prediction, or the result of a search (`anywhere`)."""
        numbers = self._numbers_for(measured)
        window = (TRACKING_WINDOW_PX if window_px is None else window_px) / self._px_per_rad
        prior, least = self._prior(window), MIN_TRACKED_KNOWN if measured.sigmas_known else MIN_TRACKED
        if anywhere:
            prior, least, numbers = WHOLE_SKY, MIN_MATCHED, numbers.copy()
            numbers["log_chance_tracking"] = numbers["log_chance"]
        answer = self._track_kernel(
            self._camera.params, measured.xy, measured.flux, measured.sigmas, numbers,
            predicted.matrix, window, least, prior,
        )  # fmt: skip
        return self._solution(answer, numbers, "tracking")

    def _prior(self, window_rad: float) -> tuple[float, float]:
        """Prior volume of rotations within a window, rad³, and solid angle of the window."""
        # a star at the edge of the field stays within it after a roll of window/(field radius)
        radius = math.sqrt(self._camera.width * self._camera.height / math.pi) / self._px_per_rad
        volume = 2.0 * math.pi * square(window_rad) * min(window_rad / radius, math.pi)
        return min(volume, WHOLE_SKY[0]), min(math.pi * square(window_rad), WHOLE_SKY[1])

    def warm_up(self) -> None:
        """Compile or load the kernels, so that the first image is not delayed."""
        xy = self._camera.border(2)[:6]
        self.identify(xy, np.ones(6))
        self.track(xy, np.ones(6), Attitude.identity())

    def with_camera(
        self, camera: Camera, *, fov_tolerance: float = 0.0, effort: Effort | None = None
    ) -> Identifier:
        """Identifier for a similar camera, of the same size, that shares this one's index.

        Parameters
        ----------
        camera : Camera
            The other camera; its focal length must be within the tolerance.
        fov_tolerance : float
            Relative uncertainty of its focal length.
        effort : Effort, optional
            Bounds of its search, by default those of this identifier; no window may be wider.
        """
        if (camera.width, camera.height) != (self._camera.width, self._camera.height):
            raise StaridError(
                f"camera {camera.width}×{camera.height}: the identifier is for "
                f"{self._camera.width}×{self._camera.height}; make another one"
            )
        other = object.__new__(Identifier)
        other.__dict__.update(self.__dict__)
        other._configure(camera, fov_tolerance, effort or self._effort)
        return other

    @property
    def directions(self) -> Array:
        """Unit vectors (m, 3) of `stars`, as stored in the index."""
        return self._index.stars[:, :3]

    def with_direction(self, row: int, direction: Array) -> Identifier:
        """Identifier with another direction (3,), of any length, for a row of `stars`."""
        stars = self._index.stars.copy()
        stars[row, :3] = direction
        stars.flags.writeable = (
            False  # as in an index loaded from a file, so that the same machine code is used
        )
        other = object.__new__(Identifier)
        other.__dict__.update(self.__dict__)
        other._set_index(self._index._replace(stars=stars))
        return other

    def _solution(self, answer: Answer, numbers: Records, mode: Mode) -> Solution:
        if answer.status != ACCEPTED:
            reason = Reason.NO_MATCH if mode == "lost_in_space" else Reason.PREDICTION_LOST
            if answer.status == TOO_FEW:
                reason = Reason.TOO_FEW_STARS
            return Solution.invalid(reason, mode=mode)
        rms, sigma, log_false, _, _, _ = answer.numbers.tolist()
        unknowns = 4 if float(numbers["scale_tolerance"][0]) > 0.0 else 3
        freedom = max(2 * answer.pairs.shape[1] - unknowns, 1)
        solution = Solution(
            valid=True,
            reason=Reason.OK,
            quaternion_xyzw=answer.quaternion,
            detection_index=answer.pairs[0],
            catalog_index=self._rows[answer.pairs[1]],
            hip=self._stars.hip[answer.pairs[1]],
            covariance=answer.covariance,
            freedom=freedom + (PRIOR_FREEDOM if int(numbers["sigmas_known"][0]) else 0.0),
            rms_px=rms,
            sigma_px=sigma,
            probability_false=exp(log_false),
            mode=mode,
        )
        return flagged(solution, self._largest_error_deg)


def _scale_variation(camera: Camera) -> float:
    """Variation across the field of the scale of triangle sides, per relative change of focal length."""
    angle = min(camera.field_radius_rad, 0.5 * math.pi)
    if camera.model == "pinhole":
        return 2.0 * square(sin(angle))
    return 1.0 - angle / tan(angle)


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """Camera with the focal length multiplied by a factor."""
    fx, fy = camera.focal_px
    return dataclasses.replace(camera, focal_px=(fx * factor, fy * factor))
