"""Subtraction of dark frames."""

from __future__ import annotations

import numpy as np
import pytest

from starid.errors import StaridError
from starid.imaging.dark_frame import dark_excess, without_dark

pytestmark = [pytest.mark.long, pytest.mark.lowest("opencv")]

SIDE = 40


def hot_detector(dtype=np.uint16):
    rng = np.random.default_rng(5)
    dark = np.full((SIDE, SIDE), 100.0)
    dark[rng.integers(0, SIDE, 30), rng.integers(0, SIDE, 30)] += 60.0
    return dark.astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_dark_signal_is_removed_and_the_star_stays(dtype):
    dark = hot_detector(dtype)
    image = dark.copy()
    image[20:23, 20:23] += 50
    cleaned = without_dark(image, dark_excess(dark))
    expected = np.full((SIDE, SIDE), 100)
    expected[20:23, 20:23] += 50
    np.testing.assert_array_equal(cleaned, expected)
    assert cleaned.dtype == dtype


def test_a_pixel_filled_by_dark_signal_takes_the_median_of_its_neighbours():
    dark = np.full((SIDE, SIDE), 10, np.uint8)
    dark[7, 9] = 255
    image = np.full((SIDE, SIDE), 30, np.uint8)
    image[7, 9] = 255
    assert without_dark(image, dark_excess(dark))[7, 9] == 30


def test_counts_do_not_wrap_below_zero():
    dark = np.zeros((SIDE, SIDE), np.uint8)
    dark[3, 3] = 20
    image = np.full((SIDE, SIDE), 50, np.uint8)
    image[3, 3] = 5
    assert without_dark(image, dark_excess(dark))[3, 3] == 0


def test_a_dark_frame_of_another_camera_is_rejected():
    with pytest.raises(StaridError, match="10×20 pixels: the image has 40×40"):
        without_dark(np.zeros((SIDE, SIDE), np.uint8), dark_excess(np.zeros((20, 10), np.uint8)))
