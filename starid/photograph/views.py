"""Preprocessed views of a photograph of unknown origin, the plain one first.

Detection expects an image from a star sensor: round spots a pixel or two wide on a smooth, dark sky, and noise that
differs from pixel to pixel. A photograph may be out of focus, grainy, compressed or resampled, show hot pixels, nebulae
or twilight, or be a negative or mirrored. Each view compensates for some of these; positions always refer to the
original image. In every view the threshold follows the noise as detection smooths it, so that correlated noise yields
no more false stars than independent noise does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import GreyImage
from starid.imaging.background import BLOCK_PX, MIN_NOISE_DN, estimate_background
from starid.imaging.detection import Detections, DetectionSettings, detect

MAX_STARS: Final = 2000
"""Largest number of detections in a view."""

FACTORS: Final = (2, 4)
"""Number of pixels averaged along each axis for the coarser views."""

MIN_SIDE_PX: Final = 180
"""Smallest side of a coarser view."""

MIN_SPECKLES: Final = 100
"""Number of pixels that stand out of their neighbours from which on a view without them is tried."""

_SPECKLE_SIGMAS: Final = 8.0
_SMOOTHING_PX: Final = 0.9
_SMOOTHING_TAPS: Final = 9
_SAMPLED_PX: Final = 200_000
_QUIET_SHARE: Final = 25.0
_FAR_SIGMAS: Final = 4.0
_TAIL_RATIO: Final = 2
_MAD_TO_SIGMA: Final = 1.4826


class View(NamedTuple):
    """Detections in one view, and whether to mirror their positions left to right."""

    detections: Detections
    mirrored: bool = False


def views(image: GreyImage, settings: DetectionSettings | None = None) -> Iterator[View]:
    """Detect stars in the image, without its speckles, in its negative, coarser versions and its mirror image.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        The image.
    settings : DetectionSettings, optional
        Settings of the detection; by default `max_stars` is `MAX_STARS`.
    """
    options = settings or DetectionSettings(max_stars=MAX_STARS)
    upright = [_detect(image, options)]
    yield View(upright[0])
    clean = without_speckles(image, upright[0].noise)
    if clean is not None:
        upright.append(_detect(clean, options))
        yield View(upright[1])
    if has_dark_tail(image):
        yield View(_detect(np.invert(image), options))
    for factor in FACTORS:
        if min(image.shape) >= factor * MIN_SIDE_PX:
            yield View(_coarser(image if clean is None else clean, factor, options))
    for found in upright:
        yield View(found, mirrored=True)


def _detect(image: GreyImage, settings: DetectionSettings) -> Detections:
    """Detect stars with a threshold for the noise of the smoothed image."""
    threshold = settings.threshold_sigma * correlation(image)
    return detect(image, dataclasses.replace(settings, threshold_sigma=threshold))


def correlation(image: GreyImage) -> float:
    """Ratio of the noise of the smoothed image to that of an image with independent noise; at least 1.

    It is the lower quartile over blocks, so that a foreground does not count, after removing a plane from each.
    """
    import cv2

    rows, columns = (side // BLOCK_PX for side in image.shape)
    if min(rows, columns) == 0:
        return 1.0
    step = max(rows * columns * BLOCK_PX**2 // _SAMPLED_PX, 1)
    bands = image[: rows * BLOCK_PX].reshape(rows, BLOCK_PX, -1)[::step]
    taps = cv2.getGaussianKernel(_SMOOTHING_TAPS, _SMOOTHING_PX)
    smooth = cv2.sepFilter2D(bands.reshape(-1, image.shape[1]), cv2.CV_32F, taps, taps)
    cut = smooth[:, : columns * BLOCK_PX].reshape(len(bands), BLOCK_PX, columns, BLOCK_PX)
    blocks = cut.swapaxes(1, 2).reshape(-1, BLOCK_PX**2)
    down, along = (np.indices((BLOCK_PX, BLOCK_PX), dtype=np.float32) - 0.5 * (BLOCK_PX - 1)).reshape(2, -1)
    for slope in (np.ones_like(down), down, along):
        blocks = blocks - np.outer(blocks @ slope / (slope @ slope), slope)
    spread = _MAD_TO_SIGMA * np.median(np.abs(blocks), axis=1)
    noise = estimate_background(image).noise[:rows:step, :columns].ravel()
    noisy = noise > 1.01 * MIN_NOISE_DN
    if not noisy.any():
        return 1.0
    ratio = float(np.percentile(spread[noisy] / noise[noisy], _QUIET_SHARE))
    return max(ratio / float(np.sum(taps**2)), 1.0)


def without_speckles(image: GreyImage, noise: float) -> GreyImage | None:
    """The image with a median filter of 3 × 3 pixels, if there are many speckles; None otherwise.

    Speckles are hot pixels, also those that resampling has spread over a few pixels, and very sharp stars.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        The image.
    noise : float
        Noise of a pixel, counts.
    """
    import cv2

    clean: GreyImage = image.copy()
    cv2.medianBlur(image, 3, dst=clean)
    speckles = np.count_nonzero(np.subtract(image, clean, dtype=np.int32) > _SPECKLE_SIGMAS * noise)
    return clean if speckles >= MIN_SPECKLES else None


def has_dark_tail(image: GreyImage) -> bool:
    """Whether far dark pixels outnumber far bright ones, as in a negative."""
    middle = float(np.median(image))
    deviation = image.astype(np.float32) - np.float32(middle)
    sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(deviation))), 0.5)
    far = _FAR_SIGMAS * sigma
    return int(np.count_nonzero(deviation < -far)) > _TAIL_RATIO * int(np.count_nonzero(deviation > far))


def _coarser(image: GreyImage, factor: int, settings: DetectionSettings) -> Detections:
    """Detect stars in an image of block means; positions and counts refer to the original image.

    The noise per pixel is computed as if the noise of different pixels were independent.
    """
    height, width = (side // factor * factor for side in image.shape)
    blocks = image[:height, :width].reshape(height // factor, factor, width // factor, factor)
    mean = blocks.mean(axis=(1, 3), dtype=np.float64)
    finer = 65535.0 / float(np.iinfo(image.dtype).max)
    detections = _detect(np.rint(mean * finer).astype(np.uint16), settings)
    return dataclasses.replace(
        detections,
        xy_px=detections.xy_px * factor + 0.5 * (factor - 1),
        flux=detections.flux * (factor**2 / finer),
        flux_sigma=detections.flux_sigma * (factor**2 / finer),
        xy_sigma_px=detections.xy_sigma_px * factor,
        background=detections.background / finer,
        noise=detections.noise * (factor / finer),
        psf_sigma_px=detections.psf_sigma_px * factor,
        trail_px=detections.trail_px * factor,
    )
