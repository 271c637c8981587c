"""MATLAB's `lasso`: against scikit-learn where both converge, and otherwise against the thesis."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from sklearn.linear_model import Lasso

from starid.identification.thesis.database import DatabaseError, DatabaseParameters, build_database
from starid.identification.thesis.lasso import LAMBDAS, lasso_path
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.matlab_lasso import matlab_path
from starid.identification.thesis.metrics import boresight_error
from tests.starid.identification.thesis.thesis_sky import database, thesis_catalog, thesis_frames

pytestmark = pytest.mark.long

CELLS = (509, 510, 511, 734, 735, 736, 959, 960, 961)
OMEGA_MSE = (0, 0, 0.04, 0, 0.45, 0.26, 0, 0.26, 0)
OMEGA_1SE = (0, 0, 0.03, 0, 0.44, 0.26, 0, 0.27, 0)
HALF_DIGIT = 0.0051


def path_of(dictionary, observation, lambdas=LAMBDAS):
    weights = np.empty((lambdas.size, dictionary.shape[1]))
    matlab_path(np.ascontiguousarray(dictionary), observation, lambdas, weights)
    return weights


def test_well_conditioned_columns_give_the_lasso_of_standardised_columns_with_an_intercept():
    rng = np.random.default_rng(4)
    dictionary = rng.normal(size=(60, 7)) * np.array([1, 5, 0.2, 30, 2, 1, 1]) + rng.normal(size=7)
    observation = dictionary @ np.array([2, 0, -8, 0.1, 0, 0, 1]) + 5.0 + rng.normal(size=60)
    lambdas = np.array([0.02, 0.1, 0.5, 1.5])
    deviation = dictionary.std(axis=0)
    weights = path_of(dictionary, observation, lambdas)
    for omega, penalty in zip(weights, lambdas, strict=True):
        expected = Lasso(alpha=penalty, tol=1e-10, max_iter=100_000).fit(dictionary / deviation, observation)
        np.testing.assert_allclose(omega * deviation, expected.coef_, atol=2e-3)


def test_a_column_without_variation_has_no_weight():
    dictionary = np.random.default_rng(1).normal(size=(5, 3))
    dictionary[:, 1] = 7.0
    assert np.all(path_of(dictionary, dictionary[:, 0] + dictionary[:, 1])[:, 1] == 0.0)


def test_no_weight_above_the_largest_penalty():
    dictionary = np.random.default_rng(2).normal(size=(5, 9))
    assert np.all(path_of(dictionary, 0.01 * dictionary[:, 4]) == 0.0)


@cache
def worked_example():
    """T of section 5.1 with the polar angle as a sixth row, (6, 9), and the observation, (6,)."""
    stars = thesis_catalog()
    least = float(stars.hp.min())
    shifted = dataclasses.replace(stars, hp=stars.hp - least)
    made = build_database(shifted, DatabaseParameters(overlap=0.96, kappa=11.5 - least))
    cells = [made.exact_features(cell - 1) for cell in CELLS]
    columns = [[*made.normalise(cell), cell.theta_deg / 3.6] for cell in cells]
    frame = made.sky.features(115.0, -65.0)
    return np.array(columns).T, np.array([*made.normalise(frame), frame.theta_deg / 3.6])


@pytest.mark.parametrize(("penalty", "published"), [(1.0, OMEGA_MSE), (1.35, OMEGA_1SE)])
def test_the_weights_of_the_worked_example_are_the_printed_ones(penalty, published):
    omega = path_of(*worked_example())[np.argmin(np.abs(LAMBDAS - penalty))]
    np.testing.assert_allclose(omega / omega.sum(), published, atol=HALF_DIGIT)


def test_the_exact_path_does_not_give_the_printed_weights():
    dictionary, observation = worked_example()
    weights = np.empty((LAMBDAS.size, 9))
    lasso_path(np.ascontiguousarray(dictionary), observation, LAMBDAS, weights)
    shares = weights / weights.sum(axis=1, keepdims=True)
    assert np.min(np.max(np.abs(shares - OMEGA_MSE), axis=1)) > 10 * HALF_DIGIT


def test_the_accuracy_of_the_1701_frames_is_the_published_one():
    lsi = LostInSpace(database(99.5), solver="matlab")
    ra, dec = thesis_frames(1)
    errors, psi = np.empty(ra.size), np.empty(ra.size)
    for i, (a, d) in enumerate(zip(ra, dec, strict=True)):
        estimate = lsi.solve(lsi.database.sky.features(a % 360.0, d)).mse
        errors[i] = boresight_error(estimate.right_ascension_deg, estimate.declination_deg, a, d)
        psi[i] = estimate.error_psi
    published = {0.3: 100.0, 0.2: 92.24, 0.1: 71.43, 0.013: 59.20, 0.008: 58.67, 0.002: 57.79}
    for limit, share in published.items():
        assert 100.0 * np.mean(errors <= limit) == pytest.approx(share, abs=1.5), limit
    assert psi.mean() == pytest.approx(0.49, abs=0.01)


def test_an_unknown_solver_is_rejected():
    with pytest.raises(DatabaseError, match="one of exact, matlab, sklearn"):
        LostInSpace(database(96.0), solver="octave")
