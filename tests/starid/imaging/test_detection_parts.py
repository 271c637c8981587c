"""The components of detection: background, filters, flow of trails, widths, and the normal table."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.special import erf
from scipy.stats import norm

from starid.imaging.background import estimate_background, interpolate_at
from starid.imaging.centroid import (
    FAINT,
    FIT,
    GOOD,
    HOT_PIXEL,
    fit_star,
    spot_model,
    trail_model,
)
from starid.imaging.matched_filter import (
    INTEGER_TAPS_SUM,
    find_peaks,
    find_peaks_in_bytes,
    integer_taps,
    noise_factor,
    spot_taps,
)
from starid.imaging.normal_table import _CDF, _NODES, _PDF, normal
from starid.imaging.spot_shape import trail_length
from starid.imaging.spot_width import spot_widths
from starid.imaging.trail_filter import sum_along_trails, trail_noise_factor, trail_steps
from starid.imaging.trail_flow import fit_flow, lengths_and_mismatches, trail_at, trail_shifts

pytestmark = pytest.mark.long

RNG_SEED = 12


def noisy(shape: tuple[int, int], level: float, noise: float, seed: int = RNG_SEED) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.rint(rng.normal(level, noise, shape)).astype(np.uint16)


@pytest.mark.parametrize("noise", [0.6, 3.0, 200.0])
@pytest.mark.parametrize("shape", [(256, 256), (250, 333), (40, 500), (16, 16)])
def test_background_of_an_even_sky(shape: tuple[int, int], noise: float) -> None:
    background = estimate_background(noisy(shape, 1000.3, noise))
    blocks = background.level.size
    error = 6.0 * noise / math.sqrt(min(256, shape[0] * shape[1] // 4)) + 0.05
    assert np.all(np.abs(background.level - 1000.3) < 4.0 * error)
    assert background.median_level == pytest.approx(1000.3, abs=error / math.sqrt(min(blocks, 20)) + 0.05)
    assert background.median_noise == pytest.approx(math.hypot(noise, 12**-0.5), rel=0.1)


def test_background_follows_a_slope_to_the_edges() -> None:
    rows, columns = np.mgrid[0:300, 0:410]
    sky = 500.0 + 0.8 * columns - 0.5 * rows
    background = estimate_background(
        np.rint(sky + np.random.default_rng(1).normal(0, 2, sky.shape)).astype(np.uint16)
    )
    assert background.median_noise == pytest.approx(2.0, rel=0.1), "a slope is no noise"
    for x, y in ((0, 0), (409, 0), (0, 299), (409, 299), (200, 150), (31, 32)):
        value = interpolate_at(background.level, 32.0, float(x), float(y))
        assert value == pytest.approx(sky[y, x], abs=1.5)


def test_stars_do_not_lift_the_background() -> None:
    image = noisy((256, 256), 100.0, 3.0)
    rng = np.random.default_rng(2)
    for x, y in rng.integers(3, 252, (150, 2)):
        image[y - 2 : y + 3, x - 2 : x + 3] += rng.integers(20, 3000, (5, 5)).astype(np.uint16)
    background = estimate_background(image)
    assert np.all(np.abs(background.level - 100.0) < 2.0)
    assert background.median_noise == pytest.approx(3.0, rel=0.2)


def smooth_image(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Convolution of an image with the filter along both axes; beyond its edges it goes on with its last pixels."""
    kernel = np.concatenate([taps[:0:-1], taps]).astype(np.float64)
    down = ndimage.convolve1d(image.astype(float), kernel, 0, mode="nearest")
    return ndimage.convolve1d(down, kernel, 1, mode="nearest")


@pytest.mark.parametrize("sigma", [0.4, 0.8, 1.3, 2.0, 4.0])
def test_smoothing_keeps_the_level_and_lowers_the_noise_as_stated(sigma: float) -> None:
    taps = spot_taps(sigma)
    assert taps[0] + 2.0 * taps[1:].sum() == pytest.approx(1.0, abs=1e-6)
    white = np.random.default_rng(3).normal(0.0, 1000.0, (400, 400)) + 30000.0
    smooth = smooth_image(np.rint(white).astype(np.uint16), taps)
    assert smooth[10:-10, 10:-10].std() == pytest.approx(1000.0 * noise_factor(taps), rel=0.05)


def brute_force(smooth: np.ndarray, limit: np.ndarray) -> set[tuple[int, int]]:
    top = (smooth == ndimage.maximum_filter(smooth, 3, mode="nearest")) & (smooth > limit)
    return {(int(x), int(y)) for y, x in np.argwhere(top)}


@pytest.mark.parametrize("sigma", [0.4, 1.0, 1.3, 2.0, 4.0])
@pytest.mark.parametrize("shape", [(16, 16), (50, 33), (64, 129)])
def test_peaks_are_the_local_maxima_of_the_convolution(shape: tuple[int, int], sigma: float) -> None:
    image = noisy(shape, 200.0, 20.0)
    taps = spot_taps(sigma)
    limit = 200.0 + 0.5 * 20.0 * noise_factor(taps)
    grid = np.full((2, 3), limit, dtype=np.float32)
    peaks, heights = np.empty((4000, 2), np.int32), np.empty(4000, np.float32)
    smooth = smooth_image(image, taps)
    count = find_peaks(image, grid, 32.0, taps, peaks, heights)
    found = {(int(x), int(y)) for x, y in peaks[:count]}
    assert found
    assert found == brute_force(smooth, np.full(shape, limit))
    assert heights[:count] == pytest.approx(smooth[peaks[:count, 1], peaks[:count, 0]], rel=1e-5)


@pytest.mark.parametrize("sigma", [0.5, 0.9])
def test_the_integer_filter_is_the_same_filter(sigma: float) -> None:
    image = noisy((200, 300), 60.0, 12.0).clip(0, 255).astype(np.uint8)
    taps = integer_taps(sigma)
    assert taps is not None
    as_floats = (taps / INTEGER_TAPS_SUM).astype(np.float32)
    grid = np.array([[60.0, 66.0, 72.0], [66.0, 72.0, 78.0], [66.0, 72.0, 78.0]], dtype=np.float32)
    places = []
    for finder, kernel in ((find_peaks_in_bytes, taps), (find_peaks, as_floats)):
        peaks, heights = np.empty((4000, 2), np.int32), np.empty(4000, np.float32)
        count = finder(image, grid, 32.0, kernel, peaks, heights)
        places.append({(int(x), int(y)) for x, y in peaks[:count]})
    both = places[0] & places[1]
    # the thresholds of four rows are one in the integer filter, and equal neighbours may be ordered otherwise
    assert len(both) > 0.96 * max(len(places[0]), len(places[1]))


def test_bright_bytes_do_not_overflow() -> None:
    image = np.full((40, 40), 255, dtype=np.uint8)
    image[20, 20] = 254
    taps = integer_taps(0.8)
    assert taps is not None
    peaks, heights = np.empty((100, 2), np.int32), np.empty(100, np.float32)
    count = find_peaks_in_bytes(image, np.full((2, 2), 250.0, dtype=np.float32), 32.0, taps, peaks, heights)
    assert np.all(heights[:count] == 255.0)


def test_no_more_peaks_than_there_is_room_for() -> None:
    image = noisy((60, 60), 200.0, 20.0)
    peaks, heights = np.empty((5, 2), np.int32), np.empty(5, np.float32)
    assert find_peaks(image, np.zeros((2, 2), np.float32), 32.0, spot_taps(1.0), peaks, heights) == 5


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(-12.0, 12.0))
def test_the_normal_table(z: float) -> None:
    distribution, density = normal(z)
    assert distribution == pytest.approx(norm.cdf(z), abs=1e-8)
    assert density == pytest.approx(norm.pdf(z), abs=1e-8)


def test_the_nodes_of_the_normal_table_are_exact() -> None:
    np.testing.assert_allclose(_CDF, norm.cdf(_NODES), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(_PDF, norm.pdf(_NODES), rtol=1e-14)


WINDOW = (20, 30, 21, 17)


def model_of(x: float, y: float, trail: tuple[float, float] | None = None) -> np.ndarray:
    model = np.empty((3, 21 * 17))
    if trail is None:
        spot_model(x, y, 0.8, WINDOW, model, np.empty((5, 21)))
    else:
        trail_model(x, y, 0.8, trail, WINDOW, model)
    return model


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(27.0, 33.0), st.floats(36.0, 41.0))
def test_the_spot_model_is_the_integrated_gaussian(x: float, y: float) -> None:
    edges_x, edges_y = np.arange(22) + 19.5, np.arange(18) + 29.5
    across = np.diff(0.5 * erf((edges_x - x) / (0.8 * math.sqrt(2.0))))
    down = np.diff(0.5 * erf((edges_y - y) / (0.8 * math.sqrt(2.0))))
    np.testing.assert_allclose(model_of(x, y)[0], np.outer(down, across).ravel(), atol=1e-7)


@pytest.mark.parametrize("trail", [None, (3.0, 1.0), (-6.0, 4.0), (0.6, 0.0)])
def test_slopes_are_the_derivatives(trail: tuple[float, float] | None) -> None:
    step = 1e-4
    model = model_of(30.3, 38.6, trail)
    by_x = (model_of(30.3 + step, 38.6, trail)[0] - model_of(30.3 - step, 38.6, trail)[0]) / (2.0 * step)
    by_y = (model_of(30.3, 38.6 + step, trail)[0] - model_of(30.3, 38.6 - step, trail)[0]) / (2.0 * step)
    np.testing.assert_allclose(model[1], by_x, atol=2e-5)
    np.testing.assert_allclose(model[2], by_y, atol=2e-5)
    assert model[0].sum() == pytest.approx(1.0, abs=2e-3)


def test_the_trail_model_is_the_mean_of_many_spots() -> None:
    parts = (np.arange(400) + 0.5) / 400 - 0.5
    expected = np.mean([model_of(30.3 + 5.0 * part, 38.6 - 3.0 * part)[0] for part in parts], axis=0)
    assert np.abs(model_of(30.3, 38.6, (5.0, -3.0))[0] - expected).max() < 0.02 * expected.max()


@pytest.mark.parametrize(
    ("light", "state"),
    [("star", GOOD), ("trail", GOOD), ("nothing", FAINT), ("dark", FAINT), ("pixel", HOT_PIXEL)],
)
def test_only_what_may_be_a_star_at_its_first_guess_is_fitted(light: str, state: int) -> None:
    trail = (5.0, -3.0) if light == "trail" else None
    pixels = np.random.default_rng(RNG_SEED).normal(0.0, 1.0, 21 * 17).astype(np.float32)
    if light in ("star", "trail"):
        pixels += (100.0 * model_of(30.3, 38.6, trail)[0]).astype(np.float32)
    elif light != "nothing":
        pixels[9 * 21 + 10] += -40.0 if light == "dark" else 40.0
    fit = np.zeros(1, FIT).view(np.recarray)[0]
    shape = (0.8, *(trail or (0.0, 0.0)))
    scratch = np.empty((3, 21 * 17)), np.empty((5, 21))
    fit_star.py_func(pixels, WINDOW, (30.0, 39.0), shape, (1.0, 0.0, 0.01), 3.0, *scratch, fit)
    assert fit.state == state


def flow_places(count: int, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 2))


def flow_trails(flow: np.ndarray, places: np.ndarray, noise: float, seed: int = 5) -> np.ndarray:
    size = 937
    trails = np.array([trail_at(flow, *(place * size / 2 + (size - 1) / 2), size, size) for place in places])
    rng = np.random.default_rng(seed)
    return (trails + rng.normal(0.0, noise, trails.shape)) * rng.choice([-1.0, 1.0], (len(trails), 1))


@pytest.mark.parametrize(
    "flow",
    [
        (5.0, 2.0, 0.0, 0.7, 0.3),
        (0.0, 0.0, 8.0, 0.0, 0.0),
        (3.0, -1.0, 6.0, 0.4, -0.1),
        (-1.5, 0.4, 0.5, 0.0, 0.0),
    ],
)
def test_a_flow_is_found_in_every_direction(flow: tuple[float, ...]) -> None:
    truth = np.array(flow)
    places = flow_places(30)
    trails = flow_trails(truth, places, 0.05)
    trails[:3] = ((9.0, -9.0), (0.0, 12.0), (-20.0, 3.0))
    sums = np.zeros(5)
    fit_flow(places, trails, sums)
    error = min(np.abs(sums - truth).max(), np.abs(sums + truth).max())
    assert error < 0.15
    length, off = (np.median(each) for each in lengths_and_mismatches(sums, places, trails))
    assert off < 0.15
    assert length == pytest.approx(np.median(lengths_and_mismatches(truth, places, trails)[0]), rel=0.05)


@pytest.mark.parametrize("count", [3, 5, 11])
def test_few_trails_give_a_simple_flow(count: int) -> None:
    truth = np.array([4.0, -3.0, 0.0, 0.0, 0.0])
    places = flow_places(count)
    found = np.zeros(5)
    fit_flow(places, flow_trails(truth, places, 0.02), found)
    assert min(np.abs(found - truth).max(), np.abs(found + truth).max()) < 0.2


@pytest.mark.parametrize("length", [0.3, 2.0, 8.0, 22.0])
def test_a_straight_trail_fitted_to_a_curved_one_is_shifted_as_stated(length: float) -> None:
    """The fit is by least squares on the light of a star whose path is the solution of the flow's differential equation."""
    size, sigma = 937, 0.85
    flow = length * np.array([0.7, -0.3, 0.6, 0.15, -0.1])

    def rate(_: float, p: np.ndarray) -> np.ndarray:
        return np.array(trail_at(flow, *p, size, size))

    start = np.array([750.3, 610.6])
    times = 0.5 * np.polynomial.legendre.leggauss(81)[0]
    weights = 0.5 * np.polynomial.legendre.leggauss(81)[1]
    path = np.concatenate([
        solve_ivp(rate, (0.0, side), start, t_eval=np.sort(t)[:: int(np.sign(side))], rtol=1e-11, atol=1e-9).y.T
        for side, t in ((-0.5, times[:40]), (0.5, times[40:]))
    ])  # fmt: skip
    order = np.concatenate([times[:40][::-1], times[40:]])
    weights = weights[np.argsort(times)][np.searchsorted(np.sort(times), order)]
    x, y = np.meshgrid(np.arange(-30, 31) / 1.5, np.arange(-30, 31) / 1.5)
    x, y = x + start[0], y + start[1]

    def light(points: np.ndarray) -> np.ndarray:
        each = np.exp(
            -0.5 * ((x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2) / sigma**2
        )
        return each @ weights

    image = light(path)
    straight = np.array(trail_at(flow, *start, size, size))

    def misfit(p: np.ndarray) -> np.ndarray:
        return (p[2] * light(p[:2] + order[:, None] * straight) - image).ravel()

    fitted = least_squares(misfit, np.array([*start, 1.0]), xtol=1e-14, ftol=1e-14, gtol=1e-14).x[:2]
    stated, trails = trail_shifts(flow, start[None], (size, size), sigma, float(np.hypot(*straight)))
    assert trails[0] == pytest.approx(straight)
    assert stated[0] == pytest.approx(fitted - start, abs=0.05 * np.hypot(*(fitted - start)) + 1e-6)


def test_a_turning_pinhole_camera_makes_such_a_flow() -> None:
    """Truth from the camera itself: the five terms hold its trails to a twentieth of a pixel."""
    from starid.attitude import Attitude
    from starid.camera import DEFAULT_CAMERA

    pixels = np.random.default_rng(6).uniform(20.0, 917.0, (40, 2))
    vectors = DEFAULT_CAMERA.back_project(pixels)
    turn = np.radians([0.25, -0.15, 0.6])
    icrs = Attitude.identity().to_icrs(vectors)
    ends = [
        DEFAULT_CAMERA.project(Attitude.identity().rotated(s * turn).to_sensor(icrs))[0] for s in (-0.5, 0.5)
    ]
    trails = ends[1] - ends[0]
    found = np.zeros(5)
    fit_flow((pixels - 468.0) / 468.5, trails, found)
    drawn = np.array([trail_at(found, x, y, 937, 937) for x, y in pixels])
    off = np.minimum(np.linalg.norm(drawn - trails, axis=1), np.linalg.norm(drawn + trails, axis=1))
    assert off.max() < 0.05


@pytest.mark.parametrize("length", [1.0, 4.0, 12.0, 30.0])
def test_the_length_of_a_trail_from_its_adapted_variance(length: float) -> None:
    """Adapted moments of a smeared Gaussian by numerical integration lead back to the length of the smear."""
    across = 0.72
    u = np.linspace(-60.0, 60.0, 40_001)
    profile = norm.cdf((u + length / 2) / math.sqrt(across)) - norm.cdf((u - length / 2) / math.sqrt(across))
    variance = 1.0
    for _ in range(400):
        weight = profile * np.exp(-0.5 * u * u / variance)
        variance = 2.0 * float(np.sum(weight * u * u) / np.sum(weight))
    assert trail_length(np.array([variance]), across)[0] == pytest.approx(length, rel=0.01)


@pytest.mark.parametrize(("dtype", "level", "noise"), [(np.uint16, 5000.0, 100.0), (np.uint8, 60.0, 12.0)])
def test_summing_along_trails_lifts_them_above_the_noise(dtype: type, level: float, noise: float) -> None:
    flow = np.array([10.0, 6.0, 0.0, 0.0, 0.0])
    taps = spot_taps(0.8)
    steps = trail_steps(flow, 200, 200)
    assert steps == 12, "a pixel apart on a trail of 11.7"
    sums, scale = sum_along_trails(noisy((200, 200), level, noise).astype(dtype), flow, steps)
    smooth = smooth_image(sums, taps) / scale
    expected = noise * trail_noise_factor(0.8, math.hypot(10.0, 6.0), steps)
    assert smooth[20:-20, 20:-20].mean() == pytest.approx(level, abs=0.5 + 0.01 * noise)
    assert smooth[20:-20, 20:-20].std() == pytest.approx(expected, rel=0.15)
    line = np.zeros((200, 200))
    for part in np.linspace(-0.5, 0.5, 200):
        line[round(100 + 6 * part), round(100 + 10 * part)] += 0.01 * noise
    sums, scale = sum_along_trails((level + 2.0 * line).astype(dtype), flow, steps)
    response = smooth_image(sums, taps) / scale - level
    y, x = np.unravel_index(np.argmax(response), response.shape)
    assert (x, y) == pytest.approx((100, 100), abs=1.5)


def test_sums_along_trails_are_plain_sums() -> None:
    image = np.random.default_rng(3).integers(0, 256, (70, 300)).astype(np.uint8)
    flow = np.array([7.0, -4.0, 0.0, 0.0, 0.0])
    sums, scale = sum_along_trails(image, flow, 8)
    parts = (np.arange(8) + 0.5) / 8 - 0.5
    for x, y in ((150, 35), (5, 30), (297, 20), (150, 0), (127, 69), (128, 32)):
        expected = 0
        for part in parts:
            column, row = x + round(7.0 * part), min(max(y + round(-4.0 * part), 0), 69)
            expected += int(image[row, column]) if 0 <= column < 300 else 0
        assert sums[y, x] == expected
    assert scale == 8.0
    bright = sum_along_trails(np.full((40, 40), 65535, np.uint16), flow, 96)
    assert bright[0][20, 20] == pytest.approx(65535 * bright[1], abs=1.0)


@pytest.mark.parametrize("sigma", [0.4, 0.7, 1.2, 2.5])
def test_spot_widths_have_no_bias(sigma: float) -> None:
    rng = np.random.default_rng(7)
    level, noise = np.full((2, 2), 50.0, np.float32), np.full((2, 2), 3.0, np.float32)
    errors = []
    for _ in range(40):
        x, y = 30.0 + rng.uniform(-0.5, 0.5, 2)
        edges = np.arange(62) - 0.5
        shares = [np.diff(0.5 * erf((edges - place) / (sigma * math.sqrt(2.0)))) for place in (y, x)]
        image = np.rint(50.0 + 8000.0 * np.outer(*shares) + rng.normal(0.0, 3.0, (61, 61))).astype(np.uint16)
        widths = np.empty(1)
        if spot_widths(image, np.array([[30, 30]], np.int32), level, noise, 32.0, 0.9, 65535.0, 0.0, widths):
            errors.append(widths[0])
    assert len(errors) > 30
    assert np.median(errors) == pytest.approx(sigma, rel=0.02)
