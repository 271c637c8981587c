"""Attitudes, and the attitude from pairs of directions."""

from starid.attitude.attitude import (
    ARCSEC_PER_RAD,
    Attitude,
    AttitudeDifference,
    interpolate,
    propagate,
    quaternion_of,
    random_attitude,
    rate_between,
    turn_text,
)

__all__ = [
    "ARCSEC_PER_RAD",
    "Attitude",
    "AttitudeDifference",
    "interpolate",
    "propagate",
    "quaternion_of",
    "random_attitude",
    "rate_between",
    "turn_text",
]
