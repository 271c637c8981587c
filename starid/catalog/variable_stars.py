"""Bright stars whose light varies with a period: their magnitude at a date.

The elements are those of the General Catalogue of Variable Stars, version 5.1 (Samus et al. 2017, Astronomy Reports 61, 80), for
β Lyrae, whose period grows by 19 s a year, those of Rucinski et al. 2019 (arXiv:1906.04831). These are the stars to V 4.5 whose
light repeats and varies by more than half a magnitude; semiregular and irregular ones, such as Betelgeuse, have no phase.

A pulsating star is brightest at its epoch, falls as half a wave of a cosine, and rises likewise. An eclipsing one is faintest at
its epoch and half a period later, in dips of the shape of a cosine; those of β Lyrae leave no time between them. Light time
to the Sun (8 min) is neglected. Maxima of Mira and χ Cygni differ from the mean ones by weeks and by magnitudes, the
eclipse of ε Aurigae has a flat bottom, and of κ Pavonis and β Doradus, whose elements are old and whose periods change, the
phase may be wrong by a tenth.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import cos

_UNIX_EPOCH_JD: Final = 2_440_587.5
_DAY_S: Final = 86_400.0


class VariableStar(NamedTuple):
    """Elements of a variable star."""

    name: str
    hip: int
    brightest: float
    faintest: float
    """V at the epoch of an eclipsing star, or half a period from that of a pulsating one."""
    second: float
    """V of the other minimum of an eclipsing star; NaN for a pulsating one."""
    epoch_jd: float
    period_d: float
    share: float
    """Length of an eclipse, or of the rise to the maximum, as a share of the period."""


VARIABLE_STARS: Final = (
    VariableStar("Algol", 14576, 2.12, 3.39, 2.12, 2_445_641.5135, 2.8673043, 0.14),
    VariableStar("lambda Tauri", 18724, 3.37, 3.91, 3.54, 2_421_506.8506, 3.9529478, 0.15),
    VariableStar("beta Lyrae", 92420, 3.25, 4.36, 3.85, 2_458_347.0119, 12.94379, 0.50),
    VariableStar("delta Cephei", 110991, 3.48, 4.37, math.nan, 2_455_479.905, 5.366208, 0.25),
    VariableStar("eta Aquilae", 97804, 3.48, 4.33, math.nan, 2_450_323.31, 7.176915, 0.32),
    VariableStar("zeta Geminorum", 34088, 3.62, 4.18, math.nan, 2_443_805.927, 10.15073, 0.50),
    VariableStar("l Carinae", 47854, 3.28, 4.18, math.nan, 2_440_736.9, 35.53584, 0.26),
    VariableStar("beta Doradus", 26069, 3.46, 4.08, math.nan, 2_440_905.30, 9.8426, 0.48),
    VariableStar("kappa Pavonis", 93015, 3.91, 4.78, math.nan, 2_440_140.167, 9.09423, 0.44),
    VariableStar("epsilon Aurigae", 23416, 2.92, 3.88, 2.92, 2_445_513.0, 9884.0, 0.08),
    VariableStar("chi Cygni", 97629, 3.3, 14.2, math.nan, 2_442_140.0, 408.05, 0.41),
    VariableStar("Mira", 10826, 2.0, 10.1, math.nan, 2_444_839.0, 331.96, 0.38),
)

HIP: Final[Indices] = np.array([star.hip for star in VARIABLE_STARS])
"""Their Hipparcos numbers (n,)."""

BRIGHTEST: Final[Array] = np.array([star.brightest for star in VARIABLE_STARS])
"""Their V at maximum (n,)."""


def variable_magnitudes(unix_s: float) -> Array:
    """Return V (n,) of `VARIABLE_STARS` at a Unix time."""
    jd = _UNIX_EPOCH_JD + unix_s / _DAY_S
    return np.array([_magnitude(star, jd) for star in VARIABLE_STARS])


def _magnitude(star: VariableStar, jd: float) -> float:
    phase = (jd - star.epoch_jd) / star.period_d % 1.0
    depth = star.faintest - star.brightest
    if math.isnan(star.second):
        fall = 1.0 - star.share
        wave = phase / fall if phase < fall else (1.0 - phase) / star.share
        return star.brightest + 0.5 * depth * (1.0 - cos(math.pi * wave))
    from_first = min(phase, 1.0 - phase)
    dip, away = (depth, from_first) if from_first < 0.25 else (star.second - star.brightest, 0.5 - from_first)
    inside = 2.0 * away / star.share
    return star.brightest + (0.5 * dip * (1.0 + cos(math.pi * inside)) if inside < 1.0 else 0.0)
