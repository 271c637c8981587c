"""Few stars near a prediction: the bound, the combined attitude, and predictions that are wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter, maximum_filter

from starid.attitude import Attitude, random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.catalog import StarCatalog, load_catalog
from starid.identification.predicted_stars import (
    Prediction,
    expected_places,
    noise_peaks,
    solve_with_prediction,
    unnoticed_share,
)
from starid.identification.solution import Solution
from starid.imaging.detection import Detections

pytestmark = pytest.mark.long

SIGMA_RAD = 60.0 / 206265.0
PRIOR = np.diag([SIGMA_RAD**2, SIGMA_RAD**2, 4.0 * SIGMA_RAD**2])
ZERO_POINT, SNR, POSITION_PX = 14.0, 8.0, 0.15
MAX_ERROR_DEG, FREEDOM = 0.3, 60.0


@pytest.fixture(scope="module")
def bright() -> StarCatalog:
    return load_catalog().brighter_than(4.5)


def detections(xy: np.ndarray, magnitude: np.ndarray) -> Detections:
    count = len(xy)
    flux = 10.0 ** (-0.4 * (magnitude - ZERO_POINT))
    errors = np.full((count, 2), POSITION_PX)
    no = np.zeros(count, dtype=bool)
    return Detections(xy, flux, flux / SNR, errors, np.zeros(count), no, no, 10.0, 1.0, 1.2, 0.0, 0, "")


def image(truth: Attitude, stars: StarCatalog, count: int | None, rng: np.random.Generator) -> Detections:
    """A number of the stars in the field, chosen at random, with noise."""
    rows, xy = expected_places(DEFAULT_CAMERA, stars, truth)
    chosen = rng.permutation(len(rows))[:count]
    noisy = xy[chosen] + POSITION_PX * rng.standard_normal((len(chosen), 2))
    return detections(noisy, stars.v[rows[chosen]])


def solve(found: Detections, predicted: Attitude, stars: StarCatalog, prior: np.ndarray = PRIOR) -> Solution:
    return solve_with_prediction(
        DEFAULT_CAMERA, stars, found, Prediction(predicted, prior, FREEDOM), ZERO_POINT, 1e-5, MAX_ERROR_DEG
    )


def test_peaks_of_smoothed_noise_are_as_many_as_stated() -> None:
    size, sigma = 2000, 2.5
    field = gaussian_filter(np.random.default_rng(1).standard_normal((size, size)), sigma, mode="wrap")
    field /= field.std()
    is_peak = field == maximum_filter(field, 3, mode="wrap")
    for ratio in (3.0, 3.5, 4.0):
        peaks = np.count_nonzero(is_peak & (field > ratio))
        expected = size * size * float(noise_peaks(np.array(ratio), sigma))
        # the formula counts maxima less saddles and minima: right to a few per cent at these levels
        assert peaks == pytest.approx(expected, abs=4.0 * math.sqrt(expected) + 0.1 * expected), ratio


def test_the_error_with_few_stars_is_as_stated(bright: StarCatalog) -> None:
    squares = []
    for count, least in ((2, 10), (3, 43), (5, 47)):
        rng, before = np.random.default_rng(count), len(squares)
        for _ in range(50):
            truth = random_attitude(rng)
            error = np.sqrt(np.diag(PRIOR)) * rng.standard_normal(3)
            solution = solve(image(truth, bright, count, rng), truth.rotated(error), bright)
            if solution.valid:
                off = solution.attitude.error_to(truth)
                assert max(off.cross_boresight_arcsec, off.roll_arcsec) < 360.0
                squares.append(
                    off.rotation_vector_rad @ np.linalg.solve(solution.covariance, off.rotation_vector_rad)
                )
        assert len(squares) - before > least
    # chi-squared of three degrees of freedom: beyond four standard errors in one of 15 000 samples
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * math.sqrt(6.0 / len(squares)))


def test_one_star_is_not_enough(bright: StarCatalog) -> None:
    rng = np.random.default_rng(4)
    for _ in range(30):
        truth = random_attitude(rng)
        assert not solve(image(truth, bright, 1, rng), truth, bright).valid


def test_a_wrong_prediction_is_not_confirmed_by_other_stars() -> None:
    """Among 160 stars in the field and four times the errors of the others, pairs fit by chance in a quarter of the images."""
    stars = load_catalog().brighter_than(6.0)
    rng = np.random.default_rng(5)
    for _ in range(25):
        truth = random_attitude(rng)
        found = image(truth, stars, None, rng)
        wrong = truth.rotated(np.radians(rng.uniform(-5.0, 5.0, 3)))
        assert not solve(found, wrong, stars, 16.0 * PRIOR).valid


def test_a_star_far_from_its_place_or_of_another_brightness_is_left_out(bright: StarCatalog) -> None:
    rng = np.random.default_rng(6)
    truth = random_attitude(rng)
    rows, xy = expected_places(DEFAULT_CAMERA, bright, truth)
    xy, magnitude = xy[:5].copy(), bright.v[rows[:5]].copy()
    xy[1] += 8.0
    magnitude[3] += 2.5
    solution = solve(detections(xy, magnitude), truth, bright)
    assert sorted(solution.detection_index.tolist()) == [0, 2, 4]


LIMIT_RAD = math.radians(0.1)
CONTRADICTION = stats.chi2.ppf(0.999, 3)


SAMPLES = 50_000


def simulated_shares(
    stars: np.ndarray, prior: np.ndarray, angles: list[float], rng: np.random.Generator
) -> list[float]:
    """For each angle the share of errors by it about random axes that pass the test, and are too large in the combined attitude."""
    axes = rng.standard_normal((SAMPLES, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    of_stars = rng.multivariate_normal(np.zeros(3), stars, SAMPLES)
    noise = rng.multivariate_normal(np.zeros(3), prior, SAMPLES) - of_stars
    weights = np.linalg.inv(prior + stars)
    shares = []
    for angle in angles:
        off = angle * axes + noise
        passes = np.sum((off @ weights) * off, axis=1) <= CONTRADICTION
        answer = of_stars[passes] + off[passes] @ (stars @ weights).T
        large = np.maximum(np.hypot(answer[:, 0], answer[:, 1]), np.abs(answer[:, 2])) > LIMIT_RAD
        shares.append(np.count_nonzero(large) / SAMPLES)
    return shares


@pytest.mark.parametrize(
    ("stars_arcsec", "turned", "least"),
    [((30.0, 30.0, 300.0), 0.0, 0.01), ((40.0, 20.0, 600.0), 0.5, 0.01), ((25.0, 25.0, 100.0), 0.2, 0.0)],
    ids=["few stars", "two stars off the boresight", "stars that show the roll"],
)
def test_wrong_predictions_go_unnoticed_no_more_often_than_bounded(
    stars_arcsec: tuple[float, ...], turned: float, least: float
) -> None:
    prior = np.diag(np.square(np.array([30.0, 30.0, 75.0]) / 206265.0))
    turn = Attitude.identity().rotated((turned, 0.0, 0.0)).matrix
    stars = turn @ np.diag(np.square(np.array(stars_arcsec) / 206265.0)) @ turn.T
    bound = unnoticed_share(np.linalg.inv(stars), prior, LIMIT_RAD)
    rng = np.random.default_rng(7)
    angles = [step * LIMIT_RAD for step in (0.6, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0)]
    worst = max(simulated_shares(stars, prior, angles, rng))
    assert worst <= bound + 4.0 * math.sqrt(max(worst, 1e-5) / SAMPLES)
    assert bound <= 3.0 * worst + 1e-4
    assert worst >= least


def test_an_attitude_that_rests_on_the_prediction_is_invalid_where_many_predictions_are_wrong(
    bright: StarCatalog,
) -> None:
    """Three stars close together do not show a roll about them."""
    valid = {1e-3: 0, 1.0: 0}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = random_attitude(rng)
        rows, xy = expected_places(DEFAULT_CAMERA, bright, truth)
        close = np.argsort(np.hypot(*(xy - xy[0]).T))[:3]
        found = detections(xy[close] + POSITION_PX * rng.standard_normal((3, 2)), bright.v[rows[close]])
        for share in valid:
            solution = solve_with_prediction(
                DEFAULT_CAMERA, bright, found, Prediction(truth, PRIOR, FREEDOM), ZERO_POINT, 1e-5, 0.15,
                wrong_predictions=share,
            )  # fmt: skip
            valid[share] += solution.valid
    assert valid[1e-3] > 20
    assert valid[1.0] < 10
