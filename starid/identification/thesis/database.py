"""The feature database: an 8-bit feature vector for each frame of a grid, computed from the stars."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import atan2, hypot, tan
from starid.camera import Camera
from starid.catalog import Band, StarCatalog
from starid.errors import StaridError
from starid.identification.thesis.features import FEATURE_COUNT, FeatureVector
from starid.identification.thesis.frame_grid import FrameGrid, Geometry, GridArrays, make_grid
from starid.identification.thesis.frame_sky import (
    Direction,
    FrameSky,
    SkyArrays,
    cell_features,
    make_frame_sky,
)
from starid.kernels.jit import compiled

CODE_MAX: Final = 255
"""Largest code of a stored feature; codes span 0 … 100 of the normalised scale."""

THESIS_FRAME_DEG: Final = 40.0
"""Frame width, degrees, of all published figures (the text says 42°)."""

THESIS_KAPPA: Final = 11.5
"""Brightness limit, in Hp, of all published figures; the stars that are *fainter* are kept."""

_ROWS_PER_BLOCK: Final = 8
_WIDEST_HALF_FIELD: Final = math.radians(60.0)

Progress = Callable[[int, int], None]
"""Called with the number of cells done and the total, over both passes."""


class DatabaseError(StaridError):
    """A database that cannot be built, read, or used with this identifier."""


@dataclass(frozen=True, slots=True)
class DatabaseParameters:
    """What a database depends on besides the stars.

    Attributes
    ----------
    geometry
        "planar" for the thesis's plane, "spherical" for a camera on the true sphere.
    overlap
        Overlap ratio p as a fraction.
    fov_deg
        Width φ of a frame, degrees.
    kappa, direction, band
        Brightness limit, which side of it is kept, and the magnitude band.
    full_field
        Square frames instead of circular ones (not invariant to roll).
    focal_px, half_width_px
        Focal length and half-width of a frame in pixels of a gnomonic image; spherical only.
    """

    geometry: Geometry = "planar"
    overlap: float = 0.995
    fov_deg: float = THESIS_FRAME_DEG
    kappa: float = THESIS_KAPPA
    direction: Direction = "faintest"
    band: Band = "hp"
    full_field: bool = False
    focal_px: float = 0.0
    half_width_px: float = 0.0

    @classmethod
    def for_camera(
        cls,
        camera: Camera,
        *,
        overlap: float,
        kappa: float,
        direction: Direction = "brightest",
        band: Band = "v",
        full_field: bool = False,
    ) -> Self:
        """Spherical parameters for the largest circle (or square) about the boresight that fits the image."""
        (cx, cy), focal = camera.centre_px, camera.focal_px[0]
        half = 0.5 + min(cx, camera.width - 1 - cx, cy, camera.height - 1 - cy)
        edge = np.array([[cx + half, cy]])
        direction_of_edge = camera.back_project(edge)[0]
        angle = atan2(hypot(direction_of_edge[0], direction_of_edge[1]), direction_of_edge[2])
        if not (half > 0.0 and angle < _WIDEST_HALF_FIELD):
            raise DatabaseError(
                "database: features are gnomonic and need a camera with a field of less than 120°"
            )
        return cls(
            "spherical",
            overlap,
            2.0 * math.degrees(angle),
            kappa,
            direction,
            band,
            full_field=full_field,
            focal_px=focal,
            half_width_px=focal * tan(angle),
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read the parameters from the header of a file."""
        names = {field.name for field in dataclasses.fields(cls)}
        if set(values) != names:
            raise DatabaseError(
                f"database: header must have the parameters {sorted(names)}, not {sorted(values)}"
            )
        return cls(**values)

    @property
    def half_width(self) -> float:
        """Half-width of a frame in the unit of the offsets: degrees (planar) or pixels (spherical)."""
        return self.half_width_px if self.geometry == "spherical" else 0.5 * self.fov_deg


@dataclass(frozen=True, eq=False)
class FeatureDatabase:
    """A grid of frames with their features.

    Attributes
    ----------
    parameters, grid, sky
        Parameters, grid and stars of the database.
    features
        Stored normalised features, (N, 5) uint8, read-only; 255 is 100 on the normalised scale.
    theta
        Stored polar angles, (N,) uint8; 255 for a cell without stars.
    minimum, maximum
        Extremes of each feature over the cells with stars, (5,).
    catalog_identity
        Checksum of the stars.
    """

    parameters: DatabaseParameters
    grid: FrameGrid
    sky: FrameSky
    features: NDArray[np.uint8]
    theta: NDArray[np.uint8]
    minimum: Array
    maximum: Array
    catalog_identity: str

    @property
    def cells(self) -> int:
        """Number of cells N."""
        return self.grid.cells

    @property
    def bytes_features(self) -> int:
        """Size of the stored features, bytes."""
        return int(self.features.nbytes)

    def normalise(self, features: FeatureVector | Array) -> Array:
        """Normalise features (5,), eq. 2.11: 100·(f − min)/(max − min) over the database."""
        vector = (
            features.vector if isinstance(features, FeatureVector) else np.asarray(features, dtype=np.float64)
        )
        return np.asarray((vector - self.minimum) * self.scale, dtype=np.float64)

    @cached_property
    def scale(self) -> Array:
        """Normalised units per unit of each feature, (5,); 0 for a constant feature."""
        return normalising_scale(self.minimum, self.maximum)

    def exact_features(self, cell: int) -> FeatureVector:
        """Full-precision features of a cell, computed from the stars."""
        return self.sky.features(*self.grid.centre(cell))


def normalising_scale(minimum: Array, maximum: Array) -> Array:
    """100/(max − min) for each feature; 0 if the extremes are equal."""
    span = maximum - minimum
    return np.asarray(np.where(span > 0.0, 100.0 / np.where(span > 0.0, span, 1.0), 0.0), dtype=np.float64)


@compiled
def _extremes_of_rows(sky: SkyArrays, grid: GridArrays, low: Array, high: Array) -> None:
    sums, out = np.empty(8), np.empty(5)
    for row in range(grid.row_dec.size):
        for column in range(grid.row_columns[row]):
            ra = (grid.first_ra + column * grid.row_ra_step[row]) % 360.0
            cell_features(sky, ra, grid.row_dec[row], sums, out)
            if out[0] >= 1.0:
                for f in range(5):
                    low[f] = min(low[f], out[f])
                    high[f] = max(high[f], out[f])


@compiled
def _store_rows(
    sky: SkyArrays,
    grid: GridArrays,
    low: Array,
    scale: Array,
    features: NDArray[np.uint8],
    theta: NDArray[np.uint8],
) -> None:
    sums, out = np.empty(8), np.empty(5)
    cell = 0
    for row in range(grid.row_dec.size):
        for column in range(grid.row_columns[row]):
            ra = (grid.first_ra + column * grid.row_ra_step[row]) % 360.0
            angle = cell_features(sky, ra, grid.row_dec[row], sums, out)
            if out[0] >= 1.0:
                for f in range(5):
                    features[cell, f] = np.uint8(round((out[f] - low[f]) * scale[f] * 2.55))
                turn = angle / (2.0 * math.pi)
                theta[cell] = np.uint8(round(turn * 255.0) % 255)
            else:
                for f in range(5):
                    features[cell, f] = np.uint8(0)
                theta[cell] = np.uint8(255)
            cell += 1


def sky_of(catalog: StarCatalog, parameters: DatabaseParameters) -> FrameSky:
    """Stars of a catalogue, as projected into the frames of a database."""
    return make_frame_sky(
        np.degrees(catalog.ra_rad),
        np.degrees(catalog.dec_rad),
        catalog.magnitude(parameters.band),
        geometry=parameters.geometry,
        half_width=parameters.half_width,
        kappa=parameters.kappa,
        direction=parameters.direction,
        full_field=parameters.full_field,
        focal_px=parameters.focal_px,
    )


def build_database(
    catalog: StarCatalog,
    parameters: DatabaseParameters,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
) -> FeatureDatabase:
    """Compute the features of every frame of the grid.

    There are two passes over the grid, first the extremes and then the codes, so that full-precision features
    are never stored and memory is limited to the database itself. The number of threads does not change the
    result.

    Parameters
    ----------
    catalog
        The stars; the published figures need the catalogue epoch J1991.25 without proper motion.
    parameters
        Geometry, grid and brightness limit.
    progress
        Called from this thread after each block of rows.
    threads
        Number of worker threads; by default the available processors.

    Raises
    ------
    DatabaseError, StaridError
        The parameters do not define a grid, or no star is left.
    """
    grid = make_grid(parameters.geometry, parameters.fov_deg, parameters.overlap)
    sky = sky_of(catalog, parameters)
    features = np.empty((grid.cells, FEATURE_COUNT), dtype=np.uint8)
    theta = np.empty(grid.cells, dtype=np.uint8)
    blocks = [slice(r, min(r + _ROWS_PER_BLOCK, grid.rows)) for r in range(0, grid.rows, _ROWS_PER_BLOCK)]
    low = np.full((len(blocks), FEATURE_COUNT), np.inf)
    high = np.full((len(blocks), FEATURE_COUNT), -np.inf)
    done = 0

    def cells_of(block: slice) -> slice:
        return slice(int(grid.row_start[block.start]), int(grid.row_start[block.stop]))

    def run(work: Callable[[int], None]) -> None:
        nonlocal done
        futures = {pool.submit(work, i): i for i in range(len(blocks))}
        for future in as_completed(futures):
            future.result()
            where = cells_of(blocks[futures[future]])
            done += where.stop - where.start
            if progress is not None:
                progress(done, 2 * grid.cells)

    def find_extremes(i: int) -> None:
        _extremes_of_rows(sky.arrays, grid.arrays.rows(blocks[i]), low[i], high[i])

    def store(i: int) -> None:
        rows, where = grid.arrays.rows(blocks[i]), cells_of(blocks[i])
        _store_rows(sky.arrays, rows, minimum, scale, features[where], theta[where])

    with ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1) as pool:
        run(find_extremes)
        minimum, maximum = low.min(axis=0), high.max(axis=0)
        if not np.isfinite(minimum).all():
            raise DatabaseError("database: no frame of the grid has a star; change the brightness limit")
        scale = normalising_scale(minimum, maximum)
        run(store)
    features.setflags(write=False)
    theta.setflags(write=False)
    return FeatureDatabase(parameters, grid, sky, features, theta, minimum, maximum, catalog.identity)
