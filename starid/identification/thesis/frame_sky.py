"""Catalogue stars for the frames of a database: features of any frame, computed from the stars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices, elementwise
from starid.arithmetic.elementary import asin, atan, cos, sin, square
from starid.errors import StaridError
from starid.identification.thesis.features import (
    SUM_COUNT,
    FeatureVector,
    add_star,
    clear_sums,
    feature_vector,
    finish_features,
)
from starid.identification.thesis.frame_grid import Geometry
from starid.kernels.jit import compiled, inner_checked

Direction = Literal["faintest", "brightest"]

BIN_DEG: Final = 5.0
"""Side of the bins for looking up stars, degrees."""

DEC_BINS: Final = 36
RA_BINS: Final = 72

BRIGHTNESS, RIGHT_ASCENSION, DECLINATION, UX, UY, UZ = range(6)
"""Columns of the star table: magnitude, degrees, degrees, unit vector."""

SPHERICAL, HALF_WIDTH, FULL_FIELD, FOCAL, REACH, PIVOT = range(6)
"""Indices into `SkyArrays.frame`: two are flags, lengths are in degrees or pixels, REACH is in degrees."""


class SkyError(StaridError):
    """Stars or a frame from which no database can be made."""


class SkyArrays(NamedTuple):
    """Arrays of a `FrameSky` for the kernels: stars, first star of each bin, numbers of the frame."""

    stars: Array
    bin_start: Indices
    frame: Array


@inner_checked
def bins_near(ra_deg: float, dec_deg: float, reach_deg: float, spherical: bool) -> tuple[int, int, int, int]:
    """Bins within reach of a position: first and last band, first bin in α, and number of bins."""
    low = max(math.floor((dec_deg - reach_deg + 90.0) / BIN_DEG), 0)
    high = min(math.floor((dec_deg + reach_deg + 90.0) / BIN_DEG), DEC_BINS - 1)
    window = reach_deg
    if spherical:
        window = 180.0
        if abs(dec_deg) + reach_deg < 90.0:
            ratio = sin(math.radians(reach_deg)) / cos(math.radians(dec_deg))
            window = math.degrees(asin(min(ratio, 1.0)))
    first = math.floor((ra_deg - window) / BIN_DEG)
    count = min(math.floor((ra_deg + window) / BIN_DEG) - first + 1, RA_BINS)
    return low, high, first % RA_BINS, count


@inner_checked
def stars_of_bins(bin_start: Indices, band: int, first: int, count: int, part: int) -> tuple[int, int]:
    """Range of the stars in bins of a band, up to the end of the band (part 0) or wrapped (part 1)."""
    end = min(first + count, RA_BINS)
    start = band * RA_BINS + (first if part == 0 else 0)
    stop = band * RA_BINS + (end if part == 0 else first + count - RA_BINS)
    if stop <= start:
        return 0, 0
    return bin_start[start], bin_start[stop]


@inner_checked
def position_cosines(ra_deg: float, dec_deg: float) -> tuple[float, float, float, float]:
    """Cosines and sines of α and δ of a position."""
    a, d = math.radians(ra_deg), math.radians(dec_deg)
    return cos(a), sin(a), cos(d), sin(d)


@compiled
def gnomonic(
    ux: float, uy: float, uz: float, turn: tuple[float, float, float, float], focal: float
) -> tuple[float, float]:
    """Offset of a star in a frame with north up, +x right, +y down; infinite behind the camera."""
    cos_a, sin_a, cos_d, sin_d = turn
    level = cos_a * ux + sin_a * uy
    depth = cos_d * level + sin_d * uz
    if depth <= 0.0:
        return math.inf, math.inf
    east = cos_a * uy - sin_a * ux
    return -focal * east / depth, -focal * (cos_d * uz - sin_d * level) / depth


@inner_checked
def flat_offset(star_ra: float, star_dec: float, ra_deg: float, dec_deg: float) -> tuple[float, float]:
    """Offset of a star in the flat plane, degrees; right ascension wraps."""
    x = star_ra - ra_deg
    if x > 180.0:
        x -= 360.0
    elif x < -180.0:
        x += 360.0
    return x, star_dec - dec_deg


@inner_checked
def cell_sums(sky: SkyArrays, ra_deg: float, dec_deg: float, sums: Array) -> None:
    """Accumulate the stars of the frame centred at (ra, dec), 0 ≤ ra < 360."""
    stars, bin_start, frame = sky
    clear_sums(sums)
    half = frame[HALF_WIDTH]
    half2 = half * half
    spherical = frame[SPHERICAL] > 0.5
    full = frame[FULL_FIELD] > 0.5
    turn = position_cosines(ra_deg, dec_deg) if spherical else (1.0, 0.0, 1.0, 0.0)
    low, high, first, count = bins_near(ra_deg, dec_deg, frame[REACH], spherical)
    for band in range(low, high + 1):
        for part in range(2):
            begin, end = stars_of_bins(bin_start, band, first, count, part)
            for i in range(begin, end):
                if spherical:
                    x, y = gnomonic(stars[i, UX], stars[i, UY], stars[i, UZ], turn, frame[FOCAL])
                else:
                    x, y = flat_offset(stars[i, RIGHT_ASCENSION], stars[i, DECLINATION], ra_deg, dec_deg)
                if (full and abs(x) <= half and abs(y) <= half) or (not full and x * x + y * y <= half2):
                    add_star(sums, stars[i, BRIGHTNESS], x, y, frame[PIVOT])


@inner_checked
def stars_near(
    sky: SkyArrays, ra_deg: float, dec_deg: float, margin: float, spots: Array, rows: Indices
) -> int:
    """List the stars of a circular frame with north up, and a margin around it; return their number.

    `spots` (n, 3) receives x, y in the unit of the frame and the magnitude, `rows` (n,) their rows.
    """
    stars, bin_start, frame = sky
    spherical = frame[SPHERICAL] > 0.5
    limit = square(frame[HALF_WIDTH] + margin)
    reach = frame[HALF_WIDTH] + margin
    if spherical:
        reach = math.degrees(atan(reach / frame[FOCAL]))
    turn = position_cosines(ra_deg, dec_deg)
    low, high, first, bins = bins_near(ra_deg, dec_deg, reach, spherical)
    count = 0
    for band in range(low, high + 1):
        for part in range(2):
            begin, end = stars_of_bins(bin_start, band, first, bins, part)
            for i in range(begin, end):
                if spherical:
                    x, y = gnomonic(stars[i, UX], stars[i, UY], stars[i, UZ], turn, frame[FOCAL])
                else:
                    x, y = flat_offset(stars[i, RIGHT_ASCENSION], stars[i, DECLINATION], ra_deg, dec_deg)
                if x * x + y * y <= limit and count < spots.shape[0]:
                    spots[count, 0] = x
                    spots[count, 1] = y
                    spots[count, 2] = stars[i, BRIGHTNESS]
                    rows[count] = i
                    count += 1
    return count


@compiled
def cell_features(sky: SkyArrays, ra_deg: float, dec_deg: float, sums: Array, out: Array) -> float:
    """Write the features of the frame centred at (ra, dec) to `out`; return the polar angle in radians."""
    cell_sums(sky, ra_deg, dec_deg, sums)
    return finish_features(sums, sky.frame[PIVOT], out)


@dataclass(frozen=True, eq=False)
class FrameSky:
    """Stars within the brightness limit, binned by position, and the shape of a frame.

    Attributes
    ----------
    geometry
        "planar" (offsets x = α − α_c, y = δ − δ_c in degrees) or "spherical" (gnomonic offsets in pixels, +x
        right and +y down for a camera with north up).
    half_width
        Half-width of a frame: degrees for planar, pixels for spherical.
    full_field
        The whole square (True) or the inscribed circle.
    focal_px
        Focal length in pixels for the spherical geometry, 0 for the planar one.
    stars
        Table (n, 6): brightness, α, δ in degrees, unit vector; sorted by bin.
    bin_start
        First star of each bin, (36·72 + 1,).
    source
        Row of each star in the arrays from which the sky was made, (n,).
    """

    geometry: Geometry
    half_width: float
    full_field: bool
    focal_px: float
    stars: Array
    bin_start: Indices
    source: Indices

    @cached_property
    def frame(self) -> Array:
        """Numbers that describe a frame, for the kernels, (6,)."""
        reach = self.half_width
        corner = math.sqrt(2.0) if self.full_field else 1.0
        if self.geometry == "spherical":
            reach = math.degrees(atan(corner * self.half_width / self.focal_px))
        pivot = float(np.median(self.stars[:, BRIGHTNESS])) if self.stars.size else 0.0
        return np.array(
            [
                1.0 if self.geometry == "spherical" else 0.0,
                self.half_width,
                1.0 if self.full_field else 0.0,
                self.focal_px,
                reach,
                pivot,
            ]
        )

    @cached_property
    def arrays(self) -> SkyArrays:
        return SkyArrays(self.stars, self.bin_start, self.frame)

    def features(self, ra_deg: float, dec_deg: float) -> FeatureVector:
        """Feature vector of the frame centred at (ra, dec), degrees, north up.

        Raises
        ------
        SkyError
            No star is in the frame.
        """
        out = np.empty(5)
        theta = float(cell_features(self.arrays, ra_deg, dec_deg, np.empty(SUM_COUNT), out))
        if out[0] < 1.0:
            raise SkyError(
                f"sky: no star in the frame at ({ra_deg:.3f}°, {dec_deg:.3f}°) within the brightness limit"
            )
        return feature_vector(out, theta)

    def stars_in_frame(self, ra_deg: float, dec_deg: float) -> tuple[Array, Array, Indices]:
        """Brightness (n,), offsets (n, 2), source rows (n,) of the stars in the frame at (ra, dec)."""
        x, y = self.offsets(ra_deg, dec_deg)
        if self.full_field:
            inside = np.maximum(abs(x), abs(y)) <= self.half_width
        else:
            inside = x * x + y * y <= self.half_width * self.half_width
        return self.stars[inside, BRIGHTNESS], np.column_stack([x[inside], y[inside]]), self.source[inside]

    def offsets(self, ra_deg: float, dec_deg: float) -> tuple[Array, Array]:
        """Offsets x, y of all stars from the frame centre; infinite behind the camera."""
        if self.geometry == "planar":
            x = self.stars[:, RIGHT_ASCENSION] - ra_deg
            return x - 360.0 * np.rint(x / 360.0), self.stars[:, DECLINATION] - dec_deg
        a, d = math.radians(ra_deg), math.radians(dec_deg)
        east = cos(a) * self.stars[:, UY] - sin(a) * self.stars[:, UX]
        level = cos(a) * self.stars[:, UX] + sin(a) * self.stars[:, UY]
        depth = cos(d) * level + sin(d) * self.stars[:, UZ]
        north = cos(d) * self.stars[:, UZ] - sin(d) * level
        ahead = depth > 0.0
        scale = np.where(ahead, self.focal_px / np.where(ahead, depth, 1.0), np.inf)
        with np.errstate(invalid="ignore"):
            return np.where(ahead, -east * scale, np.inf), np.where(ahead, -north * scale, np.inf)


def make_frame_sky(
    ra_deg: Array,
    dec_deg: Array,
    brightness: Array,
    *,
    geometry: Geometry,
    half_width: float,
    kappa: float,
    direction: Direction,
    full_field: bool = False,
    focal_px: float = 0.0,
) -> FrameSky:
    """Select the stars within the brightness limit and bin them.

    Parameters
    ----------
    ra_deg, dec_deg, brightness
        Stars, (n,): degrees, degrees, magnitudes. Stars with a value that is not finite are left out.
    geometry, half_width, full_field, focal_px
        See `FrameSky`.
    kappa
        Brightness limit κ.
    direction
        "faintest" keeps a ≥ κ, as in all published numbers; "brightest" keeps a ≤ κ, as a sensor does.

    Raises
    ------
    SkyError
        No star is left, or the frame is not valid.
    """
    if direction not in ("faintest", "brightest"):
        raise SkyError(f"sky: brightness direction must be faintest or brightest, not {direction!r}")
    if geometry == "spherical" and not focal_px > 0.0:
        raise SkyError("sky: the spherical geometry needs the focal length of the camera in pixels")
    if not half_width > 0.0:
        raise SkyError(f"sky: half-width of the frame must be positive, not {half_width}")
    keep = (brightness >= kappa) if direction == "faintest" else (brightness <= kappa)
    source = np.flatnonzero(keep & np.isfinite(ra_deg) & np.isfinite(dec_deg) & np.isfinite(brightness))
    if source.size == 0:
        raise SkyError(f"sky: no star is {direction} than {kappa} mag; change the limit or its direction")
    ra = ra_deg[source] % 360.0
    dec = dec_deg[source]
    a, d = np.radians(ra), np.radians(dec)
    band = np.clip(np.floor((dec + 90.0) / BIN_DEG), 0, DEC_BINS - 1).astype(np.int64)
    place = np.clip(np.floor(ra / BIN_DEG), 0, RA_BINS - 1).astype(np.int64)
    bins = band * RA_BINS + place
    order = np.argsort(bins, kind="stable")
    (ca, sa), (cd, sd) = ([elementwise(function, angles) for function in (cos, sin)] for angles in (a, d))
    table = np.column_stack([brightness[source], ra, dec, cd * ca, cd * sa, sd])
    bin_start = np.searchsorted(bins[order], np.arange(DEC_BINS * RA_BINS + 1)).astype(np.int64)
    return FrameSky(
        geometry,
        half_width,
        full_field,
        focal_px,
        np.ascontiguousarray(table[order]),
        bin_start,
        source[order],
    )
