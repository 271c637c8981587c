"""A sky that differs from the unit's catalogue: displaced stars, other magnitudes, and what they do to the attitude."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.sensor.renderer import Renderer
from starhil.emulator.sensor.sky.objects import CatalogError, SkyObjects
from starhil.emulator.sensor.sky.stars import _drawn, _with_errors, displaced
from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.identification.star_identifier import make_identifier

BETELGEUSE = 27989
ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CAMERA = Camera.from_fov(42.0, width=937, height=937)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(CAMERA, load_catalog(), seed=4)


def places(renderer: Renderer, attitude: Attitude, objects: SkyObjects) -> dict[int, np.ndarray]:
    """Directions in which the stars of an image are shown, by Hipparcos number."""
    stars = renderer.render(attitude, objects=objects).stars
    return dict(zip(stars.hip.tolist(), attitude.to_icrs(CAMERA.back_project(stars.xy_px)), strict=True))


@pytest.mark.parametrize("dec_deg", [-90.0, -60.0, 0.0, 45.0, 89.9])
def test_a_star_is_displaced_along_a_great_circle_to_the_east_and_north(dec_deg: float) -> None:
    dec, ra = math.radians(dec_deg), 1.0
    start = np.array([[math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]])
    moved = displaced(start, np.array([300.0]), np.array([400.0]))
    assert np.linalg.norm(moved[0]) == pytest.approx(1.0)
    assert math.acos(start[0] @ moved[0]) * ARCSEC_PER_RAD == pytest.approx(500.0, rel=1e-5)
    if abs(dec_deg) < 89.0:
        east = math.remainder(math.atan2(moved[0, 1], moved[0, 0]) - ra, math.tau) * math.cos(dec)
        assert east * ARCSEC_PER_RAD == pytest.approx(300.0, rel=5e-3)
        assert (math.asin(moved[0, 2]) - dec) * ARCSEC_PER_RAD == pytest.approx(400.0, rel=5e-3)


def test_a_wrong_star_is_shown_elsewhere_and_fainter_and_no_other(renderer: Renderer) -> None:
    wrong = SkyObjects(catalog_errors=(CatalogError(BETELGEUSE, east_arcsec=900.0, fainter=1.0),))
    right, found = places(renderer, ORION, SkyObjects()), places(renderer, ORION, wrong)
    off = {hip: math.dist(right[hip], found[hip]) * ARCSEC_PER_RAD for hip in right.keys() & found.keys()}
    assert off.pop(BETELGEUSE) == pytest.approx(900.0, rel=1e-4)
    assert max(off.values()) < 1e-6
    before, after = (renderer.render(ORION, objects=sky).stars for sky in (SkyObjects(), wrong))
    ratio = after.electrons[after.hip == BETELGEUSE] / before.electrons[before.hip == BETELGEUSE]
    assert ratio == pytest.approx(10.0**-0.4)


def test_errors_of_the_catalogue_have_the_stated_spread_and_stay_the_same(renderer: Renderer) -> None:
    sky = SkyObjects(catalog_position_error_arcsec=20.0, catalog_magnitude_error=0.3)
    off = []
    for roll_deg in (0.0, 60.0):
        attitude = Attitude.from_radec_roll(83.8, -1.2, roll_deg)
        right, found = places(renderer, attitude, SkyObjects()), places(renderer, attitude, sky)
        off.append({hip: (found[hip] - right[hip]) * ARCSEC_PER_RAD for hip in right.keys() & found.keys()})
    both = off[0].keys() & off[1].keys()
    assert max(np.linalg.norm(off[0][hip] - off[1][hip]) for hip in both) < 0.01
    squares = [float(vector @ vector) / 2.0 for vector in off[0].values()]
    assert math.sqrt(np.mean(squares)) == pytest.approx(20.0, rel=4.0 * 0.5 / math.sqrt(len(squares)))


def test_another_star_does_not_change_the_errors_of_the_others() -> None:
    """So a recording replays after a variable star was added to those that come within the limit at their maximum."""
    hip = np.array([7, 27989, 100_000], dtype=np.int32)
    vectors = np.eye(3)
    drawn = _drawn(hip, seed=3)
    assert np.array_equal(_drawn(np.insert(hip, 1, 97_649), seed=3)[[0, 2, 3]], drawn)
    assert not np.array_equal(_drawn(hip, seed=4), drawn)
    shown, fainter = _with_errors(hip, vectors, 20.0, 0.3, (), drawn)
    assert np.all(np.linalg.norm(shown - vectors, axis=1) > 0.0)
    assert fainter == pytest.approx(0.3 * drawn[:, 2])


@pytest.mark.long
def test_the_attitude_is_off_by_the_mean_of_its_stars_errors() -> None:
    """Without noise, n stars of equal weight with an error σ along each axis leave σ/√n across the boresight."""
    catalog = load_catalog()
    identifier = make_identifier("geometric", CAMERA)
    sigma = 60.0
    sky = SkyObjects(catalog_position_error_arcsec=sigma)
    over = []
    for seed in range(20):
        renderer = Renderer(CAMERA, catalog, seed=seed)
        attitude = random_attitude(np.random.default_rng(seed))
        stars = renderer.render(attitude, objects=sky).stars
        bright = np.flatnonzero(stars.magnitude < 4.5)[:40]
        solution = identifier.identify(
            stars.xy_px[bright], stars.electrons[bright], np.full(bright.size, sigma / 160.0)
        )
        assert solution.valid
        error = solution.attitude.error_to(attitude).rotation_vector_rad[:2] * ARCSEC_PER_RAD
        over.append(error * math.sqrt(solution.star_count) / sigma)
    assert np.sqrt(np.mean(np.square(over))) == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * np.size(over)))
