"""Fixed-pattern noise: dark current and sensitivity of each pixel, hot and dead pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from starhil.emulator.sensor.model import SensorModel
from starid.arrays import Array32, Indices

_HOT_LOG_SPREAD: Final = 1.0


@dataclass(frozen=True)
class FixedPattern:
    """Differences between pixels that are the same in every frame."""

    sensitivity: Array32
    """Signal relative to the mean pixel, (h, w), float32; 0 for a dead pixel."""
    dark_e_s: Array32
    """Dark current, electrons/s, (h, w), float32."""
    hot: Indices
    dead: Indices
    """Rows and columns of the hot and of the dead pixels, (n, 2), int."""


def make_fixed_pattern(sensor: SensorModel, height: int, width: int) -> FixedPattern:
    """Draw the fixed pattern of a pixel array from the sensor's `pattern_seed`.

    Dark currents are gamma-distributed (never negative, with the long upper tail of silicon), sensitivities
    are normal, hot pixels log-normal. No pixel is both hot and dead. The last two patterns are cached,
    because exposure and gain do not affect them.
    """
    pixels = (sensor.hot_pixels, sensor.dead_pixels)
    spreads = (sensor.prnu, sensor.dsnu, sensor.dark_e_s, sensor.hot_e_s)
    return _draw(sensor.pattern_seed, height, width, pixels, spreads)


@lru_cache(maxsize=2)
def _draw(
    seed: int, height: int, width: int, pixels: tuple[int, int], spreads: tuple[float, float, float, float]
) -> FixedPattern:
    """Draw a read-only pattern from numbers of (hot, dead) pixels and (prnu, dsnu, dark_e_s, hot_e_s)."""
    hot_pixels, dead_pixels = pixels
    prnu, dsnu, dark_e_s, hot_e_s = spreads
    rng = np.random.default_rng((seed, height, width))
    size = height * width
    faulty = rng.permutation(size)[: hot_pixels + dead_pixels]
    hot, dead = faulty[:hot_pixels], faulty[hot_pixels:]
    sensitivity = np.ones(size, dtype=np.float32)
    if prnu > 0.0:
        sensitivity += np.float32(prnu) * rng.standard_normal(size, dtype=np.float32)
        np.maximum(sensitivity, 0.0, out=sensitivity)
    dark = np.full(size, dark_e_s, dtype=np.float32)
    if dsnu > 0.0:
        shape = 1.0 / dsnu**2
        dark = rng.standard_gamma(shape, size, dtype=np.float32) * np.float32(dark_e_s / shape)
    dark[hot] += (hot_e_s * np.exp(_HOT_LOG_SPREAD * rng.standard_normal(hot.size))).astype(np.float32)
    sensitivity[dead] = 0.0
    dark[dead] = 0.0
    for pattern in (sensitivity, dark):
        pattern.flags.writeable = False
    return FixedPattern(
        sensitivity.reshape(height, width),
        dark.reshape(height, width),
        np.column_stack(np.divmod(np.sort(hot), width)),
        np.column_stack(np.divmod(np.sort(dead), width)),
    )
