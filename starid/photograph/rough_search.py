"""Identification for a camera with an approximate field of view and an unknown lens.

The search makes several attempts, from cheap to expensive: with all detections, or with the brightest of each
cell of the image, so that trees, lettering or a nebula count only by their area; without distortion, or with
barrel or pincushion distortion; with few or many triangles.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starid.arithmetic.arrays import Array
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Effort, Identifier, scaled_camera
from starid.identification.options import UNLIMITED_DEG
from starid.identification.solution import Reason, Solution
from starid.photograph.typical_camera import blend_in_typical, typical_camera

SIZE_PX: Final = 1000.0
"""Side of the image for which the windows are defined; they scale with the side."""

CELLS: Final = 60
"""Approximate number of cells of the image for an even selection of detections."""

NARROWEST_DEG: Final = 1.0
"""Narrowest field, degrees: a square one has three Hipparcos stars on average."""

MAX_AT_ONCE: Final = 500
"""Largest number of detections used in one attempt."""

WINDOW_PX: Final = 20.0
"""Widest first matching window."""

MAX_FALSE: Final = 1e-7
"""Bound on the probability of a false solution per attempt; there are several dozen attempts."""

_STRICT: Final = Effort(max_false_probability=MAX_FALSE)
_LENIENT: Final = Effort(
    tolerance_px=6.0,
    window_px=WINDOW_PX,
    test_window_px=16.0,
    magnitude_gate=2.5,
    max_false_probability=MAX_FALSE,
)


class _Round(NamedTuple):
    """Attempts of similar effort: one for each selection of detections and each distortion.

    Attributes
    ----------
    effort : Effort
        Windows, for an image of `SIZE_PX`, and number of triangles.
    depths : tuple of int
        Detections per cell of the image, brightest first; 0 for the brightest of the whole image.
    distortions : tuple of float
        Relative displacement of the corner of the image.
    """

    effort: Effort
    depths: tuple[int, ...]
    distortions: tuple[float, ...]


_THOROUGH: Final = dataclasses.replace(_LENIENT, max_triangles=1000)

ROUNDS: Final = (
    _Round(dataclasses.replace(_STRICT, max_triangles=100), (0, 1, 4), (0.0,)),
    _Round(_THOROUGH, (0,), (0.0, -0.05)),
    _Round(_THOROUGH, (1, 4), (0.0, -0.05)),
    _Round(_THOROUGH, (0, 1, 4), (0.05, -0.12)),
    _Round(dataclasses.replace(_LENIENT, max_triangles=5000), (0, 1, 4), (0.0,)),
)
"""Rounds of the search, quick ones first. Few photographs need more than the first."""

ALL_ROUNDS: Final = range(len(ROUNDS))


class _Attempt(NamedTuple):
    """One attempt: rows of the detections, distortion and effort."""

    rows: NDArray[np.intp]
    distortion: float
    effort: Effort


class RoughSearch:
    """Lost-in-space search for a camera with an approximate field of view and an unknown lens.

    Parameters
    ----------
    camera : Camera
        Size, model and approximate focal length; if it has distortion, only that is tried.
    catalog : StarCatalog
        The stars.
    fov_tolerance : float
        Relative uncertainty of the focal length.

    Raises
    ------
    StaridError
        The field is too narrow for the catalogue.
    """

    def __init__(self, camera: Camera, catalog: StarCatalog, *, fov_tolerance: float) -> None:
        if camera.fov_deg < NARROWEST_DEG:
            raise StaridError(
                f"camera fov_deg: must be at least {NARROWEST_DEG:g}, not {camera.fov_deg:g}; a narrower field has too few stars"
            )
        self._tolerance = fov_tolerance
        self._scale = max(math.sqrt(camera.width * camera.height) / SIZE_PX, 0.75)
        typical = typical_camera(camera)
        self._first = Identifier(
            camera,
            catalog,
            blend_px=blend_in_typical(camera, typical),
            fov_tolerance=fov_tolerance,
            largest_error_deg=UNLIMITED_DEG,
            effort=self._scaled(_LENIENT),
            index_camera=typical,
        )

    @property
    def identifier(self) -> Identifier:
        """Identifier for the nominal camera that shares the index of the search."""
        return self._first

    def identify(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        *,
        rounds: Sequence[int] = ALL_ROUNDS,
        time_limit_s: float = math.inf,
    ) -> Solution:
        """Find the attitude and the camera; invalid, with the reason, if every attempt fails.

        Parameters
        ----------
        xy_px, flux
            See `Identifier.identify`.
        rounds : sequence of int
            Rounds to run, as indices of `ROUNDS`.
        time_limit_s : float
            Time after which no further attempt is made.
        """
        begin = time.perf_counter()
        xy, brightness = (
            np.asarray(xy_px, dtype=np.float64).reshape(-1, 2),
            np.asarray(flux, dtype=np.float64),
        )
        solution = Solution.invalid(Reason.NO_MATCH)
        plain = self._first.camera
        straight: dict[float, Array] = {0.0: xy}
        for attempt in self._attempts(xy, brightness, rounds):
            lens = distorted(plain, attempt.distortion)
            if attempt.distortion not in straight:
                straight[attempt.distortion] = plain.project(lens.back_project(xy))[0]
            positions = straight[attempt.distortion]
            rows = attempt.rows[np.isfinite(positions[attempt.rows, 0])]
            search = self._first.with_camera(plain, fov_tolerance=self._tolerance, effort=attempt.effort)
            solution = search.identify(positions[rows], brightness[rows])
            if solution.valid:
                camera = solution.camera or plain
                solution = dataclasses.replace(
                    solution,
                    detection_index=rows[solution.detection_index].astype(np.int64),
                    camera=scaled_camera(lens, camera.focal_px[0] / plain.focal_px[0]),
                )
            late = time.perf_counter() - begin > time_limit_s
            if solution.valid or solution.reason is Reason.TOO_FEW_STARS or late:
                break
        return solution.timed(begin)

    def _attempts(self, xy: Array, flux: Array, rounds: Sequence[int]) -> Iterator[_Attempt]:
        brightest = np.argsort(-flux, kind="stable")
        known_lens = any(self._first.camera.distortion)
        for number in rounds:
            effort = self._scaled(ROUNDS[number].effort)
            for depth in ROUNDS[number].depths:
                rows = brightest[:MAX_AT_ONCE]
                if depth > 0:
                    rows = even_selection(xy, brightest, self._first.camera, depth)
                for distortion in ROUNDS[number].distortions:
                    if distortion == 0.0 or not known_lens:
                        yield _Attempt(rows, distortion, effort)

    def _scaled(self, effort: Effort) -> Effort:
        """Scale the windows of an effort to the size of the image."""
        return dataclasses.replace(
            effort,
            tolerance_px=effort.tolerance_px * self._scale,
            window_px=effort.window_px * self._scale,
            test_window_px=effort.test_window_px * self._scale,
        )


def even_selection(xy: Array, brightest: NDArray[np.intp], camera: Camera, depth: int) -> NDArray[np.intp]:
    """Select the `depth` brightest detections in each cell of the image.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Positions, pixels.
    brightest : ndarray (n,)
        Rows, sorted by decreasing flux.
    camera : Camera
        A camera of the same width and height as the image.
    depth : int
        Number of detections per cell.
    """
    side = math.sqrt(camera.width * camera.height / CELLS)
    columns = math.ceil(camera.width / side)
    cell = (xy[:, 0] // side).astype(np.int64) + columns * (xy[:, 1] // side).astype(np.int64)
    ordered = cell[brightest]
    by_cell = np.argsort(ordered, kind="stable")
    grouped = ordered[by_cell]
    first = np.searchsorted(grouped, grouped, side="left")
    rank = np.empty(len(ordered), dtype=np.int64)
    rank[by_cell] = np.arange(len(ordered)) - first
    return brightest[rank < depth]


def distorted(camera: Camera, displacement: float) -> Camera:
    """Camera with the same field, and distortion that displaces the corner by a share of its radius."""
    if displacement == 0.0:
        return camera
    corner = 0.5 * math.hypot(camera.width, camera.height) / camera.focal_px[0]
    distortion = (displacement / corner**2,)
    return Camera.from_fov(camera.fov_deg, camera.width, camera.height, camera.model, distortion)
