"""Sun, Moon and Earth in the field of view, and whether they blind the sensor.

A frame without a valid attitude is `blinded` only if a body is in the field and hardly any of the frame's stars were
detected. Where they were, the attitude was lost for another reason, which stands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from starhil.emulator.sensor.pipeline.messages import FrameResult
from starhil.emulator.sensor.sky.light import disc_in_field, through_baffle
from starhil.emulator.sensor.sky.objects import SkyObjects
from starid.arithmetic.arrays import Array, Mask
from starid.arithmetic.matrices import lengths
from starid.attitude import Attitude
from starid.camera import Camera

_BRIGHTEST: Final = 200
"""Number of a frame's stars that are looked for; detections of other light rarely coincide with so few."""

SEEN_PX: Final = 3.0
"""Largest distance between a star and its detection, pixels."""


def bodies_in_field(sky: SkyObjects, attitude: Attitude, camera: Camera) -> tuple[str, ...]:
    """Return which of `sun`, `moon` and `earth` are in the field of view, or light it past the baffle; none behind a cover.

    A body is in the field with any part of its disc.
    """
    if sky.blank:
        return ()
    passing = through_baffle(sky, attitude)
    return tuple(
        name
        for name, body in (("sun", sky.sun), ("moon", sky.moon), ("earth", sky.earth))
        if body is not None
        and (name in passing or disc_in_field(attitude.to_sensor(body.direction), body.radius_rad, camera))
    )


def stars_seen(stars_xy: Array, detections_xy: Array) -> int:
    """Return how many of a frame's stars (n, 2), brightest first, were detected (m, 2)."""
    return int(np.count_nonzero(near_any(stars_xy[:_BRIGHTEST], detections_xy)))


def near_any(xy: Array, others_xy: Array) -> Mask:
    """Return which positions (n, 2) are those of a star and its detection together with one of the others (m, 2)."""
    offsets = xy[:, None] - others_xy
    return np.asarray((lengths(offsets) <= SEEN_PX).any(axis=1), dtype=np.bool_)


def with_bodies(result: FrameResult, in_field: tuple[str, ...], *, enough_stars: bool) -> FrameResult:
    """Return a result with the bodies in the field; unless enough stars were seen, they are the reason for no attitude."""
    blinded = bool(in_field) and not result.valid and not enough_stars
    return replace(result, in_field=in_field, reason="blinded" if blinded else result.reason)
