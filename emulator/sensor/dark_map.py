"""The dark frame of the unit, which is measured on the ground and scaled to each image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sensor.fixed_pattern import make_fixed_pattern
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.noise import digitize
from starid.arithmetic.arrays import Array32
from starid.imaging.dark_frame import dark_excess, without_dark

_HEADROOM: Final = 0.5
_LONGEST_S: Final = 1.0


@dataclass(frozen=True)
class DarkMap:
    """The dark signal of each pixel above the typical dark signal."""

    sensor: SensorModel
    rate_dn_s: Array32
    """Counts/s at gain 1 and the sensor's `reference_c`, (h, w), float32."""

    def subtracted(
        self, image: npt.NDArray[Any], exposure_s: float, gain: float, temperature_c: float
    ) -> npt.NDArray[Any]:
        """Return an image without the dark signal of its exposure, gain and temperature."""
        scale = exposure_s * gain * self.sensor.dark_factor(temperature_c)
        return without_dark(image, self.rate_dn_s * np.float32(scale))


def measure_dark_map(sensor: SensorModel, height: int, width: int, frames: int, seed: int) -> DarkMap:
    """Average exposures with the lens covered, at gain 1 and `reference_c`; the seed is that of their noise.

    The exposure, at most 1 s, is chosen so that the mean dark signal fills half of the converter's range.
    """
    unit = sensor.with_(gain=1.0, temperature_c=sensor.reference_c, damage_tev_g=0.0)  # on the ground
    exposure_s = min(_LONGEST_S, _HEADROOM * unit.adc_range_e / max(unit.dark_e_s, 1.0))
    mean_e = make_fixed_pattern(unit, height, width).dark_e_s * np.float32(exposure_s)
    total = np.zeros((height, width), dtype=np.float32)
    for frame in range(frames):
        total += digitize(mean_e, unit.digitizer, seed, frame)
    return DarkMap(sensor, dark_excess(total / np.float32(frames)) / np.float32(exposure_s))
