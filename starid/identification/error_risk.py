"""The risk that an attitude is off by more than a limit, by its own covariance.

An error whose covariance was estimated from residuals with ν degrees of freedom follows Student's distribution, whose tails are longer
than the normal distribution's. Its scale s is given by the variance ``σ² = s² ν/(ν − 2)``. In a plane, the square of an error's length
over 2 s² is F-distributed with 2 and ν degrees of freedom, so that the length exceeds L with the probability ``(1 + x²/ν)^(−ν/2)``, where
x = L/s. On a line, the integral of the density beyond x is less than that of the density times t/x, so that an error exceeds L with a
probability of at most ``√(2/π) ν/((ν − 1) x) (1 + x²/ν)^((1 − ν)/2)``.
"""

from __future__ import annotations

import math

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import hypot, power, square


def largest_across_rad(covariance: Array) -> float:
    """Return the largest standard deviation about an axis across the boresight, from the covariance (3, 3) of a rotation vector."""
    (xx, xy), (_, yy) = covariance[:2, :2].tolist()
    return math.sqrt(0.5 * (xx + yy) + hypot(0.5 * (xx - yy), xy))


def error_risk(covariance: Array, freedom: float, limit_rad: float) -> float:
    """Return a bound on the probability that the boresight, or the rotation about it, is off by more than a limit.

    Parameters
    ----------
    covariance : ndarray (3, 3)
        Covariance of the attitude's rotation vector in the sensor frame, rad².
    freedom : float
        Degrees of freedom from which its scale was estimated, above 2.
    limit_rad : float
        The limit, radians.
    """
    across, about = (
        square(limit_rad / sigma) / (freedom - 2.0)  # x²/ν
        for sigma in (largest_across_rad(covariance), math.sqrt(float(covariance[2, 2])))
    )
    boresight = power(1.0 + across, -0.5 * freedom)
    mills = math.sqrt(2.0 * freedom / (math.pi * about)) / (freedom - 1.0)
    return min(boresight + mills * power(1.0 + about, 0.5 * (1.0 - freedom)), 1.0)
