"""Stellar aberration: the apparent directions of stars for a moving observer.

The observer's velocity v relative to the barycentre of the solar system turns every direction towards v, by
up to 20.5″ for the Earth and 5.2″ more for a low orbit. With β = v/c and γ = 1/√(1 − β²), p is seen as

    p' = [p/γ + (1 + (p·β)/(1 + 1/γ)) β] / (1 + p·β)

(Urban & Seidelmann 2013, eq. 7.40; the inverse has −β). Light deflection by the Sun (4 mas at 90°) is left
out.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.matrices import length
from starid.errors import StaridError

SPEED_OF_LIGHT_M_S: Final = 299_792_458.0

FASTEST_M_S: Final = 1e6
"""Largest observer velocity accepted, m/s: 13 times the speed of a low Earth orbit at perihelion."""

REST: Final[Array] = np.zeros(3)
"""β of an observer at rest."""
REST.flags.writeable = False


def checked_beta(velocity_m_s: ArrayLike | None) -> Array:
    """Return the velocity of an observer as β = v/c (3,); zeros for None.

    Raises
    ------
    StaridError
        The velocity is not three finite numbers, or is above `FASTEST_M_S`.
    """
    if velocity_m_s is None:
        return REST
    try:
        velocity = np.asarray(velocity_m_s, dtype=np.float64)
    except (TypeError, ValueError):
        velocity = np.empty(0)
    if velocity.shape != (3,) or not length(velocity) <= FASTEST_M_S:
        given = " ".join(repr(velocity_m_s).split())
        raise StaridError(
            f"observer_velocity: must be three numbers in m/s (ICRS) of at most {FASTEST_M_S:g}, not {given[:60]}"
        )
    return velocity / SPEED_OF_LIGHT_M_S


def aberrated(directions: ArrayLike, velocity_m_s: ArrayLike) -> Array:
    """Apparent directions (…, 3) for an observer who moves relative to the barycentre.

    Parameters
    ----------
    directions : array (…, 3)
        Unit vectors for an observer at rest, ICRS.
    velocity_m_s : array (3,)
        Velocity of the observer, ICRS, m/s; its negative inverts the transformation.
    """
    p, beta = np.asarray(directions, dtype=np.float64), checked_beta(velocity_m_s)
    u, v, w = beta.tolist()
    inverse_gamma = math.sqrt(1.0 - (u * u + v * v + w * w))
    along = (p[..., 0] * u + p[..., 1] * v + p[..., 2] * w)[
        ..., None
    ]  # BLAS would sum as the processor likes
    seen: Array = inverse_gamma * p + (1.0 + along / (1.0 + inverse_gamma)) * beta
    seen /= 1.0 + along
    return seen
