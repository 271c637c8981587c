"""Light that the model of a star does not have: how far it shifts the fit, by least squares on a fine grid, and hot pixels beside stars."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import erf

from starid.imaging.detection import DetectionSettings, detect
from starid.imaging.unmodelled_light import shift_by_hidden_stars

pytestmark = pytest.mark.long

SIGMA_PX = 0.8
WIDTH_PX = math.sqrt(SIGMA_PX**2 + 1.0 / 12.0)
FLUX = 1000.0


def shape(u: np.ndarray, v: np.ndarray, length: float, width: float) -> np.ndarray:
    """Light per square pixel of a spot that moves by `length` along u."""
    across = np.exp(-0.5 * (v / width) ** 2) / (math.sqrt(2.0 * math.pi) * width)
    if length == 0.0:
        return across * np.exp(-0.5 * (u / width) ** 2) / (math.sqrt(2.0 * math.pi) * width)
    root = math.sqrt(2.0) * width
    ends = erf((u + 0.5 * length) / root) - erf((u - 0.5 * length) / root)
    return across * ends / (2.0 * length)


def shift_by_light(u: np.ndarray, v: np.ndarray, length: float, width: float) -> np.ndarray:
    """Shift along and across of a star of flux 1 by extra light of 1 in each place, in the linear limit of equal weights."""
    small = 1e-3
    by_u = (shape(u - small, v, length, width) - shape(u + small, v, length, width)) / (2.0 * small)
    by_v = (shape(u, v - small, length, width) - shape(u, v + small, length, width)) / (2.0 * small)
    return np.array([by / np.sum(by**2) for by in (by_u, by_v)])


def grid(length: float) -> tuple[np.ndarray, np.ndarray]:
    reach = 0.5 * length + 6.0
    return np.meshgrid(np.arange(-reach, reach, 0.4), np.arange(-6.0, 6.0, 0.4), indexing="ij")


def test_stars_hidden_in_a_trail_shift_it_by_the_stated_mean_square() -> None:
    """Fainter stars everywhere within a length of the trail and six pixels of it, one at a time: 1 per square pixel."""
    length, share, step = 15.0, 0.05, 0.75
    u, v = grid(length)
    by_light = shift_by_light(u, v, length, WIDTH_PX)
    squares = np.zeros(2)
    for along in np.arange(-length + 0.5 * step, length, step):
        for across in np.arange(-6.0, 6.0, step):
            extra = share * shape(u - along, v - across, length, WIDTH_PX)
            squares += np.sum(by_light * extra, axis=(1, 2)) ** 2
    squares *= step**2
    size = (100, 50)
    stated = shift_by_hidden_stars(
        np.array([FLUX, share * FLUX]), np.array([length, length]), SIGMA_PX, size
    )[0] ** 2 * (size[0] * size[1])
    assert stated == pytest.approx(squares, rel=0.2)


def test_brighter_neighbours_are_resolved_and_do_not_count() -> None:
    flux = np.array([FLUX, 0.5 * FLUX])
    assert not shift_by_hidden_stars(flux, np.array([10.0, 10.0]), SIGMA_PX, (100, 100)).any()


@pytest.mark.parametrize(("x", "y"), [(103.2, 40.7), (100.4, 43.1), (97.1, 37.6)])
def test_a_hot_pixel_beside_a_star_does_not_cost_the_star(x: float, y: float) -> None:
    """A star and, four pixels beside it, a pixel as bright as all its light; before, the star was taken for the hot pixel."""
    rng = np.random.default_rng(3)
    columns, rows = np.meshgrid(np.arange(200.0), np.arange(100.0))
    image = 20.0 + rng.normal(0.0, 1.5, columns.shape)
    for star_x, star_y in ((x, y), (40.0, 70.0), (150.0, 25.0), (170.0, 80.0)):
        image += 400.0 * shape(columns - star_x, rows - star_y, 0.0, WIDTH_PX)
    image[40, 100] += 200.0
    found = detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), DetectionSettings(psf_sigma_px=SIGMA_PX))
    gaps = np.hypot(*(found.xy_px - (x, y)).T)
    assert gaps.min() < 0.15


def image_with_edge(rng: np.random.Generator, edge: float, step: float, x: float, y: float) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(120.0), np.arange(120.0))
    image = np.where(columns > edge, 20.0, 20.0 - step) + 200.0 * shape(columns - x, rows - y, 0.0, WIDTH_PX)
    for star_x, star_y in ((100.0, 20.0), (95.0, 100.0), (80.0, 60.0)):
        image += 200.0 * shape(columns - star_x, rows - star_y, 0.0, WIDTH_PX)
    return np.clip(np.rint(image + rng.normal(0.0, 0.6, image.shape)), 0, 255).astype(np.uint8)


def test_a_star_that_an_edge_cuts_has_the_error_of_the_step() -> None:
    """Its fit is shifted by up to 8πσ³h/(√(2π)F); stated without that, errors were many sigmas."""
    rng = np.random.default_rng(5)
    over, cut = [], []
    for _ in range(60):
        x, y = 40.0 + rng.uniform(-0.5, 0.5, 2)
        detections = detect(
            image_with_edge(rng, 40.0 - rng.uniform(0.0, 3.0), 12.0, x, y),
            DetectionSettings(psf_sigma_px=SIGMA_PX),
        )
        off = detections.xy_px - (x, y)
        near = np.flatnonzero(np.hypot(*off.T) < 3.0)
        if near.size:
            over.append(np.abs(off[near[0]]).max() / detections.sigma_px[near[0]])
            cut.append(detections.sigma_px[near[0]])
    assert len(over) > 20
    assert max(over) < 4.0
    height = 8.0 * math.pi * SIGMA_PX**3 * 12.0 / (math.sqrt(2.0 * math.pi) * 200.0)
    assert np.median(cut) == pytest.approx(height, rel=0.5)
