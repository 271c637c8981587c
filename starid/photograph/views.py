"""Preprocessed views of a photograph of unknown origin, the plain one first.

Detection expects a star sensor's image: round spots of a pixel or two on a smooth, dark sky. A photograph may be out of
focus, grainy or compressed, show nebulae or twilight, or be a negative or mirrored. Each view compensates for one of
these; positions always refer to the image itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from starid.arrays import GreyImage
from starid.imaging.detection import Detections, DetectionSettings, detect

MAX_STARS: Final = 2000
"""Most detections of each view."""

FACTORS: Final = (2, 4)
"""Pixels along each axis that are averaged for the coarser views."""

MIN_SIDE_PX: Final = 180
"""Least side of a coarser view."""

_FAR_SIGMAS: Final = 4.0
_LONGER: Final = 2
_MAD_TO_SIGMA: Final = 1.4826


class View(NamedTuple):
    """Detections of one view, and whether their positions must be mirrored left to right."""

    detections: Detections
    mirrored: bool = False


def views(image: GreyImage, settings: DetectionSettings | None = None) -> Iterator[View]:
    """Detect stars on the image as it is, on its negative, on coarser images, and mirrored.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        Grey.
    settings : DetectionSettings, optional
        For the detection; by default `max_stars` is `MAX_STARS`.
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
    """Detections on the means of blocks of pixels, in the pixels and counts of the image itself.

    The noise per pixel assumes that the noise of different pixels is independent.
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
