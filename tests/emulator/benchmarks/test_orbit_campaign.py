"""A campaign along an orbit: where the sensor looks, and what is found to be the cause of a frame without an attitude."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from starhil.emulator.benchmarks.orbit_campaign import (
    STARS,
    TOGETHER,
    WITHOUT,
    OrbitDevice,
    OrbitPlan,
    run_chunk,
    summarise,
    zenith_attitude,
)
from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import KeplerOrbit

pytestmark = pytest.mark.long

SMALL = ("camera.width=320", "camera.height=320", "camera.fov_deg=30.0")
PERIOD_S = 2.0 * math.pi * math.sqrt(6.928137e6**3 / 3.986004418e14)


@pytest.fixture(scope="module")
def device() -> OrbitDevice:
    return OrbitDevice(OrbitPlan("ideal", ("orbit=leo", *SMALL), frames=400))


def test_the_zenith_frame_looks_away_from_the_earth_and_turns_once_per_revolution() -> None:
    orbit = KeplerOrbit(0.0, 6.928137e6, inclination_rad=1.7, raan_rad=0.4, j2=False)
    place = orbit.state(1000.0)
    attitude, rate = zenith_attitude(place)
    assert attitude.boresight == pytest.approx(place.position_m / 6.928137e6, abs=1e-9)
    later, _ = zenith_attitude(orbit.state(1010.0))
    assert attitude.rotated(10.0 * rate).error_to(later).rotation_vector_rad == pytest.approx(
        np.zeros(3), abs=1e-8
    )
    assert np.linalg.norm(rate) == pytest.approx(2.0 * math.pi / PERIOD_S, rel=1e-6)


def test_causes_are_those_that_were_put_there(device: OrbitDevice) -> None:
    """A frame with an attitude; then one influence at a time that leaves none."""
    number = next(n for n in range(400) if device.outcome(device.request(n)) == "correct")
    good = device.request(number)
    ahead = good.truth.attitude.boresight
    centre = {
        "ra_deg": math.degrees(math.atan2(ahead[1], ahead[0])),
        "dec_deg": math.degrees(math.asin(ahead[2])),
    }
    planted = {
        "sun": replace(good, faults={"sun": centre}),
        "earth": replace(good, faults={"earth": {**centre, "radius_deg": 64.0}}),
        "rate": replace(good, truth=replace(good.truth, rate_rad_s=np.radians([0.0, 0.0, 0.0]) + 3.0)),
        "temperature": replace(good, temperature_c=120.0),
        "particles": replace(good, particles_s=4e4),
        STARS: replace(good, faults={"blank": True}),
        TOGETHER: replace(good, faults={"sun": centre}, temperature_c=120.0),
    }
    for cause, request in planted.items():
        assert device.outcome(request) != "correct", cause
        assert device.cause(request) == cause


def test_every_influence_can_be_taken_away(device: OrbitDevice) -> None:
    assert list(WITHOUT) == ["sun", "moon", "earth", "particles", "rate", "temperature"]
    request = device.request(7)
    assert request.particles_s > 0.0
    spared = WITHOUT["particles"](device, request)
    assert spared.particles_s == 0.0


def test_rows_add_up_and_a_part_is_the_same_again() -> None:
    plan = OrbitPlan("ideal", ("orbit=leo", *SMALL), frames=40, chunk=20)
    first, again = run_chunk(plan, 1), run_chunk(plan, 1)
    np.testing.assert_array_equal(first["outcome"], again["outcome"])
    np.testing.assert_array_equal(first["cause"], again["cause"])
    rows = {row["cause"]: row["frames"] for row in summarise([first])}
    assert rows["correct"] == int(np.sum(first["outcome"] == "correct"))
    assert sum(rows.values()) - rows["wrong"] == 20


def test_a_profile_without_an_orbit_is_rejected() -> None:
    with pytest.raises(EmulatorError, match="has no orbit"):
        OrbitDevice(OrbitPlan("ideal", overrides=()))
