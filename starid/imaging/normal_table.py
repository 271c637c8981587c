"""The normal distribution and its density for compiled loops: by a small table, or by polynomials for vector instructions."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.elementary import exp
from starid.kernels.jit import compiled_ieee, inner

REACH: Final = 8.0
"""Beyond this many standard deviations the distribution is taken as 0 or 1."""

_LEAST_EXPONENT: Final = -0.6
_PER_SIGMA: Final = 32
_COUNT: Final = int(2 * REACH) * _PER_SIGMA + 1
_NEGLIGIBLE: Final = 1e-17
_NODES: Final = np.linspace(-REACH, REACH, _COUNT)


def density(z: float) -> float:
    """Density of the standard normal distribution."""
    return exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


def distribution(z: float) -> float:
    """Standard normal distribution function, |z| ≤ `REACH`, to 1e-15: ½ + φ(z) (z + z³/3 + z⁵/15 + …)."""
    term = total = z
    k = 1
    while abs(term) > _NEGLIGIBLE * abs(total):
        k += 2
        term *= z * z / k
        total += term
    return 0.5 + density(z) * total


_CDF: Final = np.array([distribution(node) for node in _NODES.tolist()])
_PDF: Final = np.array([density(node) for node in _NODES.tolist()])


@compiled_ieee
def normal(z: float) -> tuple[float, float]:
    """Standard normal distribution function and density at z, to 1e-8."""
    if z <= -REACH:
        return 0.0, 0.0
    if z >= REACH:
        return 1.0, 0.0
    k = int((z + REACH) * _PER_SIGMA + 0.5)
    node = k / _PER_SIGMA - REACH
    d = z - node
    bend = (node * node - 1.0) * d * d
    density = _PDF[k]
    return (
        _CDF[k] + density * d * (1.0 - 0.5 * node * d + bend / 6.0),
        density * (1.0 - node * d + 0.5 * bend + (3.0 * node - node * node * node) * d * d * d / 6.0),
    )


@inner
def gaussian(distance2: float) -> float:
    """exp(−distance2/2) to 1e-8, without a branch: a power of a Taylor polynomial."""
    a = max(distance2 / -64.0, _LEAST_EXPONENT)
    root = 1.0 + a * (1.0 + a * (1.0 / 2.0 + a * (1.0 / 6.0 + a * (1.0 / 24.0 + a * (1.0 / 120.0)))))
    root *= root
    root *= root
    root *= root
    root *= root
    return root * root


@inner
def quick_normal(z: float) -> tuple[float, float]:
    """Density and distribution of the standard normal at z, to 1e-7, without a table or branch.

    The distribution is that of Abramowitz & Stegun 26.2.17.
    """
    bell = 0.3989422804014327 * gaussian(z * z)
    t = 1.0 / (1.0 + 0.2316419 * abs(z))
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    return bell, 1.0 - bell * series if z > 0.0 else bell * series
