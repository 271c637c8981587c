"""The risk that an attitude is off by more than a limit, by its own covariance.

An error whose covariance was estimated from residuals with ν degrees of freedom follows Student's distribution, whose tails are longer
than the normal distribution's. Its scale s is given by the variance ``σ² = s² ν/(ν − 2)``. In a plane, the square of an error's length
over 2 s² is F-distributed with 2 and ν degrees of freedom, so that the length exceeds L with the probability ``(1 + x²/ν)^(−ν/2)``, where
x = L/s. On a line, the integral of the density beyond x is less than that of the density times t/x, so that an error exceeds L with a
probability of at most ``√(2/π) ν/((ν − 1) x) (1 + x²/ν)^((1 − ν)/2)``.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import exp, hypot, power, square
from starid.identification.solution import Reason, Solution

MAX_RISK: Final = 1e-4
"""Largest risk of an error above the largest one: of 10 000 images, all at this limit, one would be wrong. Most are far below."""


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
        Degrees of freedom from which its scale was estimated; with 2 or fewer, errors have no variance, and the risk is 1.
    limit_rad : float
        The limit, radians.
    """
    if limit_rad >= math.pi:
        return 0.0
    if freedom <= 2.0:
        return 1.0
    across, about = (
        square(limit_rad / sigma) / (freedom - 2.0)  # x²/ν
        for sigma in (largest_across_rad(covariance), math.sqrt(float(covariance[2, 2])))
    )
    boresight = power(1.0 + across, -0.5 * freedom)
    mills = math.sqrt(2.0 * freedom / (math.pi * about)) / (freedom - 1.0)
    return min(boresight + mills * power(1.0 + about, 0.5 * (1.0 - freedom)), 1.0)


def normal_density(x: float) -> float:
    """Return the density of the standard normal distribution."""
    return exp(-0.5 * square(x)) / math.sqrt(2.0 * math.pi)


def normal_above(x: float) -> float:
    """Return the probability that a standard normal deviate is above x, to 7.5e-8 (Abramowitz & Stegun, 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * abs(x))
    terms = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = normal_density(x) * terms
    return tail if x >= 0.0 else 1.0 - tail


def flagged(solution: Solution, largest_error_deg: float, other_risk: float = 0.0) -> Solution:
    """Return a valid solution unchanged, or invalid if it may be off by more than a limit.

    Parameters
    ----------
    solution : Solution
        A valid solution with `freedom`.
    largest_error_deg : float
        The limit, degrees.
    other_risk : float
        Probability of such an error for another reason.
    """
    risk = other_risk + error_risk(solution.covariance, solution.freedom, math.radians(largest_error_deg))
    return solution if risk <= MAX_RISK else rejected(solution, Reason.UNCERTAIN)


def rejected(solution: Solution, reason: Reason) -> Solution:
    """Return an invalid solution in place of one that is not good enough."""
    invalid = Solution.invalid(reason, mode=solution.mode, elapsed=solution.elapsed)
    return dataclasses.replace(invalid, features=solution.features)


def combined_freedom(*parts: tuple[Array, float]) -> float:
    """Return the degrees of freedom of a sum of covariances, by the formula of Welch and Satterthwaite; that of the axis with the fewest.

    ``ν = (Σ Vⱼ)²/Σ(Vⱼ²/νⱼ)`` for variances Vⱼ that were estimated with νⱼ degrees of freedom.
    """
    variances = np.array([np.diag(covariance) for covariance, _ in parts])
    freedoms = np.array([freedom for _, freedom in parts])
    with np.errstate(divide="ignore"):
        each = square(variances.sum(axis=0)) / np.sum(square(variances) / freedoms[:, None], axis=0)
    return float(each.min())
