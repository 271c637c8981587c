"""Detection in windows around expected places, as a tracker does it: a fraction of the image is searched.

A tile of two blocks of background a side is cut out around each place, and the tiles are searched as one image. Within half a
block of its centre, the background of a tile depends on its own pixels only: an edge of a body in another tile does not matter.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, GreyImage, Indices, Mask
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import lengths
from starid.errors import StaridError
from starid.imaging.background import BLOCK_PX, estimate_background
from starid.imaging.detection import Detections, DetectionSettings, detect

TILE_PX: Final = 2 * BLOCK_PX
"""Side of a tile."""

MAX_RADIUS_PX: Final = BLOCK_PX / 2.0
"""Largest radius: the background of a tile is interpolated between the centres of its own blocks."""

_RIVAL_SHARE: Final = 0.4
"""Flux from which another detection is like a star, as a share of the star's: a magnitude."""

_NOISE_SIGMA: Final = 5.0
_CLEARLY_SIGMA: Final = 2.0
"""On an even background, a peak below five sigmas, as noise has them, is not like a star that is two sigmas higher."""

_UNEVEN_SIGMA: Final = 1.0
"""Difference of the background in the quarters of a tile, in sigmas of a pixel, from which it is not smooth."""

_MIN_EDGE_PX: Final = 8
"""Places nearer to the edge of the image are left out: the windows of their stars would extend into other tiles."""


class Windows(NamedTuple):
    """What is seen near places.

    Attributes
    ----------
    found : Detections
        Stars near a place, each once, brightest first. Trails are not followed.
    rivals : ndarray (n,)
        Other detections around the places, at most a magnitude fainter, per square pixel and summed over the places: times an
        area, the mean number of such detections that lie by chance in windows of that area. Where the background is uneven, as at
        the edge of a body, they are counted apart.
    searched : ndarray (m,) bool
        Whether anything can be found at each place: not where the image is constant, nor close to its edge.
    """

    found: Detections
    rivals: Array
    searched: Mask


def detect_near(image: GreyImage, places: Array, radius_px: float, settings: DetectionSettings) -> Windows:
    """Find the stars within a radius of places (m, 2) of an image (h, w)."""
    if not 0.0 < radius_px <= MAX_RADIUS_PX:
        raise StaridError(f"radius_px: must be above 0 and at most {MAX_RADIUS_PX:g}, not {radius_px:g}")
    height, width = image.shape
    if min(height, width) < TILE_PX:
        raise StaridError(f"image: must be at least {TILE_PX}×{TILE_PX} pixels, not {width}×{height}")
    inner = np.all(
        (places >= _MIN_EDGE_PX) & (places <= (width - 1 - _MIN_EDGE_PX, height - 1 - _MIN_EDGE_PX)), axis=1
    )
    used = np.flatnonzero(inner)
    if used.size == 0:
        empty = np.full((TILE_PX, TILE_PX), 0, dtype=image.dtype)
        return Windows(detect(empty, settings), np.zeros(0), np.zeros(len(places), dtype=np.bool_))
    columns = int(np.ceil(np.sqrt(used.size)))
    rows = -(-used.size // columns)
    corners = np.clip(
        np.rint(places[used]).astype(np.int64) - TILE_PX // 2, 0, (width - TILE_PX, height - TILE_PX)
    )
    row, column = np.divmod(np.arange(rows * columns), columns)
    tiles = np.empty((rows, TILE_PX, columns, TILE_PX), dtype=image.dtype)
    for number in range(rows * columns):  # the last row is filled up with the first tiles
        x, y = corners[number % used.size]
        tiles[row[number], :, column[number]] = image[y : y + TILE_PX, x : x + TILE_PX]
    # a place in the mosaic is not that in the image, so its spots have one width
    quiet = dataclasses.replace(settings, follow_trails=False, block_px=BLOCK_PX, psf_growth=0.0)
    mosaic = tiles.reshape(rows * TILE_PX, columns * TILE_PX)
    detections = detect(mosaic, quiet)
    at = np.clip(np.floor((detections.xy_px + 0.5) / TILE_PX).astype(np.int64), 0, (columns - 1, rows - 1))
    tile = at[:, 1] * columns + at[:, 0]
    first = tile < used.size
    tile = np.where(first, tile, 0)
    xy = detections.xy_px - TILE_PX * at + corners[tile]
    distance = lengths(xy - places[used][tile])
    around = first & (distance <= MAX_RADIUS_PX)
    off = xy[:, None, :] - places[None, :, :]
    elsewhere = around & ~(np.sum(square(off), axis=2) <= radius_px * radius_px).any(axis=1)
    uneven = _uneven_tiles(mosaic, (rows, columns))[tile]
    searched = np.zeros(len(places), dtype=np.bool_)
    searched[used] = (tiles.max(axis=(1, 3)) > tiles.min(axis=(1, 3))).ravel()[: used.size]
    ratio = detections.flux / detections.flux_sigma
    no_noise = ratio >= np.minimum(ratio - _CLEARLY_SIGMA, _NOISE_SIGMA)[:, None]
    alike = (detections.flux >= _RIVAL_SHARE * detections.flux[:, None]) & (uneven == uneven[:, None])
    alike &= uneven | no_noise
    count = np.count_nonzero(elsewhere & alike, axis=1)
    rivals = count / (np.pi * (square(MAX_RADIUS_PX) - square(radius_px)))
    near = np.flatnonzero(around & (distance <= radius_px))
    near = near[np.argsort(distance[near], kind="stable")]
    pixel = np.rint(xy[near]).astype(np.int64)
    _, once = np.unique(pixel[:, 1] * width + pixel[:, 0], return_index=True)
    kept = np.sort(near[once])
    return Windows(_chosen(detections, xy, kept), rivals[kept], searched)


def _uneven_tiles(mosaic: GreyImage, shape: tuple[int, int]) -> Mask:
    """Whether the background of each tile (n,) differs between its quarters by more than the noise of a pixel."""
    background = estimate_background(mosaic, BLOCK_PX)
    quarters = background.level.reshape(shape[0], 2, shape[1], 2)
    noise = background.noise.reshape(quarters.shape).max(axis=(1, 3))
    return np.asarray((np.ptp(quarters, axis=(1, 3)) > _UNEVEN_SIGMA * noise).ravel())


def _chosen(detections: Detections, xy: Array, kept: Indices) -> Detections:
    return dataclasses.replace(
        detections,
        xy_px=xy[kept],
        **{
            name: getattr(detections, name)[kept]
            for name in ("flux", "flux_sigma", "xy_sigma_px", "correlation", "saturated", "edge")
        },
    )
