"""The uncertainty that the device states is that of its attitudes, at rest and at its largest rate.

The squared error in units of the stated variance is χ²-distributed, so the mean of n such squares with k degrees of freedom is 1
with a standard deviation of √(2/(kn)).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from starhil.emulator.benchmarks.ecss_campaign import Condition, EcssDevice, EcssPlan
from starhil.emulator.sensor.pipeline.messages import FrameResult
from starid.attitude import ARCSEC_PER_RAD, Attitude

pytestmark = pytest.mark.long

SIGMAS = 3.0
"""Tolerance in standard deviations of the mean."""


def errors_over_stated(
    profile: str, rate_deg_s: float, frames: int, *overrides: str, least: float = 0.98
) -> tuple[np.ndarray, np.ndarray]:
    """Errors about x, y and z over what the unit sends, across and about the boresight, and over the covariance's, both (n, 3).

    Along a trail the error is larger than across it. The one number that the unit sends across the boresight is the larger, so that
    errors are smaller than it lets expect; the covariance has each axis's own.
    """
    device = EcssDevice(EcssPlan(profile, overrides, seed=3))
    condition = Condition("stated", "rate", rate_deg_s, frames)
    rows, by_axis = [], []
    for number in range(frames):
        shot, result = device.solve(condition, number)
        assert isinstance(result, FrameResult)
        if result.valid:
            error = Attitude(np.array(result.quaternion_xyzw)).error_to(shot.attitude).rotation_vector_rad
            stated = np.array(
                [result.sigma_cross_arcsec, result.sigma_cross_arcsec, result.sigma_roll_arcsec]
            )
            rows.append(error * ARCSEC_PER_RAD / stated)
            by_axis.append(error / np.sqrt(np.diag(result.covariance_rad2)))
    assert len(rows) > least * frames
    return np.array(rows), np.array(by_axis)


def test_an_error_of_the_calibration_is_not_taken_for_noise_about_the_boresight() -> None:
    about = errors_over_stated("cubestar", 0.0, 85)[0][:, 2]
    assert np.mean(about**2) == pytest.approx(1.0, abs=SIGMAS * math.sqrt(2.0 / len(about)))
    for limit, share in ((1.0, 0.683), (2.0, 0.954), (3.0, 0.9973)):
        sampling = math.sqrt(share * (1.0 - share) / len(about))
        assert np.mean(np.abs(about) < limit) == pytest.approx(share, abs=SIGMAS * sampling)


def test_the_errors_of_a_calibration_are_stated_by_each_profile_that_has_them() -> None:
    """A calibration does not pass from a profile to one with another camera: cubestar-2013 stated a third of its error about y.

    The errors of this calibration are at most its standard deviations, so that the squares are at most as large as expected.
    """
    over = errors_over_stated("cubestar-2013", 0.0, 30, least=0.85)[1]
    assert np.all(np.mean(over**2, axis=0) < 1.0 + SIGMAS * math.sqrt(2.0 / len(over)))


RATES = [(2.0, 200), (5.0, 100), (5.0, 200)]
"""In degrees per second, with exposures in milliseconds."""
TRAILS = [*([each] for each in RATES), RATES]
"""Each by itself, and all together, in which an error of half the size is found."""

INNER = ("camera.width=600", "camera.height=600", "camera.fov_deg=27.62")
"""The middle of the detector, with pixels of the same size: two fifths of the stars."""


@cache
def errors_of_trail(rate_deg_s: float, exposure_ms: int) -> tuple[np.ndarray, np.ndarray]:
    return errors_over_stated("ideal", rate_deg_s, 60, f"parameters.exposure={exposure_ms}", *INNER)


def errors_of(trails: list[tuple[float, int]]) -> tuple[np.ndarray, np.ndarray]:
    sent, by_axis = zip(*(errors_of_trail(*each) for each in trails), strict=True)
    return np.concatenate(sent), np.concatenate(by_axis)


@pytest.mark.parametrize("trails", TRAILS, ids=str)
def test_trails_do_not_make_the_stated_uncertainty_wrong(trails: list[tuple[float, int]]) -> None:
    sent, by_axis = errors_of(trails)
    sampling = SIGMAS * math.sqrt(2.0 / sent.size)
    assert np.mean(by_axis**2) == pytest.approx(1.0, abs=sampling)
    assert np.mean(sent**2) < 1.0 + sampling


@pytest.mark.parametrize("trails", TRAILS, ids=str)
def test_errors_of_trails_have_the_stated_distribution(trails: list[tuple[float, int]]) -> None:
    over, _ = errors_of(trails)
    for limit, share in ((1.0, 0.683), (2.0, 0.954), (3.0, 0.9973)):
        sampling = math.sqrt(share * (1.0 - share) / over.size)
        assert np.mean(np.abs(over) < limit) > share - SIGMAS * sampling
