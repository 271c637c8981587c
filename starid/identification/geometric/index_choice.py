"""Choice of the index for a camera: depth, pattern size and resolution, from the field and the pixels."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.arithmetic.elementary import power, square
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric import index_file
from starid.identification.geometric.pattern_index import (
    INDEX_VERSION,
    IndexArrays,
    IndexSettings,
    build_arrays,
    field_solid_angle,
    resolved_stars,
)
from starid.storage.cache import Tables, cache_dir, cached_tables, evict, mark_used

STARS_PER_FIELD: Final = 200
"""Mean number of catalogue stars per field at the default limiting magnitude."""

BRIGHTEST_LIMIT: Final = 6.0
FAINTEST_LIMIT: Final = 9.0
"""Range of the default limiting magnitude; beyond the faint end Hipparcos is incomplete."""

BRIGHT_QUOTA: Final = 5
LARGEST_QUOTA: Final = 20
SMALLEST_QUOTA: Final = 6
"""Pattern stars in half the area of the field: a few bright ones, and as many deep ones as fit."""

MAX_BRIGHT: Final = 120_000
MAX_DEEP: Final = 420_000
"""Approximate limits on the number of triangles of bright and of deep pattern stars."""

BRIGHT_SIDES: Final = (0.04, 1.3)
DEEP_SIDES: Final = (0.12, 0.95)
"""Shortest and longest side as a share of the width of the field; smaller longest side in narrow fields."""

MIDDLE_SIDE: Final = 0.5
"""Below this share the number of deep pattern stars is reduced, not their longest side."""

COARSEST_PX_PER_DEG: Final = 2.0
"""Coarsest image for which an index is built: below this, stars a degree apart are one, and merging them takes minutes."""

SIDE_BINS: Final = 128
_STARS_PER_QUOTA: Final = 30.0
"""(Pattern stars in the whole sky) · (solid angle of the field) / quota; measured on indices."""

_TRIANGLES_PER_QUOTA2: Final = 6.0
"""(Triangles per pattern star) / (quota² · (longest side / width)⁴); measured on indices."""


_MERGED_COLUMNS: Final = ("vectors", "ra_rad", "dec_rad", "hp", "v")
"""Columns of the catalogue that differ for merged stars."""


def default_limiting_magnitude(catalog: StarCatalog, field_area_sr: float) -> float:
    """V limit at which a field has `STARS_PER_FIELD` on average, in steps of ¼, within 6…9."""
    wanted = STARS_PER_FIELD * 4.0 * math.pi / field_area_sr
    row = min(int(wanted), len(catalog)) - 1
    limit = math.ceil(4.0 * float(catalog.v[row])) / 4.0
    return min(max(limit, BRIGHTEST_LIMIT), FAINTEST_LIMIT)


def pixels_per_radian(camera: Camera) -> float:
    """Lowest scale in the field, pixels per radian: the smaller singular value of the projection."""
    steps = np.linspace(0.0, 1.0, 9)
    grid = np.stack(np.meshgrid(steps * (camera.width - 1), steps * (camera.height - 1)), axis=-1)
    directions = camera.back_project(grid.reshape(-1, 2))
    directions = directions[np.isfinite(directions[:, 0])]
    slopes = camera.jacobian(directions)
    u, v = slopes[:, 0], slopes[:, 1]
    uu, uv, vv = np.sum(square(u), axis=1), np.sum(u * v, axis=1), np.sum(square(v), axis=1)
    smaller = 0.5 * (uu + vv - np.sqrt(square(uu - vv) + 4.0 * square(uv)))
    return math.sqrt(float(smaller.min()))


def index_settings(
    camera: Camera, catalog: StarCatalog, limiting_magnitude: float, blend_px: float, window_px: float
) -> IndexSettings:
    """Choose the settings of the index for a camera.

    Parameters
    ----------
    camera, catalog
        Camera and catalogue of the index.
    limiting_magnitude : float
        Faintest V.
    blend_px, window_px : float
        Distance below which two stars are merged, and the largest matching window, pixels.

    Raises
    ------
    StaridError
        The image is coarser than `COARSEST_PX_PER_DEG`.
    """
    least = pixels_per_radian(camera)
    if not math.radians(least) >= COARSEST_PX_PER_DEG:
        raise StaridError(
            f"index: {math.radians(least):.3g} pixels per degree are too few to tell stars apart; "
            f"at least {COARSEST_PX_PER_DEG:g} are needed: use a longer focal length or more pixels"
        )
    area = field_solid_angle(camera)
    width = math.sqrt(area)
    window = window_px / least
    spacing = math.sqrt(4.0 * math.pi / max(len(catalog.brighter_than(limiting_magnitude)), 1))
    cube = MAX_DEEP * area / (_STARS_PER_QUOTA * _TRIANGLES_PER_QUOTA2 * square(square(MIDDLE_SIDE)))
    quota = min(max(int(power(cube, 1.0 / 3.0)), SMALLEST_QUOTA), LARGEST_QUOTA)
    deep = min(_longest_share(MAX_DEEP, quota, area), DEEP_SIDES[1])
    bright = max(min(_longest_share(MAX_BRIGHT, BRIGHT_QUOTA, area), BRIGHT_SIDES[1]), deep)
    return IndexSettings(
        limiting_magnitude=limiting_magnitude,
        blend_rad=blend_px / least,
        window_rad=window,
        field_area_sr=area,
        bright_sides_rad=(BRIGHT_SIDES[0] * width, min(bright * width, 0.9 * math.pi)),
        deep_sides_rad=(DEEP_SIDES[0] * width, min(deep * width, 0.9 * math.pi)),
        bright_quota=BRIGHT_QUOTA,
        deep_quota=quota,
        cells_per_edge=max(int(0.5 * math.pi / max(window, 0.7 * spacing)), 1),
        side_bins=SIDE_BINS,
    )


def _longest_share(triangles: int, quota: int, area: float) -> float:
    """Longest side, as a share of the width of the field, for about a given number of triangles."""
    per_star = triangles * area / (_STARS_PER_QUOTA * quota)
    return math.sqrt(math.sqrt(per_star / (_TRIANGLES_PER_QUOTA2 * square(quota))))


def obtain_stars(catalog: StarCatalog, settings: IndexSettings, cache: bool | str | Path) -> StarCatalog:
    """Return the stars of an index (`resolved_stars`), from the cache if it is the cache folder (True)."""

    def build() -> Tables:
        stars = resolved_stars(catalog, settings.limiting_magnitude, settings.blend_rad)
        return {name: getattr(stars, name) for name in ("hip", *_MERGED_COLUMNS)}

    text = repr((INDEX_VERSION, catalog.identity, settings.limiting_magnitude, settings.blend_rad))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    stars = cached_tables(f"stars-{key}", build) if cache is True else build()
    rows = catalog.index_of(stars["hip"])
    merged: dict[str, Any] = {name: stars[name] for name in _MERGED_COLUMNS}
    return dataclasses.replace(catalog.subset(rows), **merged)


def obtain_index(stars: StarCatalog, settings: IndexSettings, cache: bool | str | Path) -> IndexArrays:
    """Map the index from the cache, or build and cache it.

    Parameters
    ----------
    stars : StarCatalog
        From `obtain_stars`.
    settings : IndexSettings
        From `index_settings`.
    cache : bool or path
        True for the cache folder, a path for another folder, False for memory only.
    """
    text = repr((INDEX_VERSION, stars.identity, dataclasses.astuple(settings)))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    if cache is False:
        return index_file.unpack(index_file.pack(build_arrays(stars, settings), key), key)
    folder = cache_dir() if cache is True else Path(cache)
    path = folder / f"index-{key}.bin"
    stored = index_file.load(path, key)
    if stored is not None:
        if cache is True:
            mark_used(path)
        return stored
    built = index_file.store(path, build_arrays(stars, settings), key)
    evict(keep=path)
    return built
