"""Detection: stars are found to the accuracy that the noise allows, with calibrated errors."""

from __future__ import annotations

import functools
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit
from scipy.special import erf

from starid.catalog.photometry import fitted_share
from starid.errors import StaridError
from starid.imaging.detection import Detections, DetectionSettings, detect

pytestmark = [pytest.mark.long, pytest.mark.lowest("numba")]

SIGMA = 0.8
SKY, NOISE, GAIN = 40.0, 3.0, 2.0
KNOWN = DetectionSettings(gain_e_per_dn=GAIN)
Kernel = type(njit(lambda: None))


def spot(shape: tuple[int, int], x: float, y: float, flux: float, sigma: float = SIGMA) -> np.ndarray:
    """A Gaussian star integrated over pixels, independent of the code under test."""
    return spots(shape, np.array([[x, y]]), flux, sigma)


def spots(
    shape: tuple[int, int],
    places: np.ndarray,
    flux: float | np.ndarray,
    sigma: float | np.ndarray = SIGMA,
) -> np.ndarray:
    """The light of many such stars: the product of their profiles along columns and rows, summed by a product of matrices."""
    width = np.reshape(sigma, (-1, 1)) * math.sqrt(2.0)
    down, along = (
        np.diff(0.5 * erf((np.arange(size + 1) - 0.5 - place[:, None]) / width))
        for size, place in zip(shape, (places[:, 1], places[:, 0]), strict=True)
    )
    return (down.T * flux) @ along


def trails(
    shape: tuple[int, int],
    places: np.ndarray,
    flux: float | np.ndarray,
    paths: np.ndarray,
    sigma: float = SIGMA,
) -> np.ndarray:
    """Stars that move evenly along a path, its middle at their places."""
    parts = (np.arange(64) + 0.5) / 64 - 0.5
    moved = places[:, None] + parts[:, None] * np.reshape(paths, (-1, 1, 2))
    return spots(shape, moved.reshape(-1, 2), np.repeat(np.broadcast_to(flux, len(places)) / 64, 64), sigma)


def photograph(
    light: np.ndarray, seed: int = 1, sky: float | np.ndarray = SKY, top: int = 65535
) -> np.ndarray:
    """Counts of light (DN) above a sky, with shot noise of the light and white noise."""
    rng = np.random.default_rng(seed)
    shot = rng.normal(0.0, 1.0, light.shape) * np.sqrt(np.maximum(light, 0.0) / GAIN)
    counts = sky + light + shot + rng.normal(0.0, NOISE, light.shape)
    return np.clip(np.rint(counts), 0, top).astype(np.uint8 if top < 256 else np.uint16)


@functools.cache
def scattered(count: int, shape: tuple[int, int], seed: int, gap: float = 14.0) -> np.ndarray:
    """Random positions, no two closer than `gap`, none within 10 pixels of the edge."""
    rng = np.random.default_rng(seed)
    places, found = np.empty((count, 2)), 0
    while found < count:
        places[found] = rng.uniform((10.0, 10.0), (shape[1] - 11.0, shape[0] - 11.0))
        off = places[:found] - places[found]
        found += bool(np.all(np.hypot(off[:, 0], off[:, 1]) > gap))
    places.setflags(write=False)
    return places


def matched(detections: Detections, places: np.ndarray, reach: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """For each position the index of its detection (−1 if none); a mask of spurious detections."""
    gaps = np.linalg.norm(places[:, None] - detections.xy_px[None], axis=2)
    nearest = np.where(gaps.min(axis=1) < reach, gaps.argmin(axis=1), -1)
    return nearest, np.setdiff1d(np.arange(len(detections)), nearest)


@pytest.mark.parametrize("top", [255, 65535])
def test_stars_are_found_where_they_are(top: int) -> None:
    shape = (300, 400)
    places = scattered(40, shape, 2)
    fluxes = np.geomspace(200.0, 900.0, 40)
    image = photograph(spots(shape, places, fluxes), top=top)
    detections = detect(image, KNOWN)
    number, spurious = matched(detections, places)
    assert np.all(number >= 0)
    assert len(spurious) == 0
    assert detections.reason == ""
    assert detections.background == pytest.approx(SKY, abs=0.5)
    assert detections.noise == pytest.approx(NOISE, rel=0.05)
    assert detections.psf_sigma_px == pytest.approx(SIGMA, rel=0.05)
    assert np.all(np.diff(detections.flux) <= 0.0), "brightest first"
    pull = (detections.flux[number] / GAIN - fluxes) / (detections.flux_sigma[number] / GAIN)
    assert abs(pull.mean()) < 0.7
    assert pull.std() == pytest.approx(1.0, abs=0.4)


def test_whole_numbers_in_settings_call_the_same_kernels() -> None:
    """A kernel is compiled, for seconds, for each combination of types of its arguments."""
    whole = {
        "threshold_sigma": 6,
        "psf_sigma_px": 1,
        "psf_growth": 0,
        "gain_e_per_dn": 2,
        "model_error": 0,
        "blend_px": 2,
        "pixel_sigma": 3,
    }
    shape = (200, 200)
    image = photograph(spots(shape, scattered(8, shape, 2), 60_000.0, 1.0))
    for flow in (False, True):
        detect(
            image,
            DetectionSettings(**{name: float(value) for name, value in whole.items()}, follow_trails=flow),
        )
    before = _kernels()
    for flow in (False, True):
        assert len(detect(image, DetectionSettings(**whole, follow_trails=flow))) >= 8
    assert _kernels() == before
    assert any("measure" in name for name, _ in before)


def _kernels() -> set[tuple[str, object]]:
    """Name and types of arguments of each kernel that has been called."""
    modules = [module for name, module in sys.modules.items() if name.startswith("starid.")]
    kernels = [item for module in modules for item in vars(module).values() if isinstance(item, Kernel)]
    return {(kernel.__name__, types) for kernel in kernels for types in kernel.signatures}


@pytest.mark.parametrize("flux", [250.0, 1000.0, 8000.0, 60000.0])
def test_errors_are_calibrated_and_reach_the_bound(flux: float) -> None:
    """The mean ratio of squared error to estimated variance is 1; the estimate is the Cramér–Rao bound."""
    shape = (400, 400)
    squares, stated = [], []
    for seed in range(4):
        places = scattered(120, shape, seed, gap=16.0)
        image = photograph(spots(shape, places, flux), seed)
        detections = detect(image, DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA, model_error=0.0))
        number, _ = matched(detections, places)
        assert np.all(number >= 0)
        error = detections.xy_px[number] - places
        squares.append((error / detections.xy_sigma_px[number]) ** 2)
        stated.append(detections.xy_sigma_px[number])
    normalised = np.concatenate(squares)
    assert normalised.mean() == pytest.approx(1.0, abs=0.2)
    model = spot((31, 31), 15.0, 15.0, flux)
    slope = (spot((31, 31), 15.001, 15.0, flux) - spot((31, 31), 14.999, 15.0, flux)) / 0.002
    bound = 1.0 / math.sqrt(np.sum(slope**2 / (NOISE**2 + 1.0 / 12.0 + model / GAIN)))
    assert np.sqrt(np.mean(np.concatenate(stated) ** 2)) == pytest.approx(bound, rel=0.12)


@pytest.mark.parametrize("contrast", [1.0, 100.0])
def test_without_the_gain_the_noise_of_light_is_estimated_from_the_stars(contrast: float) -> None:
    """Positions, their errors and the scatter of the flux are those of a known gain, with stars of equal or different brightness."""
    shape = (400, 400)
    places = scattered(60, shape, 4, gap=16.0)
    fluxes = np.geomspace(40000.0, 40000.0 / contrast, len(places))
    squares, widths = [], []
    for seed in range(6):
        image = photograph(spots(shape, places, fluxes), seed)
        found = detect(image, DetectionSettings(psf_sigma_px=SIGMA, model_error=0.0))
        known = detect(image, DetectionSettings(psf_sigma_px=SIGMA, model_error=0.0, gain_e_per_dn=GAIN))
        number, spurious = matched(found, places)
        assert np.all(number >= 0)
        assert len(spurious) == 0
        squares.append(((found.xy_px[number] - places) / found.xy_sigma_px[number]) ** 2)
        widths.append(found.sigma_px[number] / known.sigma_px[matched(known, places)[0]])
    assert np.mean(squares) == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / np.size(squares)) + 0.1)
    brightest = np.array(squares)[:, :15]
    assert brightest.mean() == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / brightest.size) + 0.1)
    assert np.mean(widths) == pytest.approx(1.0, abs=0.1)


def test_some_bright_stars_of_another_shape_do_not_widen_the_errors_of_the_others() -> None:
    shape = (400, 400)
    places = scattered(60, shape, 4, gap=16.0)
    fluxes = np.where(np.arange(60) < 10, 40000.0, 20000.0)
    image = photograph(spots(shape, places, fluxes, np.where(np.arange(60) < 10, 1.2, SIGMA)))
    found, known = (
        detect(image, DetectionSettings(psf_sigma_px=SIGMA, model_error=0.0, gain_e_per_dn=gain))
        for gain in (None, GAIN)
    )
    ordinary = places[10:]
    ratio = found.sigma_px[matched(found, ordinary)[0]] / known.sigma_px[matched(known, ordinary)[0]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.25)


def test_no_pixel_phase_error() -> None:
    """Bright stars on a grid of sub-pixel positions: the error has no systematic part."""
    shape = (420, 420)
    places = np.array(
        [(20.0 * i + i / 20.0, 20.0 * j + j / 20.0) for i in range(1, 20) for j in range(1, 20)]
    )
    light = spots(shape, places, 30000.0)
    found = detect(photograph(light), KNOWN)
    number, _ = matched(found, places)
    error = found.xy_px[number] - places
    phase = places[:, 0] % 1.0
    for low in np.arange(0.0, 1.0, 0.25):
        chosen = (phase >= low) & (phase < low + 0.25)
        assert abs(error[chosen, 0].mean()) < 0.004


def test_noise_is_not_detected_as_stars() -> None:
    image = photograph(np.zeros((900, 900)), 5)
    found = detect(image)
    assert len(found) <= 1
    assert found.reason or len(found) == 1


def test_saturated_stars_are_flagged_and_still_centred() -> None:
    shape = (200, 200)
    places = scattered(15, shape, 4, gap=30.0)
    light = spots(shape, places, 20000.0)
    image = photograph(light, top=255)
    detections = detect(image, DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA))
    number, spurious = matched(detections, places, 0.5)
    assert np.all(number >= 0)
    assert len(spurious) == 0
    assert np.all(detections.saturated[number])
    error = detections.xy_px[number] - places
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.median(detections.flux[number]) == pytest.approx(20000.0 * GAIN, rel=0.2)


def test_stars_at_the_edge_are_flagged() -> None:
    shape = (120, 160)
    places = np.array([(0.4, 60.0), (159.2, 30.0), (80.0, 0.2), (40.0, 118.7), (80.0, 60.0), (30.0, 40.0)])
    detections = detect(photograph(spots(shape, places, 2000.0)), KNOWN)
    number, _ = matched(detections, places)
    assert np.all(number >= 0)
    assert detections.edge[number].tolist() == [True, True, True, True, False, False]
    error = np.hypot(*(detections.xy_px[number] - places).T)
    assert np.all(error < 0.25)
    assert np.all(detections.xy_sigma_px[number[:4]].max(axis=1) > detections.xy_sigma_px[number[4:]].max())


@pytest.mark.parametrize("height", [60.0, 300.0, 3000.0, 60000.0])
def test_hot_pixels_are_rejected(height: float) -> None:
    shape = (300, 300)
    places = scattered(30, shape, 6)
    light = spots(shape, places[:15], 1500.0)
    light[tuple(np.rint(places[15:]).astype(int)[:, ::-1].T)] += height
    detections = detect(photograph(light), KNOWN)
    number, spurious = matched(detections, places[:15])
    assert np.all(number >= 0)
    assert len(spurious) == 0
    assert detections.rejected >= 15


def test_saturated_hot_pixels_are_rejected() -> None:
    shape = (200, 200)
    light = spot(shape, 50.0, 50.0, 1500.0)
    light[100, 120] = 70000.0
    found = detect(photograph(light), KNOWN)
    assert len(found) == 1


@pytest.mark.parametrize("separation", [2.5, 3.5, 5.0])
def test_pairs_are_deblended(separation: float) -> None:
    shape = (400, 400)
    places = scattered(40, shape, 8, gap=25.0)
    angles = np.random.default_rng(3).uniform(0.0, 2.0 * math.pi, 40)
    partners = places + separation * np.column_stack([np.cos(angles), np.sin(angles)])
    both = np.concatenate([places, partners])
    fluxes = np.concatenate([np.full(40, 4000.0), np.full(40, 2500.0)])
    light = spots(shape, both, fluxes)
    found = detect(photograph(light), DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA))
    gaps = np.linalg.norm(both[:, None] - found.xy_px[None], axis=2)
    assert np.mean(gaps.min(axis=1) < 0.3) > 0.95
    error = gaps.min(axis=1)
    assert np.sqrt(np.mean(error[error < 0.3] ** 2)) < 0.08


@pytest.mark.parametrize("separation", [0.6, 1.0, 1.4, 1.8])
def test_a_close_pair_is_one_star_at_its_centre_of_light(separation: float) -> None:
    shape = (100, 100)
    for seed in range(5):
        light = spot(shape, 50.2, 50.0, 6000.0) + spot(shape, 50.2 + separation, 50.0, 3000.0)
        found = detect(photograph(light, seed), DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA))
        assert len(found) == 1
        assert found.xy_px[0] == pytest.approx((50.2 + separation / 3.0, 50.0), abs=0.05)
        assert found.flux[0] == pytest.approx(9000.0 * GAIN, rel=0.06)


@pytest.mark.parametrize("ratio", [0.05, 0.15])
@pytest.mark.parametrize("separation", [0.8, 1.3, 1.9])
def test_a_faint_companion_shifts_a_star_as_in_a_merged_catalogue(ratio: float, separation: float) -> None:
    """Whether or not the pair is resolved, which depends here on the flux of the brighter star."""
    shape = (60, 60)
    share = float(fitted_share(np.array([separation / 2.0]), np.array([ratio]))[0])
    shift = share * separation * ratio / (1.0 + ratio)
    for flux in (6000.0, 60000.0):
        light = spot(shape, 30.2, 30.0, flux) + spot(shape, 30.2 + separation, 30.0, ratio * flux)
        known = DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA)
        places = np.array([detect(photograph(light, seed), known).xy_px[0] for seed in range(20)])
        assert places.mean(axis=0) == pytest.approx((30.2 + shift, 30.0), abs=0.015 + 0.15 * shift)


def test_a_barely_resolved_pair_has_wider_errors() -> None:
    shape = (60, 120)
    known = DetectionSettings(gain_e_per_dn=GAIN, psf_sigma_px=SIGMA)
    light = spot(shape, 30.0, 30.0, 6000.0) + spot(shape, 90.0, 30.0, 6000.0)
    pair = detect(photograph(light + spot(shape, 32.4, 30.0, 1500.0)), known)
    assert len(pair) == 3
    doubtful, alone = np.argsort(pair.xy_px[:2, 0])
    assert pair.xy_sigma_px[doubtful, 0] > 5.0 * pair.xy_sigma_px[alone, 0]
    assert pair.xy_sigma_px[doubtful, 1] < 2.0 * pair.xy_sigma_px[alone, 1]


def test_a_close_pair_is_resolved() -> None:
    shape = (100, 100)
    light = spot(shape, 50.0, 50.0, 6000.0) + spot(shape, 51.3, 50.0, 4000.0)
    found = detect(photograph(light), DetectionSettings(psf_sigma_px=SIGMA, blend_px=0.0))
    assert found.xy_px == pytest.approx(np.array([[50.0, 50.0], [51.3, 50.0]]), abs=0.1)


@pytest.mark.parametrize(("dx", "dy"), [(2.0, 1.0), (6.0, 0.0), (-5.0, 8.0), (15.0, 10.0)])
def test_trails_of_a_rotating_sensor_are_followed(dx: float, dy: float) -> None:
    shape = (400, 500)
    places = scattered(40, shape, 9, gap=45.0)
    places = places[np.all((places > 20.0) & (places < np.array([479.0, 379.0])), axis=1)]
    fluxes = np.geomspace(3000.0, 30000.0, len(places))
    light = trails(shape, places, fluxes, np.array([dx, dy]))
    detections = detect(photograph(light), KNOWN)
    number, spurious = matched(detections, places)
    assert np.all(number >= 0)
    assert len(spurious) <= 1
    assert detections.trail_px == pytest.approx(math.hypot(dx, dy), rel=0.05)
    error = (detections.xy_px[number] - places) / detections.xy_sigma_px[number]
    assert np.mean(error**2) == pytest.approx(1.0, abs=0.5)


def test_trails_are_followed_among_more_and_brighter_round_points() -> None:
    """Particles and reflections are round while the sensor rotates; stars agree on a motion."""
    shape = (400, 500)
    places = scattered(60, shape, 9, gap=30.0)
    places = places[np.all((places > 20.0) & (places < np.array([479.0, 379.0])), axis=1)]
    stars, points = places[::3], np.concatenate([places[1::3], places[2::3]])
    light = trails(shape, stars, 3000.0, np.array([6.0, -2.0]))
    light = light + spots(shape, points, 9000.0)
    detections = detect(photograph(light), KNOWN)
    assert len(points) > 1.8 * len(stars) > 18
    assert detections.trail_px == pytest.approx(math.hypot(6.0, 2.0), rel=0.1)
    number, spurious = matched(detections, stars)
    assert np.all(number >= 0)
    assert len(spurious) == 0  # an object at rest while the stars move is not a star
    error = (detections.xy_px[number] - stars) / detections.xy_sigma_px[number]
    assert np.mean(error**2) == pytest.approx(1.0, abs=0.6)


def test_a_few_streaks_among_round_stars_are_not_trails() -> None:
    shape = (400, 500)
    places = scattered(60, shape, 9, gap=30.0)
    light = spots(shape, places[:40], 3000.0)
    angles = np.linspace(0.0, math.pi, 12, endpoint=False)
    paths = 12.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    light = light + trails(shape, places[40:52], 9000.0, paths)
    found = detect(photograph(light), KNOWN)
    assert found.trail_px == 0.0
    number, _ = matched(found, places[:40])
    assert np.count_nonzero(number >= 0) >= 39


def few_trails(seed: int, width: float = 1.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image with hot pixels, four round spots and the trails of five stars; positions of the brightest three, and the trail."""
    rng = np.random.default_rng((12, seed))
    shape, path = (400, 400), 13.0 * np.array([math.cos(seed), math.sin(seed)])
    places = 40.0 + 0.8 * scattered(9, shape, seed, gap=50.0)
    light = trails(shape, places[:5], np.array([500.0, 380.0, 260.0, 170.0, 150.0]), path, width)
    light = light + spots(shape, places[5:], 90.0)
    hot = rng.integers(0, 400, (40, 2))
    light[hot[:, 1], hot[:, 0]] += 150.0
    return photograph(light, seed), places[:3], path


def test_trails_of_few_faint_stars_are_followed() -> None:
    """A round spot fits a part of a dim trail, and would be sure of a position several pixels from the middle.

    Of 30 images, 23 showed no trails when six stars or more had to agree on them.
    """
    followed, images = 0, 15
    for seed in range(images):
        image, _, path = few_trails(seed)
        trail_px = detect(image, KNOWN).trail_px
        followed += trail_px > 0.0
        assert trail_px == 0.0 or trail_px == pytest.approx(np.linalg.norm(path), rel=0.35)
    assert followed >= images // 2


def test_the_width_of_few_spots_is_measured_among_hot_pixels_beside_a_dark_body() -> None:
    """Hot pixels and the edge are more than the stars; a spot taken for too narrow states too small an error."""
    shape, width, squares = (400, 400), 1.2, []
    for seed in range(15):
        rng = np.random.default_rng((13, seed))
        places = scattered(8, shape, seed, gap=40.0)
        light = spots(shape, places, np.geomspace(600, 250, 8), width)
        hot = rng.integers(0, 400, (40, 2))
        light[hot[:, 1], hot[:, 0]] += 150.0
        image = photograph(light, seed)
        image[:, 200:] = 0
        found = detect(image, KNOWN)
        assert found.trail_px == 0.0
        bare = places[(places[:, 0] < 190.0)]
        if not len(found):
            continue
        number, _ = matched(found, bare, 3.0)
        error = found.xy_px[number[number >= 0]] - bare[number >= 0]
        squares += (np.square(error / found.xy_sigma_px[number[number >= 0]])).mean(axis=1).tolist()
    assert len(squares) >= 45
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 / math.sqrt(len(squares)))


def test_a_dark_body_does_not_displace_the_stars_beside_it() -> None:
    """The sky ends at its edge: a grid of blocks on either side would make a slope of it."""
    shape, squares = (400, 400), []
    for seed in range(10):
        rng = np.random.default_rng((14, seed))
        places = np.column_stack([rng.uniform(170.0, 192.0, 10), np.arange(20.0, 400.0, 38.0)])
        image = photograph(spots(shape, places, 400.0, 1.2), seed)
        image[:, 203:] = 0
        found = detect(image, KNOWN)
        number, _ = matched(found, places, 3.0)
        error = found.xy_px[number[number >= 0]] - places[number >= 0]
        squares += np.square(error / found.xy_sigma_px[number[number >= 0]]).mean(axis=1).tolist()
    assert len(squares) > 95
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 / math.sqrt(len(squares)))


def test_two_streaks_among_few_round_stars_are_not_trails() -> None:
    shape = (300, 300)
    places = scattered(6, shape, 9, gap=40.0)
    light = spots(shape, places[:4], 900.0)
    light = light + trails(shape, places[4:], 4000.0, np.array([9.0, 5.0]))
    found = detect(photograph(light), KNOWN)
    assert found.trail_px == 0.0
    assert np.all(matched(found, places[:4])[0] >= 0)


def test_trails_of_a_roll_are_followed() -> None:
    shape = (400, 400)
    places = scattered(60, shape, 10, gap=30.0)
    roll = 0.03
    off = places - 199.5
    paths = roll * np.column_stack([-off[:, 1], off[:, 0]])
    light = trails(shape, places, 15000.0, paths)
    detections = detect(photograph(light), KNOWN)
    number, _ = matched(detections, places, 1.0)
    assert np.mean(number >= 0) > 0.95
    number, places = number[number >= 0], places[number >= 0]
    assert np.sqrt(np.mean((detections.xy_px[number] - places) ** 2)) < 0.05


def test_round_stars_have_no_trail() -> None:
    shape = (300, 300)
    places = scattered(50, shape, 11)
    for seed in range(5):
        image = photograph(spots(shape, places, 700.0), seed)
        assert detect(image).trail_px == 0.0


def test_uneven_sky_does_not_move_stars() -> None:
    """A vignetted sky with a gradient causes no false stars and no bias."""
    shape = (500, 600)
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    radius2 = ((columns - 300.0) ** 2 + (rows - 250.0) ** 2) / 390.0**2
    sky = 3000.0 * (1.0 - 0.5 * radius2) + 1.5 * columns
    places = scattered(80, shape, 12)
    light = spots(shape, places, 900.0)
    detections = detect(photograph(light, sky=sky), DetectionSettings())
    number, spurious = matched(detections, places)
    assert np.mean(number >= 0) > 0.97
    assert len(spurious) == 0
    seen = number >= 0
    error = detections.xy_px[number[seen]] - places[seen]
    assert np.all(np.abs(error.mean(axis=0)) < 0.02)


def test_a_bright_limb_hides_only_itself() -> None:
    shape = (400, 400)
    places = scattered(60, shape, 13)
    light = spots(shape, places, 1500.0)
    rows = np.mgrid[0 : shape[0], 0 : shape[1]][0]
    light = np.where(rows > 260, 20000.0, light)
    found = detect(photograph(light), KNOWN)
    number, spurious = matched(found, places)
    assert np.all(number[places[:, 1] < 228.0] >= 0), "more than a block away from the limb"
    assert len(spurious) <= 2


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.5, 2.5])
def test_other_spot_widths_are_estimated(sigma: float) -> None:
    shape = (400, 400)
    places = scattered(60, shape, 14, gap=22.0)
    light = spots(shape, places, 6000.0, sigma)
    detections = detect(photograph(light), KNOWN)
    number, spurious = matched(detections, places)
    assert np.all(number >= 0)
    assert len(spurious) == 0
    assert detections.psf_sigma_px == pytest.approx(sigma, rel=0.12)


def test_spots_that_grow_towards_the_corners_have_right_errors_there() -> None:
    """With one width for all stars, those in the corners stated too small an error, and too little light."""
    shape, growth, sigma = (400, 400), 0.25, 0.9
    known = DetectionSettings(gain_e_per_dn=GAIN, psf_growth=growth)
    squares, light_errors, outside = [], [], []
    for seed in range(5):
        places = scattered(100, shape, seed, gap=20.0)
        off2 = np.sum(np.square((places + 0.5) / 200.0 - 1.0), axis=1)
        widths = sigma * (1.0 + growth * off2)
        found = detect(photograph(spots(shape, places, 600.0, widths), seed), known)
        assert found.psf_sigma_px == pytest.approx(sigma * (1.0 + growth * 2.0 / 3.0), rel=0.05)
        number, _ = matched(found, places)
        seen = number[number >= 0]
        assert len(seen) >= 95
        error = (found.xy_px[seen] - places[number >= 0]) / found.xy_sigma_px[seen]
        squares.append(np.mean(np.square(error), axis=1))
        light_errors.append(found.flux[seen] / (600.0 * GAIN) - 1.0)
        outside.append(off2[number >= 0] > 1.0)
    z2, light, corner = np.concatenate(squares), np.concatenate(light_errors), np.concatenate(outside)
    for part in (corner, ~corner):
        assert z2[part].mean() == pytest.approx(1.0, abs=4.0 / math.sqrt(part.sum()))
    sampling = math.hypot(*(light[part].std() / math.sqrt(part.sum()) for part in (corner, ~corner)))
    assert light[corner].mean() == pytest.approx(light[~corner].mean(), abs=4.0 * sampling)


def test_star_sizes_can_be_limited() -> None:
    shape = (200, 200)
    light = spot(shape, 50.0, 50.0, 40000.0) + spot(shape, 150.0, 150.0, 400.0)
    image = photograph(light)
    assert len(detect(image)) == 2
    big = detect(image, DetectionSettings(min_star_pixels=12))
    assert big.xy_px[0] == pytest.approx((50.0, 50.0), abs=0.1)
    assert len(big) == 1
    small = detect(image, DetectionSettings(max_star_pixels=12))
    assert len(small) == 1
    assert small.xy_px[0] == pytest.approx((150.0, 150.0), abs=0.3)
    assert small.rejected >= 1


def test_at_most_max_stars() -> None:
    shape = (300, 300)
    places = scattered(40, shape, 15)
    image = photograph(spots(shape, places, 500.0 + 50.0 * np.arange(40)))
    found = detect(image, DetectionSettings(max_stars=10))
    assert len(found) == 10
    assert found.flux.min() > np.median(detect(image).flux)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(16, 16), (17, 400), (400, 17), (33, 31), (937, 937)])
def test_black_white_and_flat_images_have_a_reason(dtype: type, shape: tuple[int, int]) -> None:
    top = int(np.iinfo(dtype).max)
    for level, word in ((0, "flat"), (7, "flat"), (top, "saturated")):
        detections = detect(np.full(shape, level, dtype=dtype))
        assert len(detections) == 0
        assert word in detections.reason
        assert detections.xy_px.shape == (0, 2)
        assert detections.sigma_px.shape == (0,)


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (np.zeros((50, 50, 3), np.uint8), "colour"),
        (np.zeros((50, 50, 1, 1), np.uint8), "shape"),
        (np.zeros(50, np.uint8), "shape"),
        (np.zeros((50, 50), np.float64), "type must be uint8 or uint16, not float64"),
        (np.full((50, 50), np.nan), "type must be uint8 or uint16, not float64"),
        (np.zeros((50, 50), np.int16), "not int16"),
        (np.zeros((50, 50), np.uint32), "not uint32"),
        (np.zeros((50, 50), bool), "not bool"),
        (np.zeros((15, 50), np.uint8), "at least 16×16"),
        (np.zeros((0, 0), np.uint8), "at least 16×16"),
        ([[1, 2], [3, 4]], "not a list"),
        (None, "not a NoneType"),
    ],
)
def test_an_invalid_image_is_rejected_in_one_line(image: object, text: str) -> None:
    with pytest.raises(StaridError) as caught:
        detect(image)  # type: ignore[arg-type]
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "values",
    [
        {"threshold_sigma": 0.0},
        {"psf_sigma_px": -1.0},
        {"max_stars": 0},
        {"block_px": 2},
        {"model_error": 2.0},
    ],
)
def test_bad_settings_are_rejected(values: dict[str, float]) -> None:
    with pytest.raises(StaridError, match=rf"detection {next(iter(values))}: "):
        DetectionSettings(**values)  # type: ignore[arg-type]


def test_memory_layout_and_byte_order_do_not_matter() -> None:
    shape = (120, 150)
    image = photograph(spots(shape, scattered(10, shape, 16), 1500.0))
    plain = detect(image)
    big_endian = detect(image.astype(">u2"))
    columns_first = detect(np.asfortranarray(image))
    cut = detect(np.pad(image, 5)[5:-5, 5:-5])
    for other in (big_endian, columns_first, cut):
        np.testing.assert_array_equal(other.xy_px, plain.xy_px)


def test_the_image_is_not_changed() -> None:
    image = photograph(spot((100, 100), 50.0, 50.0, 5000.0))
    before = image.copy()
    detect(image)
    np.testing.assert_array_equal(image, before)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    image=st.one_of(
        hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, min_side=16, max_side=60)),
        hnp.arrays(np.uint16, hnp.array_shapes(min_dims=2, max_dims=2, min_side=16, max_side=60)),
    )
)
def test_any_image_gets_an_answer(image: np.ndarray) -> None:
    detections = detect(image)
    assert np.all(np.isfinite(detections.xy_px))
    assert np.all(np.isfinite(detections.flux))
    assert np.all(detections.xy_sigma_px > 0.0)
    assert np.all(detections.flux > 0.0)
    inside = (detections.xy_px > -0.5) & (detections.xy_px < np.array(image.shape[::-1]) - 0.5)
    assert np.all(inside)
    assert bool(detections.reason) == (len(detections) == 0)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    share=st.sampled_from([0.0, 0.01, 0.2, 0.9]),
    top=st.sampled_from([255, 65535]),
)
def test_salt_and_pepper_gets_an_answer(seed: int, share: float, top: int) -> None:
    rng = np.random.default_rng(seed)
    image = photograph(np.zeros((80, 90)), seed, top=top)
    image[rng.random(image.shape) < share] = top
    image[rng.random(image.shape) < share] = 0
    found = detect(image)
    assert np.all(np.isfinite(found.xy_sigma_px))
    assert bool(found.reason) == (len(found) == 0)
