"""Spots hold the star's light at the star's place, at rest and on a path."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.psf import add_spots, path_rule
from starhil.emulator.sensor.renderer import Renderer
from starid.camera import Camera
from starid.catalog import load_catalog

SIZE = 64


def draw(
    path: list[float], electrons: float = 10000.0, sigma: tuple[float, float] = (0.8, 0.8)
) -> np.ndarray:
    image = np.zeros((SIZE, SIZE), dtype=np.float32)
    nodes, weights = path_rule(2.0 * float(np.hypot(path[2], path[3])), min(sigma))
    add_spots(
        image, np.ones_like(image), np.array([path]), np.array([electrons]), np.array([sigma]), nodes, weights
    )
    return image.astype(np.float64)


def centre(image: np.ndarray) -> tuple[float, float]:
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    return float((columns * image).sum() / image.sum()), float((rows * image).sum() / image.sum())


@pytest.mark.long
@pytest.mark.parametrize("place", [(30.0, 30.0), (30.5, 30.5), (31.23, 28.71)])
def test_a_spot_is_the_gaussian_integrated_over_pixels(place: tuple[float, float]) -> None:
    image = draw([*place, 0.0, 0.0, 0.0, 0.0])
    edges = np.arange(SIZE + 1) - 0.5
    x, y = (np.diff(0.5 * erf((edges - value) / (0.8 * np.sqrt(2.0)))) for value in place)
    np.testing.assert_allclose(image, 10000.0 * np.outer(y, x), atol=0.02)
    assert image.sum() == pytest.approx(10000.0, rel=1e-5)
    assert centre(image) == pytest.approx(place, abs=1e-4)


@pytest.mark.parametrize("length", [0.3, 3.0, 9.0, 25.0])
def test_a_trail_is_the_mean_of_many_spots(length: float) -> None:
    along = np.array([0.8, 0.6]) * length / 2.0
    trail = draw([30.2, 31.7, *along, 0.0, 0.0])
    times = (np.arange(2000) + 0.5) / 1000.0 - 1.0
    many = np.zeros((SIZE, SIZE), dtype=np.float32)
    path = np.zeros((2000, 6))
    path[:, :2] = np.array([30.2, 31.7]) + times[:, None] * along
    nodes, weights = path_rule(0.0, 0.8)
    add_spots(many, np.ones_like(many), path, np.full(2000, 5.0), np.full((2000, 2), 0.8), nodes, weights)
    np.testing.assert_allclose(trail, many, atol=3e-3 * many.max())
    assert trail.sum() == pytest.approx(10000.0, rel=1e-4)
    assert centre(trail) == pytest.approx((30.2, 31.7), abs=1e-3)


def test_a_spot_half_outside_is_cut_at_the_edge() -> None:
    image = draw([-0.5, 20.0, 0.0, 0.0, 0.0, 0.0])
    assert image.sum() == pytest.approx(5000.0, rel=1e-4)


def test_widths_along_the_axes_differ() -> None:
    image = draw([30.0, 30.0, 0.0, 0.0, 0.0, 0.0], sigma=(0.7, 1.4))
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    width = ((columns - 30.0) ** 2 * image).sum() / image.sum()
    height = ((rows - 30.0) ** 2 * image).sum() / image.sum()
    assert width == pytest.approx(0.7**2 + 1.0 / 12.0, rel=1e-3)
    assert height == pytest.approx(1.4**2 + 1.0 / 12.0, rel=1e-3)


def test_a_dead_pixel_gets_no_light() -> None:
    image = np.zeros((SIZE, SIZE), dtype=np.float32)
    sensitivity = np.ones_like(image)
    sensitivity[30, 30] = 0.0
    nodes, weights = path_rule(0.0, 0.8)
    spot = np.array([[30.0, 30.0, 0.0, 0.0, 0.0, 0.0]])
    add_spots(image, sensitivity, spot, np.array([1000.0]), np.array([[0.8, 0.8]]), nodes, weights)
    assert image[30, 30] == 0.0
    assert image[30, 31] > 50.0


def test_a_spot_off_the_axis_is_round_and_grows_with_the_square_of_its_distance() -> None:
    """A defocus is as large in every direction: 1.2 px grow by a fifth at the edge, and by two fifths in the corner."""
    size, growth, base = 201, 0.2, 1.2
    camera = Camera.from_fov(20.0, width=size, height=size)
    sensor = SensorModel(psf_sigma_px=base, psf_growth=growth, prnu=0.0, dead_pixels=0)
    renderer = Renderer(camera, load_catalog().brighter_than(0.0), sensor)
    for place in ([100.0, 100.0], [187.0, 100.0], [100.0, 13.0], [180.0, 20.0]):
        mean = np.zeros((size, size), dtype=np.float32)
        renderer._add_light(mean, np.array([[*place, 0.0, 0.0, 0.0, 0.0]]), np.array([1e6]))
        rows, columns = np.mgrid[0:size, 0:size]
        spread = [
            ((axis - at) ** 2 * mean).sum() / mean.sum()
            for axis, at in zip((columns, rows), place, strict=True)
        ]
        off = (np.array(place) + 0.5 - size / 2.0) / (size / 2.0)
        expected = (base * (1.0 + growth * (off @ off))) ** 2 + 1.0 / 12.0
        assert spread == pytest.approx([expected, expected], rel=2e-3)


@pytest.mark.parametrize(("power", "edge", "corner"), [(0, 0.0, 0.0), (1, 0.0747, 0.140), (4, 0.299, 0.559)])
def test_light_off_the_axis_falls_with_a_power_of_the_cosine(power: int, edge: float, corner: float) -> None:
    """Magnitudes at 21° (the edge of a field of 42°) and atan(√2 tan 21°), its corner: -2.5 n log10 cos."""
    camera = Camera.from_fov(42.0, width=301, height=301)
    sensor = SensorModel(vignetting=power, prnu=0.0, dead_pixels=0)
    sensitivity = Renderer(camera, load_catalog().brighter_than(0.0), sensor)._pattern.sensitivity
    for place, loss in (((300, 150), edge), ((300, 300), corner)):
        x, y = place
        assert -2.5 * np.log10(sensitivity[y, x] / sensitivity[150, 150]) == pytest.approx(
            loss, abs=0.012 * max(loss, 1e-6) + 1e-6
        )
