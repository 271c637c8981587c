"""Variable stars: minima and maxima at published times, and the shape of the light curve."""

from __future__ import annotations

import numpy as np
import pytest

from starid.catalog import load_catalog
from starid.catalog.variable_stars import BRIGHTEST, HIP, VARIABLE_STARS, variable_magnitudes

MINUTE_D = 1.0 / 1440.0


def unix_of(julian_date: float) -> float:
    return (julian_date - 2_440_587.5) * 86_400.0


def curve(name: str, julian_dates: np.ndarray) -> np.ndarray:
    number = next(k for k, star in enumerate(VARIABLE_STARS) if star.name == name)
    return np.array([variable_magnitudes(unix_of(jd))[number] for jd in julian_dates])


def test_algol_is_faint_when_goodricke_saw_it_faint_as_long_as_stebbins_measured() -> None:
    """2 days 20.8 h apart (Phil. Trans. 1783), 9.8 h from first to last contact (ApJ 32, 1910, 185), V 2.12 to 3.39."""
    hours = np.arange(0.0, 30.0 * 24.0, 0.2)
    light = curve("Algol", 2_461_000.5 + hours / 24.0)
    lowest = hours[1:-1][(light[1:-1] < light[:-2]) < (light[1:-1] > light[2:])]
    assert np.diff(lowest).mean() == pytest.approx(68.8, abs=0.1)
    assert (light.min(), light.max()) == pytest.approx((2.12, 3.39), abs=0.01)
    assert np.mean(light > 2.125) * 68.8 == pytest.approx(9.8, rel=0.1)


def test_delta_cephei_rises_in_a_quarter_of_its_period() -> None:
    days = np.linspace(0.0, 5.366208, 2001)
    light = curve("delta Cephei", 2_455_479.905 + days)
    assert light[0] == pytest.approx(3.48)
    assert light.max() == pytest.approx(4.37, abs=1e-4)
    assert np.argmax(light) / 2000.0 == pytest.approx(0.75, abs=0.002)
    assert light[-1] == pytest.approx(light[0], abs=1e-5)


def test_beta_lyrae_has_two_minima_without_rest_between() -> None:
    phases = np.array([0.0, 0.25, 0.5, 0.75])
    light = curve("beta Lyrae", 2_458_347.0119 + 12.94379 * phases)
    assert light == pytest.approx([4.36, 3.25, 3.85, 3.25], abs=1e-6)


def test_epsilon_aurigae_is_eclipsed_when_it_was() -> None:
    """First contact at the end of August 2009 (Hopkins, campaign newsletter 14), 3.7 to 3.8 on 3 February 2010 (AAVSO special notice
    192); the curve here has no flat bottom, so that it is brighter on the way."""
    light = curve("epsilon Aurigae", np.array([2_454_960.0, 2_455_230.5, 2_455_397.0, 2_455_850.0]))
    assert light[[0, 3]] == pytest.approx(2.92, abs=0.01)
    assert 3.4 < light[1] < 3.8 < light[2] < 3.9


def test_chi_cygni_is_brightest_within_weeks_of_its_maximum_of_late_may_2013() -> None:
    days = 2_456_439.5 + np.arange(-150.0, 150.0)
    light = curve("chi Cygni", days)
    assert abs(days[np.argmin(light)] - 2_456_439.5) < 30.0
    assert light.min() == pytest.approx(3.3, abs=0.01)


@pytest.mark.long
def test_curves_are_continuous() -> None:
    for star in VARIABLE_STARS:
        days = np.linspace(0.0, star.period_d, 1001)
        light = curve(star.name, star.epoch_jd + days)
        assert np.abs(np.diff(light)).max() < 0.05 * (star.faintest - star.brightest), star.name
        assert light.min() >= star.brightest - 1e-9


def test_the_stars_are_those_of_the_catalogue_near_their_mean_light() -> None:
    catalog = load_catalog()
    for star in VARIABLE_STARS:
        v = float(catalog.v[catalog.hip == star.hip][0])
        assert star.brightest - 0.1 < v < star.faintest, star.name
    assert list(HIP) == [star.hip for star in VARIABLE_STARS]
    assert BRIGHTEST.max() < 4.5
