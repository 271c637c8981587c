"""Sun, Moon and Earth in the field of view."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from starhil.emulator.pipeline.messages import FrameResult
from starhil.emulator.sky.field import disc_in_field
from starhil.emulator.sky.light import through_baffle
from starhil.emulator.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera

_WITHOUT_STARS: Final = frozenset({"too_few_stars", "no_match", "prediction_lost", "detection_failed"})


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


def with_bodies(result: FrameResult, in_field: tuple[str, ...]) -> FrameResult:
    """Return a result with the bodies in the field; without stars, they are the reason."""
    if not in_field:
        return result
    blinded = not result.valid and result.reason in _WITHOUT_STARS
    return replace(result, in_field=in_field, reason="blinded" if blinded else result.reason)
