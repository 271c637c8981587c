"""Sun, Moon, Earth and planets as an observer sees them at a date, by the series of `erfa`.

All directions are apparent: with light time, the observer's parallax and aberration. The Sun's place is good
to 0.1″, the Moon's to 20″ (`erfa.moon98`), the planets' to 1.5′ (`erfa.plan94`). Magnitudes of the planets
follow Mallama & Hilton 2018, Saturn's with its rings. The series are evaluated once per slot of ten minutes, and the
motion within it is interpolated: Earth, Sun and Moon on cubics through places and velocities at both ends (1 m and
20 µm/s), the planets on straight lines (0.01″ for Mercury).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from starhil.emulator.sensor.sky.objects import CelestialBody, EarthLimb, Moon, PointSource, SunGlare
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import acos, asin, atan, atan2, cos, exp, hypot, log10, sin, square
from starid.arithmetic.matrices import dot, length, lengths
from starid.catalog.aberration import SPEED_OF_LIGHT_M_S, aberrated
from starid.catalog.earth import ASTRONOMICAL_UNIT_M, DAY_S, in_metres, terrestrial_time

Vector = Array

SUN_RADIUS_M: Final = 6.957e8
MOON_RADIUS_M: Final = 1.7374e6
EARTH_RADIUS_M: Final = 6.371e6
SMALLEST_EARTH_RAD: Final = math.radians(0.1)
"""Angular radius below which the Earth is not drawn."""
MOON_DISTANCE_M: Final = 3.844e8
"""Mean distance of the Moon, for which its magnitude is given."""

ATMOSPHERE_M: Final = 12_000.0
"""Height over which the Earth's limb fades."""

_PLANETS: Final[tuple[tuple[str, int, tuple[float, ...]], ...]] = (
    ("Mercury", 1, (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)),
    ("Venus", 2, (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)),
    ("Mars", 4, (-1.601, 2.267e-2, -1.302e-4)),
    ("Jupiter", 5, (-9.395, -3.7e-4, 6.16e-4)),
    ("Saturn", 6, (-8.914, 0.026)),
    ("Uranus", 7, (-7.110,)),
    ("Neptune", 8, (-7.00,)),
)
"""Name, number in `erfa.plan94`, and V at 1 au from Sun and Earth as a polynomial in the phase angle, degrees."""

_SATURN_POLE: Final = (0.08547, 0.07323, 0.99365)
"""Direction of the pole of Saturn's rings, ICRS (IAU 2015: right ascension 40.589°, declination 83.537°)."""

_LIGHT_TIME_ROUNDS: Final = 2

SLOT_S: Final = 600.0
"""Length of a slot of time; leap seconds fall between two."""


@dataclass(frozen=True)
class Observer:
    """Date, place and velocity of the sensor."""

    unix_s: float
    offset_m: Vector | None = None
    relative_velocity_m_s: Vector | None = None
    """Position and velocity relative to the Earth's centre, GCRS, (3,); None: at the centre, without an Earth."""

    @cached_property
    def _motion(self) -> Vector:
        """Barycentric places (3, 3) of Earth, Sun and Moon, m, and then their velocities (3, 3), m/s, ICRS."""
        slot, since_s = divmod(self.unix_s, SLOT_S)
        share = since_s / SLOT_S
        a, b, c, d, u, v, w = _polynomials_of(int(slot)).reshape(7, 3, 3)
        place = a + share * (b + share * (c + share * d))
        velocity = u + share * (v + share * w)
        return np.stack([place, velocity])

    @cached_property
    def sun(self) -> Vector:
        """Barycentric position (3,) of the Sun, m, ICRS."""
        sun: Vector = self._motion[0, 1]
        return sun

    @cached_property
    def to_sun(self) -> Vector:
        """Geometric direction (3,) of the Sun, ICRS."""
        gap = self.sun - self.position_m
        unit: Vector = gap / length(gap)
        return unit

    @cached_property
    def moon(self) -> Vector:
        """Barycentric position (3,) of the Moon when the light left it that arrives now, m, ICRS."""
        moon, velocity = self._motion[:, 2]
        seen: Vector = moon - _length(moon - self.position_m) / SPEED_OF_LIGHT_M_S * velocity
        return seen

    @cached_property
    def position_m(self) -> Vector:
        """Barycentric position (3,), ICRS."""
        position: Vector = self._motion[0, 0]
        return position if self.offset_m is None else position + self.offset_m

    @cached_property
    def velocity_m_s(self) -> Vector:
        """Barycentric velocity (3,), ICRS."""
        velocity: Vector = self._motion[1, 0]
        return velocity if self.relative_velocity_m_s is None else velocity + self.relative_velocity_m_s

    @cached_property
    def directions(self) -> Vector:
        """Apparent directions (9, 3) of Sun, Moon and the planets."""
        slot, since_s = divmod(self.unix_s, SLOT_S)
        places, velocities, _ = _planets_of(int(slot))
        gaps = np.vstack([self.sun, self.moon, places + since_s * velocities]) - self.position_m
        return aberrated(gaps / np.sqrt(np.sum(gaps * gaps, axis=1, keepdims=True)), self.velocity_m_s)

    @cached_property
    def places_deg(self) -> list[tuple[float, float]]:
        """Apparent right ascension and declination of Sun, Moon and the planets, degrees."""
        return [_place_deg(direction) for direction in self.directions]

    def apparent_stars(self, vectors: Vector, parallax_rad: Vector) -> Vector:
        """Return the directions (n, 3) of stars with parallax and aberration, as vectors of length 1 but for the parallax."""
        shift = parallax_rad[:, None] * (self.position_m / ASTRONOMICAL_UNIT_M)
        return aberrated(vectors - shift, self.velocity_m_s)


def sun_seen_by(observer: Observer, style: SunGlare, earth: EarthLimb | None) -> SunGlare | None:
    """Return the Sun in its place, with the light that the Earth leaves of `style`; None if it is hidden."""
    share = _visible_share_of_sun(observer, earth)
    if share == 0.0:
        return None
    ra_deg, dec_deg = observer.places_deg[0]
    return dataclasses.replace(style, ra_deg=ra_deg, dec_deg=dec_deg, stray_share=share * style.stray_share)


def moon_seen_by(observer: Observer, style: Moon) -> Moon:
    """Return the Moon in its place, with its size, phase and magnitude, and the other fields of `style`.

    Its magnitude follows Allen (1976): −12.73 + 0.026 i + 4·10⁻⁹ i⁴ for the phase angle i in degrees.
    """
    to_observer, to_sun = observer.position_m - observer.moon, observer.sun - observer.moon
    distance, sun_distance = _length(to_observer), _length(to_sun)
    phase = _angle(to_observer / distance, to_sun / sun_distance)
    degrees = math.degrees(phase)
    light = 5.0 * log10(distance / MOON_DISTANCE_M * sun_distance / ASTRONOMICAL_UNIT_M)
    sun, moon = observer.directions[:2]
    ra_deg, dec_deg = observer.places_deg[1]
    return dataclasses.replace(
        style,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        diameter_deg=2.0 * math.degrees(asin(min(MOON_RADIUS_M / distance, 1.0))),
        magnitude=-12.73 + 0.026 * degrees + 4e-9 * square(square(degrees)) + light,
        illuminated=0.5 * (1.0 + cos(phase)),
        bright_limb_deg=_position_angle(moon, sun),
    )


def earth_seen_by(observer: Observer, style: EarthLimb) -> EarthLimb | None:
    """Return the Earth's disc, lit by the Sun, with the other fields of `style`; None if it is too small or far."""
    if observer.offset_m is None:
        return None
    distance = _length(observer.offset_m)
    if distance * sin(SMALLEST_EARTH_RAD) > EARTH_RADIUS_M or distance == 0.0:
        return None
    nadir = -observer.offset_m / distance
    if observer.relative_velocity_m_s is not None:
        nadir = aberrated(nadir, observer.relative_velocity_m_s)
    to_limb = math.sqrt(max(square(distance) - square(EARTH_RADIUS_M), EARTH_RADIUS_M * ATMOSPHERE_M))
    ra_deg, dec_deg = _place_deg(nadir)
    sun_ra_deg, sun_dec_deg = observer.places_deg[0]
    return dataclasses.replace(
        style,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        radius_deg=math.degrees(asin(min(EARTH_RADIUS_M / distance, 1.0))),
        atmosphere_deg=math.degrees(atan(ATMOSPHERE_M / to_limb)),
        sun_ra_deg=sun_ra_deg,
        sun_dec_deg=sun_dec_deg,
    )


def planets_seen_by(observer: Observer) -> tuple[PointSource, ...]:
    """Return the planets from Mercury to Neptune in their places, with their magnitudes."""
    magnitudes = _planets_of(int(observer.unix_s // SLOT_S))[2]
    return tuple(
        PointSource(ra_deg, dec_deg, magnitude, name)
        for (name, _, _), magnitude, (ra_deg, dec_deg) in zip(
            _PLANETS, magnitudes, observer.places_deg[2:], strict=True
        )
    )


@lru_cache(maxsize=2)
def _polynomials_of(slot: int) -> Vector:
    """Coefficients of the barycentric places and velocities of Earth, Sun and Moon by the share of a slot that is over.

    They are (4, 9), m, and (3, 9), m/s. The velocities are not the slopes of the places, which are on a grid (`in_metres`).
    """
    first, rest = terrestrial_time(slot * SLOT_S)
    (start, u), (_, middle), (end, last) = (
        _series(first, rest + k * SLOT_S / DAY_S) for k in (0.0, 0.5, 1.0)
    )
    rise, slope, last_slope = end - start, SLOT_S * u, SLOT_S * last
    return np.stack(
        [
            *(start, slope, 3.0 * rise - 2.0 * slope - last_slope, slope + last_slope - 2.0 * rise),
            *(u, 4.0 * middle - 3.0 * u - last, 2.0 * (u + last) - 4.0 * middle),
        ]
    )


def _series(first: float, rest: float) -> tuple[Vector, Vector]:
    """Barycentric places (9,) of Earth, Sun and Moon at a terrestrial time, m, and their velocities, m/s."""
    from erfa import moon98, ufunc

    heliocentric, barycentric = (in_metres(pv) for pv in ufunc.epv00(first, rest)[:2])
    moon = in_metres(moon98(first, rest))
    place, velocity = (
        np.concatenate([earth, earth - about_sun, earth + about_earth])
        for earth, about_sun, about_earth in zip(barycentric, heliocentric, moon, strict=True)
    )
    return place, velocity


@lru_cache(maxsize=2)
def _planets_of(slot: int) -> tuple[Vector, Vector, tuple[float, ...]]:
    """Barycentric places (7, 3), m, of the planets where the Earth sees them at the start of a slot of time.

    Also their velocities (7, 3), m/s, by which they move until the next one, and their magnitudes.
    """
    import erfa

    observer = Observer(slot * SLOT_S)
    numbers = np.array([number for _, number, _ in _PLANETS])
    first, rest = terrestrial_time(observer.unix_s)
    delay_s = np.zeros(len(numbers))
    places = velocities = np.zeros((len(numbers), 3))
    for _ in range(_LIGHT_TIME_ROUNDS):
        heliocentric, velocities = in_metres(erfa.plan94(first, rest - delay_s / DAY_S, numbers))
        places = observer.sun + heliocentric
        delay_s = lengths(places - observer.position_m) / SPEED_OF_LIGHT_M_S
    magnitudes = tuple(
        _planet_magnitude(observer, place, name, law)
        for (name, _, law), place in zip(_PLANETS, places, strict=True)
    )
    return places, velocities, magnitudes


def _planet_magnitude(observer: Observer, place_m: Vector, name: str, law: tuple[float, ...]) -> float:
    to_observer, to_sun = observer.position_m - place_m, observer.sun - place_m
    distance, sun_distance = _length(to_observer), _length(to_sun)
    phase = math.degrees(_angle(to_observer / distance, to_sun / sun_distance))
    rings = 0.0
    if name == "Saturn":
        tilt = abs(dot(to_observer, np.array(_SATURN_POLE))) / distance
        rings = -tilt * (1.825 + 0.378 * exp(-2.25 * phase))
    light = 5.0 * log10(distance * sun_distance / square(ASTRONOMICAL_UNIT_M))
    by_phase = 0.0
    for term in reversed(law):
        by_phase = by_phase * phase + term
    return light + rings + by_phase


def _visible_share_of_sun(observer: Observer, earth: EarthLimb | None) -> float:
    """Return the share of the Sun's disc that the Earth leaves visible, 0…1 (the limb taken as straight)."""
    if earth is None:
        return 1.0
    radius = asin(SUN_RADIUS_M / _length(observer.sun - observer.position_m))
    above = _angle(observer.directions[0], earth.direction)
    height = (above - earth.radius_rad) / radius
    if abs(height) >= 1.0:
        return 1.0 if height > 0.0 else 0.0
    return (acos(-height) + height * math.sqrt(1.0 - height * height)) / math.pi


def hidden_by(earth: EarthLimb | None, body: CelestialBody) -> bool:
    """Whether the Earth's disc lies in front of the centre of a body."""
    return earth is not None and _angle(body.direction, earth.direction) < earth.radius_rad


def _place_deg(direction: Vector) -> tuple[float, float]:
    """Right ascension and declination of a direction, degrees."""
    x, y, z = direction.tolist()
    return math.degrees(atan2(y, x)) % 360.0, math.degrees(atan2(z, hypot(x, y)))


def _length(vector: Vector) -> float:
    """Length of a vector (3,)."""
    return length(vector)


def _angle(one: Vector, other: Vector) -> float:
    """Angle between two unit vectors, radians."""
    return 2.0 * atan2(length(one - other), length(one + other))


def _position_angle(origin: Vector, target: Vector) -> float:
    """Position angle of one direction seen from another, from north through east, degrees."""
    (x, y, z), (u, v, w) = origin.tolist(), target.tolist()
    east, north = x * v - y * u, w * (x * x + y * y) - z * (x * u + y * v)
    return math.degrees(atan2(east, north)) % 360.0
