"""Sun, Moon and Earth in the field of view."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from starhil.emulator.pipeline.messages import FrameResult
from starhil.emulator.sky.directions import icrs_vector
from starhil.emulator.sky.field import disc_in_field
from starhil.emulator.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera

_WITHOUT_STARS: Final = frozenset({"too_few_stars", "no_match", "prediction_lost", "detection_failed"})


def bodies_in_field(sky: SkyObjects, attitude: Attitude, camera: Camera) -> tuple[str, ...]:
    """Return which of `sun`, `moon` and `earth` are in the field of view, with any part of their discs; none behind a cover."""
    if sky.blank:
        return ()
    bodies: tuple[tuple[str, float, float, float], ...] = ()
    if sky.sun is not None:
        bodies += (("sun", sky.sun.ra_deg, sky.sun.dec_deg, 0.0),)
    if sky.moon is not None:
        bodies += (("moon", sky.moon.ra_deg, sky.moon.dec_deg, sky.moon.diameter_deg / 2.0),)
    if sky.earth is not None:
        bodies += (("earth", sky.earth.ra_deg, sky.earth.dec_deg, sky.earth.radius_deg),)
    return tuple(
        name
        for name, ra, dec, radius in bodies
        if disc_in_field(attitude.to_sensor(icrs_vector(ra, dec)), math.radians(radius), camera)
    )


def with_bodies(result: FrameResult, in_field: tuple[str, ...]) -> FrameResult:
    """Return a result with the bodies in the field; without stars, they are the reason."""
    if not in_field:
        return result
    blinded = not result.valid and result.reason in _WITHOUT_STARS
    return replace(result, in_field=in_field, reason="blinded" if blinded else result.reason)
