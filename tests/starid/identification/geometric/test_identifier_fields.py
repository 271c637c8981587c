"""The identifier over the whole sky, in narrow and wide fields, with known and unknown focal length."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from starid.attitude import Attitude, random_attitude
from starid.camera import Camera
from starid.identification.geometric.identifier import Identifier, scaled_camera
from tests.starid.identification.geometric.sky_points import identifier, sky

pytestmark = pytest.mark.long

RIGHT_ARCSEC = 60.0
PLACES = [
    (ra, dec, roll)
    for ra, dec in [(0.0, 90.0), (77.0, -90.0), (12.0, 89.9), (0.0, 0.0), (359.999, 20.0), (180.0, -45.0)]
    for roll in (0.0, 90.0, 180.0, 271.3)
]


@pytest.mark.parametrize(("ra", "dec", "roll"), PLACES)
def test_poles_and_wrap_of_right_ascension(ra: float, dec: float, roll: float) -> None:
    attitude = Attitude.from_radec_roll(ra, dec, roll)
    solution = identifier().identify(*sky(attitude)[:2])
    assert solution.valid
    assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC


CAMERAS = {
    "5°": Camera.from_fov(5.0, 1024, 1024),
    "12° × 9°": Camera.from_fov(12.0, 1024, 768),
    "25° distorted": Camera.from_fov(25.0, 1024, 1024, distortion=(-0.1, 0.03, 1e-3, -5e-4, 0.0)),
    "90°": Camera.from_fov(90.0, 1024, 1024),
    "90° equidistant": Camera.from_fov(90.0, 1024, 1024, model="equidistant"),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_fields_of_5_to_90_degrees(name: str) -> None:
    camera = CAMERAS[name]
    identifier = Identifier(camera)
    rng = np.random.default_rng(8)
    error_px, count = 0.3, 8
    for i in range(count):
        attitude = random_attitude(rng)
        xy, flux, hip = sky(
            attitude,
            i,
            camera=camera,
            limit=float(identifier.stars.v.max()) - 0.5,
            sigma_px=error_px,
            identified=identifier,
        )
        solution = identifier.identify(xy, flux)
        assert solution.valid, (i, solution.reason, len(xy))
        error = solution.attitude.error_to(attitude)
        assert error.cross_boresight_arcsec < 6.0 * solution.cross_boresight_sigma_arcsec
        assert solution.cross_boresight_sigma_arcsec < np.degrees(camera.pixel_scale_rad) * 3600.0
        assert np.mean(solution.hip == hip[solution.detection_index]) > 0.95


@functools.cache
def of_unknown_focal_length(model: str, fov_deg: float) -> Identifier:
    return Identifier(Camera.from_fov(fov_deg, 1024, 1024, model=model), fov_tolerance=0.1)


@pytest.mark.parametrize("model", ["pinhole", "equidistant"])
@pytest.mark.parametrize("fov_deg", [11.0, 60.0])
@pytest.mark.parametrize("factor", [0.93, 1.06])
def test_an_unknown_focal_length_is_found(model: str, fov_deg: float, factor: float) -> None:
    identifier = of_unknown_focal_length(model, fov_deg)
    camera = scaled_camera(identifier.camera, factor)
    rng = np.random.default_rng(9)
    for i in range(3):
        attitude = random_attitude(rng)
        xy, flux, _ = sky(attitude, i, camera=camera, limit=6.5, identified=identifier)
        solution = identifier.identify(xy, flux)
        assert solution.valid
        assert solution.camera is not None
        assert solution.camera.focal_px[0] == pytest.approx(camera.focal_px[0], rel=2e-3)
        assert solution.attitude.error_to(attitude).cross_boresight_arcsec < RIGHT_ARCSEC


def test_random_points_are_rejected_at_an_unknown_focal_length_too() -> None:
    identifier = of_unknown_focal_length("pinhole", 25.0)
    rng = np.random.default_rng(10)
    for _ in range(4):
        n = int(rng.integers(20, 100))
        points = rng.uniform(0.0, 1023.0, (n, 2))
        assert not identifier.identify(points, 10.0 ** rng.uniform(0.0, 1.5, n)).valid


def test_a_refined_camera_is_used_as_calibrated() -> None:
    nominal = Camera.from_fov(25.0, 1024, 1024)
    camera = scaled_camera(nominal, 1.04)
    identifier = of_unknown_focal_length("pinhole", 25.0)
    attitude = Attitude.from_radec_roll(80.0, 10.0, 30.0)
    xy, flux, _ = sky(attitude, camera=camera, limit=6.0, identified=identifier)
    assert not identifier.with_camera(nominal).identify(xy, flux).valid
    solution = identifier.with_camera(camera).identify(xy, flux)
    assert solution.valid
    assert solution.camera is None
    assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
