"""Missing stars: restored from the previous frame, or avoided by a divided field."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from starid.identification.thesis.cme import estimate_motion
from starid.identification.thesis.database import DatabaseError, DatabaseParameters, build_database
from starid.identification.thesis.false_stars import FilterResult, ObservedFrame
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.metrics import boresight_error
from starid.identification.thesis.missing_stars import DividedField, restore_missing
from starid.lab.simulation import turned
from tests.starid.identification.thesis.thesis_sky import lost_in_space, thesis_catalog

pytestmark = pytest.mark.long

RADIUS = 20.0


def two_frames(lost, shift=(0.4, -0.3)):
    """Ten stars, and the same moved, without some of them; every object in the later frame is matched."""
    rng = np.random.default_rng(3)
    brightness, positions = rng.uniform(11.5, 13.0, 10), rng.uniform(-12.0, 12.0, (10, 2))
    kept = np.delete(np.arange(10), lost)
    moved = turned(positions, 2.0) + np.array(shift)
    before = ObservedFrame(brightness, positions)
    now = ObservedFrame(brightness[kept], moved[kept])
    matches = np.column_stack([kept, np.arange(kept.size)])
    result = FilterResult(np.ones(10, dtype=bool), np.ones(kept.size, dtype=bool), matches)
    return before, now, result, estimate_motion(positions[kept], moved[kept]), moved


def test_a_missing_star_is_restored_where_the_motion_carries_it():
    before, now, result, motion, moved = two_frames([4])
    mended = restore_missing(before, now, result, motion, radius_deg=RADIUS, margin_deg=0.1)
    assert len(mended) == 10
    np.testing.assert_allclose(mended.positions[-1], moved[4], atol=1e-9)
    assert mended.brightness[-1] == before.brightness[4]


def test_a_star_that_left_the_field_is_not_restored():
    before, now, result, motion, _ = two_frames([4], shift=(30.0, 0.0))
    mended = restore_missing(before, now, result, motion, radius_deg=RADIUS, margin_deg=0.1)
    assert len(mended) == 9


def test_a_false_star_of_the_previous_frame_is_not_restored():
    before, now, result, motion, _ = two_frames([4])
    true_before = result.true_before.copy()
    true_before[4] = False
    mended = restore_missing(
        before,
        now,
        FilterResult(true_before, result.true_now, result.matches),
        motion,
        radius_deg=RADIUS,
        margin_deg=0.1,
    )
    assert len(mended) == 9


@cache
def divided():
    parameters = DatabaseParameters(overlap=1.0 - 0.2 / 24.0, fov_deg=24.0)
    return DividedField(LostInSpace(build_database(thesis_catalog(), parameters)), half_width_deg=RADIUS)


@pytest.mark.parametrize(
    ("ra", "dec", "roll"), [(52.13, -21.71, 0.0), (201.87, 33.44, 130.0), (359.9, 5.05, -60.0)]
)
def test_a_covered_field_is_identified_by_the_circles_that_are_left(ra, dec, roll):
    brightness, places, _ = lost_in_space(99.5).database.sky.stars_in_frame(ra, dec)
    seen = places[:, 0] < 12.0
    answer = divided().solve(ObservedFrame(brightness[seen], turned(places[seen], roll)))
    assert answer is not None
    assert answer.votes >= 2
    assert boresight_error(answer.right_ascension_deg, answer.declination_deg, ra, dec) < 0.5
    assert abs((answer.roll_deg - roll + 180.0) % 360.0 - 180.0) < 3.0


def test_random_stars_have_no_answer():
    rng = np.random.default_rng(11)
    frame = ObservedFrame(rng.uniform(11.5, 15.0, 12), rng.uniform(-14.0, 14.0, (12, 2)))
    assert divided().solve(frame) is None


def test_circles_that_do_not_fit_into_the_field_are_rejected():
    with pytest.raises(DatabaseError, match="at most 28"):
        DividedField(lost_in_space(99.5), half_width_deg=RADIUS)
