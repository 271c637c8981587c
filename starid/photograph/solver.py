"""Attitude from an image, with a calibrated camera or an approximate field of view."""

from __future__ import annotations

import dataclasses
import logging
import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arrays import Array, GreyImage
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.geometric.identifier import Identifier
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.photograph.rough_search import ALL_ROUNDS, RoughSearch
from starid.photograph.self_calibration import IMAGE_MODELS, Stars, calibrate_identified
from starid.photograph.views import View, views
from starid.solution import Reason, Solution

_log = logging.getLogger(__name__)

_FEW: Final = 8
"""Smallest number of matched stars for estimating the lens."""

_ROUNDS: Final = ((ALL_ROUNDS[:2], None), (ALL_ROUNDS[2:3], 4), (ALL_ROUNDS[3:], 1))
"""Rounds of the search, and the number of views for each; None for all views, made by the first entry."""


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
    """

    solution: Solution
    detections: Detections
    camera: Camera
    stars: StarCatalog
    mirrored: bool = False

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
        See `starid.interface.StarIdentifier.identify`.

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
            "give the profile of the camera that took it, or its field of view"
        )
    sky = load_catalog() if catalog is None else catalog
    if fov_tolerance > 0.0:
        return _solve_roughly(image, nominal, sky, fov_tolerance, settings, observer_velocity)
    found = detect(image, settings or DetectionSettings())
    identifier = Identifier(nominal, sky)
    solution = identifier.identify(
        found.xy_px, found.flux, found.xy_sigma_px, observer_velocity=observer_velocity
    )
    stars = identifier.stars.aberrated(observer_velocity)
    return ImageSolution(solution, found, solution.camera or nominal, stars)


def _solve_roughly(
    image: GreyImage,
    camera: Camera,
    sky: StarCatalog,
    fov_tolerance: float,
    settings: DetectionSettings | None,
    observer_velocity: ArrayLike | None,
) -> ImageSolution:
    """Try one view of the image after another until one is identified."""
    begin = time.perf_counter()
    search = RoughSearch(camera, sky, fov_tolerance=fov_tolerance)
    made: list[View] = []
    answer = Solution.invalid(Reason.NO_MATCH)
    for rounds, source in _ROUNDS:
        for view in views(image, settings) if source is None else made[:source]:
            if source is None:
                made.append(view)
            found = view.detections
            xy = flipped(found.xy_px, camera.width) if view.mirrored else found.xy_px
            answer = search.identify(xy, found.flux, rounds=rounds)
            if answer.valid:
                return refine_solution(answer, view, camera, search, begin, observer_velocity)
    answer = Solution.invalid(answer.reason, elapsed=time.perf_counter() - begin)
    return ImageSolution(answer, made[0].detections, camera, search.identifier.stars)


def refine_solution(
    solution: Solution,
    view: View,
    camera: Camera,
    search: RoughSearch,
    begin: float,
    observer_velocity: ArrayLike | None = None,
) -> ImageSolution:
    """Estimate the lens from the matched stars, if there are enough, and refine the solution with it.

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
        See `starid.interface.StarIdentifier.identify`.
    """
    identifier = search.identifier
    found = view.detections
    if view.mirrored:
        found = dataclasses.replace(found, xy_px=flipped(found.xy_px, camera.width))
    refined = solution.camera or camera
    if solution.star_count >= _FEW:
        stars = Stars(found.xy_px, found.flux, found.xy_sigma_px)
        refined = _refined(stars, solution, refined, camera, identifier.catalog.aberrated(observer_velocity))
    again = identifier.with_camera(refined).track(
        found.xy_px, found.flux, solution.attitude, found.xy_sigma_px, observer_velocity=observer_velocity
    )
    if again.valid:
        solution = dataclasses.replace(again, mode="lost_in_space", camera=refined)
    solution = solution.timed(begin)
    seen = identifier.stars.aberrated(observer_velocity)
    return ImageSolution(solution, found, solution.camera or camera, seen, view.mirrored)


def _refined(
    stars: Stars, solution: Solution, found: Camera, nominal: Camera, catalog: StarCatalog
) -> Camera:
    """Calibrate the camera on an identified image; return `found` if that fails."""
    try:
        outcome = calibrate_identified([stars], {0: solution}, nominal, catalog, models=IMAGE_MODELS)
    except StaridError as error:
        _log.info("lens not calibrated: %s", error)
        return found
    return outcome.calibration.camera


def flipped(xy: Array, width: int) -> Array:
    """Positions (n, 2) in the image flipped left to right."""
    return np.stack([width - 1.0 - xy[:, 0], xy[:, 1]], axis=1)
