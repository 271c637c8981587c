"""Sky objects besides the catalogue stars: bodies, stray light, obstructions, false and missing stars.

All are plain values for profiles and tests; `starhil.emulator.sensor.sky.light` renders them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Self

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.limited import limited, listed
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import cos, sin

_MAX_OBJECTS: Final = 100_000

LENS_SCATTER: Final = 0.012
"""Fraction of a source's light that a clean lens scatters, falling with the square of the angle: that of ten polished
surfaces at 10° (Harvey's law with b0 = 0.1/sr, a knee at 0.01 rad and slope −1.5, as FRED assumes them)."""

SUN_V: Final = -26.74
"""V of the Sun at 1 au (Allen's Astrophysical Quantities, 4th edition)."""

MAX_ROWS: Final = 200
"""Most planets, obstructions, or corners of an obstruction."""


def icrs_vector(ra_deg: float, dec_deg: float) -> Array:
    """Unit vector (3,) of a direction."""
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([cos(dec) * cos(ra), cos(dec) * sin(ra), sin(dec)])


@dataclass(frozen=True)
class CelestialBody:
    """Something in one direction of the sky."""

    ra_deg: float = limited(-360.0, 360.0)
    dec_deg: float = limited(-90.0, 90.0)
    """Direction of its centre, ICRS."""

    @cached_property
    def direction(self) -> Array:
        """Direction (3,) of its centre, ICRS."""
        return icrs_vector(self.ra_deg, self.dec_deg)

    @property
    def radius_rad(self) -> float:
        """Angular radius of its disc; 0 if it has none in the image."""
        return 0.0


@dataclass(frozen=True)
class Moon(CelestialBody):
    """The Moon: a saturated disc, and its light scattered in the lens."""

    diameter_deg: float = limited(1e-3, 90.0, 0.52)
    """Apparent diameter."""
    magnitude: float = limited(-30.0, 20.0, -12.7)
    """V of the whole disc; −12.7 when full."""
    illuminated: float = limited(0.0, 1.0, 1.0)
    """Illuminated fraction of the disc, 0…1."""
    bright_limb_deg: float = limited(-360.0, 360.0, 90.0)
    """Position angle of the midpoint of the bright limb, from north through east."""
    glare_share: float = limited(0.0, 1.0, LENS_SCATTER)
    """Fraction of its light that the lens scatters over the field; falls with the square of the angle."""
    exclusion_deg: float = limited(0.0, 180.0, 0.0)
    """Angle from the boresight within which moonlight passes the baffle and saturates the image."""
    reach_deg: float = limited(0.0, 180.0, 180.0)
    """Angle from the boresight beyond which none of its light enters the lens."""

    @property
    def radius_rad(self) -> float:
        """Angular radius of its disc."""
        return math.radians(self.diameter_deg) / 2.0


@dataclass(frozen=True)
class SunGlare(CelestialBody):
    """The Sun: stray light, and in the field of view a disc whose light, scattered in the lens, saturates the image."""

    stray_share: float = limited(0.0, 1.0, 1e-5)
    """Fraction that a baffle leaves of the light that a bare lens would scatter at 30° from the Sun; falls with the cube
    of the angle. The default is a point-source transmittance of some 7e-9 at 30° with a 12 mm f/1.2 lens."""
    decade_deg: float = limited(0.0, 90.0, 0.0)
    """Angle in which what the baffle leaves falls tenfold, from all at the exclusion angle to `stray_share`; 0: at once."""
    exclusion_deg: float = limited(0.0, 180.0, 0.0)
    """Angle from the boresight within which sunlight passes the baffle and saturates the image."""
    reach_deg: float = limited(0.0, 180.0, 180.0)
    """Angle from the boresight beyond which no sunlight enters the lens."""

    @property
    def radius_rad(self) -> float:
        """Angular radius of its disc."""
        return self.disc.radius_rad

    @cached_property
    def disc(self) -> Moon:
        """Its disc: the mean diameter and V of the Sun, with the light that a lens scatters from the Moon's."""
        return Moon(self.ra_deg, self.dec_deg, diameter_deg=0.533, magnitude=SUN_V)


@dataclass(frozen=True)
class EarthLimb(CelestialBody):
    """The Earth's disc in front of part of the sky."""

    radius_deg: float = limited(0.1, 179.0, 64.0)
    """Angular radius of the Earth; 64° at an altitude of 700 km."""
    albedo: float = limited(0.0, 1.0, 0.3)
    """Fraction of the sunlight that the disc reflects, in all directions alike; 0 for a dark disc, 0.3 on average."""
    atmosphere_deg: float = limited(1e-3, 20.0, 0.15)
    """Angular height over which the limb fades."""
    exclusion_deg: float = limited(0.0, 180.0, 0.0)
    """Angle between the boresight and the nearest point of the disc, if that is lit, within which its light passes
    the baffle and saturates the image; 0 for no baffle."""
    stray_share: float = limited(0.0, 1.0, 0.0)
    """Fraction that a baffle leaves of the light of the disc, as for the Sun, whose default is 1e-5; 0: none is scattered."""
    sun_ra_deg: float | None = limited(-360.0, 360.0, None)
    sun_dec_deg: float | None = limited(-90.0, 90.0, None)
    """Direction of the Sun, which lights the half of the Earth that faces it; by default all of the disc is lit."""

    def __post_init__(self) -> None:
        if (self.sun_ra_deg is None) != (self.sun_dec_deg is None):
            raise EmulatorError("sun_ra_deg and sun_dec_deg belong together; give both or neither")

    @cached_property
    def sun_direction(self) -> Array | None:
        """Direction (3,) of the Sun that lights it, ICRS; None if all of the disc is lit."""
        if self.sun_ra_deg is None or self.sun_dec_deg is None:
            return None
        return icrs_vector(self.sun_ra_deg, self.sun_dec_deg)

    @property
    def radius_rad(self) -> float:
        """Angular radius of its disc."""
        return math.radians(self.radius_deg)


@dataclass(frozen=True)
class PointSource(CelestialBody):
    """A planet, satellite or other point source that is not in the star catalogue."""

    magnitude: float = limited(-30.0, 20.0)
    """V magnitude in the sensor's band."""
    name: str = ""
    """Name in the truth."""


@dataclass(frozen=True)
class Constellation:
    """Satellites on circular orbits around the Earth; the defaults are the first shell of Starlink."""

    count: int = limited(1, 20_000, 1584)
    """Number of satellites."""
    planes: int = limited(1, 20_000, 72)
    """Number of orbital planes, evenly spread over all nodes."""
    altitude_km: float = limited(150.0, 50_000.0, 550.0)
    """Altitude of all of them."""
    inclination_deg: float = limited(0.0, 180.0, 53.0)
    """Inclination of the planes."""
    magnitude: float = limited(-20.0, 30.0, 5.9)
    """V of one at a range of 1000 km, half lit (phase angle 90°)."""


@dataclass(frozen=True)
class CatalogError:
    """A star that the unit's catalogue has at another place, or with another magnitude, than the sky."""

    hip: int = limited(1, 200_000)
    """Hipparcos number."""
    east_arcsec: float = limited(-648_000.0, 648_000.0, 0.0)
    north_arcsec: float = limited(-324_000.0, 324_000.0, 0.0)
    """Where the sky shows it, as seen from its place in the catalogue."""
    fainter: float = limited(-20.0, 20.0, 0.0, unit="magnitudes")
    """By how much the sky shows it fainter than in the catalogue."""


@dataclass(frozen=True)
class Obstruction:
    """A dark object near the lens that covers the image beyond a straight edge or inside a polygon."""

    share: float = limited(0.0, 1.0, 0.5)
    """Fraction of the image beyond the edge, 0…1; not used with a polygon."""
    angle_deg: float = limited(-360.0, 360.0, 0.0)
    """Direction from the image to the covered side, 0 to the right, 90 down."""
    polygon_px: tuple[tuple[float, float], ...] = limited(-1e5, 1e5, (), most=MAX_ROWS)
    """Corners, pixels; empty for an edge."""
    softness_px: float = limited(0.0, 1000.0, 3.0)
    """Blur of the out-of-focus outline, pixels."""


@dataclass(frozen=True)
class SkyObjects:
    """Everything that changes an image besides the catalogue stars."""

    moon: Moon | None = None
    sun: SunGlare | None = None
    earth: EarthLimb | None = None
    """The bodies, if present."""
    planets: tuple[PointSource, ...] = listed(MAX_ROWS)
    """Point sources at fixed directions."""
    satellites: Constellation | None = None
    """Satellites whose trails cross the image; seen from an orbit."""
    obstructions: tuple[Obstruction, ...] = listed(MAX_ROWS)
    """Objects that cover parts of the image."""
    false_stars: int = limited(0, _MAX_OBJECTS, 0)
    """Number of false stars at random positions that change with every frame."""
    fixed_false_stars: int = limited(0, _MAX_OBJECTS, 0)
    """Number of false stars at random positions that stay the same during a run."""
    false_star_magnitudes: tuple[float, float] = limited(-5.0, 20.0, (1.0, 5.5))
    """Range of the magnitudes of false stars, brighter first; uniformly distributed."""
    star_position_noise_px: float = limited(0.0, 100.0, 0.0)
    """Standard deviation of a displacement of each star along each axis, random in every frame: the position noise with
    which Özyurt's thesis tests its algorithms, in addition to the sensor's own noise."""
    star_magnitude_noise: float = limited(0.0, 5.0, 0.0)
    """The same of a change of each star's magnitude."""
    ghost_share: float = limited(0.0, 1.0, 0.0)
    """Fraction of the light of each star, planet and of the Moon that reflections in the lens bring to the place mirrored
    through its axis."""
    catalog_position_error_arcsec: float = limited(0.0, 3600.0, 0.0)
    """Standard deviation, along each axis, of the errors of places in the unit's catalogue: the sky shows each star elsewhere, at the
    same place in all frames."""
    catalog_magnitude_error: float = limited(0.0, 5.0, 0.0)
    """The same of its magnitudes."""
    catalog_errors: tuple[CatalogError, ...] = listed(MAX_ROWS)
    """Single stars that the sky shows elsewhere than in the unit's catalogue, or brighter or fainter."""
    missing_stars: int = limited(0, _MAX_OBJECTS, 0)
    """Number of catalogue stars omitted, the brightest in the field."""
    cosmic_rays_s: float = limited(0.0, 1e6, 0.0)
    """Mean number of particles per second that hit the detector, each leaving thousands of electrons in few pixels."""
    blank: bool = False
    """True if no light reaches the detector."""

    def __post_init__(self) -> None:
        low, high = self.false_star_magnitudes
        if low > high:
            raise EmulatorError(f"false_star_magnitudes: {low:g} to {high:g}; put the brighter one first")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Make sky objects from a table that is valid (`starhil.emulator.sensor.sky.tables`).

        The keys are the fields of this class. Bodies and `satellites` are tables of their fields; `planets`, `catalog_errors` and
        `obstructions` are lists of tables. `blocked_share` adds an obstruction with a straight edge.
        """
        fields = dict(values)
        share = fields.pop("blocked_share", 0.0)
        for name, kind in BODY_KINDS.items():
            if fields.get(name) is not None:
                fields[name] = kind(**fields[name])
        if fields.get("satellites") is not None:
            fields["satellites"] = Constellation(**fields["satellites"])
        fields["planets"] = tuple(PointSource(**row) for row in fields.get("planets", ()))
        fields["catalog_errors"] = tuple(CatalogError(**row) for row in fields.get("catalog_errors", ()))
        edge = [Obstruction(share=share)] if share else []
        fields["obstructions"] = (*(_obstruction(row) for row in fields.get("obstructions", ())), *edge)
        if "false_star_magnitudes" in fields:
            fields["false_star_magnitudes"] = tuple(fields["false_star_magnitudes"])
        return cls(**fields)

    @property
    def has_extended_objects(self) -> bool:
        """Whether anything lights or covers an area of the image."""
        return bool(self.moon or self.sun or self.earth or self.obstructions or self.blank)


BODY_KINDS: Final[dict[str, type[CelestialBody]]] = {"moon": Moon, "sun": SunGlare, "earth": EarthLimb}
"""Fields of `SkyObjects` that are bodies, and their classes."""


def _obstruction(table: Mapping[str, Any]) -> Obstruction:
    corners = tuple((x, y) for x, y in table.get("polygon_px", ()))
    return Obstruction(**{**table, "polygon_px": corners})
