"""Particles follow the orbit through the South Atlantic Anomaly."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.sensor.sky.radiation import anomaly_share, particle_rate, sub_satellite_point

pytestmark = pytest.mark.lowest("pyerfa")

NOON_2026_UNIX_S = 1_767_268_800.0
NOON_2026_JD = 2_461_042.0
DISTANCE_M = 6.871e6


def sidereal_deg(julian_date: float) -> float:
    """Greenwich mean sidereal time (Meeus, Astronomical Algorithms, equation 12.4, linear part)."""
    return (280.46061837 + 360.98564736629 * (julian_date - 2_451_545.0)) % 360.0


def place(latitude_deg: float, longitude_deg: float, hours: float = 0.0) -> np.ndarray:
    """Position over a point of the Earth, metres, in the frame that sidereal time counts from."""
    turned = math.radians(longitude_deg + sidereal_deg(NOON_2026_JD + hours / 24.0))
    latitude = math.radians(latitude_deg)
    return DISTANCE_M * np.array(
        [math.cos(latitude) * math.cos(turned), math.cos(latitude) * math.sin(turned), math.sin(latitude)]
    )


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(0.0, 0.0), (-26.0, -49.0), (51.5, 179.0), (80.0, -120.0)]
)
@pytest.mark.parametrize("hours", [0.0, 7.5])
def test_the_sub_satellite_point_follows_sidereal_time(latitude, longitude, hours):
    below = sub_satellite_point(place(latitude, longitude, hours), NOON_2026_UNIX_S + 3600.0 * hours)
    precession_deg = 0.4
    assert below[0] == pytest.approx(latitude, abs=1e-6)
    assert (below[1] - longitude + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=precession_deg)
    assert below[2] == pytest.approx(500.0, abs=1e-6)


def test_the_anomaly_lies_over_brazil_and_rises_with_altitude():
    assert anomaly_share(-26.0, -49.0, 500.0) == pytest.approx(1.0)
    assert anomaly_share(-26.0, -49.0, 650.0) == pytest.approx(math.e)
    for latitude, longitude in ((45.0, 10.0), (-26.0, 130.0), (0.0, -160.0)):
        assert anomaly_share(latitude, longitude, 500.0) < 1e-6


def test_the_particle_rate_is_the_quiet_rate_plus_the_anomaly():
    inside, outside = place(-26.0, -49.0), place(40.0, 100.0)
    assert particle_rate(2.0, 100.0, inside, NOON_2026_UNIX_S) == pytest.approx(102.0, rel=1e-3)
    assert particle_rate(2.0, 100.0, outside, NOON_2026_UNIX_S) == pytest.approx(2.0, abs=1e-3)
    assert particle_rate(2.0, 100.0, None, NOON_2026_UNIX_S) == 2.0
