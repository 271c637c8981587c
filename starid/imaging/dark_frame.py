"""Dark frames: the signal of a detector without light."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array32
from starid.errors import StaridError

_BLIND_SHARE: Final = 0.5
_NEIGHBOURS_PX: Final = 5

Counts = npt.NDArray[Any]


def dark_excess(dark: Counts) -> Array32:
    """Return the excess of each pixel (h, w) of a dark frame over the median, counts."""
    return np.asarray(dark - np.float32(np.median(dark)), dtype=np.float32)


def without_dark(image: Counts, excess_dn: Array32) -> Counts:
    """Subtract the dark signal from an image, but keep its mean level.

    Parameters
    ----------
    image : ndarray (h, w) of uint8 or uint16
        The image.
    excess_dn : ndarray (h, w)
        Dark signal of each pixel above the median, counts, at the exposure time and temperature of the image.

    Returns
    -------
    ndarray (h, w)
        Of the same type as the image. A pixel with a dark signal of half the largest count or more carries no
        information and takes the median of its neighbours.

    Raises
    ------
    StaridError
        The shapes differ.
    """
    import cv2

    if image.shape != excess_dn.shape:
        here, there = ("×".join(str(side) for side in reversed(array.shape)) for array in (excess_dn, image))
        raise StaridError(f"dark frame of {here} pixels: the image has {there}; give one of the same camera")
    most = np.iinfo(image.dtype).max
    result = np.clip(np.rint(image - excess_dn), 0, most).astype(image.dtype)
    blind = excess_dn > _BLIND_SHARE * float(image.max(initial=1))
    if np.any(blind):
        result[blind] = cv2.medianBlur(result, _NEIGHBOURS_PX)[blind]
    return result
