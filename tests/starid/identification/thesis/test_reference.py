"""The compiled code against the thesis's methods with scikit-learn."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from sklearn.linear_model import Lasso

from starid.identification.thesis.fsf import ClusterFilter
from starid.identification.thesis.lasso import LAMBDAS, lasso_path
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.reference import ReferenceFilter, ReferenceLostInSpace, reference_path
from starid.lab.simulation import NoiseModel, moved_frames
from tests.starid.identification.thesis.thesis_sky import database, lost_in_space

pytestmark = [pytest.mark.long, pytest.mark.lowest("scikit-learn")]

STARS = np.array(
    [[-19.6, -4.7], [-12.7, 10.4], [-9.0, 4.3], [3.4, -3.9], [5.2, 19.8], [6.4, -6.9], [7.9, 15.9]]
)
BRIGHTNESS = np.array([0.5, 2.91, 1.93, 2.85, 1.58, 0.46, 1.29])


def minimised(dictionary, observation, omega, penalty):
    """The objective of eq. 2.34."""
    return np.sum((observation - dictionary @ omega) ** 2) / 10.0 + penalty * np.abs(omega).sum()


@pytest.mark.parametrize(("ra", "dec"), [(115.0, -65.0), (201.7, 40.2), (359.1, -20.6)])
def test_lost_in_space_is_the_nearest_neighbour_and_the_lasso_of_scikit_learn(ra, dec):
    made = database(96.0)
    features = made.sky.features(ra, dec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = ReferenceLostInSpace(made).solve(features)
    solution = lost_in_space(96.0).solve(features)
    assert solution.nearest == expected.nearest
    assert solution.distance == pytest.approx(expected.distance, abs=1e-9)
    assert solution.mse.penalty == expected.penalty
    # nearly equal columns: coordinate descent comes close to the minimum, the path reaches it
    ours, theirs = (
        minimised(solution.dictionary, solution.observation, omega, expected.penalty)
        for omega in (solution.mse.omega, expected.omega)
    )
    assert ours <= theirs + 1e-9
    assert ours == pytest.approx(theirs, abs=1e-3)
    assert solution.mse.error_psi == pytest.approx(expected.error_psi, abs=0.05)
    assert solution.mse.declination_deg == pytest.approx(expected.declination_deg, abs=0.5)


@pytest.mark.parametrize("penalty", [0.5, 2.0, 5.0])
def test_the_path_reaches_scikit_learn_s_minimum(penalty):
    made = database(96.0)
    observation = made.normalise(made.sky.features(115.0, -65.0))
    cells = made.grid.dictionary(734)
    dictionary = np.array([made.normalise(made.exact_features(int(cell))) for cell in cells]).T.copy()
    path = np.empty((LAMBDAS.size, 9))
    lasso_path(dictionary, observation, LAMBDAS, path)
    omega = path[int(np.argmin(np.abs(LAMBDAS - penalty)))]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = Lasso(alpha=penalty, fit_intercept=False, tol=1e-9, max_iter=200_000)
        expected = model.fit(dictionary, observation).coef_
    ours, theirs = (minimised(dictionary, observation, weights, penalty) for weights in (omega, expected))
    assert ours <= theirs + 1e-9


@pytest.mark.parametrize("false_stars", [0, 2, 5])
@pytest.mark.parametrize("factor", [0.0, 1.0, 4.0])
def test_the_filter_is_the_clustering_of_scikit_learn(false_stars, factor):
    noise = NoiseModel.of("both", factor, false_stars=false_stars, magnitude_range=(-1.5, 3.0))
    frames = moved_frames(np.random.default_rng(3), BRIGHTNESS, STARS, noise, count=6, radius_deg=21.0)
    first = next(frames).observed
    for frame in frames:
        expected = ReferenceFilter()(first, frame.observed)
        result = ClusterFilter()(first, frame.observed)
        np.testing.assert_array_equal(result.true_before, expected.true_before)
        np.testing.assert_array_equal(result.true_now, expected.true_now)
        np.testing.assert_array_equal(result.matches, expected.matches)


@pytest.mark.parametrize("precision", ["exact", "stored"])
def test_the_solver_of_scikit_learn_finds_the_cells_and_weights_of_the_compiled_code(precision):
    made = database(96.0)
    compiled, reference = (
        LostInSpace(made, precision=precision, solver=name) for name in ("exact", "sklearn")
    )
    for ra, dec in ((115.0, -65.0), (359.1, -20.6)):
        observation = made.normalise(made.sky.features(ra, dec))
        ours, theirs = (lsi.solve_normalised(observation) for lsi in (compiled, reference))
        assert theirs.nearest == ours.nearest
        assert theirs.distance == pytest.approx(ours.distance, abs=1e-6)
        np.testing.assert_allclose(theirs.dictionary, ours.dictionary)
        least, errors = (
            minimised(ours.dictionary, observation, omega, ours.mse.penalty)
            for omega in (ours.mse.omega, theirs.mse.omega)
        )
        assert theirs.mse.penalty == ours.mse.penalty
        assert least - 1e-9 <= errors <= least + 1e-3


def test_the_search_of_scikit_learn_lists_the_nearest_cells():
    made = database(96.0)
    compiled, reference = (LostInSpace(made, solver=name) for name in ("exact", "sklearn"))
    observation = made.normalise(made.sky.features(88.0, 3.0))
    for count in (1, 30, made.cells + 5):
        ours, theirs = (np.sort(lsi.neighbours(observation, count)[0]) for lsi in (compiled, reference))
        np.testing.assert_allclose(theirs, ours, atol=1e-6)
    cells = reference.neighbours(observation, made.cells + 5)[1]
    assert np.count_nonzero(cells < 0) >= 5


def test_the_intercept_takes_the_means_out():
    made = database(96.0)
    cells = made.grid.dictionary(734)
    dictionary = np.array([made.normalise(made.exact_features(int(cell))) for cell in cells]).T
    observation = made.normalise(made.sky.features(115.0, -65.0))
    path = reference_path(dictionary, observation, intercept=True)
    shifted = reference_path(dictionary + 7.0, observation - 3.0, intercept=True)
    np.testing.assert_allclose(shifted, path, atol=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        deviation = dictionary.std(axis=0)
        expected = Lasso(alpha=5.0, tol=1e-8, max_iter=100_000).fit(dictionary / deviation, observation)
    np.testing.assert_allclose(path[-1] * deviation, expected.coef_, atol=1e-3)
