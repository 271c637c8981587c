"""The comparison of algorithms on rendered images, with a part of the thesis's algorithms and without it."""

from dataclasses import replace

import pytest

from starhil.emulator.benchmarks.algorithms import AlgorithmPlan, Comparison, Scene
from tests.emulator.sensor.pipeline.known_photometry import known_photometry

pytestmark = pytest.mark.long

IMAGES = 4
ALGORITHM = "thesis + refinement"
"""Without refinement, errors of features are measured again for each part that is taken away."""


@pytest.fixture(scope="module")
def refined():
    """The row by the part taken away, on the same device."""
    settings = ("run.algorithm=rsi", *known_photometry("ideal"))
    comparison = Comparison(AlgorithmPlan("ideal", IMAGES, 1, settings, "region"))
    comparison.devices = {ALGORITHM: comparison.devices[ALGORITHM]}

    def row(part):
        comparison.plan = replace(comparison.plan, without=part)
        seen = []
        rows = {row["algorithm"]: row for row in comparison.rows(Scene(0.3), lambda: seen.append(None))}
        assert len(seen) == Scene(0.3).images(IMAGES) == IMAGES
        return rows[ALGORITHM]

    return {part: row(part) for part in (None, "region")}


def test_a_slew_is_answered_from_the_region_unless_that_is_taken_away(refined):
    assert refined[None]["in_region"] > 0
    assert refined["region"]["in_region"] == 0
    assert refined["region"]["triggers"] > 0


def test_shares_are_of_all_images_and_one_sequence_has_no_standard_error(refined):
    for row in refined.values():
        assert row["frames"] == IMAGES
        assert row["valid_pct"] == 100.0 * row["valid"] / IMAGES
        assert row["right_pct"] == 100.0 * (row["valid"] - row["wrong"]) / IMAGES
        assert row["valid_error_pct"] is None
        assert row["normalised_squared_error_error"] is None
