"""Sun, Moon and Earth in the field of view."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from starhil.emulator.pipeline.messages import FrameResult
from starhil.emulator.sky.directions import icrs_vector
from starhil.emulator.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera

_BORDER_SAMPLES: Final = 33
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
        name for name, ra, dec, radius in bodies if _reaches(icrs_vector(ra, dec), radius, attitude, camera)
    )


def _reaches(centre: np.ndarray, radius_deg: float, attitude: Attitude, camera: Camera) -> bool:
    """Return whether a disc around an ICRS direction reaches the field."""
    direction = attitude.to_sensor(centre)
    _, inside = camera.project(direction[None, :])
    if inside[0]:
        return True
    edge = camera.back_project(camera.border(_BORDER_SAMPLES))
    nearest = float(np.nanmax(edge @ direction, initial=-1.0))
    return nearest >= math.cos(math.radians(min(radius_deg, 180.0)))


def with_bodies(result: FrameResult, in_field: tuple[str, ...]) -> FrameResult:
    """Return a result with the bodies in the field; without stars, they are the reason."""
    if not in_field:
        return result
    blinded = not result.valid and result.reason in _WITHOUT_STARS
    return replace(result, in_field=in_field, reason="blinded" if blinded else result.reason)
