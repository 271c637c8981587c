"""The body rate from recent attitudes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starid.attitude import Attitude, propagate
from starid.identification.attitude_history import AttitudeHistory


def history(window: int, *angles_deg: float, period_s: float = 1.0) -> AttitudeHistory:
    """Attitudes a period apart, turned about the boresight."""
    recent = AttitudeHistory(window)
    for number, angle in enumerate(angles_deg):
        attitude = Attitude.identity().rotated((0.0, 0.0, math.radians(angle)))
        recent.add(number * period_s, attitude, 1.0)
    return recent


@pytest.mark.parametrize(
    ("window", "rate_deg_s"), [(2, 4.0), (3, 3.0), (10, 3.0)], ids=["last two", "last three", "two seconds"]
)
def test_the_rate_is_that_of_the_last_attitudes_within_two_seconds(window, rate_deg_s):
    rate = history(window, -9.0, 0.0, 2.0, 6.0).rate()
    assert [math.degrees(abs(value)) for value in rate] == pytest.approx([0.0, 0.0, rate_deg_s], abs=1e-9)


def test_a_window_of_twenty_is_of_twenty_attitudes():
    still_then_turning = [*[0.0] * 10, *range(1, 11)]
    ten, twenty = (abs(history(window, *still_then_turning, period_s=0.1).rate()[2]) for window in (10, 20))
    assert twenty < 0.9 * ten


def test_a_single_attitude_has_no_rate():
    assert history(2, 1.0).rate() is None


def test_attitudes_at_one_time_have_no_rate():
    assert history(2, 1.0, 2.0, period_s=0.0).rate() is None


def test_an_interruption_or_a_longer_gap_ends_the_history():
    recent = history(3, 0.0, 1.0)
    recent.interrupt()
    recent.add(2.0, Attitude.identity(), 1.0)
    assert recent.rate() is None
    recent.add(3.0, Attitude.identity(), 1.0)
    assert recent.rate() is not None
    recent.add(4.1, Attitude.identity(), 1.0)
    assert recent.rate() is None


@pytest.mark.long
@pytest.mark.parametrize("window", [2, 3, 10])
def test_the_error_of_a_prediction_is_as_large_as_stated(window):
    """One second after attitudes half a second apart; of those within two seconds."""
    sigma, rng = np.array([1e-4, 2e-4, 3e-4]), np.random.default_rng(1)
    rate = np.array([0.01, -0.02, 0.03])
    squares, recent, samples = [], AttitudeHistory(window), 1000
    *truths, truth = (
        propagate(Attitude.identity(), rate, time_s)
        for time_s in [*0.5 * np.arange(window), 0.5 * window + 0.5]
    )
    at = 0.5 * window + 0.5
    for _ in range(samples):
        recent = AttitudeHistory(window)
        for number, attitude in enumerate(truths):
            noisy = attitude.rotated(sigma * rng.standard_normal(3))
            recent.add(0.5 * number, noisy, 1.0, np.diag(sigma**2), 40.0)
        error = recent.predict(at, recent.rate()).error_to(truth)
        squares.append(error.rotation_vector_rad**2)
    stated, _ = recent.uncertainty(at)
    bound = 4.0 * math.sqrt(2.0 / samples)
    assert np.mean(squares, axis=0) / np.diag(stated) == pytest.approx(1.0, abs=bound)


def test_two_attitudes_have_fewer_degrees_of_freedom_than_their_sum():
    """At twice the time, ``(2² + 1)²/(2⁴/ν + 1/ν)`` for variances of 4 and 1: 25/17 ν."""
    recent = AttitudeHistory(2)
    for number in range(2):
        recent.add(number, Attitude.identity(), 1.0, np.eye(3), 34.0)
    covariance, freedom = recent.uncertainty(2.0)
    assert covariance == pytest.approx(5.0 * np.eye(3))
    assert freedom == pytest.approx(50.0)
