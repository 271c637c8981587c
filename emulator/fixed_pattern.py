"""The pixels' own differences, the same in every frame: dark current, sensitivity, hot and dead pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from emulator.sensor_model import SensorModel

_HOT_LOG_SPREAD: Final = 1.0


@dataclass(frozen=True)
class FixedPattern:
    """What makes one pixel differ from the next.

    Attributes
    ----------
    sensitivity : ndarray (h, w), float32
        Signal relative to the mean pixel; 0 for a dead one.
    dark_e_s : ndarray (h, w), float32
        Dark current, electrons/s.
    hot, dead : ndarray (n, 2), int
        Rows and columns of the hot and of the dead pixels.
    """

    sensitivity: npt.NDArray[np.float32]
    dark_e_s: npt.NDArray[np.float32]
    hot: npt.NDArray[np.int64]
    dead: npt.NDArray[np.int64]


def make_fixed_pattern(sensor: SensorModel, height: int, width: int) -> FixedPattern:
    """Draw the fixed pattern of a pixel array from the sensor's `pattern_seed`.

    Dark currents are gamma-distributed about the mean (never negative, with the long upper tail of silicon),
    sensitivities normal; hot pixels are log-normal. No pixel is both hot and dead.
    """
    rng = np.random.default_rng((sensor.pattern_seed, height, width))
    size = height * width
    faulty = rng.permutation(size)[: sensor.hot_pixels + sensor.dead_pixels]
    hot, dead = faulty[: sensor.hot_pixels], faulty[sensor.hot_pixels :]
    sensitivity = np.ones(size, dtype=np.float32)
    if sensor.prnu > 0.0:
        sensitivity += np.float32(sensor.prnu) * rng.standard_normal(size, dtype=np.float32)
        np.maximum(sensitivity, 0.0, out=sensitivity)
    dark = np.full(size, sensor.dark_e_s, dtype=np.float32)
    if sensor.dsnu > 0.0:
        shape = 1.0 / sensor.dsnu**2
        dark = rng.standard_gamma(shape, size, dtype=np.float32) * np.float32(sensor.dark_e_s / shape)
    dark[hot] += (sensor.hot_e_s * np.exp(_HOT_LOG_SPREAD * rng.standard_normal(hot.size))).astype(np.float32)
    sensitivity[dead] = 0.0
    dark[dead] = 0.0
    return FixedPattern(
        sensitivity.reshape(height, width),
        dark.reshape(height, width),
        np.column_stack(np.divmod(np.sort(hot), width)),
        np.column_stack(np.divmod(np.sort(dead), width)),
    )
