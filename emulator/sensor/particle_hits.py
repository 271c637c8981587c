"""Charge left by energetic protons in the detector: energy loss by Bethe's formula, along straight tracks.

A proton that crosses the epitaxial layer of a pixel array, in which charge is collected, leaves the electrons of its energy
loss in the pixels along its track: thousands, mostly in one pixel or two, where stars leave hundreds.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, Array32, elementwise
from starid.arithmetic.elementary import cos, log, sin, square

_STEP_PX: Final = 0.1
_LEAST_COSINE: Final = 0.02
"""Cosine of the angle of incidence below which tracks are not longer: 1 in 2500 of an isotropic flux."""

_DENSITY_G_CM3: Final = 2.33
_CHARGE_PER_MASS: Final = 14.0 / 28.0855
_EXCITATION_MEV: Final = 173e-6
"""Density of silicon, protons per nucleon mass, and mean excitation energy (ICRU 49)."""
_COUPLING: Final = 0.307075
"""Constant of Bethe's formula, MeV cm²/mol."""
_ELECTRON_MEV: Final = 0.51099895
_PROTON_MEV: Final = 938.272
_PAIR_MEV: Final = 3.65e-6
"""Energy that frees an electron in silicon."""

_SHIELDED_MEV: Final = 30.0
"""Least energy of protons behind 4 mm of aluminium."""
_SPECTRUM_MEV: Final = 100.0
"""Energy over which the flux of trapped protons falls by a factor of e, after AP-8 between 30 and 300 MeV."""

_MOYAL_MEAN: Final = 1.2704
"""Mean of Moyal's distribution, Euler's constant plus ln 2."""


def stopping_power(energy_mev: npt.ArrayLike) -> Array:
    """Return the mean energy loss of protons in silicon, MeV cm²/g, above some 10 MeV.

    Bethe's formula (Particle Data Group, Review of Particle Physics, equation 34.5) without density effect, which is 2 %
    at 2 GeV and less below.
    """
    gamma = 1.0 + np.asarray(energy_mev, dtype=np.float64) / _PROTON_MEV
    beta2 = 1.0 - 1.0 / square(gamma)
    ratio = _ELECTRON_MEV / _PROTON_MEV
    transfer = 2.0 * _ELECTRON_MEV * beta2 * square(gamma)
    largest = transfer / (1.0 + 2.0 * gamma * ratio + square(ratio))
    logarithm = 0.5 * elementwise(log, transfer * largest / square(_EXCITATION_MEV)) - beta2
    return np.asarray(_COUPLING * _CHARGE_PER_MASS / beta2 * logarithm)


def add_protons(
    mean_e: Array32,
    count: int,
    rng: np.random.Generator,
    epi_um: float,
    pixel_um: float,
    energy_mev: float | None = None,
) -> Array:
    """Add the charge of protons to an image, in place; return x, y of both ends of each track (count, 4), pixels.

    They come from all directions alike through a layer of thickness `epi_um`, with energies of trapped protons behind a
    shield unless one is given. The energy loss varies about the mean by Moyal's approximation of Landau's distribution;
    along the track it is uniform.
    """
    height, width = mean_e.shape
    start = rng.uniform((-0.5, -0.5), (width - 0.5, height - 0.5), (count, 2))
    cosine = np.maximum(np.sqrt(rng.random(count)), _LEAST_COSINE)
    run_px = epi_um / pixel_um * np.sqrt(1.0 - square(cosine)) / cosine
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    ends = np.column_stack(
        [
            start,
            start + run_px[:, None] * np.column_stack([elementwise(cos, azimuth), elementwise(sin, azimuth)]),
        ]
    )
    trapped = _SHIELDED_MEV + rng.exponential(_SPECTRUM_MEV, count)
    charge = _electrons(trapped if energy_mev is None else np.full(count, energy_mev), epi_um / cosine, rng)
    for (x, y, end_x, end_y), run, electrons in zip(
        ends.tolist(), run_px.tolist(), charge.tolist(), strict=True
    ):
        steps = max(math.ceil(run / _STEP_PX), 1)
        along = (np.arange(steps) + 0.5) / steps
        columns = np.rint(x + along * (end_x - x)).astype(np.int64)
        rows = np.rint(y + along * (end_y - y)).astype(np.int64)
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        np.add.at(mean_e, (rows[inside], columns[inside]), np.float32(electrons / steps))
    return ends


def _electrons(energy_mev: Array, path_um: Array, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return electrons freed on paths (n,) through silicon by protons of given energies (n,)."""
    mass_g_cm2 = _DENSITY_G_CM3 * path_um * 1e-4
    mean_mev = stopping_power(energy_mev) * mass_g_cm2
    beta2 = 1.0 - 1.0 / square(1.0 + energy_mev / _PROTON_MEV)
    spread_mev = 0.5 * _COUPLING * _CHARGE_PER_MASS * mass_g_cm2 / beta2
    moyal = -elementwise(log, square(rng.standard_normal(len(energy_mev))))
    lost_mev = np.clip(mean_mev + spread_mev * (moyal - _MOYAL_MEAN), 0.1 * mean_mev, energy_mev)
    return lost_mev / _PAIR_MEV
