"""The arrays that most functions of this package take and return."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers in double precision."""

Indices = NDArray[np.int64]
"""Rows, counts and other whole numbers."""

Mask = NDArray[np.bool_]
"""Which of several are meant."""

Array32 = NDArray[np.float32]
"""Numbers in single precision: pixels and what is made of them."""

Indices32 = NDArray[np.int32]
"""Whole numbers in half the room."""

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]
"""Counts of an image, (h, w)."""
