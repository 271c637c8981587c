"""Fixed-pattern noise: dark current and sensitivity of each pixel, hot and dead pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sensor.model import SensorModel
from starid.arithmetic.arrays import Array32, Indices, elementwise
from starid.arithmetic.elementary import exp, power, square
from starid.camera import Camera

_HOT_LOG_SPREAD: Final = 1.0

_DAMAGE_E_S: Final = 4400.0
_DAMAGE_UM3_TEV_G: Final = 31_150.0
"""Mean dark current of a displacement cascade in silicon at 22 °C, electrons/s, exponentially distributed, and volume times
dose in which there is one: assumed. The numbers are quoted as those of Belloir et al. 2016 (Optics Express 24, 4299), whose text was
not found."""

_TELEGRAPH_E_S: Final = 1200.0
_TELEGRAPH_PER_UM3_TEV_G: Final = 3.5e-5
"""Mean amplitude of the random telegraph signals of dark current at 22 °C, electrons/s, exponentially distributed, and their
number: assumed. The numbers are quoted as those of Virmontois et al. 2011 (IEEE TNS 58, 3085: 35 per cm³ and MeV/g), whose text was
not found."""

_LONGEST_DWELL: Final = 1000.0
"""Mean number of frames for which the slowest signals stay; the fastest change with every frame."""


@dataclass(frozen=True)
class TelegraphSignals:
    """Dark currents that switch at random between zero and their amplitude."""

    pixel: Indices
    """Number of the pixel, row by row, (n,); a pixel may have several."""
    dark_e_s: Array32
    """Amplitude, electrons/s, (n,), float32."""
    dwell: Indices
    """Number of frames for which a state lasts, (n,)."""
    seed: int

    def add(self, mean_e: Array32, frame: int, factor: float) -> None:
        """Add the electrons of a frame to the means (h, w), in place; `factor` is the exposure, scaled by temperature."""
        if not self.pixel.size:
            return
        number = np.arange(self.pixel.size, dtype=np.uint64)
        period = ((frame + self.pixel) // self.dwell).astype(np.uint64)
        high = _scrambled(period + _scrambled(number + np.uint64(self.seed))) >> np.uint64(63)
        np.add.at(
            mean_e.reshape(-1), self.pixel, self.dark_e_s * high.astype(np.float32) * np.float32(factor)
        )


def _scrambled(number: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return well mixed bits of numbers (n,): the finalizer of SplitMix64."""
    mixed = number + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))


@dataclass(frozen=True)
class FixedPattern:
    """Differences between pixels that are the same in every frame."""

    sensitivity: Array32
    """Signal relative to the mean pixel, (h, w), float32; 0 for a dead pixel."""
    dark_e_s: Array32
    """Dark current, electrons/s, (h, w), float32."""
    telegraph: TelegraphSignals
    hot: Indices
    dead: Indices
    """Rows and columns of the hot and of the dead pixels, (n, 2), int."""


def make_fixed_pattern(
    sensor: SensorModel, height: int, width: int, lens: Camera | None = None
) -> FixedPattern:
    """Draw the fixed pattern of a pixel array from the sensor's `pattern_seed`; behind a lens its sensitivity falls by the vignetting.

    Dark currents are gamma-distributed (never negative, with the long upper tail of silicon), sensitivities
    are normal, hot pixels log-normal. No pixel is both hot and dead. Radiation damage adds dark current and random
    telegraph signals, and leaves the rest of the pattern as it is. The last two patterns are cached, because exposure and
    gain do not affect them.
    """
    pixels = (sensor.hot_pixels, sensor.dead_pixels)
    spreads = (sensor.prnu, sensor.dsnu, sensor.dark_e_s, sensor.hot_e_s)
    return _draw(
        sensor.pattern_seed,
        height,
        width,
        pixels,
        spreads,
        square(sensor.pixel_um) * sensor.epi_um * sensor.damage_tev_g,
        None if lens is None or sensor.vignetting == 0 else (lens, sensor.vignetting),
    )


@lru_cache(maxsize=2)
def _draw(
    seed: int,
    height: int,
    width: int,
    pixels: tuple[int, int],
    spreads: tuple[float, float, float, float],
    damage: float,
    vignetting: tuple[Camera, int] | None,
) -> FixedPattern:
    """Draw a read-only pattern from numbers of (hot, dead) pixels, (prnu, dsnu, dark_e_s, hot_e_s) and damage, µm³·TeV/g."""
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
        shape = 1.0 / square(dsnu)
        dark = rng.standard_gamma(shape, size, dtype=np.float32) * np.float32(dark_e_s / shape)
    dark[hot] += (hot_e_s * elementwise(exp, _HOT_LOG_SPREAD * rng.standard_normal(hot.size))).astype(
        np.float32
    )
    rng = np.random.default_rng((seed, height, width, 1))
    if damage > 0.0:
        cascades = rng.poisson(damage / _DAMAGE_UM3_TEV_G, size)
        dark += (_DAMAGE_E_S * rng.standard_gamma(cascades)).astype(np.float32)
    switching = np.sort(rng.integers(0, size, rng.poisson(size * damage * _TELEGRAPH_PER_UM3_TEV_G)))
    telegraph = TelegraphSignals(
        switching,
        rng.exponential(_TELEGRAPH_E_S, switching.size).astype(np.float32),
        np.rint(elementwise(partial(power, _LONGEST_DWELL), rng.random(switching.size))).astype(np.int64),
        seed,
    )
    sensitivity[dead] = 0.0
    dark[dead] = 0.0
    if vignetting is not None:
        sensitivity *= _falloff(*vignetting)
    for pattern in (sensitivity, dark):
        pattern.flags.writeable = False
    return FixedPattern(
        sensitivity.reshape(height, width),
        dark.reshape(height, width),
        telegraph,
        np.column_stack(np.divmod(np.sort(hot), width)),
        np.column_stack(np.divmod(np.sort(dead), width)),
    )


def _falloff(camera: Camera, power: int) -> Array32:
    """Power of the cosine of the angle of each pixel from the optical axis, row by row, (h·w,)."""
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    directions = camera.back_project(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    cosine = np.maximum(directions[:, 2], 0.0)
    return np.asarray(np.prod([cosine] * power, axis=0), dtype=np.float32)
