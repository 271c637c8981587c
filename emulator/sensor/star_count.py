"""How many stars a camera sees, and whether they are enough."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from starhil.emulator.sensor.model import SensorModel
from starid.arithmetic.elementary import power

STARS_TO_V6: Final = 5000.0
"""Stars in the whole sky to V = 6; their number grows by a factor 10 ** 0.5 per magnitude."""
FEW_STARS: Final = 8.0
"""Mean number of stars in the field below which a share of the images that matters has too few for an identification."""


def mean_stars(camera: Mapping[str, Any], faintest_v: float) -> float:
    """Return the mean number of stars in a field down to a magnitude; `camera` has the fields of a `starid.camera.Camera`."""
    share: float = camera["width"] * camera["height"] / math.prod(camera["focal_px"]) / (4.0 * math.pi)
    return STARS_TO_V6 * power(10.0, 0.5 * (faintest_v - 6.0)) * min(share, 1.0)


def few_stars(camera: Mapping[str, Any], sensor: SensorModel, settings: Mapping[str, Any]) -> str:
    """Return a warning if a camera sees too few stars for most images to be solved, or an empty text.

    `settings` are the device's parameters.
    """
    sensor = sensor.with_(exposure_s=settings["exposure"] / 1000.0, gain=settings["analog_gain"])
    pixel_rad = 1.0 / math.sqrt(math.prod(camera["focal_px"]))
    faintest = sensor.faintest_magnitude(pixel_rad, settings["detection_threshold"])
    limit = settings["limiting_magnitude"]
    stars = mean_stars(camera, min(faintest, limit))
    if stars >= FEW_STARS:
        return ""
    cause, remedy = f"parameters.limiting_magnitude is {limit:g}", "raise it, or widen the field"
    if faintest < limit:
        cause = f"the detector finds stars to about V {faintest:.1f}"
        remedy = "widen the field, or gather more light: sensor.aperture_m, parameters.exposure"
    return (
        f"the field has {stars:.1f} stars on average, since {cause}; with fewer than some {FEW_STARS:g}, "
        f"many images cannot be solved: {remedy}"
    )
