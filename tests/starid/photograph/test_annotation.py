"""Annotated images explain their own marks."""

import cv2
import numpy as np
import pytest

from starid.photograph.annotation import MARK_BGR, MISS_BGR, RADIUS_PX, annotate

SKY = np.full((240, 320), 20, np.uint8)
STAR = np.array([[160.0, 120.0]])
OTHER = np.array([[200.0, 60.0]])


def circles(image, colour):
    """Centres (x, y) of the circles of a colour, from left to right."""
    strongest = np.argmax(colour)
    others = np.delete(image, strongest, axis=2).max(axis=2).astype(int)
    found, _, statistics, centres = cv2.connectedComponentsWithStats(
        (image[:, :, strongest] > others + 30).astype(np.uint8)
    )
    wide = [i for i in range(1, found) if statistics[i, cv2.CC_STAT_WIDTH] > RADIUS_PX]
    return sorted(tuple(centres[i].round()) for i in wide)


def test_colours_are_explained_where_stars_are_not_identified():
    image = annotate(SKY, STAR, ["Rigel"], missed_xy_px=OTHER)
    example, drawn = circles(image, MARK_BGR)
    other_example, missed = circles(image, MISS_BGR)
    assert (drawn, missed) == ((160, 120), (200, 60))
    assert example[0] == other_example[0]
    assert 2 * RADIUS_PX < other_example[1] - example[1] < 4 * RADIUS_PX


def test_an_image_whose_stars_are_all_identified_has_no_legend():
    image = annotate(SKY, STAR, ["Rigel"], missed_xy_px=np.empty((0, 2)))
    assert circles(image, MARK_BGR) == [(160, 120)]
    assert circles(image, MISS_BGR) == []


@pytest.mark.parametrize("corner", [(12.0, 228.0), (12.0, 210.0)])
def test_the_legend_covers_no_star(corner):
    image = annotate(SKY, np.array([corner]), [""], missed_xy_px=OTHER)
    (example,) = (at for at in circles(image, MARK_BGR) if at != corner)
    assert np.hypot(example[0] - corner[0], example[1] - corner[1]) > 4 * RADIUS_PX


@pytest.mark.long
def test_an_image_too_small_for_a_legend_has_none():
    image = annotate(SKY[:48, :64], np.array([[20.0, 20.0]]), [""], missed_xy_px=np.array([[44.0, 30.0]]))
    assert circles(image, MISS_BGR) == [(44, 30)]


def test_between_crowded_corners_the_legend_stands_at_a_free_edge():
    grid = np.array([(x, y) for x in range(20, 320, 40) for y in range(20, 240, 40)], float)
    crowded = grid[~((grid[:, 0] > 60) & (grid[:, 0] < 270) & (grid[:, 1] > 160))]
    image = annotate(SKY, crowded, ["HIP 1"] * len(crowded), missed_xy_px=OTHER)
    (example,) = set(circles(image, MARK_BGR)) - {tuple(at) for at in crowded}
    assert 60 < example[0] < 300
    assert example[1] > 160
