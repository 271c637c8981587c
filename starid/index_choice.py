"""Which index suits a camera: depth, pattern size and fineness from its field and its pixels."""

from __future__ import annotations

import hashlib
import math
from dataclasses import astuple
from pathlib import Path
from typing import Final

import numpy as np

from starid import index_file
from starid.cache import cache_dir
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.pattern_index import (
    INDEX_VERSION,
    IndexArrays,
    IndexSettings,
    build_arrays,
    field_solid_angle,
)

STARS_PER_FIELD: Final = 200
"""Catalogue stars a field, on the average, that the default limiting magnitude aims at."""

BRIGHTEST_LIMIT: Final = 6.0
FAINTEST_LIMIT: Final = 9.0
"""The default limiting magnitude stays between these: Hipparcos thins out beyond the second."""

LARGEST_QUOTA: Final = 20
SMALLEST_QUOTA: Final = 6
"""Pattern stars in half the field's area: many stand against false stars, few keep the index small."""

MIDDLE_SIDE: Final = 0.5
"""Where it comes to the choice, triangles may be up to this share of the field's width rather than more."""

MOST_PATTERNS: Final = 700_000
"""Triangles at most, about; narrow fields get them by keeping only the smaller ones."""

WIDEST_SIDE: Final = 0.95
NARROWEST_SIDE: Final = 0.12
"""Sides of a triangle as shares of the field's width."""

SIDE_BINS: Final = 56
_STARS_PER_QUOTA: Final = 30.0
"""Pattern stars of the whole sky, times the field's solid angle, over the quota; found by building."""

_TRIANGLES_PER_QUOTA2: Final = 6.0
"""Triangles a pattern star over (quota² · (longest side / width)⁴); found by building."""


def default_limiting_magnitude(catalog: StarCatalog, field_area_sr: float) -> float:
    """V to which a field holds `STARS_PER_FIELD` on the average, in steps of ¼, within 6…9."""
    wanted = STARS_PER_FIELD * 4.0 * math.pi / field_area_sr
    row = min(int(wanted), len(catalog)) - 1
    limit = math.ceil(4.0 * float(catalog.v[row])) / 4.0
    return min(max(limit, BRIGHTEST_LIMIT), FAINTEST_LIMIT)


def pixels_per_radian(camera: Camera) -> float:
    """Least pixels per radian anywhere in the field: the smaller singular value of the projection."""
    steps = np.linspace(0.0, 1.0, 9)
    grid = np.stack(np.meshgrid(steps * (camera.width - 1), steps * (camera.height - 1)), axis=-1)
    directions = camera.back_project(grid.reshape(-1, 2))
    directions = directions[np.isfinite(directions[:, 0])]
    values = np.linalg.svd(camera.jacobian(directions), compute_uv=False)
    return float(values[:, 1].min())


def index_settings(
    camera: Camera, catalog: StarCatalog, limiting_magnitude: float, blend_px: float, window_px: float
) -> IndexSettings:
    """Settings of the index that suits a camera.

    Parameters
    ----------
    camera, catalog
        What it is for.
    limiting_magnitude : float
        Faintest V.
    blend_px, window_px : float
        Distance within which two stars are seen as one, and the largest matching window, pixels.
    """
    area = field_solid_angle(camera)
    width = math.sqrt(area)
    least = pixels_per_radian(camera)
    window = window_px / least
    spacing = math.sqrt(4.0 * math.pi / max(len(catalog.brighter_than(limiting_magnitude)), 1))
    cube = MOST_PATTERNS * area / (_STARS_PER_QUOTA * _TRIANGLES_PER_QUOTA2 * MIDDLE_SIDE**4)
    quota = min(max(int(cube ** (1.0 / 3.0)), SMALLEST_QUOTA), LARGEST_QUOTA)
    triangles = MOST_PATTERNS * area / (_STARS_PER_QUOTA * quota)
    share = (triangles / (_TRIANGLES_PER_QUOTA2 * quota**2)) ** 0.25
    longest = min(share, WIDEST_SIDE) * width
    return IndexSettings(
        limiting_magnitude=limiting_magnitude,
        blend_rad=blend_px / least,
        window_rad=window,
        field_area_sr=area,
        longest_side_rad=min(longest, 0.9 * math.pi),
        shortest_side_rad=NARROWEST_SIDE * width,
        quota=quota,
        cells_per_edge=max(int(0.5 * math.pi / max(window, 0.7 * spacing)), 1),
        side_bins=SIDE_BINS,
    )


def obtain_index(stars: StarCatalog, settings: IndexSettings, cache: bool | str | Path) -> IndexArrays:
    """Map the index from the cache, or build it and keep it there.

    Parameters
    ----------
    stars : StarCatalog
        As `starid.pattern_index.seen_stars` gives them.
    settings : IndexSettings
        What to build.
    cache : bool or path
        The cache folder, a folder given, or (False) memory only.
    """
    text = repr((INDEX_VERSION, stars.identity, astuple(settings)))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    if cache is False:
        return index_file.unpack(index_file.pack(build_arrays(stars, settings), key), key)
    folder = cache_dir() if cache is True else Path(cache)
    path = folder / f"index-{key}.bin"
    return index_file.load(path, key) or index_file.store(path, build_arrays(stars, settings), key)
