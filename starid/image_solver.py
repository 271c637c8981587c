"""From an image to an attitude, with a known camera or with little more than a guess of its field."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.geometric.identifier import Effort, Identifier
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.self_calibration import IMAGE_MODELS, Stars, self_calibrate
from starid.solution import Solution

_FEW: Final = 8
"""Fewer matched stars leave the lens as it was taken to be."""

_PATIENT: Final = Effort(
    tolerance_px=8.0,
    window_px=20.0,
    test_window_px=16.0,
    magnitude_gate=2.5,
    max_triangles=30000,
)
"""Second try on an image of an unknown camera: rough positions, odd colours, many false stars."""


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
    """

    solution: Solution
    detections: Detections
    camera: Camera
    stars: StarCatalog


def solve_image(
    image: NDArray[np.uint8] | NDArray[np.uint16],
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
        Relative uncertainty of the camera's field of view. If it is not 0, focal length and, with enough
        stars, distortion are estimated on the image.
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
    found = detect(image, settings or DetectionSettings())
    identifier = Identifier(given, sky, fov_tolerance=fov_tolerance)
    solution = identifier.identify(found.xy_px, found.flux, found.xy_sigma_px)
    if fov_tolerance > 0.0:
        if not solution.valid:
            identifier = Identifier(given, sky, fov_tolerance=fov_tolerance, effort=_PATIENT)
            solution = identifier.identify(found.xy_px, found.flux)
        if solution.valid:
            solution = _polished(solution, found, identifier)
    return ImageSolution(solution, found, solution.camera or given, identifier.stars)


def _polished(solution: Solution, found: Detections, identifier: Identifier) -> Solution:
    """Solution with the lens estimated on the same stars, where they suffice."""
    rough = solution.camera or identifier.camera
    if solution.star_count < _FEW:
        return solution
    stars = Stars(found.xy_px, found.flux, found.xy_sigma_px)
    camera = self_calibrate(
        [stars], rough, identifier.catalog, fov_tolerance=0.01, models=IMAGE_MODELS
    ).calibration.camera
    again = identifier.with_camera(camera).track(
        found.xy_px, found.flux, solution.attitude, found.xy_sigma_px
    )
    if not again.valid:
        return solution
    return dataclasses.replace(again, mode="lost_in_space", camera=camera)
