"""Each kind of error, injected alone, is recovered within 10 % and appears in no other line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starhil.emulator.benchmarks.ecss_errors import (
    ErrorSeries,
    aberration_residual,
    coverage_factor,
    static_errors,
    thermo_elastic_error,
)
from starhil.emulator.errors import EmulatorError

pytestmark = [pytest.mark.long, pytest.mark.lowest("scipy")]

FIELDS, POSITIONS, REPEATS, DATES, POINTS = 600, 4, 4, 6, 12
CONFIDENCE = 0.997
SIZE = np.array([4.0, 7.0, 12.0])
FAINT = 1e-3
"""Noise that every series has, relative to the error injected: frames never agree to the last bit."""

BIAS, FIELD, PIXEL, NOISE, THERMAL, ABERRATION = range(6)
NAMES = ["bias", "field-of-view", "pixel", "noise", "thermo-elastic", "aberration"]


def series(fields: int, conditions: int, repeats: int, rng, **sizes) -> ErrorSeries:
    """Errors of a nested design; `sizes` are vectors (3,): bias, field, position, noise, swing, of_orbit (v/c)."""
    shape = (fields, conditions, repeats, 3)
    error = np.zeros(shape)
    error += sizes.get("bias", 0.0)
    error += rng.standard_normal((fields, 1, 1, 3)) * sizes.get("field", 0.0)
    error += rng.standard_normal((fields, conditions, 1, 3)) * sizes.get("position", 0.0)
    error += rng.standard_normal(shape) * sizes.get("noise", FAINT * SIZE)
    points = np.sin(2.0 * np.pi * np.arange(conditions) / conditions)
    error += points[None, :, None, None] * sizes.get("swing", 0.0)
    to_sensor = Rotation.random(fields, random_state=12).as_matrix() if fields > 1 else np.eye(3)[None]
    year = 2.0 * np.pi * np.arange(conditions) / conditions
    velocity = np.stack(
        [-np.sin(year), np.cos(year), 0.0 * year], axis=1
    )  # of a circular orbit, of unit length
    ecliptic = Rotation.from_euler("x", 23.44, degrees=True).as_matrix()
    seen = np.einsum("fij,jk,ck->fci", to_sensor, ecliptic, velocity)
    turn = np.stack([-seen[..., 1], seen[..., 0], 0.0 * seen[..., 0]], axis=-1)
    error += turn[:, :, None] * sizes.get("of_orbit", 0.0)
    field, condition, _ = np.indices(shape[:3])
    return ErrorSeries(error.reshape(-1, 3), field.ravel(), condition.ravel(), to_sensor[field.ravel()])


def lines(kind: int, size, rng, **others):
    """All lines of a report, from series in which only one kind of error is injected."""
    injected = {("bias", "field", "position", "noise")[kind]: size} if kind <= NOISE else {}
    every = {**injected, **others}
    still = series(FIELDS, POSITIONS, REPEATS, rng, **every)
    swing = {"swing": size} if kind == THERMAL else {}
    thermal = thermo_elastic_error(series(FIELDS, POINTS, 1, rng, **every, **swing), CONFIDENCE)
    dated = {**every, "of_orbit": size} if kind == ABERRATION else every
    aberration = aberration_residual(series(FIELDS, DATES, REPEATS, rng, **dated), still, CONFIDENCE)
    return [*static_errors(still, CONFIDENCE), thermal, aberration]


@pytest.mark.parametrize("kind", range(6), ids=NAMES)
def test_an_error_alone_is_recovered_and_appears_in_no_other_line(kind):
    size = np.array([7.0, 7.0, 0.0]) if kind == ABERRATION else SIZE
    error_lines = lines(kind, size, np.random.default_rng(100 + kind))
    expected = size if kind in (BIAS, THERMAL, ABERRATION) else coverage_factor(CONFIDENCE) * SIZE
    np.testing.assert_allclose(error_lines[kind].arcsec, expected, rtol=0.1)
    faint = coverage_factor(CONFIDENCE) * FAINT * SIZE
    for other in set(range(6)) - {kind}:
        allowed = 1.1 * faint if other == NOISE else np.zeros(3)
        assert np.all(error_lines[other].arcsec <= allowed), NAMES[other]


def test_all_kinds_of_error_are_separated():
    rng = np.random.default_rng(7)
    sizes = {
        "bias": np.array([9.0, -8.0, 5.0]),
        "field": np.array([5.0, 4.0, 12.0]),
        "position": np.array([2.0, 2.5, 6.0]),
        "noise": np.array([3.0, 3.5, 9.0]),
    }
    error_lines = lines(ABERRATION, np.array([8.0, 8.0, 0.0]), rng, **sizes)
    factor = coverage_factor(CONFIDENCE)
    np.testing.assert_allclose(error_lines[BIAS].arcsec, np.abs(sizes["bias"]), rtol=0.25)
    for line, name in ((FIELD, "field"), (PIXEL, "position"), (NOISE, "noise")):
        np.testing.assert_allclose(error_lines[line].arcsec, factor * sizes[name], rtol=0.1)
    np.testing.assert_allclose(error_lines[ABERRATION].arcsec[:2], 8.0, rtol=0.1)
    assert np.all(error_lines[THERMAL].arcsec == 0.0)


def test_frames_without_an_attitude_may_be_missing():
    rng = np.random.default_rng(3)
    whole = series(FIELDS, POSITIONS, REPEATS, rng, field=SIZE, position=SIZE / 2.0, noise=SIZE / 3.0)
    kept = rng.random(len(whole.field)) < 0.7
    part = ErrorSeries(
        whole.error_arcsec[kept], whole.field[kept], whole.condition[kept], whole.to_sensor[kept]
    )
    _, field, pixel, noise = static_errors(part, CONFIDENCE)
    factor = coverage_factor(CONFIDENCE)
    np.testing.assert_allclose(field.arcsec, factor * SIZE, rtol=0.12)
    np.testing.assert_allclose(pixel.arcsec, factor * SIZE / 2.0, rtol=0.12)
    np.testing.assert_allclose(noise.arcsec, factor * SIZE / 3.0, rtol=0.1)


def test_an_error_below_the_resolution_is_zero():
    rng = np.random.default_rng(5)
    _, field, pixel, _ = static_errors(series(30, 2, 2, rng, noise=SIZE, field=0.05 * SIZE), CONFIDENCE)
    assert np.all(field.arcsec == 0.0)
    assert np.all(pixel.arcsec == 0.0)
    assert np.all(field.resolution_arcsec > 0.05 * SIZE)


def test_noise_does_not_lengthen_the_aberration_residual():
    """A turn by a velocity in a random direction is uniform up to its speed, at most 30.29 km/s for the Earth (Astronomical Almanac)."""
    largest_arcsec = np.degrees(30.29e3 / 299_792_458.0) * 3600.0
    noise, position = np.array([14.0, 14.0, 21.0]), np.array([6.0, 6.0, 8.0])
    sizes = []
    for seed in range(40):
        rng = np.random.default_rng((8, seed))
        still = series(20, 4, 4, rng, noise=noise, position=position)
        dated = series(40, DATES, 2, rng, noise=noise, position=position, of_orbit=20.5)
        sizes.append(aberration_residual(dated, still, CONFIDENCE).arcsec[:2].mean())
    sampling = np.std(sizes) / np.sqrt(len(sizes))
    assert np.mean(sizes) == pytest.approx(CONFIDENCE * 20.5, abs=4.0 * sampling)
    assert np.mean(sizes) < largest_arcsec + 4.0 * sampling


def test_without_dates_the_aberration_is_not_evaluated():
    rng = np.random.default_rng(6)
    assert aberration_residual(None, series(10, 2, 2, rng), CONFIDENCE).arcsec is None


@pytest.mark.parametrize("shape", [(1, 4, 4), (4, 1, 4), (4, 4, 1)])
def test_a_series_too_short_is_rejected(shape):
    with pytest.raises(EmulatorError, match="more of each are needed"):
        static_errors(series(*shape, np.random.default_rng(1)), CONFIDENCE)


def test_a_confidence_is_a_share():
    assert coverage_factor(0.6827) == pytest.approx(1.0, abs=1e-3)
    with pytest.raises(EmulatorError, match=r"0\.997"):
        coverage_factor(99.7)
