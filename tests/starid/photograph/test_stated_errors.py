"""The stated error of an attitude includes that of the lens, which was estimated from the same stars."""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import pytest

from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.detection import Detections, detect
from starid.photograph.rough_search import RoughSearch
from starid.photograph.solver import refine_solution
from starid.photograph.views import View
from tests.starid.photograph.night_sky import FOV_DEG, HEIGHT, WIDTH

pytestmark = pytest.mark.long

IMAGES = 40
NOISE_PX = 0.1


def test_the_stated_error_includes_that_of_the_lens() -> None:
    """Trees hide all stars but those on the left of random images: with another focal length they turn the camera about y.

    The mean of the squared errors about y over their variances is 1; without the lens it is 2.5.
    """
    sky = load_catalog()
    nominal = Camera.from_fov(FOV_DEG, WIDTH, HEIGHT)
    camera = dataclasses.replace(nominal, focal_px=(nominal.focal_px[0] * 1.01, nominal.focal_px[1] * 1.01))
    search = RoughSearch(nominal, sky, fov_tolerance=0.1)
    known = search.identifier.with_camera(camera)
    stars = known.stars
    none = detect(np.full((HEIGHT, WIDTH), 10, dtype=np.uint8))
    squares = []
    for seed in range(IMAGES):
        rng = np.random.default_rng((31, seed))
        truth = random_attitude(rng)
        xy, inside = camera.project(truth.to_sensor(stars.vectors))
        inside &= xy[:, 0] < 0.5 * WIDTH
        xy = xy[inside] + rng.normal(0.0, NOISE_PX, (np.count_nonzero(inside), 2))
        flux = 10.0 ** (-0.4 * stars.v[inside])
        solution = known.track(xy, flux, truth, np.full(len(xy), NOISE_PX))
        found = _detections(none, xy, flux)
        refined = refine_solution(solution, View(found), nominal, search, time.perf_counter()).solution
        error = refined.attitude.error_to(truth).rotation_vector_rad
        squares.append(error[1] ** 2 / refined.covariance[1, 1])
    assert np.mean(squares) == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / IMAGES))


def _detections(none: Detections, xy: np.ndarray, flux: np.ndarray) -> Detections:
    """Detections at positions (n, 2) with the true errors."""
    count = len(xy)
    return dataclasses.replace(
        none,
        xy_px=xy,
        flux=flux,
        flux_sigma=0.01 * flux,
        xy_sigma_px=np.full((count, 2), NOISE_PX),
        correlation=np.zeros(count),
        saturated=np.zeros(count, dtype=np.bool_),
        edge=np.zeros(count, dtype=np.bool_),
    )
