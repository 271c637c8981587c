"""Measure how well photographs are solved: simulated ones with one defect each, as a Markdown table.

Run from the repository's root: ``python tools/measure_photographs.py --frames 10 --seed 1``.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
WRONG_ARCSEC: Final = 360.0
TOLERANCE: Final = 0.1

CONDITIONS: Final[dict[str, dict[str, Any]]] = {
    "6° wide": {"fov_deg": 6.0},
    "11° wide": {},
    "25° wide": {"fov_deg": 25.0},
    "66° wide, to V 6": {"fov_deg": 66.0, "limit": 6.0},
    "a pole in the field": {"fov_deg": 20.0, "centre_deg": (10.0, 88.0)},
    "RA 0° in the field": {"fov_deg": 20.0, "centre_deg": (359.9, -5.0)},
    "barrel distortion, 10 % at the corner": {"distortion": -0.10},
    "pincushion distortion, 5 %": {"distortion": 0.05},
    "out of focus, spots of σ 5 px": {"spot_px": 5.0},
    "undersampled, spots of σ 0.5 px": {"spot_px": 0.5},
    "trails of 12 px": {"trail_px": 12.0},
    "hill over half the image": {"foreground": 0.5},
    "0.1 % of the pixels hot": {"hot": 1e-3},
    "2000 pixels hot, JPEG of quality 85": {"hot": 2000 / 480000, "quality": 85},
    "2000 pixels hot, clouds, 34° wide": {
        "hot": 2000 / 480000,
        "clouds": 0.9,
        "fov_deg": 34.0,
        "limit": 6.0,
        "spot_px": 0.8,
    },
    "distortion removed, 0.5 % of the pixels hot, 34° wide": {
        "hot": 5e-3,
        "distortion": -0.12,
        "straight": 0.8,
        "fov_deg": 34.0,
        "limit": 6.8,
    },
    "clouds": {"clouds": 0.9},
    "Moon in the field": {"glow": 120.0},
    "JPEG of quality 50": {"quality": 50},
    "JPEG of quality 70, hill, hot pixels, barrel 5 %": {
        "quality": 70,
        "foreground": 0.3,
        "hot": 2e-4,
        "distortion": -0.05,
    },
    "mirrored": {"mirrored": True},
    "negative": {"negative": True},
}


def main() -> int:
    """Print the table; return 1 if any solution was wrong."""
    sys.path.insert(0, str(ROOT))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10, help="photographs per condition")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(
        "| photograph | frames | solved | wrong | error of the centre ″, median | worst | processor time s, median |"
    )
    print("|---|---|---|---|---|---|---|")
    wrong = 0
    for number, (name, defects) in enumerate(CONDITIONS.items()):
        errors, times = zip(
            *(_solve(options.seed + 1000 * number + frame, dict(defects)) for frame in range(options.frames)),
            strict=True,
        )
        answered = np.array([error for error in errors if error is not None])
        good = answered[answered < WRONG_ARCSEC]
        wrong += len(answered) - len(good)
        middle, worst = (np.median(good), good.max()) if good.size else (np.nan, np.nan)
        print(
            f"| {name} | {options.frames} | {len(good)} | {len(answered) - len(good)} | {middle:.1f} | {worst:.1f} "
            f"| {np.median(times):.1f} |",
            flush=True,
        )
    return 1 if wrong else 0


def _solve(seed: int, defects: dict[str, Any]) -> tuple[float | None, float]:
    """Error of the image centre, arcseconds (None without an answer), and processor time, seconds."""
    from starid.attitude import ARCSEC_PER_RAD
    from starid.camera import Camera
    from starid.catalog import load_catalog
    from starid.photograph.solver import solve_image
    from tests.starid.photograph.night_sky import photograph

    sky = load_catalog()
    mirrored, negative = defects.pop("mirrored", False), defects.pop("negative", False)
    image, truth, camera = photograph(sky, seed, **defects)
    if mirrored:
        image = np.ascontiguousarray(image[:, ::-1])
    if negative:
        image = np.invert(image)
    off = np.random.default_rng(seed).uniform(-0.9, 0.9) * TOLERANCE
    rough = Camera.from_fov(camera.fov_deg * (1.0 + off), camera.width, camera.height)
    begin = time.process_time()
    result = solve_image(image, rough, sky, fov_tolerance=TOLERANCE)
    took = time.process_time() - begin
    if not result.solution.valid:
        return None, took
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    seen = result.solution.attitude.to_icrs(result.camera.back_project(middle))
    true = truth.to_icrs(camera.back_project(middle))
    return float(np.linalg.norm(seen - true) * ARCSEC_PER_RAD), took


if __name__ == "__main__":
    sys.exit(main())
