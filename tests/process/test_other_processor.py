"""The same seed gives the same bytes on another processor: catalogue, images with and without bodies, detections and attitudes."""

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
from starhil.emulator.sensor.sky.objects import EarthLimb, Moon, SkyObjects, SunGlare
from starhil.emulator.sensor.sky.view import Sky
from starid.attitude import Attitude
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

here = Attitude.from_radec_roll(83.8, -1.2, 30.0)
bodies = dict(moon=Moon(80.0, 2.0, illuminated=0.4), sun=SunGlare(83.8, 60.0))
for radius_deg, dec_deg in ((64.0, -62.0), (5.0, -8.0)):
    earth = EarthLimb(83.8, dec_deg, radius_deg=radius_deg, sun_ra_deg=83.8, sun_dec_deg=60.0)
    show(f"Earth of {radius_deg}", renderer.render(here, objects=SkyObjects(earth=earth, **bodies)).image)
seen = Sky({"bodies": "ephemeris"}).view(1.78e9, np.array([7e6, 0.0, 0.0]), np.array([0.0, 7500.0, 0.0]))
show("apparent directions", seen.observer.directions, seen.observer.apparent_stars(catalog.vectors, 0.0 * catalog.v))
show("sky of a date", renderer.render(here, objects=seen.objects, observer=seen.observer).image)
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
    """Kernels and BLAS for a processor of the year 2004, and none of numpy's own vector instructions."""
    umath = getattr(np, "_core", None) or np.core
    features = " ".join(umath._multiarray_umath.__cpu_dispatch__)
    here = results()
    assert len(here) == 19
    assert (
        results(NUMBA_CPU_NAME="generic", NPY_DISABLE_CPU_FEATURES=features, OPENBLAS_CORETYPE="Prescott")
        == here
    )
