"""The limit of a detector is measured, and the thesis's algorithms get it with the zero point and the colour term."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.benchmarks.algorithms import AlgorithmPlan, Comparison, Scene
from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.sensor.pipeline.photometry import _limit_of
from starhil.emulator.truth.source import TruthState
from starid.attitude import Attitude, propagate


@pytest.mark.parametrize(("profile", "low", "high"), [("cubestar", 3.25, 3.75), ("ideal", 5.5, 6.0)])
def test_the_features_stop_where_the_detector_does(profile, low, high):
    device = EcssDevice(EcssPlan(profile, ("run.algorithm=lsi",), 3))
    request = next(iter(Comparison(AlgorithmPlan(profile, 1, 3))._images(Scene(0.0))))[0]
    lsi = device.pipeline.identifier(request)
    assert low <= lsi.options.detected_limit <= high
    assert lsi.database.parameters.kappa <= lsi.options.detected_limit
    sensor = device.pipeline._sensor
    assert lsi.zero_point == pytest.approx(2.5 * math.log10(sensor.zero_magnitude_e_s))
    assert lsi.options.colour_term == sensor.colour_term


def test_the_limit_is_where_ninety_percent_are_found():
    rng = np.random.default_rng(6)
    magnitude = rng.uniform(0.0, 7.0, 20_000)
    found = rng.uniform(size=magnitude.size) < 1.0 / (1.0 + np.exp(12.0 * (magnitude - 4.2)))
    error = np.where(found, rng.normal(0.0, 0.07, magnitude.size), np.nan)
    photometry = _limit_of(magnitude, error)
    assert photometry.limit == pytest.approx(4.0, abs=0.25)
    assert photometry.sigma == pytest.approx(0.07, rel=0.15)


def test_false_stars_are_counted_among_the_detections_and_among_those_removed():
    device = EcssDevice(EcssPlan("ideal", ("run.algorithm=rsi",), 3))
    rate = np.radians([0.0, 0.5, 0.0])
    attitude = Attitude.from_radec_roll(83.8, -1.2, 0.0)
    results = []
    for index in range(3):
        sky = {"false_stars": 8, "false_star_magnitudes": [2.0, 4.0]}
        truth = TruthState(propagate(attitude, rate, float(index)), np.zeros(3))
        request = FrameRequest(index, truth, device.exposure_s, device.gain, device.settings, faults=sky)
        results.append(device.pipeline.handle(request))
    assert [result.false_detected for result in results] == [8, 8, 8]  # they are bright, and rarely overlap
    assert results[0].false_removed == 0  # the filter compares two images
    assert results[2].false_removed >= 7
    assert results[2].features.removed < results[2].detected / 4
