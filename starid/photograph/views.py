"""Preprocessed views of a photograph of unknown origin, the plain one first.

Detection expects an image from a star sensor: round spots a pixel or two wide on a smooth, dark sky. A
photograph may be out of focus, grainy or compressed, show nebulae or twilight, or be a negative or mirrored.
Each view compensates for one of these; positions always refer to the original image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from starid.arrays import GreyImage
from starid.imaging.detection import Detections, DetectionSettings, detect

MAX_STARS: Final = 2000
"""Largest number of detections in a view."""

FACTORS: Final = (2, 4)
"""Number of pixels averaged along each axis for the coarser views."""

MIN_SIDE_PX: Final = 180
"""Smallest side of a coarser view."""

_FAR_SIGMAS: Final = 4.0
_LONGER: Final = 2
_MAD_TO_SIGMA: Final = 1.4826


class View(NamedTuple):
    """Detections in one view, and whether to mirror their positions left to right."""

    detections: Detections
    mirrored: bool = False


def views(image: GreyImage, settings: DetectionSettings | None = None) -> Iterator[View]:
    """Detect stars in the image, its negative, coarser versions and its mirror image.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        The image.
    settings : DetectionSettings, optional
        Settings of the detection; by default `max_stars` is `MAX_STARS`.
    """
    chosen = settings or DetectionSettings(max_stars=MAX_STARS)
    plain = detect(image, chosen)
    yield View(plain)
    if has_dark_tail(image):
        yield View(detect(np.invert(image), chosen))
    for factor in FACTORS:
        if min(image.shape) >= factor * MIN_SIDE_PX:
            yield View(_coarser(image, factor, chosen))
    yield View(plain, mirrored=True)


def has_dark_tail(image: GreyImage) -> bool:
    """Whether far dark pixels outnumber far bright ones, as in a negative."""
    middle = float(np.median(image))
    deviation = image.astype(np.float32) - np.float32(middle)
    sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(deviation))), 0.5)
    far = _FAR_SIGMAS * sigma
    return int(np.count_nonzero(deviation < -far)) > _LONGER * int(np.count_nonzero(deviation > far))


def _coarser(image: GreyImage, factor: int, settings: DetectionSettings) -> Detections:
    """Detect stars in an image of block means; positions and counts refer to the original image.

    The noise per pixel is computed as if the noise of different pixels were independent.
    """
    height, width = (side // factor * factor for side in image.shape)
    blocks = image[:height, :width].reshape(height // factor, factor, width // factor, factor)
    mean = blocks.mean(axis=(1, 3), dtype=np.float64)
    finer = 65535.0 / float(np.iinfo(image.dtype).max)
    found = detect(np.rint(mean * finer).astype(np.uint16), settings)
    return dataclasses.replace(
        found,
        xy_px=found.xy_px * factor + 0.5 * (factor - 1),
        flux=found.flux * (factor**2 / finer),
        flux_sigma=found.flux_sigma * (factor**2 / finer),
        xy_sigma_px=found.xy_sigma_px * factor,
        background=found.background / finer,
        noise=found.noise * (factor / finer),
        psf_sigma_px=found.psf_sigma_px * factor,
        trail_px=found.trail_px * factor,
    )
