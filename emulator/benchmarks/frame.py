"""Processor time of each stage of a frame on one core."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.pipeline.bodies import bodies_in_field
from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.sensor.sky.light import through_baffle
from starhil.emulator.sensor.sky.view import Sky
from starhil.emulator.truth.orbit import KeplerOrbit
from starid.attitude import Attitude, random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.catalog.earth import unix_time
from starid.identification.star_identifier import make_identifier
from starid.imaging.detection import detect

_WARM_UP: Final = 3

_START: Final = "2026-03-01"
"""Date of the first frame with bodies, two days before the Moon is full."""

_INTERVAL_S: Final = 5.0
_ORBIT: Final = KeplerOrbit(unix_time(_START), 7.07e6, 0.001, math.radians(98.0), math.radians(70.0))
_BESIDE_MOON_RAD: Final = math.radians(18.0)
_MAX_TRIES: Final = 20


@dataclass(frozen=True)
class StageRow:
    """Time of one stage over many frames."""

    stage: str
    """`render`, `detect`, `identify`, or `all`."""
    frames: int
    median_ms: float
    p99_ms: float
    least_ms: float
    """Median, 99th percentile and minimum, milliseconds."""


def measure_frames(
    frames: int = 200,
    seed: int = 1,
    rate_deg_s: float = 0.0,
    progress: Callable[[str], None] = lambda _text: None,
) -> list[StageRow]:
    """Measure the processor time of each stage over frames of random attitude, after a warm-up.

    The body turns about an axis across the boresight. The thread's processor time is used because other programs on
    the machine have little effect on it.
    """
    if frames < 1:
        raise EmulatorError(f"bench frame: frames must be at least one, not {frames}")
    sensor, camera, catalog = SensorModel(), Camera.from_fov(), load_catalog()
    progress("warming up")
    renderer = Renderer(camera, catalog, sensor, seed)
    identifier = make_identifier("geometric", camera, catalog)
    settings = sensor.detection_settings()
    rng = np.random.default_rng(seed)
    rate = np.array([math.radians(rate_deg_s), 0.0, 0.0])
    times = []
    for index in range(-_WARM_UP, frames):
        if index == 0:
            progress(f"timing {frames} frames")
        attitude = random_attitude(rng)
        marks = [time.thread_time()]
        frame = renderer.render(attitude, rate, index + _WARM_UP)
        marks.append(time.thread_time())
        found = detect(frame.image, settings)
        marks.append(time.thread_time())
        identifier.identify(found.xy_px, found.flux, found.sigma_px)
        marks.append(time.thread_time())
        if index >= 0:
            times.append([*np.diff(marks), marks[-1] - marks[0]])
    table = 1e3 * np.array(times)
    return [
        StageRow(
            stage, frames, float(np.median(column)), float(np.quantile(column, 0.99)), float(column.min())
        )
        for stage, column in zip(("render", "detect", "identify", "all"), table.T, strict=True)
    ]


@dataclass(frozen=True)
class BodiesRow:
    """Time of frames with Sun, Moon, Earth, planets and aberration, and of the same frames with stars only."""

    in_field: str
    """Bodies in the field of view: `none`, `earth` or `moon`."""
    stage: str
    """`render` or, with detection and identification, `all`."""
    frames: int
    without_ms: float
    with_ms: float
    ratio: float


def measure_bodies(
    frames: int = 200, seed: int = 1, progress: Callable[[str], None] | None = None
) -> list[BodiesRow]:
    """Measure the time that bodies and aberration add to a frame, alternately with and without them.

    Attitudes are random, for "moon" around the Moon; attitudes at which light passes the baffle are skipped.
    The times are processor time of one thread, including the computation of the sky.
    """
    camera, catalog = Camera.from_fov(), load_catalog()
    renderer = Renderer(camera, catalog, seed=seed)
    identifier = make_identifier("geometric", camera, catalog)
    settings = renderer.sensor.detection_settings()
    skies = (Sky({}), Sky({"bodies": "ephemeris"}))
    rng = np.random.default_rng(seed)

    def times(sky: Sky, unix_s: float, attitude: Attitude, index: int) -> list[float]:
        state = _ORBIT.state(unix_s)
        marks = [time.thread_time()]
        view = sky.view(unix_s, state.position_m, state.velocity_m_s)
        frame = renderer.render(
            attitude,
            frame_index=index,
            objects=view.objects,
            observer=view.observer,
            satellites=view.satellites,
        )
        bodies_in_field(view.objects, attitude, camera)
        marks.append(time.thread_time())
        found = detect(frame.image, settings)
        identifier.identify(found.xy_px, found.flux, found.sigma_px)
        return [mark - marks[0] for mark in (marks[1], time.thread_time())]

    rows = []
    for case in ("none", "earth", "moon"):
        if progress is not None:
            progress(f"timing {frames} pairs of frames, in the field: {case}")
        table: list[list[list[float]]] = []
        for index in range(_MAX_TRIES * (frames + _WARM_UP)):
            unix_s = _ORBIT.epoch_unix_s + index * _INTERVAL_S
            state, attitude = _ORBIT.state(unix_s), random_attitude(rng)
            objects = skies[1].view(unix_s, state.position_m, state.velocity_m_s).objects
            if case == "moon" and objects.moon is not None:
                at_moon = Attitude.from_radec_roll(
                    objects.moon.ra_deg, objects.moon.dec_deg, rng.uniform(0.0, 360.0)
                )
                attitude = at_moon.rotated(_BESIDE_MOON_RAD * rng.uniform(-0.7, 0.7, 3))
            seen = bodies_in_field(objects, attitude, camera) or ("none",)
            if seen != (case,) or through_baffle(objects, attitude):
                continue
            pair = [times(skies[k], unix_s, attitude, index) for k in ((0, 1), (1, 0))[index % 2]]
            table.append(pair if index % 2 == 0 else pair[::-1])
            if len(table) == frames + _WARM_UP:
                break
        medians = 1e3 * np.median(table[_WARM_UP:], axis=0)
        rows += [
            BodiesRow(
                case, stage, len(table) - _WARM_UP, float(without), float(with_), float(with_ / without)
            )
            for stage, (without, with_) in zip(("render", "all"), medians.T, strict=True)
        ]
    return rows
