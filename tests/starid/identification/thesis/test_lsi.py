"""LSI: search and LASSO against scipy and scikit-learn; published accuracy; improvement off the grid."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree
from sklearn.linear_model import Lasso

from starid.identification.thesis.cell_search import exact_nearest, exact_vector, stored_neighbours
from starid.identification.thesis.database import DatabaseError
from starid.identification.thesis.features import FeatureVector, extract_features
from starid.identification.thesis.lasso import LAMBDAS, coordinate_descent, lasso_path, optimality_gap
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.metrics import boresight_error
from starid.identification.thesis.subcell import SubcellSearch
from starid.lab.simulation import turned
from tests.starid.identification.thesis.thesis_sky import database, lost_in_space, thesis_frames

pytestmark = pytest.mark.long

GRID_STEP = 0.2


def observations(percent, every, shift=0.0):
    made = database(percent)
    ra, dec = thesis_frames(every)
    return np.array(
        [
            made.normalise(made.sky.features((a + shift) % 360.0, d + 0.67 * shift))
            for a, d in zip(ra, dec, strict=True)
        ]
    )


@pytest.mark.parametrize("k", [1, 20])
def test_stored_neighbours_match_a_tree(k):
    made, lsi = database(99.0), lost_in_space(99.0)
    tree = cKDTree(made.features.astype(np.float64))
    for observation in observations(99.0, 40, 0.13):
        query = observation * 2.55
        distances, cells = np.empty(k), np.empty(k, dtype=np.int64)
        stored_neighbours(lsi.index, query, distances, cells)
        expected = np.atleast_1d(tree.query(query, k)[0])
        np.testing.assert_allclose(np.sort(np.sqrt(distances)), expected, atol=1e-9)


def test_the_exact_neighbour_matches_full_precision():
    made, lsi = database(96.0), lost_in_space(96.0)
    full = np.empty((made.cells, 5))
    sums = np.empty(8)
    for cell in range(made.cells):
        exact_vector(lsi.arrays, cell, sums, full[cell])
    tree = cKDTree(full)
    outcome = np.empty(2)
    for observation in observations(96.0, 20, 0.13):
        cell = exact_nearest(lsi.index, lsi.arrays, observation, outcome)
        expected, _ = tree.query(observation)
        assert outcome[0] == pytest.approx(expected, abs=1e-9)
        assert np.linalg.norm(full[cell] - observation) == pytest.approx(expected, abs=1e-9)


def objective(dictionary, observation, penalty, omega):
    return ((observation - dictionary @ omega) ** 2).sum() / 10.0 + penalty * np.abs(omega).sum()


def test_lasso_path_is_at_least_as_good_as_scikit_learns():
    lsi = lost_in_space(99.5)
    weights = np.empty((LAMBDAS.size, 9))
    for observation in observations(99.5, 680, 0.07):
        solution = lsi.solve_normalised(observation)
        dictionary = solution.dictionary
        assert lasso_path(dictionary, observation, LAMBDAS, weights)
        gram, correlation = dictionary.T @ dictionary / 5.0, dictionary.T @ observation / 5.0
        for i in (0, 19, 99):
            assert optimality_gap(gram, correlation, LAMBDAS[i], weights[i].copy()) < 1e-6
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model = Lasso(alpha=LAMBDAS[i], fit_intercept=False, tol=1e-12, max_iter=20_000)
                theirs = model.fit(dictionary, observation).coef_
            ours = objective(dictionary, observation, LAMBDAS[i], weights[i])
            assert ours <= objective(dictionary, observation, LAMBDAS[i], theirs) * (1.0 + 1e-9) + 1e-6


def test_coordinate_descent_and_the_path_agree_on_a_well_conditioned_problem():
    rng = np.random.default_rng(3)
    dictionary, observation = rng.normal(size=(5, 9)) * 10.0, rng.normal(size=5) * 10.0
    weights = np.empty((LAMBDAS.size, 9))
    lasso_path(dictionary, observation, LAMBDAS, weights)
    omega = np.zeros(9)
    coordinate_descent(dictionary.T @ dictionary / 5.0, dictionary.T @ observation / 5.0, LAMBDAS[40], omega)
    np.testing.assert_allclose(weights[40], omega, atol=1e-5)


def test_equal_columns_are_solved():
    column = np.array([50.0, 20.0, 30.0, 40.0, 10.0])
    dictionary = np.repeat(column[:, None], 9, axis=1)
    weights = np.empty((LAMBDAS.size, 9))
    lasso_path(dictionary, column, LAMBDAS, weights)
    np.testing.assert_allclose(dictionary @ weights[0], column, rtol=1e-3)


def test_published_example_about_its_own_cell():
    """For cell 735, eq. 2.34 gives weights on t5, t6 and t9, and a boresight 0.17° off."""
    lsi = lost_in_space(96.0)
    observation = lsi.database.normalise(lsi.database.sky.features(115.0, -65.0))
    estimate = lsi.estimate(observation, 734, 0.0).mse
    error = boresight_error(estimate.right_ascension_deg, estimate.declination_deg, 115.0, -65.0)
    assert estimate.omega[[4, 5, 8]] == pytest.approx([0.67, 0.11, 0.21], abs=0.03)
    assert float(error) == pytest.approx(0.17, abs=0.02)


def errors_of(solve, percent, every, shift):
    made = database(percent)
    ra, dec = thesis_frames(every)
    values = []
    for a, d in zip(ra + shift, dec + 0.67 * shift, strict=True):
        answer = solve(made.sky.features(a % 360.0, d))
        values.append(float(boresight_error(answer.right_ascension_deg, answer.declination_deg, a, d)))
    return np.array(values)


def test_accuracy_on_the_grid_reaches_the_published():
    errors = errors_of(lambda f: lost_in_space(99.5).solve(f).mse, 99.5, 3, 0.0)
    shares = [100.0 * float((errors <= limit).mean()) for limit in (0.3, 0.2, 0.1)]
    assert shares[0] >= 99.9
    assert shares[1] >= 92.0
    assert shares[2] >= 71.0


def test_accuracy_off_the_grid_and_between_the_cells():
    shift = 0.618 * GRID_STEP
    plain = errors_of(lambda f: lost_in_space(99.5).solve(f).mse, 99.5, 3, shift)
    fine = errors_of(SubcellSearch(lost_in_space(99.5)).solve, 99.5, 3, shift)
    for limit, least in ((0.3, 0.83), (0.2, 0.73), (0.1, 0.48)):
        assert (plain <= limit).mean() >= least
        assert (fine <= limit).mean() > (plain <= limit).mean()
    assert (fine <= 0.001).mean() > 0.8


def test_comparing_the_stars_separates_cells_of_equal_features():
    lsi = lost_in_space(99.5)
    search = SubcellSearch(lsi, neighbours=256)
    errors = {False: [], True: []}
    for ra, dec in zip(*thesis_frames(6), strict=True):
        where = ra + 0.618 * GRID_STEP, dec + 0.618 * GRID_STEP
        brightness, positions, _ = lsi.database.sky.stars_in_frame(where[0] % 360.0, where[1])
        positions = turned(positions, 33.0)
        features = extract_features(brightness, positions)
        for compares, errors_of_kind in errors.items():
            found = search.solve(features, positions if compares else None)
            place = found.right_ascension_deg, found.declination_deg
            errors_of_kind.append(float(boresight_error(*place, *where)))
            assert compares or found.seen == 0.0
    plain, compared = (np.array(errors[kind]) for kind in (False, True))
    assert (compared <= 0.1).mean() >= 0.975
    assert (compared <= 0.1).mean() > (plain <= 0.1).mean() + 0.02


def test_right_ascension_wraps():
    lsi = lost_in_space(99.5)
    for ra in (0.05, 359.95):
        estimate = lsi.solve(lsi.database.sky.features(ra, 10.1)).mse
        assert float(boresight_error(estimate.right_ascension_deg, estimate.declination_deg, ra, 10.1)) < 0.5


def test_a_region_contains_the_frame_or_nothing():
    lsi = lost_in_space(99.5)
    observation = lsi.database.normalise(lsi.database.sky.features(122.0, 7.0))
    cell, distance, count = lsi.nearest_in_region(observation, 122.3, 6.8, 2.0)
    assert cell == lsi.nearest(observation)[0]
    assert distance == pytest.approx(0.0, abs=1e-9)
    assert count == pytest.approx(100, abs=25)
    assert lsi.nearest_in_region(observation, 122.0, 89.0, 2.0)[0] == -1


def test_bad_observations_are_rejected():
    lsi = lost_in_space(96.0)
    with pytest.raises(DatabaseError, match="five finite numbers"):
        lsi.solve(FeatureVector(3, np.nan, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    with pytest.raises(DatabaseError, match="precision"):
        LostInSpace(database(96.0), precision="rough")
    with pytest.raises(DatabaseError, match="neighbour"):
        SubcellSearch(lsi, neighbours=0)
