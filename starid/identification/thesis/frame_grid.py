"""The grid of frames of a feature database: flat as in the thesis, or on the sphere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices, elementwise
from starid.arithmetic.elementary import cos, square
from starid.errors import StaridError
from starid.kernels.jit import compiled, inner_checked

Geometry = Literal["planar", "spherical"]

DICTIONARY_SIDE: Final = 3
"""Number of cells along one side of a dictionary."""

DICTIONARY_SIZE: Final = DICTIONARY_SIDE * DICTIONARY_SIDE
"""Number of cells in a dictionary: the nearest cell and its neighbours."""

MAX_CELLS: Final = 200_000_000
"""Largest number of frames in a grid (planar, over the whole sky): 1.2 GB of features."""

_FULL_TURN: Final = 360.0
_PLANAR_DECLINATION_SPAN: Final = 140.0
_ROUNDING: Final = 1e-9


class GridError(StaridError):
    """A grid that cannot be made."""


class GridArrays(NamedTuple):
    """Arrays of a `FrameGrid`, or of some of its rows, for the kernels."""

    row_start: Indices
    row_columns: Indices
    row_dec: Array
    row_ra_step: Array
    first_ra: float

    def rows(self, selection: slice) -> GridArrays:
        """Select some of the rows; the cell numbers do not change."""
        start = self.row_start[selection.start : selection.stop + 1]
        return GridArrays(
            start,
            self.row_columns[selection],
            self.row_dec[selection],
            self.row_ra_step[selection],
            self.first_ra,
        )


@dataclass(frozen=True, eq=False)
class FrameGrid:
    """Frame centres in rows of constant declination; cells are numbered row by row from the south, from 0.

    Attributes
    ----------
    geometry
        "planar": the flat (α, δ) plane of the thesis, with the same number of columns in every row.
        "spherical": the rows start half a step off the poles, and cells have similar areas.
    step_deg
        Distance between two cells, φ·(1 − p), degrees.
    first_ra_deg
        Right ascension of the centre of column 0, degrees.
    row_dec_deg, row_ra_step_deg
        Declination of each row, and distance between its columns, degrees, (rows,).
    row_columns, row_start
        Number of columns (rows,), and the first cell of each row (rows + 1,).
    """

    geometry: Geometry
    step_deg: float
    first_ra_deg: float
    row_dec_deg: Array
    row_ra_step_deg: Array
    row_columns: Indices
    row_start: Indices

    @property
    def rows(self) -> int:
        return int(self.row_columns.size)

    @property
    def cells(self) -> int:
        """Number of cells N."""
        return int(self.row_start[-1])

    @property
    def arrays(self) -> GridArrays:
        return GridArrays(
            self.row_start, self.row_columns, self.row_dec_deg, self.row_ra_step_deg, self.first_ra_deg
        )

    def centre(self, cell: int) -> tuple[float, float]:
        """Right ascension (0 … 360) and declination of the centre of a cell, degrees."""
        if not 0 <= cell < self.cells:
            raise GridError(f"grid: cell {cell} does not exist; there are {self.cells}, numbered from 0")
        ra, dec = cell_centre(self.arrays, cell)
        return float(ra) % _FULL_TURN, float(dec)

    def dictionary(self, cell: int) -> Indices:
        """Cells of the 3×3 neighbourhood, (9,), row by row: the dictionary T of eq. 2.30 in terms of cells.

        Right ascension wraps. At the first and last row the block is moved inwards as a whole, so that it
        always has nine different cells; on the sphere the nearest three columns of a row.
        """
        cells = np.empty(DICTIONARY_SIZE, dtype=np.int64)
        turns = np.empty(DICTIONARY_SIZE)
        dictionary_cells(self.arrays, cell, cells, turns)
        return cells


@inner_checked
def cell_row(row_start: Indices, cell: int) -> int:
    low = 0
    high = row_start.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if row_start[middle] <= cell:
            low = middle
        else:
            high = middle
    return low


@compiled
def dictionary_cells(grid: GridArrays, cell: int, cells: Indices, right_ascension: Array) -> int:
    """Fill in the nine cells and their right ascensions (degrees, not wrapped); return the first row."""
    row = cell_row(grid.row_start, cell)
    centre = (cell - grid.row_start[row]) * grid.row_ra_step[row]
    first_row = min(max(row - 1, 0), grid.row_columns.size - 3)
    for i in range(3):
        r = first_row + i
        middle = round(centre / grid.row_ra_step[r])
        for j in range(3):
            column = middle - 1 + j
            cells[3 * i + j] = grid.row_start[r] + column % grid.row_columns[r]
            right_ascension[3 * i + j] = grid.first_ra + column * grid.row_ra_step[r]
    return first_row


@compiled
def cell_centre(grid: GridArrays, cell: int) -> tuple[float, float]:
    """Right ascension (not wrapped) and declination of the centre of a cell, degrees."""
    row = cell_row(grid.row_start, cell)
    return grid.first_ra + (cell - grid.row_start[row]) * grid.row_ra_step[row], grid.row_dec[row]


def make_grid(geometry: Geometry, fov_deg: float, overlap: float) -> FrameGrid:
    """Make the grid for a frame width φ and an overlap ratio p.

    The planar grid has the published database sizes: step 40°·(1 − p), 360°/step columns whose lower-left
    corner starts at α = 0°, and ⌈140°/step⌉ rows whose corner starts at δ = −90°.

    Parameters
    ----------
    geometry
        "planar" or "spherical".
    fov_deg
        Width φ of a frame, degrees; 40° for the published planar numbers.
    overlap
        Overlap ratio p, 0 ≤ p < 1.

    Raises
    ------
    GridError
        A value is out of range, or there would be fewer than three rows or columns.
    """
    if not (math.isfinite(overlap) and 0.0 <= overlap < 1.0):
        raise GridError(
            f"grid: overlap ratio {overlap} is not in [0, 1); 0.995 means that frames overlap by 99.5 %"
        )
    if not (math.isfinite(fov_deg) and 0.0 < fov_deg <= 120.0):
        raise GridError(f"grid: frames cannot be {fov_deg}° wide; give more than 0° and at most 120°")
    step = fov_deg * (1.0 - overlap)
    if not MAX_CELLS * square(step) >= _FULL_TURN * 180.0:
        raise GridError(
            f"grid: frames {fov_deg}° wide that overlap by {100.0 * overlap:.9g} % number more than {MAX_CELLS} over the whole "
            "sky; give less overlap or wider frames"
        )
    if geometry == "planar":
        columns = math.ceil(_FULL_TURN / step - _ROUNDING * _FULL_TURN)
        rows = math.ceil(_PLANAR_DECLINATION_SPAN / step - _ROUNDING * _PLANAR_DECLINATION_SPAN)
        dec = -90.0 + step * np.arange(rows) + 0.5 * fov_deg
        row_columns = np.full(rows, columns, dtype=np.int64)
        ra_step = np.full(rows, step, dtype=np.float64)
        first_ra = 0.5 * fov_deg
    elif geometry == "spherical":
        rows = math.ceil(180.0 / step)
        dec = -90.0 + (np.arange(rows) + 0.5) * (180.0 / rows)
        row_columns = np.maximum(np.rint(_FULL_TURN * elementwise(cos, np.radians(dec)) / step), 3).astype(
            np.int64
        )
        ra_step = np.asarray(_FULL_TURN / row_columns, dtype=np.float64)
        first_ra = 0.0
    else:
        raise GridError(f"grid: geometry must be planar or spherical, not {geometry!r}")
    if rows < DICTIONARY_SIDE or int(row_columns.min()) < DICTIONARY_SIDE:
        raise GridError(f"grid: overlap {overlap} gives {rows} rows of frames; at least three are needed")
    row_dec = np.asarray(dec, dtype=np.float64)
    row_start = np.concatenate([[0], np.cumsum(row_columns)]).astype(np.int64)
    return FrameGrid(geometry, step, first_ra, row_dec, ra_step, row_columns, row_start)


def nominal_cells(fov_deg: float, overlap: float) -> float:
    """Nominal number of cells N = 2π² / (φ_x·φ_y·(1 − p)²), eq. 2.23, with φ_x = φ_y = `fov_deg`."""
    fov = math.radians(fov_deg)
    return 2.0 * square(math.pi) / square(fov * (1.0 - overlap))


def circle_intrusion(radius: float) -> float:
    """Overlap of neighbouring circles, in the unit of the radius, that leaves no gap.

    Diagonal neighbours touch when 2·(2r − x)² = 4r², eq. 2.24, so that x = (2 − √2)·r, eq. 2.25.
    """
    return (2.0 - math.sqrt(2.0)) * radius


def minimum_overlap() -> float:
    """Smallest overlap ratio that loses no star: p = x/φ, eq. 2.26; with r = φ/2, 0.2929, eq. 2.27."""
    return circle_intrusion(0.5)
