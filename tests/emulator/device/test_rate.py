"""The body rate from recent attitudes."""

from __future__ import annotations

import math

import pytest

from starhil.emulator.device.rate import RateEstimator
from starid.attitude import Attitude


def estimator(*angles_deg: float) -> RateEstimator:
    """Attitudes a second apart, turned about the boresight."""
    rates = RateEstimator()
    for number, angle in enumerate(angles_deg):
        rates.add(number * 10**9, Attitude.identity().rotated((0.0, 0.0, math.radians(angle))), 1.0)
    return rates


@pytest.mark.parametrize(
    ("window", "rate_deg_s"), [(2, 4.0), (3, 3.0), (10, 3.0)], ids=["last two", "last three", "two seconds"]
)
def test_the_rate_is_that_of_the_last_attitudes_within_two_seconds(window, rate_deg_s):
    rate = estimator(-9.0, 0.0, 2.0, 6.0).rate(window)
    assert [math.degrees(abs(value)) for value in rate] == pytest.approx([0.0, 0.0, rate_deg_s], abs=1e-9)


def test_a_single_attitude_has_no_rate():
    assert estimator(1.0).rate(2) is None
