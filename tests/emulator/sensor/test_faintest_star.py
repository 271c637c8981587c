"""What a camera sees: the faintest star that its detector finds, and the warning of a field with few stars."""

import math
import re

import numpy as np
import pytest

from starhil.emulator.benchmarks.ecss_campaign import EcssPlan
from starhil.emulator.sensor.model import SensorModel
from starid.catalog import load_catalog


def test_the_faintest_star_has_the_threshold_in_an_ideal_matched_filter():
    sensor = SensorModel(psf_sigma_px=1.2, read_noise_e=10.0, dark_e_s=50.0)
    pixel_rad, threshold = 1.0 / 1200.0, 5.0
    edge = np.arange(-12.0, 13.0) - 0.5
    along = np.diff([0.5 * math.erf(x / (1.2 * math.sqrt(2.0))) for x in edge])
    spot = np.outer(along, along)  # share of the light in each pixel
    variance = 10.0**2 + 50.0 * 0.2 + sensor.sky_e_s(pixel_rad) * 0.2 + (6400.0 / 255.0) ** 2 / 12.0
    electrons = sensor.electrons(sensor.faintest_magnitude(pixel_rad, threshold))
    assert electrons * math.sqrt(float(np.sum(spot**2)) / variance) == pytest.approx(threshold, rel=0.02)


def test_a_camera_that_sees_few_stars_is_warned_of():
    assert EcssPlan("cubestar").warning() == ""
    text = EcssPlan("cubestar", ("camera.fov_deg=20",)).warning()
    stated = re.match(
        r"the field has (.*) stars on average, since the detector finds stars to about V (.*); ", text
    )
    assert stated is not None
    stars, faintest = map(float, stated.groups())
    share = (
        4.0 * math.asin(math.sin(math.radians(10.0)) ** 2) / (4.0 * math.pi)
    )  # of the sky: a square pyramid
    number = share * np.count_nonzero(load_catalog().v < faintest)
    assert stars == pytest.approx(
        number, rel=0.15
    )  # 0.05 mag of rounding are 6 %; the law of the stars' number, as much
    bright = EcssPlan("ideal", ("parameters.limiting_magnitude=2",)).warning()
    assert "since parameters.limiting_magnitude is 2" in bright
