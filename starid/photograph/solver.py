"""Attitude from an image, with a calibrated camera or an approximate field of view."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, GreyImage
from starid.camera import DEFAULT_CAMERA, Camera
from starid.camera.calibration import Calibration
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.identification.error_risk import flagged
from starid.identification.geometric.answer import MIN_MATCHED
from starid.identification.geometric.identifier import Identifier
from starid.identification.lens_errors import with_lens_errors
from starid.identification.options import LARGEST_ERROR_DEG
from starid.identification.solution import Reason, Solution
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.photograph.rough_search import RoughSearch
from starid.photograph.self_calibration import IMAGE_MODELS, Stars, calibrate_identified
from starid.photograph.views import View, views

_log = logging.getLogger(__name__)

_MIN_FOR_LENS: Final = 8
"""Smallest number of matched stars for estimating the lens."""

SCHEDULE: Final[tuple[tuple[int, int | None], ...]] = ((0, None), (1, None), (2, None), (3, None), (4, 1))
"""Rounds of the search, and in how many views; None for all."""

Progress = Callable[[str], None]
"""Called with a description of the attempt that follows."""


@dataclass(frozen=True, eq=False)
class ImageSolution:
    """The result of solving an image.

    Attributes
    ----------
    solution : Solution
        Attitude and matches; indices refer to `detections` and the catalogue.
    detections : Detections
        All stars found in the image.
    camera : Camera
        The camera, or its estimate from this image.
    stars : StarCatalog
        Catalogue stars as the camera resolves them, aberrated if aberration was corrected.
    mirrored : bool
        The image is a mirror image; attitude, camera and detections refer to the image flipped left to right.
    complete : bool
        Whether the search ended by itself, not because of the time limit.
    """

    solution: Solution
    detections: Detections
    camera: Camera
    stars: StarCatalog
    mirrored: bool = False
    complete: bool = True

    def on_image(self, xy_px: Array) -> Array:
        """Convert positions (n, 2) of the solution to positions on the original image."""
        return flipped(xy_px, self.camera.width) if self.mirrored else xy_px


def solve_image(
    image: GreyImage,
    camera: Camera | None = None,
    catalog: StarCatalog | None = None,
    *,
    fov_tolerance: float = 0.0,
    settings: DetectionSettings | None = None,
    observer_velocity: ArrayLike | None = None,
    time_limit_s: float = math.inf,
    progress: Progress | None = None,
) -> ImageSolution:
    """Find the stars in an image and the attitude of the camera.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        The image.
    camera : Camera, optional
        By default `DEFAULT_CAMERA`.
    catalog : StarCatalog, optional
        By default all of Hipparcos at its default epoch.
    fov_tolerance : float
        Relative uncertainty of the camera's field of view. If it is not 0, the image may come from any
        camera: focal length and, with enough stars, distortion are estimated from it, and other views are
        tried if the plain one fails (`starid.photograph.views`, `starid.photograph.rough_search`).
    settings : DetectionSettings, optional
        Settings of the detection.
    observer_velocity : array (3,), optional
        See `starid.identification.star_identifier.StarIdentifier.identify`.
    time_limit_s, progress
        With a `fov_tolerance`, see `search_views`.

    Raises
    ------
    StaridError
        The image does not have the size of the camera, or is not valid for detection.
    """
    nominal = DEFAULT_CAMERA if camera is None else camera
    height, width = image.shape[:2]
    if (width, height) != (nominal.width, nominal.height):
        raise StaridError(
            f"image of {width}×{height} pixels: the camera has {nominal.width}×{nominal.height}; "
            "give --fov auto, its field of view with --fov, or the camera that took it with --profile"
        )
    sky = load_catalog() if catalog is None else catalog
    if fov_tolerance > 0.0:

        def search_for(camera: Camera) -> RoughSearch:
            return RoughSearch(camera, sky, fov_tolerance=fov_tolerance)

        return search_views(
            views(image, settings), [nominal], search_for, observer_velocity, time_limit_s, progress
        )
    detections = detect(image, settings or DetectionSettings())
    identifier = Identifier(nominal, sky)
    solution = identifier.identify(
        detections.xy_px, detections.flux, detections.xy_sigma_px, observer_velocity=observer_velocity
    )
    stars = identifier.stars.aberrated(observer_velocity)
    return ImageSolution(solution, detections, solution.camera or nominal, stars)


def search_views(
    waiting: Iterator[View],
    cameras: Sequence[Camera],
    search_for: Callable[[Camera], RoughSearch],
    observer_velocity: ArrayLike | None = None,
    time_limit_s: float = math.inf,
    progress: Progress | None = None,
) -> ImageSolution:
    """Try views of an image with one camera after another, quick rounds first, until one is identified.

    Parameters
    ----------
    waiting : iterator of View
        The views, plain one first; each is made when first needed.
    cameras : sequence of Camera
        Approximate cameras, common ones first.
    search_for : callable
        Returns the search for a camera; it is called again for each round and view.
    observer_velocity : array (3,), optional
        See `starid.identification.star_identifier.StarIdentifier.identify`.
    time_limit_s : float
        Time after which the search is given up. Compiling kernels and building indices, which is done once, does
        not count.
    progress : callable, optional
        See `Progress`.
    """
    begin = time.perf_counter()
    plain = next(waiting)
    first = search_for(cameras[0])
    first.identifier.warm_up()
    started = time.perf_counter()
    complete = True
    for number, view, camera, attempt in _attempts(plain, waiting, cameras):
        if progress is not None:
            progress(attempt)
        before = time.perf_counter()
        search = first if camera is first.identifier.camera else search_for(camera)
        started += time.perf_counter() - before
        found = view.detections
        xy = flipped(found.xy_px, camera.width) if view.mirrored else found.xy_px
        left = started + time_limit_s - time.perf_counter()
        answer = search.identify(xy, found.flux, rounds=[number], time_limit_s=left)
        if answer.valid:
            return refine_solution(answer, view, camera, search, begin, observer_velocity)
        complete = time.perf_counter() - started < time_limit_s
        if not complete:
            break
    reason = Reason.TOO_FEW_STARS if len(plain.detections) < MIN_MATCHED else Reason.NO_MATCH
    answer = Solution.invalid(reason, elapsed=time.perf_counter() - begin)
    return ImageSolution(answer, plain.detections, cameras[0], first.identifier.stars, complete=complete)


def _attempts(
    plain: View, waiting: Iterator[View], cameras: Sequence[Camera]
) -> Iterator[tuple[int, View, Camera, str]]:
    """Yield round, view, camera and their description, for views with enough stars."""
    made = [plain]
    for number, count in SCHEDULE:
        chosen = itertools.chain(made, waiting) if number == 0 else made[:count]
        for place, view in enumerate(chosen):
            if place >= len(made):
                made.append(view)
            if len(view.detections) < MIN_MATCHED:
                continue
            for camera in cameras:
                attempt = f"round {number + 1} of {len(SCHEDULE)}, view {place + 1}, field {camera.fov_deg:.0f}° wide"
                yield number, view, camera, attempt


def refine_solution(
    solution: Solution,
    view: View,
    camera: Camera,
    search: RoughSearch,
    begin: float,
    observer_velocity: ArrayLike | None = None,
) -> ImageSolution:
    """Estimate the lens from the matched stars, if there are enough, and refine the solution with it.

    The uncertainty of the lens is part of that of the attitude.

    Parameters
    ----------
    solution : Solution
        A valid solution whose indices refer to the view's detections.
    view : View
        The view that was identified.
    camera : Camera
        The nominal camera.
    search : RoughSearch
        The search that found the solution.
    begin : float
        Value of the performance counter at the start.
    observer_velocity : array (3,), optional
        See `starid.identification.star_identifier.StarIdentifier.identify`.
    """
    identifier = search.identifier
    detections = view.detections
    if view.mirrored:
        detections = dataclasses.replace(detections, xy_px=flipped(detections.xy_px, camera.width))
    refined, lens = solution.camera or camera, None
    if solution.star_count >= _MIN_FOR_LENS:
        stars = Stars(detections.xy_px, detections.flux, detections.xy_sigma_px)
        lens = _calibration(stars, solution, camera, identifier.catalog.aberrated(observer_velocity))
    if lens is not None:
        refined = lens.camera
    again = identifier.with_camera(refined).track(
        detections.xy_px,
        detections.flux,
        solution.attitude,
        detections.xy_sigma_px,
        observer_velocity=observer_velocity,
    )
    seen = identifier.stars.aberrated(observer_velocity)
    if again.valid:
        if lens is not None:
            again = _less_certain(again, detections, lens, seen)
        solution = dataclasses.replace(again, mode="lost_in_space", camera=refined)
    solution = flagged(solution, LARGEST_ERROR_DEG).timed(begin)
    return ImageSolution(solution, detections, solution.camera or camera, seen, view.mirrored)


def _calibration(
    stars: Stars, solution: Solution, camera: Camera, catalog: StarCatalog
) -> Calibration | None:
    """Calibrate the camera on an identified image; return None if that fails."""
    try:
        outcome = calibrate_identified([stars], {0: solution}, camera, catalog, models=IMAGE_MODELS)
    except StaridError as error:
        _log.info("lens not calibrated: %s", error)
        return None
    return outcome.calibration


def _less_certain(
    solution: Solution, detections: Detections, lens: Calibration, seen: StarCatalog
) -> Solution:
    """Return the solution with the uncertainty of the lens in its covariance."""
    used = solution.detection_index
    xy_px = detections.xy_px[used]
    directions = seen.vectors[seen.index_of(solution.hip)]
    predicted_px, _ = lens.camera.project(solution.attitude.to_sensor(directions))
    offsets = xy_px - predicted_px
    return with_lens_errors(
        solution, lens.camera, lens.covariance, xy_px, detections.xy_sigma_px[used], offsets
    )


def flipped(xy: Array, width: int) -> Array:
    """Positions (n, 2) in the image flipped left to right."""
    return np.stack([width - 1.0 - xy[:, 0], xy[:, 1]], axis=1)
