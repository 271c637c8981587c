"""Array types used throughout the package."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
"""Double-precision numbers."""

Indices = NDArray[np.int64]
"""Indices, counts and other integers."""

Mask = NDArray[np.bool_]

Array32 = NDArray[np.float32]
"""Single-precision numbers: pixels, and what is computed from them."""

Indices32 = NDArray[np.int32]

Records = NDArray[np.void]
"""A table (n,) of records, each with named fields (`record_type`)."""

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]
"""Pixel values (h, w) of a grey image."""


def record_type(form: type) -> np.dtype[np.void]:
    """Return the type of a table's records, whose fields (float or int, 64 bits each) are those of a protocol class."""
    return np.dtype([(name, str(kind)) for name, kind in form.__annotations__.items()], align=True)


def elementwise(function: Callable[..., float], *arrays: ArrayLike) -> Array:
    """Return a function of `starid.arithmetic.elementary` for each element of arrays of equal shape."""
    tables = [np.asarray(each, np.float64) for each in arrays]
    values = map(function, *(each.ravel().tolist() for each in tables))
    return np.fromiter(values, np.float64, tables[0].size).reshape(tables[0].shape)


def interpolated(values: ArrayLike, nodes: Array, heights: Array) -> Array:
    """Interpolate linearly, as `numpy.interp` does, whose last bit depends on the processor."""
    at = np.asarray(values, np.float64)
    row = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    part = np.clip((at - nodes[row]) / (nodes[row + 1] - nodes[row]), 0.0, 1.0)
    return np.asarray(heights[row] + part * (heights[row + 1] - heights[row]), np.float64)


def on_grid(values: ArrayLike, step: float) -> Array:
    """Round to multiples of a power of two, which hides that libraries differ in the last digits on different machines."""
    return np.asarray(np.rint(np.asarray(values, np.float64) / step) * step, np.float64)
