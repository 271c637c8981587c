"""Noise has the statistics of electrons, differs between images and seeds, and is the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from starhil.emulator.sensor.noise import Digitizer, digitize, fill_normal, lane_states

SHAPE = (512, 512)
FINE = Digitizer(read_noise_e=12.0, full_well_e=15000.0, gain_e_per_dn=0.1, offset_dn=2000.0, max_dn=65535)
BYTES = Digitizer(read_noise_e=12.0, full_well_e=15000.0, gain_e_per_dn=25.0, offset_dn=8.0, max_dn=255)
QUIET = Digitizer(read_noise_e=0.5, full_well_e=15000.0, gain_e_per_dn=0.5, offset_dn=100.0, max_dn=65535)


def electrons(mean_e: float, digitizer: Digitizer, frame: int = 0, seed: int = 3) -> np.ndarray:
    counts = digitize(np.full(SHAPE, mean_e, dtype=np.float32), digitizer, seed, frame)
    return (counts.astype(np.float64) - digitizer.offset_dn) * digitizer.gain_e_per_dn


def normals(seed: int) -> np.ndarray:
    bits, more, uniform = np.empty(512, np.uint32), np.empty(512, np.uint32), np.empty(512, np.float32)
    state, out = lane_states(seed, 0), np.empty((400, 1024), np.float32)
    for row in out:
        fill_normal(state, bits, more, uniform, row)
    return out.ravel().astype(np.float64)


def test_normal_deviates_have_a_normal_distribution() -> None:
    sample = normals(1)
    assert stats.kstest(sample, "norm").pvalue > 1e-3
    assert abs(sample.mean()) < 5.0 / np.sqrt(sample.size)
    assert sample.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / sample.size))
    assert stats.kurtosis(sample) == pytest.approx(0.0, abs=5.0 * np.sqrt(24.0 / sample.size))
    beyond = np.count_nonzero(np.abs(sample) > 4.0)
    expected = 2.0 * stats.norm.sf(4.0) * sample.size
    assert abs(beyond - expected) < 5.0 * np.sqrt(expected)


def test_normal_deviates_are_uncorrelated() -> None:
    sample = normals(2)
    for lag in (1, 2, 511, 512, 513, 1024, 2048):
        correlation = np.corrcoef(sample[:-lag], sample[lag:])[0, 1]
        assert abs(correlation) < 5.0 / np.sqrt(sample.size), lag
        squares = np.corrcoef(sample[:-lag] ** 2, sample[lag:] ** 2)[0, 1]
        assert abs(squares) < 5.0 / np.sqrt(sample.size), lag


@pytest.mark.parametrize("mean_e", [0.0, 3.0, 17.0, 100.0, 1000.0, 5000.0])
@pytest.mark.parametrize("digitizer", [FINE, QUIET], ids=["fine", "quiet"])
def test_the_variance_follows_the_photon_transfer_curve(digitizer: Digitizer, mean_e: float) -> None:
    """Mean and variance follow the electrons: variance = mean + read noise² + rounding²."""
    sample = electrons(mean_e, digitizer)
    variance = mean_e + digitizer.read_noise_e**2 + digitizer.gain_e_per_dn**2 / 12.0
    assert sample.mean() == pytest.approx(mean_e, abs=5.0 * np.sqrt(variance / sample.size))
    assert sample.var() == pytest.approx(variance, rel=5.0 * np.sqrt(2.0 / sample.size) + 0.002)


@pytest.mark.parametrize("mean_e", [17.0, 300.0])
def test_the_skewness_follows_poisson_statistics(mean_e: float) -> None:
    expected = mean_e / (mean_e + FINE.read_noise_e**2) ** 1.5
    sample = np.concatenate([electrons(mean_e, FINE, frame).ravel() for frame in range(8)])
    assert stats.skew(sample) == pytest.approx(expected, abs=5.0 * np.sqrt(6.0 / sample.size))


def test_few_electrons_are_whole_numbers() -> None:
    """A sensor without read noise counts photons: the histogram is Poisson's."""
    counter = Digitizer(0.0, 15000.0, 1.0, 10.0, 4095)
    sample = np.rint(electrons(2.5, counter)).astype(int)
    seen = np.bincount(sample.ravel(), minlength=16)[:16]
    expected = stats.poisson.pmf(np.arange(16), 2.5) * sample.size
    chosen = expected > 20.0
    chi2 = np.sum((seen[chosen] - expected[chosen]) ** 2 / expected[chosen])
    assert chi2 < stats.chi2.isf(1e-4, np.count_nonzero(chosen))


def test_images_of_8_bits_have_the_mean_of_the_electrons() -> None:
    sample = electrons(17.0, BYTES)
    assert sample.mean() == pytest.approx(17.0, abs=0.3)


def test_full_well_and_converter_limit_the_counts() -> None:
    assert electrons(40000.0, QUIET).max() < QUIET.full_well_e + 6.0
    full = digitize(np.full(SHAPE, 40000.0, dtype=np.float32), BYTES, 1, 0)
    assert np.all(full == BYTES.max_dn)


def test_noise_differs_between_images_and_seeds() -> None:
    first, second = electrons(1000.0, FINE, 0), electrons(1000.0, FINE, 1)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 5.0 / 512.0
    other_seed = electrons(1000.0, FINE, 0, seed=4)
    assert abs(np.corrcoef(first.ravel(), other_seed.ravel())[0, 1]) < 5.0 / 512.0


def test_noise_has_no_spatial_pattern() -> None:
    """The power spectrum of many frames' mean is white: no row, column or block stands out."""
    mean = np.mean([electrons(1000.0, FINE, frame) for frame in range(16)], axis=0)
    mean -= mean.mean()
    power = np.abs(np.fft.rfft2(mean)) ** 2
    power = np.delete(power.ravel(), 0)
    assert power.max() / power.mean() < 2.0 * np.log(power.size)
    for axis in (0, 1):
        profile = mean.mean(axis=axis)
        assert profile.std() == pytest.approx(mean.std() / np.sqrt(512), rel=0.2)


def test_the_same_seed_and_image_number_give_the_same_noise() -> None:
    mean = np.linspace(0.0, 8000.0, 937 * 31, dtype=np.float32).reshape(31, 937)
    for digitizer in (FINE, BYTES, QUIET):
        first = digitize(mean, digitizer, 7, 5)
        assert first.tobytes() == digitize(mean, digitizer, 7, 5).tobytes()
        assert first.tobytes() != digitize(mean, digitizer, 7, 6).tobytes()
        assert first.tobytes() != digitize(mean, digitizer, 8, 5).tobytes()


def test_light_that_saturates_changes_no_count_beside_it() -> None:
    """The noise of a pixel does not depend on the light of others."""
    sky = np.full(SHAPE, 50.0, dtype=np.float32)
    lit = sky.copy()
    lit[100:300] = 8_000.0
    lit[200, 7] = 0.0
    plain, bright = (digitize(mean, BYTES, 3, 4) for mean in (sky, lit))
    mask = lit == 8_000.0
    assert np.all(bright[mask] == BYTES.max_dn)
    mask[200, 7] = True
    assert np.array_equal(bright[~mask], plain[~mask])
    assert bright[200, 7] < 20
