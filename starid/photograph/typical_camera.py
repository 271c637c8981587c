"""Typical cameras with rounded fields, so that photographs of similar fields share one star index."""

from __future__ import annotations

import math
from typing import Final

from starid.camera import Camera
from starid.geometric.pattern_index import field_solid_angle

FIELD_STEP: Final = 1.2
"""Ratio of the sides of two neighbouring typical fields."""

WIDTHS_PX: Final = (500, 1000, 2000)
"""Sides of the typical images: the index merges doubles that the pixels of the image cannot resolve."""

WIDEST_SR: Final = 1.5
"""Fields beyond this solid angle differ too much by the lens: each gets a separate index."""


def typical_camera(camera: Camera) -> Camera | None:
    """Camera with a square image of a rounded size whose index suits a camera; None for the widest fields.

    Its pixels are no finer than the camera's, so that the index covers the camera's matching windows. Only for images
    smaller than about 590 pixels are they finer; the windows are then limited to those of the index.
    """
    area = field_solid_angle(camera)
    if not area < WIDEST_SR:
        return None
    side_deg = math.degrees(math.sqrt(area))
    steps = round(math.log(side_deg) / math.log(FIELD_STEP))
    longest = math.sqrt(camera.width * camera.height) * 0.85
    width = max((side for side in WIDTHS_PX if side <= longest), default=WIDTHS_PX[0])
    return Camera.from_fov(FIELD_STEP**steps, width, width)
