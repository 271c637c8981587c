"""The noise of the author's program, inferred from the published numbers: a √-law, with one constant a quantity.

The printed noise of the factor μ is a standard deviation of μ pixels and μ units of the 8-bit intensity. The
published numbers follow √μ, as if μ had been passed to a function that expects a variance, and are smaller.
The constants are fitted to published numbers (`choices`).
"""

from __future__ import annotations

import math
from typing import Final

from starid.lab.simulation import NoiseModel

Kind = str
"""Which noise: "position", "brightness" or "both"."""

POSITION_ROOT_PX: Final = 1.0 / 3.0
"""Experiments on the filter, position noise and both noises: σ = this·√μ pixels."""

BRIGHTNESS_ROOT_PX: Final = 0.13
"""Experiments on the filter, brightness noise alone, which moves positions too: σ = this·√μ pixels."""

IDENTIFICATION_ROOT: Final = 0.27
"""Experiments on identification: σ = this·√μ, pixels and units of intensity."""


FILTER_MAGNITUDES: Final = (-1.5, 3.0)
"""Experiments on the filter: range of the brightness, also of false stars."""


def filter_noise(kind: Kind, factor: float, false_stars: int, stretch: float = 1.0) -> NoiseModel:
    """Noise of a set of experiments on the filter; frames with noise have positions in whole pixels.

    `stretch` multiplies the two constants, to fit them.
    """
    root = BRIGHTNESS_ROOT_PX if kind == "brightness" else POSITION_ROOT_PX
    return NoiseModel(
        position_sigma_px=stretch * root * math.sqrt(factor),
        brightness_sigma=0.0 if kind == "position" else factor,
        false_stars=false_stars,
        magnitude_range=FILTER_MAGNITUDES,
        whole_pixels=factor > 0.0,
    )


def identification_noise(factor: float, kind: Kind = "both", false_stars: int = 0) -> NoiseModel:
    """Noise of the experiments on LSI and RSI."""
    return NoiseModel.of(kind, IDENTIFICATION_ROOT * math.sqrt(factor), false_stars=false_stars)
