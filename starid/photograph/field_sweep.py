"""Solving photographs with an unknown field of view by trying one approximate field after another."""

from __future__ import annotations

import math
from typing import Final

from numpy.typing import ArrayLike

from starid.arithmetic.arrays import GreyImage
from starid.camera import Camera, Model
from starid.catalog import StarCatalog
from starid.imaging.detection import DetectionSettings
from starid.photograph.rough_search import RoughSearch
from starid.photograph.solver import ImageSolution, Progress, search_views
from starid.photograph.typical_camera import FIELD_STEP
from starid.photograph.views import views

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
        time_limit_s: float = math.inf,
        progress: Progress | None = None,
    ) -> ImageSolution:
        """Find the stars in an image, and the attitude and field of view of its camera.

        Parameters
        ----------
        image : ndarray (h, w) of uint8 or uint16
            The image.
        settings : DetectionSettings, optional
            Settings of the detection.
        observer_velocity : array (3,), optional
            See `starid.identification.star_identifier.StarIdentifier.identify`.
        time_limit_s, progress
            See `starid.photograph.solver.search_views`.

        Raises
        ------
        StaridError
            The image is not valid for detection.
        """
        return search_views(
            views(image, settings), self._cameras, self._search, observer_velocity, time_limit_s, progress
        )


def solve_any_field(
    image: GreyImage,
    catalog: StarCatalog,
    *,
    model: Model = "pinhole",
    settings: DetectionSettings | None = None,
    observer_velocity: ArrayLike | None = None,
    time_limit_s: float = math.inf,
    progress: Progress | None = None,
) -> ImageSolution:
    """Solve one image with a `FieldSweep`.

    The parameters are those of `FieldSweep` and of its `solve`.
    """
    height, width = image.shape
    sweep = FieldSweep(width, height, catalog, model=model)
    return sweep.solve(image, settings, observer_velocity, time_limit_s, progress)
