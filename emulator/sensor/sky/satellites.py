"""Satellites that cross the field: a constellation on circular orbits, as a sensor on an orbit of its own sees it.

They are spread evenly, as in Walker's delta pattern with a phase of 1, and do not stand for real ones: their planes do not
precess. A satellite shines where the Sun lights it, as a diffuse sphere does, and is hidden behind the Earth; the Earth's
shadow is a cylinder. Light time and the aberration by the relative velocity, some 10″, are neglected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from starhil.emulator.sensor.sky.ephemeris import EARTH_RADIUS_M
from starhil.emulator.sensor.sky.objects import Constellation
from starid.arithmetic.arrays import Array, Indices, elementwise
from starid.arithmetic.elementary import acos, cos, log10, sin, square
from starid.arithmetic.matrices import length, lengths, product

_GM_M3_S2: Final = 3.986004418e14
_RANGE_OF_MAGNITUDE_M: Final = 1e6


@dataclass(frozen=True)
class Crossing:
    """Satellites in a cone."""

    directions: Array
    """Where they are seen at begin, middle and end of the exposure, unit vectors (3, n, 3), ICRS."""
    magnitudes: Array
    """V (n,)."""


@lru_cache(maxsize=2)
def _pattern(constellation: Constellation) -> tuple[Array, Array, Array, Array]:
    """Cosines and sines (n,) of the arguments of latitude at the Unix epoch, and the axes (n, 3) to which they belong."""
    number = np.arange(constellation.count)
    plane = number % constellation.planes
    in_plane = -(-constellation.count // constellation.planes)
    node = 2.0 * math.pi / constellation.planes * plane
    along = 2.0 * math.pi * ((number // constellation.planes) / in_plane + plane / constellation.count)
    tilt = math.radians(constellation.inclination_deg)
    c, s, none = elementwise(cos, node), elementwise(sin, node), np.zeros(constellation.count)
    ascending = np.column_stack([c, s, none])
    highest = np.column_stack([-s * cos(tilt), c * cos(tilt), none + sin(tilt)])
    return elementwise(cos, along), elementwise(sin, along), ascending, highest


@dataclass(frozen=True)
class Satellites:
    """A constellation at a date, as an observer on an orbit sees it."""

    constellation: Constellation
    unix_s: float
    place_m: Array
    velocity_m_s: Array
    """Place and velocity (3,) of the observer relative to the Earth's centre, GCRS."""
    to_sun: Array
    """Direction (3,) of the Sun from the Earth."""

    @cached_property
    def _relative(self) -> tuple[Array, Array, Array]:
        """Places (n, 3) relative to the Earth, m, and places and velocities (n, 3) relative to the observer, m and m/s, GCRS."""
        radius_m = EARTH_RADIUS_M + 1e3 * self.constellation.altitude_km
        rate = math.sqrt(_GM_M3_S2 / radius_m) / radius_m
        turned = math.fmod(rate * self.unix_s, 2.0 * math.pi)
        c0, s0, ascending, highest = _pattern(self.constellation)
        c = (c0 * cos(turned) - s0 * sin(turned))[:, None]
        s = (s0 * cos(turned) + c0 * sin(turned))[:, None]
        places = radius_m * (c * ascending + s * highest)
        velocities = radius_m * rate * (c * highest - s * ascending)
        return places, places - self.place_m, velocities - self.velocity_m_s

    @cached_property
    def visible(self) -> Indices:
        """Numbers of the satellites that the Sun lights and the Earth does not hide."""
        places, gaps, _ = self._relative
        towards_sun = product(places, self.to_sun)
        lit = (towards_sun > 0.0) | (lengths(places - towards_sun[:, None] * self.to_sun) > EARTH_RADIUS_M)
        distances = lengths(gaps)
        # to the point of the line of sight that is nearest to the Earth
        along = -product(gaps, self.place_m) / distances
        nearest2 = square(length(self.place_m)) - square(along)
        hidden = (along > 0.0) & (along < distances) & (nearest2 < square(EARTH_RADIUS_M))
        return np.flatnonzero(lit & ~hidden & (distances > 1.0))

    def crossing(self, towards: Array, cosine: float, exposure_s: float) -> Crossing:
        """Return those that are in a cone about a direction (3,) in the middle of an exposure."""
        _, gaps, velocities = self._relative
        visible = self.visible
        distances = lengths(gaps[visible])
        inside = product(gaps[visible], towards) >= cosine * distances
        visible, distances = visible[inside], distances[inside]
        gap, moved = gaps[visible], 0.5 * exposure_s * velocities[visible]
        directions = np.stack([_unit(gap - moved), _unit(gap), _unit(gap + moved)])
        phases = elementwise(acos, np.clip(-product(directions[1], self.to_sun), -1.0, 1.0))
        lit = elementwise(sin, phases) + (math.pi - phases) * elementwise(cos, phases)
        light = 5.0 * elementwise(log10, distances / _RANGE_OF_MAGNITUDE_M)
        dimmed = -2.5 * elementwise(log10, np.maximum(lit, 1e-6))
        return Crossing(directions, self.constellation.magnitude + light + dimmed)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / lengths(vectors)[:, None])
