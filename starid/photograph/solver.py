"""From an image to an attitude, with a known camera or with little more than a guess of its field."""

from __future__ import annotations

import dataclasses
import logging
import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.geometric.identifier import Identifier
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.photograph.rough_search import ALL_ROUNDS, RoughSearch
from starid.photograph.self_calibration import IMAGE_MODELS, Stars, calibrate_identified
from starid.photograph.views import Counts, Look, looks
from starid.solution import Reason, Solution

_log = logging.getLogger(__name__)

_FEW: Final = 8
"""Fewer matched stars leave the lens as it was taken to be."""

_ROUNDS: Final = ((ALL_ROUNDS[:2], None), (ALL_ROUNDS[2:3], 4), (ALL_ROUNDS[3:], 1))
"""Rounds of the search, and how many of the looks at the image get them; None while they are still to be made."""


@dataclass(frozen=True, eq=False)
class ImageSolution:
    """What was found on an image.

    Attributes
    ----------
    solution : Solution
        Attitude and matches; they count in `detections` and `catalog`.
    detections : Detections
        All stars found on the image.
    camera : Camera
        The camera: as given, or as estimated on this image.
    stars : StarCatalog
        Catalogue stars as the camera sees them.
    mirrored : bool
        The image shows the sky mirrored. Attitude, camera and detections then are those of the image flipped
        left to right.
    """

    solution: Solution
    detections: Detections
    camera: Camera
    stars: StarCatalog
    mirrored: bool = False

    def on_image(self, xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (n, 2) of the solution's frame, on the image as it was given."""
        return flipped(xy_px, self.camera.width) if self.mirrored else xy_px


def solve_image(
    image: Counts,
    camera: Camera | None = None,
    catalog: StarCatalog | None = None,
    *,
    fov_tolerance: float = 0.0,
    settings: DetectionSettings | None = None,
) -> ImageSolution:
    """Find the stars on an image and the attitude of the camera.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        Grey.
    camera : Camera, optional
        Default: the default camera.
    catalog : StarCatalog, optional
        Default: the whole of Hipparcos at its default epoch.
    fov_tolerance : float
        Relative uncertainty of the camera's field of view. If it is not 0, the image may come from any camera:
        focal length and, with enough stars, distortion are estimated on it, and other ways to look at it are
        tried where the plain one fails (`starid.photograph.views`, `starid.photograph.rough_search`).
    settings : DetectionSettings, optional
        For the detection.

    Raises
    ------
    StaridError
        The image does not have the camera's size, or detection refuses it.
    """
    given = DEFAULT_CAMERA if camera is None else camera
    height, width = image.shape[:2]
    if (width, height) != (given.width, given.height):
        raise StaridError(
            f"image of {width}×{height} pixels: the camera has {given.width}×{given.height}; "
            "give the profile of the camera that took it, or its field of view"
        )
    sky = load_catalog() if catalog is None else catalog
    if fov_tolerance > 0.0:
        return _solve_roughly(image, given, sky, fov_tolerance, settings)
    found = detect(image, settings or DetectionSettings())
    identifier = Identifier(given, sky)
    solution = identifier.identify(found.xy_px, found.flux, found.xy_sigma_px)
    return ImageSolution(solution, found, solution.camera or given, identifier.stars)


def _solve_roughly(
    image: Counts, camera: Camera, sky: StarCatalog, fov_tolerance: float, settings: DetectionSettings | None
) -> ImageSolution:
    """Look at the image in one way after the other until one of them shows a sky."""
    begin = time.perf_counter()
    search = RoughSearch(camera, sky, fov_tolerance=fov_tolerance)
    seen: list[Look] = []
    answer = Solution.invalid(Reason.NO_MATCH)
    for rounds, source in _ROUNDS:
        for look in looks(image, settings) if source is None else seen[:source]:
            if source is None:
                seen.append(look)
            found = look.detections
            xy = flipped(found.xy_px, camera.width) if look.mirrored else found.xy_px
            answer = search.identify(xy, found.flux, rounds=rounds)
            if answer.valid:
                return polished(answer, look, camera, search, begin)
    answer = Solution.invalid(answer.reason, elapsed=time.perf_counter() - begin)
    return ImageSolution(answer, seen[0].detections, camera, search.identifier.stars)


def polished(
    solution: Solution, look: Look, camera: Camera, search: RoughSearch, begin: float
) -> ImageSolution:
    """Solution with the lens estimated on the same stars, where they suffice.

    Parameters
    ----------
    solution : Solution
        Valid, in the rows of the look's detections.
    look : Look
        What was identified.
    camera : Camera
        As it was taken to be.
    search : RoughSearch
        What found the solution.
    begin : float
        Performance counter at the start.
    """
    identifier = search.identifier
    found = look.detections
    if look.mirrored:
        found = dataclasses.replace(found, xy_px=flipped(found.xy_px, camera.width))
    refined = solution.camera or camera
    if solution.star_count >= _FEW:
        stars = Stars(found.xy_px, found.flux, found.xy_sigma_px)
        refined = _refined(stars, solution, refined, camera, identifier.catalog)
    again = identifier.with_camera(refined).track(
        found.xy_px, found.flux, solution.attitude, found.xy_sigma_px
    )
    if again.valid:
        solution = dataclasses.replace(again, mode="lost_in_space", camera=refined)
    solution = dataclasses.replace(solution, elapsed=time.perf_counter() - begin)
    return ImageSolution(solution, found, solution.camera or camera, identifier.stars, look.mirrored)


def _refined(stars: Stars, solution: Solution, found: Camera, given: Camera, catalog: StarCatalog) -> Camera:
    """Camera calibrated on an identified image, or as it was found where no calibration holds."""
    try:
        outcome = calibrate_identified([stars], {0: solution}, given, catalog, models=IMAGE_MODELS)
    except StaridError as error:
        _log.info("lens left as it was found: %s", error)
        return found
    return outcome.calibration.camera


def flipped(xy: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Positions (n, 2) in the image flipped left to right."""
    return np.stack([width - 1.0 - xy[:, 0], xy[:, 1]], axis=1)
