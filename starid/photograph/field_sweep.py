"""Photographs of which not even the field of view is known: one rough field after the other."""

from __future__ import annotations

import dataclasses
import time
from typing import Final

from starid.camera import Camera, Model
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.imaging.detection import DetectionSettings
from starid.photograph.rough_search import ALL_ROUNDS, RoughSearch
from starid.photograph.solver import ImageSolution, polished
from starid.photograph.typical_camera import FIELD_STEP
from starid.photograph.views import Counts, looks
from starid.solution import Reason

FIELDS_DEG: Final = tuple(FIELD_STEP**step for step in (13, 12, 14, 15, 11, 16, 17, 10, 18, 9, 19, 20, 21))
"""Widths of square fields that are tried, each within `TOLERANCE`: 5° to 46°, the middle ones first."""

TOLERANCE: Final = 0.1


def solve_any_field(
    image: Counts,
    catalog: StarCatalog,
    *,
    model: Model = "pinhole",
    settings: DetectionSettings | None = None,
) -> ImageSolution:
    """Find the stars on an image, and the attitude and the field of the camera that took it.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        Grey.
    catalog : StarCatalog
        The stars.
    model : {"pinhole", "equidistant", "flat"}
        How the lens maps.
    settings : DetectionSettings, optional
        For the detection.

    Raises
    ------
    StaridError
        Detection refuses the image.
    """
    begin = time.perf_counter()
    height, width = image.shape
    shape = (width / height) ** 0.5
    cameras = [Camera.from_fov(field * shape, width, height, model) for field in FIELDS_DEG]
    searches: dict[Camera, RoughSearch] = {}
    first: ImageSolution | None = None
    for look in looks(image, settings):
        if look.mirrored:
            break
        found = look.detections
        for number in ALL_ROUNDS[:-1]:
            for camera in cameras:
                search = searches.get(camera) or RoughSearch(camera, catalog, fov_tolerance=TOLERANCE)
                searches[camera] = search
                solution = search.identify(found.xy_px, found.flux, rounds=[number])
                if solution.valid:
                    return polished(solution, look, camera, search, begin)
                if first is None:
                    first = ImageSolution(solution, found, camera, search.identifier.stars)
                if solution.reason is Reason.TOO_FEW_STARS:
                    break
    if first is None:
        raise StaridError("image: no way to look at it was given")
    failed = dataclasses.replace(first.solution, elapsed=time.perf_counter() - begin)
    return dataclasses.replace(first, solution=failed)
