"""What temperature does to an image: dark current, direction, scale and distortion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.dark_map import measure_dark_map
from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.sensor.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.detection import detect

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CAMERA = Camera.from_fov(20.0, 320, 256)
SENSOR = SensorModel(bits=12, reference_c=20.0, temperature_c=20.0)
COVERED = SkyObjects(blank=True)
ARCSEC_PER_PIXEL = CAMERA.pixel_scale_rad * 206_264.8


@pytest.fixture(scope="module")
def catalog():
    return load_catalog()


@pytest.fixture(scope="module")
def renderer(catalog):
    return Renderer(CAMERA, catalog, SENSOR, seed=1)


def dark_dn(renderer, temperature_c: float) -> float:
    image = renderer.render(ORION, exposure_s=1.0, temperature_c=temperature_c, objects=COVERED).image
    return float(np.mean(image) - renderer.sensor.offset_dn)


def test_dark_current_doubles_with_every_dark_doubling_c(renderer):
    cold, warm, hot = (
        dark_dn(renderer, SENSOR.reference_c + 2.0 * SENSOR.dark_doubling_c * n) for n in range(3)
    )
    assert warm == pytest.approx(4.0 * cold, rel=0.1)
    assert hot == pytest.approx(16.0 * cold, rel=0.1)


def test_at_the_reference_temperature_an_image_is_as_without_one(renderer):
    plain, stated = renderer.render(ORION), renderer.render(ORION, temperature_c=SENSOR.reference_c)
    np.testing.assert_array_equal(plain.image, stated.image)


def test_an_impossible_temperature_is_rejected(renderer):
    with pytest.raises(EmulatorError, match="temperature_c"):
        renderer.render(ORION, temperature_c=500.0)


def test_the_boresight_drifts_against_the_mounting(catalog):
    sensor = dataclasses.replace(
        SENSOR, boresight_drift_x=10.0, boresight_drift_y=-4.0, boresight_drift_z=3.0
    )
    stars = Renderer(CAMERA, catalog, sensor).render(ORION, temperature_c=30.0).stars
    drift = np.array([100.0, -40.0, 30.0]) / 206_264.806
    expected, _ = CAMERA.project(ORION.rotated(drift).to_sensor(catalog.vectors[stars.catalog_index]))
    np.testing.assert_allclose(stars.xy_px, expected, atol=1e-9)
    there = Renderer(CAMERA, catalog, sensor).render(ORION, temperature_c=20.0).stars
    shift = np.median(np.linalg.norm(stars.xy_px[:5] - there.xy_px[:5], axis=1))
    assert shift == pytest.approx(np.hypot(100.0, 40.0) / ARCSEC_PER_PIXEL, rel=0.1)


def test_focal_length_and_distortion_drift(catalog):
    sensor = dataclasses.replace(SENSOR, focal_drift=1e-5, k1_drift=1e-4)
    stars = Renderer(CAMERA, catalog, sensor).render(ORION, temperature_c=40.0).stars
    fx, fy = CAMERA.focal_px
    hot = dataclasses.replace(
        CAMERA, focal_px=(fx * 1.0002, fy * 1.0002), distortion=(2e-3, 0.0, 0.0, 0.0, 0.0)
    )
    expected, _ = hot.project(ORION.to_sensor(catalog.vectors[stars.catalog_index]))
    np.testing.assert_allclose(stars.xy_px, expected, atol=1e-9)


def test_the_dark_frame_removes_false_stars_of_a_hot_detector(catalog):
    sensor = dataclasses.replace(SENSOR, hot_pixels=300, hot_e_s=20_000.0, psf_sigma_px=1.2)
    renderer = Renderer(CAMERA, catalog, sensor, seed=2)
    dark = measure_dark_map(sensor, CAMERA.height, CAMERA.width, frames=16, seed=3)
    image = renderer.render(ORION, exposure_s=0.1, temperature_c=40.0).image
    cleaned = dark.subtracted(image, 0.1, 1.0, 40.0)

    def rejected(pixels) -> tuple[int, int]:
        found = detect(pixels, sensor.detection_settings())
        return len(found), found.rejected

    stars, spurious = rejected(renderer.render(ORION, exposure_s=0.1, temperature_c=-20.0).image)
    raw, better = rejected(image), rejected(cleaned)
    assert raw[1] > 50
    assert better[1] < 0.2 * raw[1] + spurious
    assert better[0] >= stars - 3
