"""The five estimators against each other, scipy and the truth, including cases where one is weak."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude
from starid.attitude.wahba import METHODS, covariance, solve_wahba
from starid.errors import StaridError

AGREE_RAD = 1e-10
Turn = Callable[[np.random.Generator], Attitude]


def half_turn(rng: np.random.Generator) -> Attitude:
    return Attitude(np.append(rng.standard_normal(3), 0.0))


def half_turn_about_an_axis(rng: np.random.Generator) -> Attitude:
    return Attitude(np.eye(4)[rng.integers(3)])


def almost_half_turn(rng: np.random.Generator) -> Attitude:
    return half_turn(rng).rotated(1e-8 * rng.standard_normal(3))


def no_turn(rng: np.random.Generator) -> Attitude:
    return Attitude.identity()


def tiny_turn(rng: np.random.Generator) -> Attitude:
    return Attitude.identity().rotated(1e-7 * rng.standard_normal(3))


def scene(
    rng: np.random.Generator, turn: Turn, n: int, spread_deg: float, noise: float
) -> tuple[Attitude, np.ndarray, np.ndarray, np.ndarray]:
    """Truth, noisy body and reference directions within a cap about a random direction, and weights."""
    truth = turn(rng)
    cap = math.tan(math.radians(spread_deg))
    angles = rng.uniform(0, 2 * math.pi) + np.linspace(0, 2 * math.pi, n, endpoint=False)
    radii = cap * rng.uniform(0.8, 1.0, n)
    local = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.ones(n)])
    reference = local @ random_attitude(rng).matrix
    reference /= np.linalg.norm(reference, axis=1, keepdims=True)
    body = truth.to_sensor(reference) + noise * rng.standard_normal((n, 3))
    return truth, body, reference, rng.uniform(0.5, 2.0, n)


@pytest.mark.parametrize(
    "turn", [random_attitude, half_turn, half_turn_about_an_axis, almost_half_turn, no_turn, tiny_turn]
)
@pytest.mark.parametrize(
    ("n", "spread_deg", "noise"),
    [
        (2, 20.0, 1e-4),
        (2, 0.25, 1e-6),
        (3, 21.0, 0.0),
        (3, 0.25, 1e-6),
        (5, 60.0, 0.2),
        (40, 21.0, 1e-4),
        (2, 80.0, 0.0),
    ],
)
def test_estimators_agree_with_each_other_and_scipy(
    turn: Turn, n: int, spread_deg: float, noise: float
) -> None:
    rng = np.random.default_rng([n, int(spread_deg * 100)])
    for _ in range(5):
        _, body, reference, weights = scene(rng, turn, n, spread_deg, noise)
        unit = body / np.linalg.norm(body, axis=1, keepdims=True)
        theirs = Attitude(Rotation.align_vectors(unit, reference, weights=weights)[0].as_quat())
        for method in METHODS:
            ours = solve_wahba(body, reference, weights, method)
            assert ours.error_to(theirs).total_arcsec < AGREE_RAD * ARCSEC_PER_RAD, method


@pytest.mark.parametrize("method", METHODS)
def test_exact_directions_give_the_true_attitude(method: str) -> None:
    rng = np.random.default_rng(11)
    for turn in (random_attitude, half_turn, half_turn_about_an_axis, no_turn):
        for n in (2, 3, 30):
            truth, body, reference, weights = scene(rng, turn, n, 21.0, 0.0)
            error = solve_wahba(body, reference, weights, method).error_to(truth)
            assert error.total_arcsec < AGREE_RAD * ARCSEC_PER_RAD


@pytest.mark.parametrize("method", METHODS)
def test_the_answer_minimises_the_loss(method: str) -> None:
    rng = np.random.default_rng(12)
    _, body, reference, weights = scene(rng, random_attitude, 8, 30.0, 0.05)
    body /= np.linalg.norm(body, axis=1, keepdims=True)

    def loss(attitude: Attitude) -> float:
        return float(weights @ ((body - attitude.to_sensor(reference)) ** 2).sum(axis=1))

    best = solve_wahba(body, reference, weights, method)
    for _ in range(30):
        assert loss(best.rotated(1e-4 * rng.standard_normal(3))) > loss(best)


def test_larger_weights_have_more_influence() -> None:
    reference = np.eye(3)
    body = np.eye(3)
    body[0] = [1.0, 0.02, 0.0]
    light = solve_wahba(body, reference, [1e-6, 1.0, 1.0]).error_to(Attitude.identity()).total_arcsec
    heavy = solve_wahba(body, reference, [1e6, 1.0, 1.0]).error_to(Attitude.identity()).total_arcsec
    assert light < 1.0
    assert heavy > 2000.0


@pytest.mark.long
def test_the_covariance_matches_the_scatter_of_many_solutions() -> None:
    rng = np.random.default_rng(13)
    truth, body, reference, _ = scene(rng, random_attitude, 12, 18.0, 0.0)
    sigma = rng.uniform(1e-4, 4e-4, 12)
    predicted = covariance(body, sigma)
    errors, samples = [], 600
    for _ in range(samples):
        noisy = body + sigma[:, None] * rng.standard_normal((12, 3))
        errors.append(solve_wahba(noisy, reference, sigma**-2.0).error_to(truth).rotation_vector_rad)
    measured = np.cov(np.array(errors).T)
    normalised = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(predicted), errors).mean() / 3.0
    assert normalised == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / 3.0 / samples))
    np.testing.assert_allclose(measured, predicted, atol=0.1 * np.trace(predicted))


def test_covariance_of_stars_on_the_axes() -> None:
    np.testing.assert_allclose(covariance(np.eye(3), 2e-5), np.eye(3) * 2e-10, rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("body", "reference", "weights", "message"),
    [
        ([[0, 0, 1]], [[0, 0, 1]], None, "1 star; an attitude needs"),
        ([[0, 0, 1]] * 3, [[1, 0, 0]] * 3, None, "undetermined"),
        ([[0, 0, 1], [0, 0, -1]], [[1, 0, 0], [-1, 0, 0]], None, "undetermined"),
        ([[0, 0, 1], [0, 1, 0]], [[1, 0, 0]], None, "their numbers must be equal"),
        ([[0, 0, 1], [0, 1]], [[1, 0, 0]], None, "directions"),
        ([[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 1, 0]], None, "not zero"),
        ([[0, 0, math.nan], [0, 1, 0]], [[1, 0, 0], [0, 1, 0]], None, "finite"),
        (np.eye(3), np.eye(3), [1, 1], "weights"),
        (np.eye(3), np.eye(3), [1, 1, 0], "weights"),
        (np.eye(3), np.eye(3), [1, 1, math.inf], "weights"),
        (np.eye(3), -np.eye(3), None, "undetermined"),
    ],
)
def test_undetermined_and_bad_input_is_rejected(method: str, body, reference, weights, message: str) -> None:
    with pytest.raises(StaridError, match=message):
        solve_wahba(body, reference, weights, method)


def test_an_unknown_method_is_rejected() -> None:
    with pytest.raises(StaridError, match="'newton'"):
        solve_wahba(np.eye(3), np.eye(3), method="newton")  # type: ignore[arg-type]


@pytest.mark.parametrize("sigma", [0.0, [1e-4, 1e-4], [1e-4, -1.0, 1e-4], math.nan])
def test_bad_sigmas_are_rejected(sigma: object) -> None:
    with pytest.raises(StaridError, match="standard deviations"):
        covariance(np.eye(3), sigma)  # type: ignore[arg-type]


def test_covariance_of_one_star_is_rejected() -> None:
    with pytest.raises(StaridError, match="undetermined"):
        covariance([[0, 0, 1]], 1e-4)
