"""Ways to look at a photograph of unknown making, the plain one first.

Detection is made for a star sensor's frames: round spots of a pixel or two on a smooth, dark sky. A photograph
may be out of focus, grainy or compressed, lie on nebulae or twilight, be printed white on black, or mirrored.
Each look brings one of these nearer to what detection expects; positions are always those of the image itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from starid.imaging.detection import Detections, DetectionSettings, detect

Counts: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

MOST_STARS: Final = 2000
"""Detections kept of each look."""

FACTORS: Final = (2, 4)
"""Pixels along each axis that are added up for the coarser looks."""

LEAST_SIDE_PX: Final = 180
"""Least side of an image after that."""

_FAR_SIGMAS: Final = 4.0
_LONGER: Final = 2
_MAD_TO_SIGMA: Final = 1.4826


class Look(NamedTuple):
    """Detections of one look, and whether they are to be mirrored left to right."""

    detections: Detections
    mirrored: bool = False


def looks(image: Counts, settings: DetectionSettings | None = None) -> Iterator[Look]:
    """Look at an image: as it is, in the negative, coarser, mirrored.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        Grey.
    settings : DetectionSettings, optional
        For the detection; with its own settings given, `max_stars` is kept as it is.
    """
    chosen = settings or DetectionSettings(max_stars=MOST_STARS)
    plain = detect(image, chosen)
    yield Look(plain)
    if has_dark_tail(image):
        yield Look(detect(np.invert(image), chosen))
    for factor in FACTORS:
        if min(image.shape) >= factor * LEAST_SIDE_PX:
            yield Look(_coarser(image, factor, chosen))
    yield Look(plain, mirrored=True)


def has_dark_tail(image: Counts) -> bool:
    """Whether more pixels are far darker than most than far brighter: it may be a negative."""
    middle = float(np.median(image))
    deviation = image.astype(np.float32) - np.float32(middle)
    sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(deviation))), 0.5)
    far = _FAR_SIGMAS * sigma
    return int(np.count_nonzero(deviation < -far)) > _LONGER * int(np.count_nonzero(deviation > far))


def _coarser(image: Counts, factor: int, settings: DetectionSettings) -> Detections:
    """Detections on the means of blocks of pixels, in the pixels and counts of the image itself.

    The noise of a pixel is told from that of a block as if it were independent from pixel to pixel.
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
