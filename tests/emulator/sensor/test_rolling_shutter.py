"""A rolling shutter shows each row at its own time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starid.attitude import Attitude, propagate
from starid.camera import Camera
from starid.catalog import load_catalog

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CAMERA = Camera.from_fov(20.0, 320, 256)
ROW_TIME_S = 1e-4
RATE_RAD_S = np.radians([3.0, -2.0, 4.0])


@pytest.fixture(scope="module")
def catalog():
    return load_catalog()


def test_every_star_is_where_it_was_when_its_row_was_exposed(catalog):
    renderer = Renderer(CAMERA, catalog, SensorModel(row_time_s=ROW_TIME_S))
    stars = renderer.render(ORION, RATE_RAD_S).stars
    assert len(stars.hip) > 20
    for row, xy in zip(stars.catalog_index, stars.xy_px, strict=True):
        after_s = (xy[1] - (CAMERA.height - 1) / 2.0) * ROW_TIME_S
        then = propagate(ORION, RATE_RAD_S, after_s)
        expected, _ = CAMERA.project(then.to_sensor(catalog.vectors[row][None, :]))
        assert xy == pytest.approx(expected[0], abs=1e-4)


def test_a_sensor_at_rest_is_not_affected(catalog):
    image = Renderer(CAMERA, catalog, SensorModel(row_time_s=ROW_TIME_S)).render(ORION).image
    np.testing.assert_array_equal(image, Renderer(CAMERA, catalog, SensorModel()).render(ORION).image)


def test_it_shears_the_image(catalog):
    sensor = SensorModel()
    rolling = Renderer(CAMERA, catalog, dataclasses.replace(sensor, row_time_s=ROW_TIME_S))
    seen = rolling.render(ORION, RATE_RAD_S).stars
    still = Renderer(CAMERA, catalog, sensor).render(ORION, RATE_RAD_S).stars
    at = dict(zip(still.hip.tolist(), still.xy_px, strict=True))
    both = [(xy, at[hip]) for hip, xy in zip(seen.hip.tolist(), seen.xy_px, strict=True) if hip in at]
    rows = np.array([there[1] for _, there in both])
    shift = np.array([here[0] - there[0] for here, there in both])
    slope = np.polyfit(rows, shift, 1)[0]
    expected_px_s = -RATE_RAD_S[1] * CAMERA.focal_px[0]  # stars move against the sensor's turn about y
    assert slope == pytest.approx(expected_px_s * ROW_TIME_S, rel=0.3)
