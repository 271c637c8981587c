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
from tests.emulator.sensor.pipeline.known_photometry import LIMIT_AND_SIGMA, known_photometry

pytestmark = pytest.mark.long


@pytest.mark.parametrize("profile", LIMIT_AND_SIGMA)
def test_the_features_stop_where_the_detector_does_and_the_attitude_is_right(profile):
    device = EcssDevice(EcssPlan(profile, ("run.algorithm=lsi", "identifier.refinement=true"), 3))
    request = next(iter(Comparison(AlgorithmPlan(profile, 1, 3))._images(Scene(0.0)))).request
    lsi = device.pipeline.identifier(request)
    limit, sigma = LIMIT_AND_SIGMA[profile]
    assert lsi.options.detected_limit == pytest.approx(limit, abs=0.01)
    assert lsi.options.magnitude_sigma == pytest.approx(sigma, rel=0.02)
    assert lsi.database.parameters.kappa <= lsi.options.detected_limit
    sensor = device.pipeline._sensor
    assert lsi.zero_point == pytest.approx(2.5 * math.log10(sensor.zero_magnitude_e_s))
    assert lsi.options.colour_term == sensor.colour_term
    if profile == "ideal":
        answer = device.pipeline.handle(request)
        off = Attitude(np.array(answer.quaternion_xyzw)).error_to(request.truth.attitude)
        assert answer.valid
        assert off.total_arcsec < 20.0


def stars_of_a_detector(rng, count, half=4.2, slope=6.0, sigma=0.07):
    """Magnitudes of stars, three times as many per magnitude, and the errors of those found; NaN for the others."""
    magnitude = 2.0 + np.log1p(rng.uniform(size=count) * (3.0**4 - 1.0)) / math.log(3.0)
    found = rng.uniform(size=count) < 1.0 / (1.0 + np.exp(slope * (magnitude - half)))
    return magnitude, np.where(found, rng.normal(0.0, sigma, count), np.nan)


NINETY = 4.2 - math.log(9.0) / 6.0


def test_the_limit_is_where_ninety_percent_are_found():
    photometry = _limit_of(*stars_of_a_detector(np.random.default_rng(6), 20_000))
    assert photometry.limit == pytest.approx(NINETY, abs=4.0 * limit_error(20_000))
    assert photometry.sigma == pytest.approx(0.07, rel=4.0 * 1.17 / math.sqrt(200.0))  # of a median of 200


def limit_error(count):
    """Standard error of the limit by the information in as many stars (Cramér-Rao)."""
    magnitude, _ = stars_of_a_detector(np.random.default_rng(1), 100_000)
    share = 1.0 / (1.0 + np.exp(6.0 * (magnitude - 4.2)))
    design = np.column_stack([np.ones(magnitude.size), magnitude])
    information = design.T @ (design * (share * (1.0 - share))[:, None]) * (count / magnitude.size)
    gradient = np.array([1.0, NINETY]) / 6.0  # of the magnitude at which the logit is that of ninety percent
    return float(np.sqrt(gradient @ np.linalg.inv(information) @ gradient))


def test_the_limit_varies_no_more_from_one_start_to_the_next_than_the_stars_seen_make_it():
    rng = np.random.default_rng(7)
    limits = [_limit_of(*stars_of_a_detector(rng, 2000)).limit for _ in range(40)]
    assert np.std(limits) <= limit_error(2000) * (1.0 + 3.0 / math.sqrt(80.0))
    assert np.mean(limits) == pytest.approx(NINETY, abs=0.5 * limit_error(2000))


def test_the_limit_of_a_detector_that_finds_all_stars_is_that_of_the_stars():
    magnitude, error = stars_of_a_detector(np.random.default_rng(8), 1000, half=20.0)
    assert _limit_of(magnitude, error).limit == pytest.approx(magnitude.max(), abs=0.02)
    error[np.argmin(magnitude)] = np.nan  # a bright double
    magnitude[0] = 9.7  # a companion, which is drawn with its star
    assert _limit_of(magnitude, error).limit == pytest.approx(np.sort(magnitude)[-2], abs=0.02)


def test_false_stars_are_counted_among_the_detections_and_among_those_removed():
    device = EcssDevice(EcssPlan("ideal", ("run.algorithm=rsi", *known_photometry("ideal")), 3))
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
