"""Solving photographs with an unknown field of view by trying one approximate field after another."""

from __future__ import annotations

import dataclasses
import time
from typing import Final

from numpy.typing import ArrayLike

from starid.arrays import GreyImage
from starid.camera import Camera, Model
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.imaging.detection import DetectionSettings
from starid.photograph.rough_search import ALL_ROUNDS, RoughSearch
from starid.photograph.solver import ImageSolution, refine_solution
from starid.photograph.typical_camera import FIELD_STEP
from starid.photograph.views import views
from starid.solution import Reason

FIELDS_DEG: Final = tuple(
    FIELD_STEP**step for step in (13, 12, 14, 15, 11, 16, 17, 10, 18, 9, 19, 20, 21, 22, 23)
)
"""Widths of the square fields tried, each within `TOLERANCE`: 5° to 66°, common ones first."""

TOLERANCE: Final = 0.1


class FieldSweep:
    """Solver for images of one size with an unknown field of view; its indices are reused.

    Parameters
    ----------
    width, height : int
        Size of the images, pixels.
    catalog : StarCatalog
        The stars.
    model : {"pinhole", "equidistant", "flat"}
        Projection of the lens.
    """

    def __init__(self, width: int, height: int, catalog: StarCatalog, *, model: Model = "pinhole") -> None:
        shape = (width / height) ** 0.5
        self._cameras = [Camera.from_fov(field * shape, width, height, model) for field in FIELDS_DEG]
        self._catalog = catalog
        self._searches: dict[Camera, RoughSearch] = {}

    def _search(self, camera: Camera) -> RoughSearch:
        """Return the search for a field about as wide as a camera's, made when first needed."""
        if camera not in self._searches:
            self._searches[camera] = RoughSearch(camera, self._catalog, fov_tolerance=TOLERANCE)
        return self._searches[camera]

    def solve(
        self,
        image: GreyImage,
        settings: DetectionSettings | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> ImageSolution:
        """Find the stars in an image, and the attitude and field of view of its camera.

        Parameters
        ----------
        image : ndarray (h, w) of uint8 or uint16
            The image.
        settings : DetectionSettings, optional
            Settings of the detection.
        observer_velocity : array (3,), optional
            See `starid.interface.StarIdentifier.identify`.

        Raises
        ------
        StaridError
            The image is not valid for detection.
        """
        begin = time.perf_counter()
        first: ImageSolution | None = None
        for view in views(image, settings):
            if view.mirrored:
                break
            found = view.detections
            for number in ALL_ROUNDS[:-1]:
                for camera in self._cameras:
                    search = self._search(camera)
                    solution = search.identify(found.xy_px, found.flux, rounds=[number])
                    if solution.valid:
                        return refine_solution(solution, view, camera, search, begin, observer_velocity)
                    if first is None:
                        first = ImageSolution(solution, found, camera, search.identifier.stars)
                    if solution.reason is Reason.TOO_FEW_STARS:
                        break
        if first is None:
            raise StaridError("image: no view of it is available")
        failed = first.solution.timed(begin)
        return dataclasses.replace(first, solution=failed)


def solve_any_field(
    image: GreyImage,
    catalog: StarCatalog,
    *,
    model: Model = "pinhole",
    settings: DetectionSettings | None = None,
    observer_velocity: ArrayLike | None = None,
) -> ImageSolution:
    """Solve one image with a `FieldSweep`.

    The parameters are those of `FieldSweep` and of its `solve`.
    """
    height, width = image.shape
    return FieldSweep(width, height, catalog, model=model).solve(image, settings, observer_velocity)
