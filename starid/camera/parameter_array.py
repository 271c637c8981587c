"""Where the numbers of a camera are in `starid.camera.Camera.params`, the array that compiled kernels take."""

from __future__ import annotations

from typing import Final

PINHOLE: Final = 0
EQUIDISTANT: Final = 1
FLAT: Final = 2

MODEL: Final = 0
FX: Final = 1
FY: Final = 2
CX: Final = 3
CY: Final = 4
K1: Final = 5
K2: Final = 6
P1: Final = 7
P2: Final = 8
K3: Final = 9
WIDTH: Final = 10
HEIGHT: Final = 11
LIMIT2: Final = 12
"""Squared radius, in the image plane, up to which the distortion is one-to-one."""
