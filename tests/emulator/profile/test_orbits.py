"""Orbits in one word: what a preset sets, and that its numbers are those of the orbit it names."""

from __future__ import annotations

import math

import erfa
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile

EARTH_RADIUS_KM, GM_KM3_S2, J2 = 6378.137, 398600.4418, 1.08262668e-3
YEAR_DAYS = 365.2422


def test_the_low_earth_orbit_is_sun_synchronous_at_550_km() -> None:
    """Node drift by the Earth's oblateness to first order (Vallado, section 9.6), one turn a year; Sun by erfa."""
    profile = load_profile("cubestar", ["orbit=leo"])
    orbit = profile.orbit
    assert orbit is not None
    assert orbit.kind == "kepler"
    a = orbit.semi_major_axis_km
    assert a - EARTH_RADIUS_KM == pytest.approx(550.0)
    motion = math.sqrt(GM_KM3_S2 / a**3)
    drift = -1.5 * motion * J2 * (EARTH_RADIUS_KM / a) ** 2 * math.cos(math.radians(orbit.inclination_deg))
    assert math.degrees(drift) * 86_400.0 == pytest.approx(360.0 / YEAR_DAYS, rel=2e-3)
    assert profile.thermal.period_s == pytest.approx(2.0 * math.pi / motion, abs=1.0)
    tt = 2440587.5 + (profile.start_unix_s + 69.2) / 86_400.0
    sun = -erfa.epv00(tt, 0.0)[0]["p"]
    sun_deg = math.degrees(math.atan2(sun[1], sun[0]))
    assert (12.0 + (orbit.raan_deg - sun_deg) / 15.0) % 24.0 == pytest.approx(22.5, abs=0.02)


def test_an_orbit_replaces_that_of_the_profile_and_keeps_the_rest() -> None:
    bare, there = load_profile("cubestar"), load_profile("cubestar", ["orbit=leo"])
    assert bare.orbit is None
    assert "date" not in bare.sky
    assert there.sky["sun"] == bare.sky["sun"]
    assert there.thermal.mounting_c == bare.thermal.mounting_c
    assert there.parameters == bare.parameters


@pytest.mark.parametrize("order", [1, -1])
def test_other_settings_change_the_orbit_wherever_they_stand(order: int) -> None:
    profile = load_profile("ideal", ["orbit=leo", "orbit.raan_deg=10.0"][::order])
    assert profile.orbit.raan_deg == 10.0


def test_an_orbit_of_ones_own_is_a_file(tmp_path) -> None:
    own = tmp_path / "geo.toml"
    own.write_text(
        '[sky]\ndate = "2027-01-01"\n[orbit]\nkind = "kepler"\nsemi_major_axis_km = 42164.0\ninclination_deg = 0.0\n'
    )
    assert load_profile("ideal", [f"orbit={own}"]).orbit.semi_major_axis_km == 42164.0


def test_an_unknown_orbit_is_named_with_those_that_there_are() -> None:
    with pytest.raises(EmulatorError, match=r"orbit 'moon': not found; give a path, or one of: leo"):
        load_profile("ideal", ["orbit=moon"])
