"""The same seed gives the same bytes on another processor: catalogue, images, detections and attitudes."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.process

SCRIPT = """
import hashlib
import numpy as np
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog.catalog import _tables
from starid.catalog import load_catalog
from starid.identification.geometric.pattern_index import resolved_stars
from starid.catalog.hipparcos import default_path
from starid.imaging.detection import detect
from starid.imaging.normal_table import _CDF, _PDF
from starid.identification.star_identifier import make_identifier

def show(name, *arrays):
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    print(name, digest.hexdigest()[:16])

def columns(stars):
    return [getattr(stars, name) for name in ("hip", "vectors", "ra_rad", "dec_rad", "hp", "v")]

show("normal distribution", _CDF, _PDF)
table = _tables(default_path(), 2026.0)
show("catalogue", *(table[name] for name in sorted(table)))
catalog, camera, sensor = load_catalog(), Camera.from_fov(), SensorModel()
show("merged stars", *columns(resolved_stars(catalog, 6.5, 2e-3)))
renderer = Renderer(camera, catalog, sensor, 1)
identifier = make_identifier("geometric", camera, catalog)
rng = np.random.default_rng(1)
for index, rate in enumerate((0.0, 0.0, 0.02, 0.05)):
    frame = renderer.render(random_attitude(rng), np.array([rate, 0.0, 0.0]), index)
    show(f"image {index}", frame.image)
    found = detect(frame.image, sensor.detection_settings())
    show(f"detections {index}", found.xy_px, found.flux, found.xy_sigma_px, found.flux_sigma)
    solution = identifier.identify(found.xy_px, found.flux, found.sigma_px)
    show(f"solution {index}", solution.quaternion_xyzw, solution.covariance)
"""


def results(**environment: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_another_processor_gives_the_same_bytes() -> None:
    """Kernels for a processor of the year 2003, and none of numpy's own vector instructions."""
    umath = getattr(np, "_core", None) or np.core
    features = " ".join(umath._multiarray_umath.__cpu_dispatch__)
    here = results()
    assert len(here) == 15
    assert results(NUMBA_CPU_NAME="generic", NPY_DISABLE_CPU_FEATURES=features) == here
