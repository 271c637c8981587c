"""Typical cameras with rounded fields, so that photographs of similar fields share one star index."""

from __future__ import annotations

import math
from typing import Final

from starid.camera import Camera
from starid.identification.geometric.index_choice import pixels_per_radian
from starid.identification.geometric.pattern_index import field_solid_angle
from starid.identification.options import GeometricOptions

FIELD_STEP: Final = 1.2
"""Ratio of the widths of two adjacent typical fields."""

WIDTHS_PX: Final = (500, 1000, 2000)
"""Sides of the typical images."""

WIDEST_SR: Final = 1.5
"""Largest solid angle of a typical field; wider lenses differ too much and get an index each."""


def typical_camera(camera: Camera) -> Camera | None:
    """Camera with a square image of a rounded size to share an index with; None for the widest fields.

    Its pixels are no finer than the pixels of the given camera, so that the index covers that camera's
    matching windows. They are finer only below about 590 pixels, where the index then limits the windows.
    """
    area = field_solid_angle(camera)
    if not area < WIDEST_SR:
        return None
    side_deg = math.degrees(math.sqrt(area))
    steps = round(math.log(side_deg) / math.log(FIELD_STEP))
    longest = math.sqrt(camera.width * camera.height) * 0.85
    width = max((side for side in WIDTHS_PX if side <= longest), default=WIDTHS_PX[0])
    return Camera.from_fov(FIELD_STEP**steps, width, width)


def blend_in_typical(camera: Camera, typical: Camera | None) -> float:
    """Return the distance, in pixels of a typical camera, of stars that are one in a camera's image.

    It is `GeometricOptions.blend_px` of that camera's, or down to a `FIELD_STEP` less, so that similar cameras share an index:
    in its own, coarser pixels the typical camera would merge stars that the image shows apart.
    """
    if typical is None:
        return GeometricOptions.blend_px
    blend_px = GeometricOptions.blend_px * pixels_per_radian(typical) / pixels_per_radian(camera)
    return FIELD_STEP ** math.floor(math.log(blend_px) / math.log(FIELD_STEP))
