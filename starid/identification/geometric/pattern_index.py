"""The identification index: merged catalogue stars, sky grid, star counts and triangles of bright stars.

The corners of triangles are *pattern stars*, selected in order of brightness: a star is selected while fewer
than a quota of selected stars lie in its neighbourhood, a cap of half the field's area. Rich and poor regions
of the sky thus have similar numbers, and a half-blocked field still has some. A small quota selects the
*bright* pattern stars: any three of them that fit into the field form a triangle, for fields with few other
stars. A large quota selects the *deep* ones: they form triangles of medium size, for fields with many false
stars. A narrow field has more sky to cover and uses smaller triangles.

Sides are chords of the unit sphere (2·sin(angle/2)), sorted longest first; corner k lies opposite side k.
A row of triangles has the same handedness and the same bins of the longest and middle side, and is sorted by
the shortest side, so that a query reads a few short runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32, Mask
from starid.arithmetic.elementary import sin, square
from starid.arithmetic.matrices import lengths
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.catalog.catalog import companions, merge_close_stars
from starid.errors import StaridError
from starid.identification.geometric.pattern_stars import select_pattern_stars
from starid.identification.geometric.sky_grid import FACES, build_sky_grid, cell_of
from starid.kernels.jit import compiled_ieee, inner

INDEX_VERSION: Final = 5
"""Incremented whenever the same catalogue and settings would yield a different index."""

SIDE_STEPS: Final = 65535
"""Number of steps into which the longest chord is divided for storing sides."""

BRIGHTEST_BIN: Final = -2.0
"""Magnitude at which the bins of the star counts begin."""

BINS_PER_MAGNITUDE: Final = 4
COUNT_CELLS: Final = 12
_BLEND_DEPTH: Final = 1.5
"""Stars up to this many magnitudes below the limit are merged; fainter ones only with stars above it."""


class IndexArrays(NamedTuple):
    """The arrays of the index, for the kernels.

    Attributes
    ----------
    stars : ndarray (m, 4) float64
        Unit vector ICRS and V magnitude of the merged stars, brightest first.
    grid_start, grid_stars : ndarray int32
        Sky grid, see `starid.identification.geometric.sky_grid`.
    counts : ndarray (cells + 1, bins) int32
        Stars down to a magnitude bin in a cap with the area of the field around each coarse cell, and in the
        whole sky.
    row_start : ndarray int32
        The triangles of row r (`pattern_row`) are in ``[start[r], start[r + 1])``, sorted by shortest side.
    sides : ndarray (p, 3) uint16
        Longest, middle and shortest chord in steps.
    corners : ndarray (p, 3) uint16
        The pattern star opposite each side.
    pattern_stars : ndarray int32
        Row of `stars` for each pattern star.
    numbers : ndarray (7,) float64
        Cells per edge of the grid, its margin (rad), bins per side, chord of one step, shortest side of all,
        shortest and longest side of the deep triangles (chords).
    """

    stars: Array
    grid_start: Indices32
    grid_stars: Indices32
    counts: Indices32
    row_start: Indices32
    sides: NDArray[np.uint16]
    corners: NDArray[np.uint16]
    pattern_stars: Indices32
    numbers: Array


STAR_MAGNITUDE: Final = 3
"""Column of `IndexArrays.stars`."""

GRID_CELLS: Final = 0
GRID_MARGIN: Final = 1
SIDE_BINS: Final = 2
SIDE_STEP: Final = 3
SHORTEST_SIDE: Final = 4
DEEP_SHORTEST: Final = 5
DEEP_LONGEST: Final = 6


@dataclass(frozen=True)
class IndexSettings:
    """Settings of an index.

    Attributes
    ----------
    limiting_magnitude : float
        Faintest V of a star in the index.
    blend_rad : float
        Stars closer than this are merged.
    window_rad : float
        Largest distance between a detection and its star: the margin of the sky grid.
    field_area_sr : float
        Solid angle of the field.
    bright_sides_rad, deep_sides_rad : (float, float)
        Shortest and longest side of a triangle of bright pattern stars, and of any other (within the first).
    bright_quota, deep_quota : int
        Number of pattern stars in a neighbourhood of half the field's area.
    cells_per_edge : int
        Cells along the edge of a face of the sky grid.
    side_bins : int
        Number of bins for the longest and for the middle side.
    """

    limiting_magnitude: float
    blend_rad: float
    window_rad: float
    field_area_sr: float
    bright_sides_rad: tuple[float, float]
    deep_sides_rad: tuple[float, float]
    bright_quota: int
    deep_quota: int
    cells_per_edge: int
    side_bins: int

    def __post_init__(self) -> None:
        (bright_low, bright_high), (deep_low, deep_high) = self.bright_sides_rad, self.deep_sides_rad
        if not 0.0 < bright_low <= deep_low < deep_high <= bright_high < math.pi:
            raise StaridError(
                f"index sides: bright {self.bright_sides_rad}, deep {self.deep_sides_rad} rad; "
                "must be 0 < shortest < longest < π, and the deep range within the bright one"
            )
        if not (
            self.deep_quota >= self.bright_quota >= 3 and self.cells_per_edge >= 1 and self.side_bins >= 1
        ):
            raise StaridError("index: quota must be 3 or more, cells and bins 1 or more")


def resolved_stars(catalog: StarCatalog, limiting_magnitude: float, blend_rad: float) -> StarCatalog:
    """Select the stars to a limiting magnitude, merging those closer than `blend_rad`; brightest first."""
    deep = catalog.v <= limiting_magnitude + _BLEND_DEPTH
    deep[companions(catalog, limiting_magnitude, blend_rad)] = True
    return merge_close_stars(catalog.subset(deep), blend_rad, as_fitted=True).brighter_than(
        limiting_magnitude
    )


def _adjacency(vectors: Array, radius_rad: float) -> tuple[Indices, Indices]:
    """Neighbours of each star within a radius, ascending, in compressed rows: start (m + 1,), neighbours."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(vectors).query_pairs(2.0 * sin(0.5 * radius_rad), output_type="ndarray")
    left = np.concatenate([pairs[:, 0], pairs[:, 1]])
    right = np.concatenate([pairs[:, 1], pairs[:, 0]])
    order = np.lexsort((right, left))
    start = np.zeros(vectors.shape[0] + 1, dtype=np.int64)
    np.cumsum(np.bincount(left, minlength=vectors.shape[0]), out=start[1:])
    return start, np.ascontiguousarray(right[order], dtype=np.int64)


@inner
def sorted_triangle(
    c0: float, c1: float, c2: float, i: int, j: int, k: int
) -> tuple[float, float, float, int, int, int]:
    """Sides (opposite i, j, k) sorted longest first, and the corners in the same order."""
    if c0 < c1:
        c0, c1, i, j = c1, c0, j, i
    if c1 < c2:
        c1, c2, j, k = c2, c1, k, j
        if c0 < c1:
            c0, c1, i, j = c1, c0, j, i
    return c0, c1, c2, i, j, k


@inner
def chord(vectors: Array, i: int, j: int) -> float:
    """Chord between two unit vectors, the first three columns of rows i and j."""
    x = vectors[i, 0] - vectors[j, 0]
    y = vectors[i, 1] - vectors[j, 1]
    z = vectors[i, 2] - vectors[j, 2]
    return math.sqrt(x * x + y * y + z * z)


@inner
def handedness(vectors: Array, i: int, j: int, k: int) -> int:
    """1 if the triple product of rows i, j, k is positive, else 0."""
    product = (
        vectors[i, 0] * (vectors[j, 1] * vectors[k, 2] - vectors[k, 1] * vectors[j, 2])
        + vectors[i, 1] * (vectors[j, 2] * vectors[k, 0] - vectors[k, 2] * vectors[j, 0])
        + vectors[i, 2] * (vectors[j, 0] * vectors[k, 1] - vectors[k, 0] * vectors[j, 1])
    )
    return 1 if product > 0.0 else 0


@inner
def pattern_row(hand: int, longest: int, middle: int, bins: int) -> int:
    """Row of a handedness and two bins, middle ≤ longest; rows with the same longest bin are adjacent."""
    return (hand * bins * (bins + 1) + longest * (longest + 1)) // 2 + middle


@compiled_ieee
def _triangles(
    vectors: Array,
    start: Indices,
    neighbours: Indices,
    bright: Mask,
    bright_sides: tuple[float, float],
    deep_sides: tuple[float, float],
    bins: int,
) -> tuple[NDArray[np.uint16], Indices]:
    """List all triangles i < j < k with sides within the limits: sides and corners (p, 6), and rows."""
    longest = bright_sides[1]
    step = longest / SIDE_STEPS
    count = 0
    patterns = np.empty((0, 6), dtype=np.uint16)
    binned = np.empty(0, dtype=np.int64)
    for fill in range(2):
        if fill == 1:
            patterns = np.empty((count, 6), dtype=np.uint16)
            binned = np.empty(count, dtype=np.int64)
            count = 0
        for i in range(vectors.shape[0]):
            for p in range(start[i], start[i + 1]):
                j = neighbours[p]
                if j <= i:
                    continue
                c2 = chord(vectors, i, j)
                both = bright[i] and bright[j]
                if not both and not deep_sides[0] <= c2 <= deep_sides[1]:
                    continue
                for q in range(p + 1, start[i + 1]):
                    k = neighbours[q]
                    if not (both and bright[k]) and not deep_sides[0] <= c2 <= deep_sides[1]:
                        continue
                    s0, s1, s2, a, b, c = sorted_triangle(
                        chord(vectors, j, k), chord(vectors, i, k), c2, i, j, k
                    )
                    shortest, limit = bright_sides if both and bright[k] else deep_sides
                    if s2 < shortest or s0 > limit:
                        continue
                    if fill == 1:
                        patterns[count, 0] = round(s0 / step)
                        patterns[count, 1] = round(s1 / step)
                        patterns[count, 2] = round(s2 / step)
                        patterns[count, 3], patterns[count, 4], patterns[count, 5] = a, b, c
                        hand = handedness(vectors, a, b, c)
                        bin0 = min(int(s0 / longest * bins), bins - 1)
                        bin1 = min(int(s1 / longest * bins), bins - 1)
                        binned[count] = pattern_row(hand, bin0, bin1, bins)
                    count += 1
    return patterns, binned


@compiled_ieee
def _count_field_stars(vectors: Array, magnitudes: Array, cap_cosine: float, bins: int) -> Indices32:
    """Cumulative star counts by magnitude in a cap around the centre of each coarse cell."""
    cells = FACES * COUNT_CELLS * COUNT_CELLS
    counts = np.zeros((cells + 1, bins), dtype=np.int32)
    for star in range(magnitudes.shape[0]):
        counts[cells, magnitude_bin(magnitudes[star], bins)] += 1
    for face in range(FACES):
        for i in range(COUNT_CELLS):
            for j in range(COUNT_CELLS):
                centre = np.empty(3)
                centre[face // 2] = 1.0 if face % 2 == 0 else -1.0
                centre[(face // 2 + 1) % 3] = (2.0 * i + 1.0) / COUNT_CELLS - 1.0
                centre[(face // 2 + 2) % 3] = (2.0 * j + 1.0) / COUNT_CELLS - 1.0
                centre /= math.sqrt(square(centre[0]) + square(centre[1]) + square(centre[2]))
                cell = cell_of(centre[0], centre[1], centre[2], COUNT_CELLS)
                for star in range(vectors.shape[0]):
                    v = vectors[star]
                    if v[0] * centre[0] + v[1] * centre[1] + v[2] * centre[2] >= cap_cosine:
                        counts[cell, magnitude_bin(magnitudes[star], bins)] += 1
    for cell in range(cells + 1):
        for b in range(1, bins):
            counts[cell, b] += counts[cell, b - 1]
    return counts


@inner
def magnitude_bin(magnitude: float, bins: int) -> int:
    """Bin of a magnitude in `IndexArrays.counts`."""
    return min(max(int((magnitude - BRIGHTEST_BIN) * BINS_PER_MAGNITUDE), 0), bins - 1)


def build_arrays(stars: StarCatalog, settings: IndexSettings) -> IndexArrays:
    """Build the index of stars from `resolved_stars`, brightest first.

    Raises
    ------
    StaridError
        No triangle fits the field, or there are more pattern stars than 16 bits can number.
    """
    vectors, magnitudes = stars.vectors.copy(), stars.v.copy()
    grid_start, grid_stars = build_sky_grid(vectors, settings.cells_per_edge, settings.window_rad)
    half_field = 0.5 * settings.field_area_sr
    bright_stars = select_pattern_stars(vectors, half_field, settings.bright_quota)
    pattern_stars = np.union1d(bright_stars, select_pattern_stars(vectors, half_field, settings.deep_quota))
    if pattern_stars.size > SIDE_STEPS:
        raise StaridError(
            f"index: {pattern_stars.size} pattern stars, at most {SIDE_STEPS} fit; the field is too narrow"
        )
    star_vectors = np.ascontiguousarray(vectors[pattern_stars])
    start, neighbours = _adjacency(star_vectors, settings.bright_sides_rad[1])
    bright_sides, deep_sides = _chords(settings.bright_sides_rad), _chords(settings.deep_sides_rad)
    bins = settings.side_bins
    bright = np.isin(pattern_stars, bright_stars)
    patterns, binned = _triangles(star_vectors, start, neighbours, bright, bright_sides, deep_sides, bins)
    if binned.size == 0:
        raise StaridError(
            f"index: no triangle of stars to V {settings.limiting_magnitude:g} fits the field; "
            "raise the limiting magnitude"
        )
    order = np.lexsort((patterns[:, 2], binned))
    rows = bins * (bins + 1)
    row_start = np.zeros(rows + 1, dtype=np.int32)
    np.cumsum(np.bincount(binned, minlength=rows), out=row_start[1:])
    magnitude_bins = max(int((settings.limiting_magnitude - BRIGHTEST_BIN) * BINS_PER_MAGNITUDE) + 1, 1)
    cap_cosine = 1.0 - settings.field_area_sr / (2.0 * math.pi)
    counts = _count_field_stars(vectors, magnitudes, cap_cosine, magnitude_bins)
    numbers = np.array(
        [
            settings.cells_per_edge,
            settings.window_rad,
            bins,
            bright_sides[1] / SIDE_STEPS,
            bright_sides[0],
            deep_sides[0],
            deep_sides[1],
        ]
    )
    return IndexArrays(
        stars=np.column_stack([vectors, magnitudes]),
        grid_start=grid_start,
        grid_stars=grid_stars,
        counts=counts,
        row_start=row_start,
        sides=np.ascontiguousarray(patterns[order, :3]),
        corners=np.ascontiguousarray(patterns[order, 3:]),
        pattern_stars=pattern_stars.astype(np.int32),
        numbers=numbers,
    )


def _chords(angles: tuple[float, float]) -> tuple[float, float]:
    """Chords that subtend two angles."""
    return 2.0 * sin(0.5 * angles[0]), 2.0 * sin(0.5 * angles[1])


def field_solid_angle(camera: Camera) -> float:
    """Solid angle of a camera's field, steradians, summed over a grid of pixels."""
    steps = 24
    x = (np.arange(steps) + 0.5) * camera.width / steps - 0.5
    y = (np.arange(steps) + 0.5) * camera.height / steps - 0.5
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    here = camera.back_project(grid)
    right = camera.back_project(grid + np.array([0.01, 0.0])) - here
    down = camera.back_project(grid + np.array([0.0, 0.01])) - here
    areas = lengths(np.cross(right, down)) / 1e-4
    return float(np.nanmean(areas)) * camera.width * camera.height
