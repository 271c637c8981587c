"""The error that features alone state in a sequence of images is the error that they have, at rest and while the body turns.

An answer is right to a fraction of a degree, or at another place of the sky. The images of a sequence show the same stars, so only
sequences are independent: in the worst case all images of one are right, or all are wrong. So their number decides what the tests
can tell, not that of images, of which there are enough for each class of an answer (`feature_error`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.truth.source import TruthState
from starid.attitude import propagate, random_attitude
from tests.emulator.sensor.pipeline.known_photometry import known_photometry

pytestmark = pytest.mark.long

SEQUENCES = 15
IMAGES = 4
SIGMAS = 3.0
"""Tolerance in standard deviations of the mean of independent sequences."""
RIGHT_DEG = 1.5
LIKELY_RIGHT = 0.1
"""Probability of another place of the sky below which an answer is said to be right: those said to be so are judged apart."""


@cache
def device(profile: str) -> EcssDevice:
    settings = ("run.algorithm=rsi", "identifier.refinement=false", *known_photometry(profile))
    return EcssDevice(EcssPlan(profile, settings))


@cache
def answers(profile: str, rate_deg_s: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each sequence: errors over stated ones, squared (n, 3); angles between the boresights, degrees; and stated probabilities."""
    unit, sequences = device(profile), []
    for number in range(SEQUENCES):
        rng = np.random.default_rng((45, number))
        attitude, axis = random_attitude(rng), rng.normal(size=3)
        rate = math.radians(rate_deg_s) * axis / np.linalg.norm(axis)
        squares, off, wrong = [], [], []
        predicted = None
        for image in range(IMAGES):
            request = FrameRequest(
                IMAGES * number + image, TruthState(attitude, rate), unit.exposure_s, unit.gain, unit.settings,
                temperature_c=unit.mean_c,
            )  # fmt: skip
            identifier = unit.pipeline.identifier(request)
            if image == 0:
                identifier.reset()
            detections, _ = unit.pipeline.detections(request)
            solution = unit.pipeline.solution(detections, replace(request, predicted=predicted), identifier)
            predicted = propagate(solution.attitude, rate, 1.0) if solution.valid else None
            if solution.valid:
                error = solution.attitude.error_to(attitude)
                squares.append(error.rotation_vector_rad**2 / np.diag(solution.covariance))
                off.append(error.cross_boresight_arcsec / 3600.0)
                wrong.append(solution.probability_false)
            attitude = propagate(attitude, rate, 1.0)
        if squares:
            sequences.append((np.array(squares), np.array(off), np.array(wrong)))
    return sequences


RATES = [("ideal", 0.0), ("ideal", 2.0), ("cubestar", 0.3), ("thesis", 0.0), ("thesis", 2.0)]
"""Profiles with rates in degrees per second: each camera, and each motion whose errors are known."""
CASES = [*([each] for each in RATES), RATES]
"""Each by itself, and all together, in which an error of half the size is found."""


def answers_of(case: list[tuple[str, float]]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [sequence for each in case for sequence in answers(*each)]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_squared_errors_are_the_stated_ones(case: list[tuple[str, float]]) -> None:
    for axes in (slice(0, 2), slice(2, 3)):
        means = np.array([np.mean(squares[:, axes]) for squares, _, _ in answers_of(case)])
        assert len(means) > 0.9 * SEQUENCES * len(case)
        # a square is 0 or, with the probability p of another place, 1/p: its variance is 1/p − 1
        expected = np.mean([1.0 / np.mean(wrong) - 1.0 for _, _, wrong in answers_of(case)])
        sampling = math.sqrt(max(expected, np.var(means, ddof=1)) / len(means))
        assert np.mean(means) == pytest.approx(1.0, abs=SIGMAS * sampling)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_places_are_wrong_as_often_as_stated(case: list[tuple[str, float]]) -> None:
    for low, high in ((0.0, LIKELY_RIGHT), (LIKELY_RIGHT, 1.01)):
        excess = variance = 0.0
        for _, off, wrong in answers_of(case):
            in_class = (wrong >= low) & (wrong < high)
            if in_class.any():
                stated = wrong[in_class].mean()
                excess += float(np.sum((off[in_class] > RIGHT_DEG) - wrong[in_class]))
                variance += np.count_nonzero(in_class) ** 2 * stated * (1.0 - stated)
        assert abs(excess) <= SIGMAS * math.sqrt(variance)
