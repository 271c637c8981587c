"""Identification of photographs without a known field of view: one approximate field after another."""

from __future__ import annotations

import dataclasses
import time
from typing import Final

from numpy.typing import ArrayLike

from starid.camera import Camera, Model
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.imaging.detection import DetectionSettings
from starid.photograph.rough_search import ALL_ROUNDS, RoughSearch
from starid.photograph.solver import ImageSolution, refine_solution
from starid.photograph.typical_camera import FIELD_STEP
from starid.photograph.views import Counts, views
from starid.solution import Reason

FIELDS_DEG: Final = tuple(FIELD_STEP**step for step in (13, 12, 14, 15, 11, 16, 17, 10, 18, 9, 19, 20, 21))
"""Widths of the square fields tried, each within `TOLERANCE`: 5° to 46°, the middle ones first."""

TOLERANCE: Final = 0.1


def solve_any_field(
    image: Counts,
    catalog: StarCatalog,
    *,
    model: Model = "pinhole",
    settings: DetectionSettings | None = None,
    observer_velocity: ArrayLike | None = None,
) -> ImageSolution:
    """Find the stars on an image, and the attitude and field of view of its camera.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        Grey.
    catalog : StarCatalog
        The stars.
    model : {"pinhole", "equidistant", "flat"}
        Projection of the lens.
    settings : DetectionSettings, optional
        For the detection.
    observer_velocity : array (3,), optional
        As in `starid.interface.StarIdentifier.identify`.

    Raises
    ------
    StaridError
        The image is invalid for detection.
    """
    begin = time.perf_counter()
    height, width = image.shape
    shape = (width / height) ** 0.5
    cameras = [Camera.from_fov(field * shape, width, height, model) for field in FIELDS_DEG]
    searches: dict[Camera, RoughSearch] = {}
    first: ImageSolution | None = None
    for view in views(image, settings):
        if view.mirrored:
            break
        found = view.detections
        for number in ALL_ROUNDS[:-1]:
            for camera in cameras:
                search = searches.get(camera) or RoughSearch(camera, catalog, fov_tolerance=TOLERANCE)
                searches[camera] = search
                solution = search.identify(found.xy_px, found.flux, rounds=[number])
                if solution.valid:
                    return refine_solution(solution, view, camera, search, begin, observer_velocity)
                if first is None:
                    first = ImageSolution(solution, found, camera, search.identifier.stars)
                if solution.reason is Reason.TOO_FEW_STARS:
                    break
    if first is None:
        raise StaridError("image: no view of it is available")
    failed = dataclasses.replace(first.solution, elapsed=time.perf_counter() - begin)
    return dataclasses.replace(first, solution=failed)
