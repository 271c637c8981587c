"""The body rate from recent attitudes."""

from __future__ import annotations

import math

import pytest

from starid.attitude import Attitude
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
