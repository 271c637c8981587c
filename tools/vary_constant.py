"""Show what detection loses if a constant has another value: `python tools/vary_constant.py imaging.fits._RELAXED_SHARE 0.4 1`.

The same images of some skies are searched with the value of the source and with each given one. A constant that a compiled kernel
reads cannot be varied: the kernel in the cache holds the old value.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import time
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from starhil.emulator.benchmarks.campaign import block_side
from starhil.emulator.benchmarks.hard_sky import FASTEST_DEG_S, HARD_SENSOR, hard_sky
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starid.arithmetic.arrays import Array, GreyImage
from starid.attitude import random_attitude
from starid.camera import DEFAULT_FOV_DEG, Camera
from starid.catalog import load_catalog
from starid.imaging.detection import Detections, DetectionSettings, detect

_MATCH_PX: Final = 1.5
_LARGEST: Final = 100.0
"""Limit of a squared error over its variance, so that one blend does not decide the mean."""


class Sky(NamedTuple):
    """Images of one kind."""

    sensor: SensorModel = SensorModel()
    rate_deg_s: float = 0.0
    fov_deg: float = DEFAULT_FOV_DEG
    blocked: float = 0.0


SKIES: Final = {
    "at rest": Sky(),
    "0.3 deg/s": Sky(rate_deg_s=0.3),
    "1 deg/s": Sky(rate_deg_s=1.0),
    "3 deg/s, 50 ms": Sky(SensorModel(exposure_s=0.05), 3.0),
    "few stars": Sky(SensorModel(limiting_magnitude=3.5, hot_pixels=300)),
    "field of 12 deg": Sky(fov_deg=12.0),
    "20 ms": Sky(SensorModel(exposure_s=0.02)),
    "behind a body": Sky(SensorModel(hot_pixels=300), blocked=0.8),
    "spot of 0.45 px": Sky(SensorModel(psf_sigma_px=0.45)),
    "16 bits, 5000 hot": Sky(SensorModel(bits=16, read_noise_e=30.0, hot_pixels=5000)),
    "hard": Sky(HARD_SENSOR, FASTEST_DEG_S),
}


def images(sky: Sky, count: int) -> Iterator[tuple[GreyImage, Array, float]]:
    """Render images; yield each with the places of its stars and the typical length of their trails, pixels."""
    renderer = Renderer(Camera.from_fov(sky.fov_deg), load_catalog(), sky.sensor, seed=1)
    for number in range(count):
        rng = np.random.default_rng((1, number))
        attitude, axis = random_attitude(rng), rng.normal(size=3)
        objects = hard_sky(attitude, rng) if sky.sensor is HARD_SENSOR else None
        rate = np.deg2rad(sky.rate_deg_s) * axis / np.linalg.norm(axis)
        frame = renderer.render(attitude, rate, number, objects=objects)
        trail_px = float(np.median(np.linalg.norm(renderer.trails(frame), axis=1)))
        yield block_side(frame.image, sky.blocked, rng), frame.stars.xy_px[frame.stars.visible], trail_px


def compared(found: Detections, places: Array, trail_px: float) -> tuple[int, int, list[float]]:
    """Return the number of stars found, that of other detections, and the stars' squared errors over their variances."""
    off = found.xy_px[:, None] - places[None]
    distance = np.linalg.norm(off, axis=2)
    nearest = distance.argmin(axis=1) if distance.size else np.zeros(0, dtype=np.int64)
    rows = np.arange(len(found))
    near = distance[rows, nearest] < _MATCH_PX + 0.25 * trail_px
    squares = np.square(off[rows, nearest][near] / found.xy_sigma_px[near]).mean(axis=1)
    return len(set(nearest[near])), int(np.count_nonzero(~near)), np.minimum(squares, _LARGEST).tolist()


def main() -> None:
    """Print a table of the skies whose detections differ, and the totals of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("constant", help="module and name, without starid: imaging.fits._RELAXED_SHARE")
    parser.add_argument("values", nargs="+", type=float)
    parser.add_argument("--images", type=int, default=5, help="of each sky")
    options = parser.parse_args()
    path, _, name = options.constant.rpartition(".")
    module = importlib.import_module(f"starid.{path}")
    kept = getattr(module, name)
    values: list[Any] = [kept, *(type(kept)(value) for value in options.values)]
    total = np.zeros((len(values), 3))
    detect(np.zeros((64, 64), dtype=np.uint8))  # kernels are loaded before times are measured
    print(f"{'sky':18}" + "".join(f"{value:>14g}: found, false, (error/sigma)^2" for value in values))
    for title, sky in SKIES.items():
        sums = np.zeros((len(values), 3))
        squares: list[list[float]] = [[] for _ in values]
        settings: DetectionSettings = dataclasses.replace(sky.sensor.detection_settings(), psf_sigma_px=None)
        for image, places, trail_px in images(sky, options.images):
            for row, value in enumerate(values):
                setattr(module, name, value)
                start = time.thread_time()
                found = detect(image, settings)
                spent = time.thread_time() - start
                hits, others, errors = compared(found, places, trail_px)
                sums[row] += hits, others, spent
                squares[row] += errors
            setattr(module, name, kept)
        total += sums
        cells = [
            f"{int(n):6d} {int(m):5d} {np.mean(e or [0.0]):6.3f}"
            for (n, m, _), e in zip(sums, squares, strict=True)
        ]
        if len(set(cells)) > 1:
            print(f"{title:18}" + "".join(f"{cell:>30}" for cell in cells))
    count = options.images * len(SKIES)
    print(f"{'all':18}" + "".join(f"{int(n):12d} {int(m):5d} {1e3 * s / count:6.2f} ms" for n, m, s in total))


if __name__ == "__main__":
    main()
