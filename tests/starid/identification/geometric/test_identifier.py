"""The identifier on the scenes of the published comparison: right or rejected, calibrated covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from starid.attitude import ARCSEC_PER_RAD
from starid.attitude.wahba import METHODS, solve_wahba
from starid.identification.geometric.identifier import Effort, Identifier
from starid.identification.solution import Reason
from starid.lab.leaderboard.comparison import ROWS, STANDARD, best_attitude
from starid.lab.leaderboard.scenes import SceneSettings
from tests.starid.identification.geometric.sky_points import WRONG_ARCSEC, identifier, maker, scenes

pytestmark = pytest.mark.lowest("numba")

FRAMES = 40
FLOOR_RATIO = 1.1
UNLIKELY = 1e-5
SAME_RAD = 1e-10


@pytest.mark.parametrize("row", [row for row in STANDARD if "random" not in row])
def test_scenes_of_the_comparison_are_solved_within_the_error_bound(row: str) -> None:
    errors, bounds = [], []
    for scene in scenes(ROWS[row], FRAMES, 17):
        solution = identifier().identify(scene.xy_px, scene.flux)
        assert solution.valid, solution.reason
        error = solution.attitude.error_to(scene.attitude)
        assert error.cross_boresight_arcsec < WRONG_ARCSEC
        pairs = scene.star[solution.detection_index]
        named = maker().stars.hip[pairs[pairs >= 0]]
        assert np.mean(named == solution.hip[pairs >= 0]) > 0.9
        errors.append(error.cross_boresight_arcsec)
        bounds.append(
            best_attitude(maker().camera, maker().stars, scene)
            .error_to(scene.attitude)
            .cross_boresight_arcsec
        )
    assert np.sqrt(np.mean(np.square(errors))) < FLOOR_RATIO * np.sqrt(np.mean(np.square(bounds)))


@pytest.mark.parametrize("row", ["100 random points", "30–150 random points"])
def test_random_points_are_rejected(row: str) -> None:
    for scene in scenes(ROWS[row], 100, 18):
        solution = identifier().identify(scene.xy_px, scene.flux)
        assert (solution.valid, solution.reason) == (False, Reason.NO_MATCH)
        assert np.isnan(solution.quaternion_xyzw).all()


def test_a_mirrored_sky_is_rejected() -> None:
    for scene in scenes(ROWS["0.5"], 30, 19):
        mirrored = scene.xy_px * [-1.0, 1.0] + [936.0, 0.0]
        assert not identifier().identify(mirrored, scene.flux).valid


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_a_covered_field_is_solved(share: float) -> None:
    for scene in scenes(SceneSettings(5.5, 0.5, covered=share), 30, 20):
        solution = identifier().identify(scene.xy_px, scene.flux)
        assert solution.valid
        assert solution.attitude.error_to(scene.attitude).cross_boresight_arcsec < WRONG_ARCSEC


def test_a_cluttered_field_is_solved_by_its_parts() -> None:
    settings = SceneSettings(5.5, 0.5, false_stars=200, cluttered=0.5)
    whole = Identifier(effort=Effort(part_stars=0))
    counts = {"parts": 0, "whole": 0}
    for scene in scenes(settings, 40, 21):
        for name, asked in (("parts", identifier()), ("whole", whole)):
            solution = asked.identify(scene.xy_px, scene.flux)
            if solution.valid:
                counts[name] += 1
                assert solution.attitude.error_to(scene.attitude).cross_boresight_arcsec < WRONG_ARCSEC
    assert counts["parts"] >= 39
    assert counts["whole"] <= 25


def test_a_field_with_a_mirrored_half_is_right_or_rejected() -> None:
    valid = 0
    for scene in scenes(ROWS["0.5"], 30, 22):
        left = scene.xy_px[:, 0] < 468.0
        ghosts = scene.xy_px[left] * [-1.0, 1.0] + [936.0, 0.0]
        solution = identifier().identify(
            np.concatenate([scene.xy_px[left], ghosts]), np.concatenate([scene.flux[left]] * 2)
        )
        if solution.valid:
            valid += 1
            assert solution.attitude.error_to(scene.attitude).cross_boresight_arcsec < WRONG_ARCSEC
    assert valid >= 27


@pytest.mark.parametrize("with_sigmas", [False, True])
def test_the_covariance_matches_the_errors(with_sigmas: bool) -> None:
    rng = np.random.default_rng(23)
    total, solved = 0.0, 0
    for scene in scenes(SceneSettings(5.5, 0.0), 200, 24):
        n = len(scene.xy_px)
        sigma = rng.uniform(0.2, 2.0, (n, 2)) if with_sigmas else np.full((n, 2), 1.5)
        xy = scene.xy_px + sigma * rng.standard_normal((n, 2))
        solution = identifier().identify(xy, scene.flux, sigma if with_sigmas else None)
        error = solution.attitude.error_to(scene.attitude).rotation_vector_rad
        total += float(error @ np.linalg.solve(solution.covariance, error))
        solved += 1
    assert chi2.ppf(UNLIKELY, 3 * solved) < total < chi2.ppf(1.0 - UNLIKELY, 3 * solved)


def test_known_errors_weight_the_stars() -> None:
    rng = np.random.default_rng(25)
    with_errors, without = [], []
    for scene in scenes(SceneSettings(5.5, 0.0), 60, 26):
        sigma = np.where(np.arange(len(scene.xy_px)) % 2 == 0, 0.1, 2.0)
        xy = scene.xy_px + sigma[:, None] * rng.standard_normal(scene.xy_px.shape)
        for errors, given in ((with_errors, sigma), (without, None)):
            solution = identifier().identify(xy, scene.flux, given)
            errors.append(solution.attitude.error_to(scene.attitude).cross_boresight_arcsec)
    assert np.median(with_errors) < 0.5 * np.median(without)


def test_the_solution_has_matches_residuals_and_covariance() -> None:
    scene = scenes(ROWS["1"], 1, 27)[0]
    solution = identifier().identify(scene.xy_px, scene.flux)
    stars = identifier().catalog
    assert 0.0 <= solution.probability_false < 1e-5
    assert 0.8 < solution.sigma_px < 1.25
    assert solution.rms_px == pytest.approx(np.sqrt(2.0) * solution.sigma_px, rel=0.1)
    assert (stars.hip[solution.catalog_index] == solution.hip).all()
    assert len(set(solution.detection_index.tolist())) == solution.star_count
    assert solution.covariance == pytest.approx(solution.covariance.T)
    seen = solution.attitude.to_sensor(stars.vectors[solution.catalog_index])
    xy, inside = identifier().camera.project(seen)
    near = np.linalg.norm(xy - scene.xy_px[solution.detection_index], axis=1)
    assert inside.all()
    assert np.median(near) < 2.0


def test_every_estimator_agrees_on_the_matches() -> None:
    scene = scenes(ROWS["0.5"], 1, 28)[0]
    solution = identifier().identify(scene.xy_px, scene.flux)
    body = identifier().camera.back_project(scene.xy_px[solution.detection_index])
    reference = identifier().catalog.vectors[solution.catalog_index]
    answers = [solve_wahba(body, reference, method=method) for method in METHODS]
    assert len(answers) == 5
    for answer in answers:
        apart = answer.error_to(answers[0]).rotation_vector_rad
        assert np.linalg.norm(apart) < SAME_RAD
        error = answer.error_to(solution.attitude)
        assert error.cross_boresight_arcsec < 3.0 * solution.cross_boresight_sigma_arcsec
        assert np.radians(error.roll_arcsec / 3600.0) < 3.0 * solution.roll_sigma_arcsec / ARCSEC_PER_RAD


def test_the_order_of_the_detections_does_not_matter() -> None:
    scene = scenes(ROWS["2, 5, 3"], 1, 29)[0]
    first = identifier().identify(scene.xy_px, scene.flux)
    order = np.random.default_rng(30).permutation(len(scene.flux))
    second = identifier().identify(scene.xy_px[order], scene.flux[order])
    assert second.quaternion_xyzw == pytest.approx(first.quaternion_xyzw, abs=1e-12)
    assert set(map(tuple, np.column_stack([order[second.detection_index], second.hip]).tolist())) == set(
        map(tuple, np.column_stack([first.detection_index, first.hip]).tolist())
    )


def test_flux_may_be_in_any_unit() -> None:
    scene = scenes(ROWS["1"], 1, 31)[0]
    first = identifier().identify(scene.xy_px, scene.flux)
    second = identifier().identify(scene.xy_px, 1e9 * scene.flux)
    assert second.quaternion_xyzw == pytest.approx(first.quaternion_xyzw, abs=1e-12)
