"""Previews: the image for display, and what is in it."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.pipeline.preview import compress, make_preview, unused_stars
from starhil.emulator.sensor.renderer import Frame, ObjectTruth, StarTruth
from starhil.emulator.sensor.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera
from starid.identification.solution import FeatureReport, Reason, Solution

pytestmark = pytest.mark.lowest("opencv")

CAMERA = Camera.from_fov(20.0, 200, 100)
POINTING = Attitude.from_radec_roll(80.0, 10.0, 0.0)


def frame(magnitudes=(2.0, 7.0), xy=((50.0, 40.0), (60.0, 20.0))):
    count = len(magnitudes)
    stars = StarTruth(
        np.arange(1, count + 1, dtype=np.int32), np.arange(count), np.array(xy), np.ones(count), np.array(magnitudes),
        np.ones(count, dtype=np.bool_),
    )  # fmt: skip
    image = np.full((100, 200), 9, dtype=np.uint8)
    image[40, 50] = 250
    objects = ObjectTruth(np.array([[3.0, 4.0]]), np.zeros((0, 2)), np.zeros((0, 4)), np.zeros((0, 4)), 0.0)
    return Frame(image, stars, POINTING, (0.0, 0.0, 0.0), 0.1, 1, 1, objects)


def preview(sky=None, **options):
    return make_preview(frame(**options), CAMERA, SensorModel(), SkyObjects.from_dict(sky or {}))


def overlay(sky=None, **options):
    return json.loads(preview(sky, **options).overlay)


def test_the_image_keeps_its_size_and_its_star_is_the_brightest():
    image = cv2.imdecode(np.frombuffer(preview().jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (100, 200)
    assert np.unravel_index(np.argmax(image), image.shape) == (40, 50)


def test_brightness_rises_with_the_counts_from_black_to_white():
    ramp = np.tile(np.arange(1024, dtype=np.uint16), (64, 1))
    shown = cv2.imdecode(np.frombuffer(compress(ramp, 9.0, 0.6, 10), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    middle = shown[32].astype(int)
    assert middle[:8].max() <= 4
    assert middle[-8:].min() >= 250
    assert np.all(np.diff(middle[::32]) >= 0)
    assert middle[9 + 30] > 60  # a faint star, 50 sigma in its pixel, is seen


def test_catalogue_stars_are_those_in_the_image_that_a_viewer_may_miss():
    found = overlay(magnitudes=(2.0, 7.0, 3.0), xy=((50.0, 40.0), (60.0, 20.0), (-5.0, 20.0)))
    assert found["catalogue"] == [[1, 50.0, 40.0, 2.0]]
    assert found["false_stars"] == [[3.0, 4.0]]


def test_a_star_that_is_detected_but_not_in_the_solution_is_not_missing():
    places = np.array([[50.0, 40.0], [60.0, 20.0], [150.0, 20.0], [151.0, 20.0]])
    hip = np.array([1, 2, 3, 4])
    detections = np.array([[50.1, 40.0], [59.0, 21.0], [150.9, 20.0], [10.0, 90.0]])
    assert unused_stars(detections, [1, 0, 0, 0], hip, places) == [0, 2, 3, 0]
    assert unused_stars(np.zeros((0, 2)), [], hip, places) == []


@pytest.mark.parametrize(
    ("obstruction", "corners"),
    [
        ({"share": 0.25}, {(149.5, -0.5), (199.5, -0.5), (199.5, 99.5), (149.5, 99.5)}),
        ({"share": 0.5, "angle_deg": 90.0}, {(-0.5, 49.5), (199.5, 49.5), (199.5, 99.5), (-0.5, 99.5)}),
        ({"polygon_px": [[1, 2], [30, 2], [3, 40]]}, {(1, 2), (30, 2), (3, 40)}),
    ],
)
def test_a_cover_is_a_polygon(obstruction, corners):
    (polygon,) = overlay({"obstructions": [obstruction]})["covered"]
    assert len(polygon) == len(corners)
    assert all(min(abs(x - a) + abs(y - b) for a, b in corners) <= 3.0 for x, y in polygon)


def test_bodies_have_their_outline_where_the_lens_shows_it():
    moon, earth, planet = overlay(
        {
            "moon": {"ra_deg": 80.0, "dec_deg": 10.0, "diameter_deg": 2.0},
            "earth": {"ra_deg": 260.0, "dec_deg": -10.0, "radius_deg": 60.0},
            "planets": [{"ra_deg": 80.0, "dec_deg": 12.0, "magnitude": -2.0, "name": "Jupiter"}],
        }
    )["bodies"]
    radius = [np.hypot(x - 99.5, y - 49.5) for x, y in moon["outline_px"]]
    assert np.mean(radius) == pytest.approx(np.tan(np.radians(1.0)) * CAMERA.focal_px[0], rel=0.01)
    assert earth["outline_px"] == [None] * len(earth["outline_px"])
    ((x, y),) = planet["outline_px"]
    assert (planet["name"], x) == ("Jupiter", pytest.approx(99.5, abs=0.1))
    assert y < 49.5  # north is up


def test_the_overlay_says_how_features_identified_the_image_and_what_the_filter_removed():
    features = FeatureReport(
        "rsi", removed_index=(3, 7), region_deg=2.0, region_at_deg=(83.8, -1.2), weights=4
    )
    solution = replace(Solution.invalid(Reason.NO_MATCH), features=features)
    made = make_preview(frame(), CAMERA, SensorModel(), SkyObjects(), None, solution)
    shown = json.loads(made.overlay)["features"]
    assert (shown["removed"], shown["region_deg"], shown["region_at_deg"]) == ([3, 7], 2.0, [83.8, -1.2])
    assert shown["error_psi"] is None  # not computed, and JSON has no NaN
    plain = make_preview(
        frame(), CAMERA, SensorModel(), SkyObjects(), None, Solution.invalid(Reason.NO_MATCH)
    )
    assert json.loads(plain.overlay)["features"] is None
