"""Aberration and the Earth's motion, against `erfa`, JPL's DE421 and exact star fields."""

from __future__ import annotations

import math
import warnings

import erfa
import numpy as np
import pytest

from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog.aberration import SPEED_OF_LIGHT_M_S, aberrated
from starid.catalog.earth import earth_and_sun, earth_velocity, julian_year, terrestrial_time
from starid.errors import StaridError
from starid.identification.geometric.identifier import Identifier
from starid.identification.tracker import Tracker
from starid.lab.classic.registry import make_identifier

pytestmark = pytest.mark.long

NEW_YEAR = 1_767_225_600.0
YEAR_S = 365.25 * 86400.0
MICROARCSEC = 1e-6 / ARCSEC_PER_RAD
LOW_ORBIT_M_S = np.array([0.0, 5400.0, -5400.0])


def velocity_at(share_of_year: float) -> np.ndarray:
    return earth_velocity(NEW_YEAR + share_of_year * YEAR_S) + LOW_ORBIT_M_S


def seen(
    solver: Identifier, camera: Camera, attitude: Attitude, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact positions and flux of the stars that a moving camera sees, and their catalogue directions."""
    stars = solver.stars
    near = stars.subset(stars.in_cone(attitude.boresight, camera.field_radius_rad + 0.01))
    xy, inside = camera.project(attitude.to_sensor(aberrated(near.vectors, velocity)))
    return xy[inside], 10.0 ** (-0.4 * near.v[inside]), near.vectors[inside]


def predicted_error(
    camera: Camera, truth: Attitude, directions: np.ndarray, velocity: np.ndarray
) -> np.ndarray:
    """Attitude error (rotation vector, sensor frame) from uncorrected aberration, to first order in v/c."""
    beta = velocity / SPEED_OF_LIGHT_M_S
    displaced = directions + beta - directions * (directions @ beta)[:, None]
    place = camera.project(truth.to_sensor(directions))[0]
    shift = camera.project(truth.to_sensor(displaced))[0] - place
    small = 1e-5
    slopes = [
        camera.project(truth.rotated(small * axis).to_sensor(directions))[0] - place for axis in np.eye(3)
    ]
    matrix = np.stack([slope.ravel() / small for slope in slopes], axis=1)
    return np.linalg.lstsq(matrix, shift.ravel(), rcond=None)[0]


@pytest.mark.parametrize("speed_m_s", [30e3, 9e5])
def test_aberration_matches_sofa(speed_m_s):
    rng = np.random.default_rng(1)
    for _ in range(20):
        p, v = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        beta = v * speed_m_s / SPEED_OF_LIGHT_M_S
        expected = erfa.ab(p, beta, 1e12, math.sqrt(1.0 - beta @ beta))  # far from the Sun's potential
        assert np.linalg.norm(aberrated(p, v * speed_m_s) - expected) < 0.1 * MICROARCSEC
        back = aberrated(aberrated(p, v * speed_m_s), -v * speed_m_s)
        assert np.linalg.norm(back - p) < 0.1 * MICROARCSEC


def test_an_observer_at_rest_sees_the_catalogue():
    assert aberrated([0.0, 0.0, 1.0], [0.0, 0.0, 0.0]) == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)


def test_the_earth_moves_as_in_epv00_and_de421():
    tt = terrestrial_time(NEW_YEAR)
    _, barycentric = erfa.epv00(*tt)
    assert earth_velocity(NEW_YEAR) == pytest.approx(barycentric["v"] * 149_597_870_700 / 86400, abs=1e-3)
    # JPL DE421 by jplephem, 2026-01-01T00:00:00 UTC
    assert earth_velocity(NEW_YEAR) == pytest.approx([-29776.429878, -4951.149713, -2146.394704], abs=0.01)
    position, _, sun = earth_and_sun(NEW_YEAR)
    assert np.linalg.norm(position - sun) == pytest.approx(0.98335 * 149_597_870_700, rel=1e-4)


@pytest.mark.parametrize(
    ("unix_s", "offset_s"), [(1_483_228_799.0, 68.184), (1_483_228_800.0, 69.184), (0.0, 42.184)]
)
def test_terrestrial_time_counts_leap_seconds(unix_s, offset_s):
    first, rest = terrestrial_time(unix_s)
    assert ((first - 2_440_587.5) + rest) * 86400.0 - unix_s == pytest.approx(offset_s, abs=1e-3)


def test_julian_year_of_the_default_epoch():
    assert julian_year(NEW_YEAR) == pytest.approx(2026.0, abs=0.001)


def test_uncorrected_attitudes_are_off_by_v_over_c_all_year():
    rng = np.random.default_rng(2)
    solver = Identifier()
    sizes = []
    for share in np.linspace(0.0, 1.0, 13)[:-1]:
        velocity, truth = velocity_at(share), random_attitude(rng)
        xy, flux, directions = seen(solver, DEFAULT_CAMERA, truth, velocity)
        error = solver.identify(xy, flux).attitude.error_to(truth).rotation_vector_rad
        expected = predicted_error(DEFAULT_CAMERA, truth, directions, velocity)
        assert np.linalg.norm(error - expected) * ARCSEC_PER_RAD < 0.1
        sizes.append(np.linalg.norm(error) * ARCSEC_PER_RAD)
    assert 20.0 < max(sizes) < 26.0


@pytest.mark.parametrize("algorithm", ["geometric", "pyramid"])
def test_corrected_attitudes_are_true(algorithm):
    rng = np.random.default_rng(3)
    solver = make_identifier(algorithm)
    index = solver if isinstance(solver, Identifier) else solver.verifier
    for share in (0.1, 0.6):
        velocity, truth = velocity_at(share), random_attitude(rng)
        xy, flux, _ = seen(index, DEFAULT_CAMERA, truth, velocity)
        for solution in (
            solver.identify(xy, flux, observer_velocity=velocity),
            solver.track(xy, flux, truth, observer_velocity=velocity),
        ):
            assert solution.attitude.error_to(truth).total_arcsec < 0.02
            assert solution.rms_px < 0.002


def test_uncorrected_aberration_shows_in_the_residuals():
    velocity, truth = velocity_at(0.3), Attitude.from_radec_roll(83.8, -1.2, 0.0)
    xy, flux, _ = seen(Identifier(), DEFAULT_CAMERA, truth, velocity)
    assert Identifier().identify(xy, flux).rms_px > 0.02


def test_a_narrow_field_is_tracked_from_a_true_prediction_through_aberration():
    """The 20″ of aberration are 8 pixels here, more than the window."""
    camera = Camera.from_fov(3.0, 4096, 4096)
    velocity, truth = velocity_at(0.5), Attitude.from_radec_roll(84.05, -5.4, 30.0)
    solver = Identifier(camera, cache=False)
    xy, flux, _ = seen(solver, camera, truth, velocity)
    solution = solver.track(xy, flux, truth, window_px=5.0, observer_velocity=velocity)
    assert solution.attitude.error_to(truth).cross_boresight_arcsec < 0.01
    assert not solver.track(xy, flux, truth, window_px=5.0).valid


def test_aberration_is_corrected_with_an_uncertain_focal_length():
    camera = DEFAULT_CAMERA
    velocity, truth = velocity_at(0.8), Attitude.from_radec_roll(200.0, 40.0, 10.0)
    solver = Identifier(Camera.from_fov(camera.fov_deg * 1.01), fov_tolerance=0.03)
    xy, flux, _ = seen(solver, camera, truth, velocity)
    solution = solver.identify(xy, flux, observer_velocity=velocity)
    assert solution.attitude.error_to(truth).total_arcsec < 0.05
    assert solution.camera.focal_px[0] == pytest.approx(camera.focal_px[0], rel=2e-6)


def test_a_tracker_corrects_aberration_from_frame_to_frame():
    velocity, truth = velocity_at(0.2), Attitude.from_radec_roll(10.0, 20.0, 30.0)
    solver = Identifier()
    tracker = Tracker(solver)
    for time_s in (0.0, 1.0):
        xy, flux, _ = seen(solver, DEFAULT_CAMERA, truth, velocity)
        solution = tracker.update(xy, flux, time_s, observer_velocity=velocity)
        assert solution.attitude.error_to(truth).total_arcsec < 0.02
    assert solution.mode == "tracking"


@pytest.mark.parametrize(
    "velocity", [[1.0, 2.0], "fast", [1.0, 2.0, math.nan], [0.0, 0.0, 3e8], [[1.0, 2.0, 3.0]]]
)
def test_an_impossible_velocity_is_rejected(velocity):
    with pytest.raises(StaridError, match="observer_velocity"):
        Identifier().identify(np.zeros((0, 2)), np.zeros(0), observer_velocity=velocity)


def test_the_velocity_of_the_earth_is_given_without_a_warning_at_any_date():
    """A device's clock may show any date; the library warns outside 1900 to 2100."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        speeds = [np.linalg.norm(earth_velocity(unix_s)) for unix_s in (-3.0e9, 1.7e9, 5.0e9)]
    assert speeds == pytest.approx([29.8e3] * 3, abs=600.0)
