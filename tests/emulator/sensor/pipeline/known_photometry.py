"""What `measure_photometry` finds of a profile with the seed 3, so that only tests of the measurement wait for its 96 images."""

from __future__ import annotations

from typing import Final

LIMIT_AND_SIGMA: Final = {"ideal": (6.0, 0.073), "thesis": (6.0, 0.011), "cubestar": (3.5, 0.107)}
"""Limit of the detector and error of a magnitude there, both in magnitudes, by profile."""


def known_photometry(profile: str) -> tuple[str, str]:
    """Return settings with which a pipeline does not measure the limit of its detector."""
    limit, sigma = LIMIT_AND_SIGMA[profile]
    return f"identifier.detected_limit={limit}", f"identifier.magnitude_sigma={sigma}"
