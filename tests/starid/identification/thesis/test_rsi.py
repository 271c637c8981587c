"""The recursive algorithm and the sequences of the simulator."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from starid.identification.thesis.cme import estimate_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.metrics import boresight_error, error_colours, rotation_error
from starid.identification.thesis.rsi import (
    RecursiveIdentification,
    RsiError,
    RsiSettings,
    correlation,
    region_cells,
    region_side,
)
from starid.identification.thesis.rsi_memory import AnswerMemory
from starid.identification.thesis.scalable_filter import TrackFilter, TrackFilterSettings
from starid.lab.simulation import NoiseModel, add_noise, sky_sequence, turned
from tests.starid.identification.thesis.thesis_sky import lost_in_space

pytestmark = [pytest.mark.long, pytest.mark.lowest("scipy")]


def quiet_filter():
    return TrackFilter(TrackFilterSettings(0.002, 0.01, max_rotation_deg=4.0, max_shift_deg=4.0))


def test_a_clean_sequence_is_followed_in_the_region():
    lsi = lost_in_space(99.5)
    recursion = RecursiveIdentification(lsi, quiet_filter(), RsiSettings(tau=0.5, memory=15))
    frames = sky_sequence(
        np.random.default_rng(1), lsi.database.sky, 108.41, 12.14, NoiseModel(), count=120, wander=True
    )
    errors, modes = [], []
    for frame in frames:
        step = recursion.step(frame.observed)
        modes.append(step.mode)
        errors.append(
            float(
                boresight_error(
                    step.estimate.right_ascension_deg,
                    step.estimate.declination_deg,
                    frame.right_ascension_deg,
                    frame.declination_deg,
                )
            )
        )
        if step.mode == "rsi":
            assert step.region_deg >= 2.0
            assert step.region_cells > 50
    assert modes[0] == "lsi"
    assert modes.count("rsi") >= 100
    assert np.mean(errors) <= 0.18


def test_an_error_above_the_threshold_searches_the_whole_database_and_may_be_invalid():
    lsi = lost_in_space(99.5)
    tiny = RsiSettings(tau=1e-9, invalid_factor=1.0)
    recursion = RecursiveIdentification(lsi, quiet_filter(), tiny)
    frames = list(
        sky_sequence(np.random.default_rng(2), lsi.database.sky, 108.41, 12.14, NoiseModel(), count=4)
    )
    steps = [recursion.step(frame.observed) for frame in frames]
    assert all(step.mode == "lsi" for step in steps)
    assert not any(step.valid for step in steps)


def test_an_empty_frame_gives_an_invalid_step():
    recursion = RecursiveIdentification(lost_in_space(99.5), None)
    step = recursion.step(ObservedFrame(np.empty(0), np.empty((0, 2))))
    assert step.estimate is None
    assert not step.valid


def test_region_of_search():
    settings = RsiSettings()
    assert region_side(0.0, 0.0, settings) == 2.0
    assert region_side(0.04, 0.01, settings) == pytest.approx(2.02)
    assert region_cells(2.0, 40.0, 0.995) == pytest.approx(100.0)
    with pytest.raises(RsiError, match="positive"):
        RsiSettings(tau=-1.0)


def test_the_same_seed_gives_the_same_frames():
    sky = lost_in_space(99.5).database.sky

    def run(seed):
        noise = NoiseModel.of("both", 2.0, false_stars=2)
        frames = sky_sequence(np.random.default_rng(seed), sky, 108.0, 12.0, noise, count=3)
        return np.concatenate([frame.observed.positions for frame in frames])

    np.testing.assert_array_equal(run(1), run(1))
    assert run(1).shape != run(2).shape or not np.array_equal(run(1), run(2))


def test_noise_has_the_requested_moments():
    rng = np.random.default_rng(3)
    brightness, positions = np.full(20_000, 12.0), np.zeros((20_000, 2))
    noise = NoiseModel(position_sigma_px=2.0, brightness_sigma=3.0, false_stars=5, missing_stars=7)
    mags, places, identity = add_noise(rng, brightness, positions, noise, 20.0)
    stars = identity >= 0
    assert (np.count_nonzero(stars), np.count_nonzero(~stars)) == (19_993, 5)
    assert places[stars].std() == pytest.approx(2.0 * 42.0 / 937.0, rel=0.02)
    assert mags[stars].std() == pytest.approx(3.0 * 3.5 / 255.0, rel=0.02)
    assert (np.hypot(*places[~stars].T) <= 20.0).all()


def test_metrics():
    assert float(boresight_error(359.9, 10.0, 0.1, 10.0)) == pytest.approx(0.2)
    assert float(rotation_error(-179.0, 179.0)) == pytest.approx(2.0)
    np.testing.assert_allclose(error_colours([0.0, 0.05, 7.0], 0.1), [[0, 1, 0], [0.5, 0.5, 0], [1, 0, 0]])
    x = np.arange(10.0)
    rho, p = correlation(x, 2.0 * x + 1.0)
    assert rho == pytest.approx(1.0)
    assert p < 1e-9


def motion(rotation_deg=0.0, shift=(0.0, 0.0)):
    before = np.array([[-10.0, 0.0], [10.0, 3.0], [2.0, -9.0], [-3.0, 8.0]])
    return estimate_motion(before, turned(before, rotation_deg) + np.asarray(shift))


def test_answers_that_agree_outvote_the_others():
    memory = AnswerMemory(9, 0.5)
    for ra, dec in [(359.9, 1.0), (40.0, 9.0), (0.1, 1.1), (200.0, -50.0), (0.0, 1.2), (1.5, 2.5)]:
        memory.add(ra, dec, 179.9)
    predicted = memory.prediction()
    assert predicted.votes == 3
    assert predicted.right_ascension_deg % 360.0 == pytest.approx(0.0, abs=1e-9)
    assert predicted.declination_deg == pytest.approx(1.1)
    assert predicted.roll_deg == pytest.approx(179.9)


def test_the_memory_follows_the_camera():
    lsi = lost_in_space(99.5)
    frames = list(
        sky_sequence(
            np.random.default_rng(5), lsi.database.sky, 359.0, 12.0, NoiseModel(), count=20, wander=True
        )
    )
    memory = AnswerMemory(30, 1e-6)
    for before, now in pairwise(frames):
        _, first, second = np.intersect1d(before.identity, now.identity, return_indices=True)
        memory.add(before.right_ascension_deg, before.declination_deg, before.roll_deg)
        memory.carry(estimate_motion(before.observed.positions[first], now.observed.positions[second]))
    predicted = memory.prediction()
    assert predicted.votes == 19
    error = boresight_error(
        predicted.right_ascension_deg, predicted.declination_deg, now.right_ascension_deg, now.declination_deg
    )
    assert float(error) < 1e-9
    assert predicted.roll_deg == pytest.approx(now.roll_deg)


def test_the_memory_drops_old_answers_and_all_when_cleared():
    memory = AnswerMemory(2, 0.5)
    for ra in (10.0, 10.1, 50.0, 50.1):
        memory.add(ra, 0.0, 0.0)
    memory.carry(motion(shift=(1.0, 0.0)))
    assert memory.prediction().right_ascension_deg == pytest.approx(49.05)
    memory.clear()
    assert memory.prediction() is None


def test_a_wrong_start_is_recovered_from_and_gross_answers_are_outvoted():
    lsi = lost_in_space(99.5)
    noise = NoiseModel.of("both", 0.34, false_stars=2)
    settings = TrackFilterSettings(0.016, 0.01, max_rotation_deg=4.0, max_shift_deg=4.0)
    errors = {}
    for memory in (0, 15):
        recursion = RecursiveIdentification(lsi, TrackFilter(settings), RsiSettings(memory=memory))
        sequence = sky_sequence(
            np.random.default_rng(7), lsi.database.sky, 108.41, 12.14, noise, count=100, wander=True
        )
        errors[memory] = []
        for frame in sequence:
            estimate = recursion.step(frame.observed).estimate
            where = estimate.right_ascension_deg, estimate.declination_deg
            truth = frame.right_ascension_deg, frame.declination_deg
            errors[memory].append(float(boresight_error(*where, *truth)))
    assert np.mean(errors[15][5:]) < min(0.18, np.mean(errors[0][5:]))
    assert max(errors[15][20:]) < 1.0
