"""Windows around expected places: the stars of the whole image, each once, and how crowded a place is."""

from __future__ import annotations

import numpy as np
import pytest

from starid.errors import StaridError
from starid.imaging.detection import DetectionSettings, detect
from starid.imaging.star_windows import MAX_RADIUS_PX, detect_near

pytestmark = pytest.mark.long

SIZE, LEVEL, NOISE, SIGMA = 400, 40.0, 2.0, 1.1
SETTINGS = DetectionSettings(psf_sigma_px=SIGMA, gain_e_per_dn=10.0)


def sky(places: np.ndarray, flux: float, seed: int = 1) -> np.ndarray:
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    image = np.full((SIZE, SIZE), LEVEL) + NOISE * np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    for x, y in places:
        distance2 = (columns - x) ** 2 + (rows - y) ** 2
        image += flux / (2.0 * np.pi * SIGMA**2) * np.exp(-0.5 * distance2 / SIGMA**2)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_stars_in_windows_are_those_of_the_whole_image() -> None:
    places = np.array([[50.2, 60.7], [201.4, 333.1], [377.8, 18.2], [120.5, 121.5], [128.5, 118.5]])
    image = sky(places, 600.0)
    whole = detect(image, SETTINGS)
    found, rivals, _ = detect_near(image, places[:4] + 1.5, 6.0, SETTINGS)
    assert len(found) == 4
    for x, y in found.xy_px:
        near = np.hypot(*(whole.xy_px - (x, y)).T)
        assert near.min() < 0.02  # the background is estimated in other blocks
    # the fifth star, as bright as the others, is around the place of the fourth
    assert rivals == pytest.approx(np.full(4, 1.0 / (np.pi * (MAX_RADIUS_PX**2 - 6.0**2))))


def test_a_star_near_two_places_is_found_once() -> None:
    image = sky(np.array([[200.0, 200.0]]), 600.0)
    found = detect_near(image, np.array([[198.0, 200.0], [203.0, 200.0]]), 6.0, SETTINGS).found
    assert len(found) == 1
    assert found.xy_px[0] == pytest.approx([200.0, 200.0], abs=0.1)


def test_nothing_is_found_away_from_the_places() -> None:
    image = sky(np.array([[200.0, 200.0], [100.0, 100.0]]), 600.0)
    image[:, 260:] = 0
    found, _, searched = detect_near(
        image, np.array([[210.0, 200.0], [300.0, 100.0], [1.0, 1.0]]), 6.0, SETTINGS
    )
    assert len(found) == 0
    assert searched.tolist() == [True, False, False], "the image is constant, or ends"


ONE = 1.0 / (np.pi * (MAX_RADIUS_PX**2 - 6.0**2))
"""One rival. Some peaks of noise pass the threshold by the median noise of the tiles that are searched together."""


def test_false_peaks_at_the_edge_of_a_dark_body_are_counted_apart() -> None:
    """Between two levels the background is neither: what is detected there says nothing about places on an even sky."""
    faint = DetectionSettings(psf_sigma_px=SIGMA, threshold_sigma=3.0, min_star_pixels=0)
    edge = np.column_stack([np.full(20, 200.0), np.linspace(30.0, 370.0, 20)])
    at_edge = inside = 0
    counted = []
    for seed in range(10):
        image = sky(np.zeros((0, 2)), 0.0, seed)
        image[:, 203:] = 0
        alone, alone_rivals, _ = detect_near(image, edge - (120.0, 0.0), 6.0, faint)
        both, rivals, _ = detect_near(image, np.concatenate([edge - (120.0, 0.0), edge]), 6.0, faint)
        away = both.xy_px[:, 0] < 140.0
        at_edge += np.count_nonzero(~away)
        counted.extend(rivals[~away] / ONE)
        for place, expected in zip(alone.xy_px, alone_rivals, strict=True):
            gap = np.hypot(*(both.xy_px - place).T)
            if gap.min() < 0.05:
                inside += 1
                assert rivals[gap.argmin()] == pytest.approx(expected, abs=3.5 * ONE)
    assert inside > 5
    assert at_edge > 5
    assert np.mean(counted) > 7.0, "or they would not have mattered"


@pytest.mark.parametrize("radius", [0.0, MAX_RADIUS_PX + 0.1])
def test_a_radius_beyond_the_tile_is_named(radius: float) -> None:
    with pytest.raises(StaridError, match="radius_px"):
        detect_near(sky(np.zeros((0, 2)), 0.0), np.zeros((1, 2)), radius, SETTINGS)


def test_an_image_smaller_than_a_tile_is_named() -> None:
    with pytest.raises(StaridError, match="at least 64×64"):
        detect_near(np.zeros((40, 80), np.uint8), np.zeros((1, 2)), 6.0, SETTINGS)
