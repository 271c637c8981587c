"""Processor time of each stage of a frame on one core."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.detection import detect
from starid.interface import make_identifier

_WARM_UP = 3


@dataclass(frozen=True)
class StageRow:
    """Time of one stage over many frames.

    Attributes
    ----------
    stage : str
        "render", "detect", "identify", or "all".
    frames : int
        Number of measured frames.
    median_ms, p99_ms, least_ms : float
        Median, 99th percentile and minimum, milliseconds.
    """

    stage: str
    frames: int
    median_ms: float
    p99_ms: float
    least_ms: float


def measure_frames(
    frames: int = 200,
    seed: int = 1,
    rate_deg_s: float = 0.0,
    sensor: SensorModel | None = None,
    camera: Camera | None = None,
    progress: Callable[[str], None] | None = None,
) -> list[StageRow]:
    """Measure the processor time of each stage over frames of random attitude, after a warm-up.

    Thread time is used because other programs on the machine affect it little.

    Parameters
    ----------
    frames : int
        Number of measured frames.
    seed : int
        Seed of attitudes and noise.
    rate_deg_s : float
        Body rate during the exposures, about an axis across the boresight.
    sensor, camera : optional
        Default: starhil's.
    progress : callable, optional
        Receives one line per step.
    """
    if frames < 1:
        raise EmulatorError(f"bench frame: frames must be at least one, not {frames}")
    sensor = SensorModel() if sensor is None else sensor
    camera = Camera.from_fov() if camera is None else camera
    catalog = load_catalog()
    if progress is not None:
        progress("warming up")
    renderer = Renderer(camera, catalog, sensor, seed)
    identifier = make_identifier("geometric", camera, catalog)
    settings = sensor.detection_settings()
    rng = np.random.default_rng(seed)
    rate = np.array([math.radians(rate_deg_s), 0.0, 0.0])
    times = []
    for index in range(-_WARM_UP, frames):
        if progress is not None and index == 0:
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
