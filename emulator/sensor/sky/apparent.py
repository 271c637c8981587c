"""Places and apparent directions for a moving observer, in compiled loops: for a few bodies, NumPy's calls take longer than the arithmetic."""

from __future__ import annotations

import math

import numpy as np

from starid.arrays import Array
from starid.kernels.jit import compiled_ieee, inner


@compiled_ieee
def motion_at(cubics: Array, share: float, slot_s: float) -> Array:
    """Return places (3, 3), m, and velocities (3, 3), m/s, of three bodies, from cubics (4, 9) in the share of a slot of time."""
    motion = np.empty((2, 3, 3))
    for body in range(3):
        for axis in range(3):
            a, b, c, d = cubics[:, 3 * body + axis]
            motion[0, body, axis] = a + share * (b + share * (c + share * d))
            motion[1, body, axis] = (b + share * (2.0 * c + share * 3.0 * d)) / slot_s
    return motion


@inner
def _aberrate(x: float, y: float, z: float, beta: Array, inverse_gamma: float, out: Array) -> None:
    """As `starid.catalog.aberration.aberrated`, for one direction."""
    along = x * beta[0] + y * beta[1] + z * beta[2]
    share, total = 1.0 + along / (1.0 + inverse_gamma), 1.0 + along
    out[0] = (inverse_gamma * x + share * beta[0]) / total
    out[1] = (inverse_gamma * y + share * beta[1]) / total
    out[2] = (inverse_gamma * z + share * beta[2]) / total


@inner
def _inverse_gamma(beta: Array) -> float:
    return math.sqrt(1.0 - (beta[0] * beta[0] + beta[1] * beta[1] + beta[2] * beta[2]))


@compiled_ieee
def apparent_stars(vectors: Array, parallax_rad: Array, position_au: Array, beta: Array) -> Array:
    """Return the directions (n, 3) of stars with parallax and aberration, as vectors of length 1 but for the parallax."""
    directions = np.empty((len(vectors), 3))
    inverse_gamma = _inverse_gamma(beta)
    for i in range(directions.shape[0]):
        x, y, z = (
            vectors[i, 0] - parallax_rad[i] * position_au[0],
            vectors[i, 1] - parallax_rad[i] * position_au[1],
            vectors[i, 2] - parallax_rad[i] * position_au[2],
        )
        _aberrate(x, y, z, beta, inverse_gamma, directions[i])
    return directions


@compiled_ieee
def apparent_bodies(
    sun: Array, moon: Array, planets: Array, velocities: Array, since_s: float, position: Array, beta: Array
) -> Array:
    """Return where the observer sees Sun, Moon and planets.

    Each of the 2 + n rows has right ascension and declination in degrees, and the direction (3,).

    Parameters
    ----------
    sun, moon, planets : ndarray (3,), (3,), (n, 3)
        Barycentric places from which light arrives now, m; for the planets, from which it arrived `since_s` ago.
    velocities : ndarray (n, 3)
        Of the planets, m/s.
    position, beta : ndarray (3,)
        Barycentric place of the observer, m, and velocity as a fraction of the speed of light.
    """
    bodies = np.empty((2 + planets.shape[0], 5))
    inverse_gamma = _inverse_gamma(beta)
    gap = np.empty(3)
    for i in range(bodies.shape[0]):
        for axis in range(3):
            if i < 2:
                place = sun[axis] if i == 0 else moon[axis]
            else:
                place = planets[i - 2, axis] + since_s * velocities[i - 2, axis]
            gap[axis] = place - position[axis]
        length = math.sqrt(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2])
        direction = bodies[i, 2:]
        _aberrate(gap[0] / length, gap[1] / length, gap[2] / length, beta, inverse_gamma, direction)
        bodies[i, 0] = math.degrees(math.atan2(direction[1], direction[0])) % 360.0
        bodies[i, 1] = math.degrees(math.atan2(direction[2], math.hypot(direction[0], direction[1])))
    return bodies
