"""Protons in silicon: energy loss by Bethe's formula, tracks by the geometry of an isotropic flux through a thin layer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.sensor.fixed_pattern import make_fixed_pattern
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.particle_hits import add_protons, stopping_power
from starhil.emulator.sensor.sky.radiation import default_rates

EPI_UM, PIXEL_UM = 10.0, 12.0
ELECTRON_EV = 3.65


def bethe_mev_cm2_g(energy_mev: float) -> float:
    """Bethe's formula as in ICRU 49, in its classical constants: 4πN_A r_e² m_e c², without shell and density terms."""
    avogadro, radius_cm, rest = 6.02214076e23, 2.8179403e-13, 0.51099895
    gamma = 1.0 + energy_mev / 938.272
    beta2 = 1.0 - 1.0 / gamma**2
    number = math.log(2.0 * rest * 1e6 * beta2 * gamma**2 / 173.0) - beta2
    return 4.0 * math.pi * avogadro * radius_cm**2 * rest * 14.0 / 28.0855 / beta2 * number


@pytest.mark.parametrize("energy_mev", [30.0, 50.0, 100.0, 300.0])
def test_the_stopping_power_is_bethes(energy_mev):
    assert float(stopping_power(np.array(energy_mev))) == pytest.approx(bethe_mev_cm2_g(energy_mev), rel=0.01)


def test_the_least_stopping_power_is_that_of_the_particle_data_group():
    """1.664 MeV cm²/g in silicon, with the density effect, some 2 % there."""
    energies = np.geomspace(10.0, 1e4, 400)
    assert stopping_power(energies).min() == pytest.approx(1.664, rel=0.04)


def hits(count: int, energy_mev: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Runs, pixels, and charges, electrons, of particles, one by one in a frame of its own."""
    rng = np.random.default_rng(5)
    runs, charges = [], []
    for _ in range(count):
        mean = np.zeros((200, 200), dtype=np.float32)
        ends = add_protons(mean, 1, rng, EPI_UM, PIXEL_UM, energy_mev)
        if np.all((ends > 20.0) & (ends < 180.0)):
            runs.append(math.hypot(*(ends[0, 2:] - ends[0, :2])))
            charges.append(float(mean.sum()))
    return np.array(runs), np.array(charges)


@pytest.mark.long
def test_three_quarters_of_the_tracks_stay_within_a_pixel_and_a_half():
    """Through a layer of thickness t, an isotropic flux falls as sin 2θ, and the run is t·tan θ: sin²(arctan 1.8) = 76 %."""
    rng = np.random.default_rng(6)
    ends = add_protons(np.zeros((937, 937), dtype=np.float32), 20_000, rng, EPI_UM, PIXEL_UM)
    runs = np.hypot(*(ends[:, 2:] - ends[:, :2]).T)
    for run in (0.5, 1.5, 4.0):
        share = math.sin(math.atan(run * PIXEL_UM / EPI_UM)) ** 2
        assert np.mean(runs <= run) == pytest.approx(share, abs=0.01)


@pytest.mark.long
def test_a_proton_of_50_mev_leaves_some_8000_electrons():
    """Median of an isotropic flux: the path through the layer is t·√2; the most probable loss is below the mean."""
    _, charges = hits(4000, 50.0)
    mean_e = bethe_mev_cm2_g(50.0) * 2.33 * EPI_UM * 1e-4 * math.sqrt(2.0) * 1e6 / ELECTRON_EV
    assert 8000.0 < mean_e < 9500.0
    assert np.median(charges) == pytest.approx(mean_e, rel=0.1)
    assert 7000.0 < np.median(charges) < 9500.0


def test_charge_is_where_the_track_is_and_most_of_it_in_two_pixels():
    rng = np.random.default_rng(7)
    shares = []
    for _ in range(500):
        mean = np.zeros((64, 64), dtype=np.float32)
        add_protons(mean, 1, rng, EPI_UM, PIXEL_UM)
        shares.append(np.sort(mean.ravel())[-2:].sum() / max(mean.sum(), 1e-9))
    assert np.mean(np.array(shares) > 0.9) > 0.6


def test_an_orbit_brings_the_particles_of_the_anomaly_to_the_area_of_the_detector():
    """1 000 protons/cm²/s from all directions (AP-8, above 30 MeV, 500 km): half of them cross each cm² of a plane."""
    sensor = SensorModel()
    quiet_s, anomaly_s = default_rates(937, 937, sensor.pixel_um)
    area_cm2 = (937 * 12e-4) ** 2
    assert anomaly_s == pytest.approx(0.5 * 1000.0 * area_cm2, rel=1e-6)
    assert 0.5 * area_cm2 < quiet_s < 5.0 * area_cm2


def test_damage_raises_the_dark_current_by_the_universal_factor_of_silicon():
    """1.9e5 carriers/cm³/s per MeV/g at 300 K, a week after irradiation (Srour and Lo 2000, IEEE TNS 47, 2451); at 22 °C a third less."""
    new, old = (make_fixed_pattern(SensorModel(damage_tev_g=dose), 400, 400) for dose in (0.0, 2.0))
    more = old.dark_e_s - new.dark_e_s
    volume_cm3 = (12e-4) ** 2 * 10e-4
    universal = 1.9e5 * volume_cm3 * 2.0e6
    assert 0.5 * universal < more.mean() < universal
    assert np.mean(more > 1000.0) == pytest.approx(
        0.088 * np.exp(-1000.0 / 4400.0), rel=0.1
    )  # mostly one cascade


def test_telegraph_signals_switch_between_two_values_and_are_the_same_again():
    signals = make_fixed_pattern(SensorModel(damage_tev_g=1.0), 400, 400).telegraph
    assert signals.pixel.size == pytest.approx(35.0 * 1e6 * 400**2 * (12e-4) ** 2 * 10e-4, rel=0.05)
    frames = []
    for index in range(300):
        mean = np.zeros((400, 400), dtype=np.float32)
        signals.add(mean, index, 1.0)
        frames.append(mean.ravel()[signals.pixel[:500]])
    once = np.bincount(signals.pixel, minlength=400**2)[signals.pixel[:500]] == 1
    values = np.array(frames)[:, once]
    amplitude = signals.dark_e_s[:500][once]
    assert np.all((values == 0.0) | (values == amplitude))
    assert np.mean(values > 0.0) == pytest.approx(0.5, abs=0.05)
    kept = np.mean(values[1:] == values[:-1], axis=0)
    slow = signals.dwell[:500][once] > 100
    assert kept[slow].min() > 0.95
    again = np.zeros((400, 400), dtype=np.float32)
    signals.add(again, 299, 1.0)
    np.testing.assert_array_equal(again.ravel()[signals.pixel[:500]], frames[299])
