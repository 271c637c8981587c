"""The normal distribution and its density for compiled loops: a small table and a Taylor step from its nearest entry."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.jit import compiled_ieee

REACH: Final = 8.0
"""Beyond this many standard deviations the distribution is taken as 0 or 1."""

_PER_SIGMA: Final = 32
_COUNT: Final = int(2 * REACH) * _PER_SIGMA + 1
_NODES: Final = np.linspace(-REACH, REACH, _COUNT)
_CDF: Final = np.array([0.5 * math.erfc(-node / math.sqrt(2.0)) for node in _NODES])
_PDF: Final = np.exp(-0.5 * _NODES**2) / math.sqrt(2.0 * math.pi)


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
