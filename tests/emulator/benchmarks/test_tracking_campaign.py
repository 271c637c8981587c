"""A campaign of tracking: what hides the field, what an unexpected motion does, and figures that do not depend on the number of parts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.benchmarks.tracking_campaign import (
    LOST,
    RECORD,
    TRACKED,
    WAYS,
    TrackingPlan,
    run_chunk,
    run_tracking,
    summarise,
)
from starhil.emulator.errors import EmulatorError
from tests.emulator.cli.command_line import run_command_line

pytestmark = [pytest.mark.long, pytest.mark.lowest("joblib")]

FRAMES = 10
EXACT = [name for name in RECORD.names or () if not name.endswith("_ms")]


def test_a_hidden_field_is_tracked_and_not_found_lost_in_space() -> None:
    """How large the shares are, is shown by `test_tracking_few_stars`."""
    rows = {
        row["way"]: row
        for row in summarise(list(run_tracking(TrackingPlan("cubestar", seed=5, frames=FRAMES))))
    }
    assert all(row["wrong"] == 0 for row in rows.values())
    assert rows[LOST]["valid"] < 0.6 * FRAMES
    assert rows[TRACKED]["valid"] > FRAMES * 0.95 - 3.0 * math.sqrt(FRAMES * 0.95 * 0.05)
    assert sum(rows[LOST]["invalid_reasons"].values()) == FRAMES - rows[LOST]["valid"]


def test_the_whole_field_is_found_in_each_way() -> None:
    plan = TrackingPlan("cubestar", seed=5, frames=5, blocked=0.0, rate_deg_s=0.1)
    assert [(row["valid"], row["wrong"]) for row in summarise(list(run_tracking(plan)))] == [(5, 0)] * 2


def test_after_a_jump_the_prediction_is_not_believed() -> None:
    """Images of the whole field contradict a prediction that is off by degrees: they are right, or invalid."""
    plan = TrackingPlan("cubestar", seed=6, frames=5, blocked=0.0, jump_deg=20.0)
    lost, tracked = summarise(list(run_tracking(plan)))
    assert lost["valid"] == 5
    assert tracked["valid"] < 5
    assert tracked["wrong"] == 0


def test_an_image_depends_on_plan_and_number_only() -> None:
    alone = run_chunk(TrackingPlan("cubestar", seed=7, frames=4, chunk=2), 1)["rows"]
    whole = run_chunk(TrackingPlan("cubestar", seed=7, frames=4, chunk=4), 0)["rows"]
    for name in EXACT:
        np.testing.assert_array_equal(alone[name], whole[2 * len(WAYS) :][name])


def test_wrong_counts_valid_attitudes_only() -> None:
    rows = np.zeros(5, RECORD)
    rows["way"] = [TRACKED] * 4 + [LOST]
    rows["valid"] = [True, True, True, False, True]
    rows["frame"] = range(5)
    rows["cross_arcsec"] = [361.0, 1.0, 1.0, np.nan, 1.0]
    rows["roll_arcsec"] = [1.0, 361.0, 359.0, np.nan, 1.0]
    _, tracking = summarise([{"rows": rows}])
    assert (tracking["valid"], tracking["wrong"], tracking["wrong_frames"]) == (3, 2, [0, 1])


def test_a_share_beyond_the_image_is_named() -> None:
    with pytest.raises(EmulatorError, match="blocked"):
        list(run_tracking(TrackingPlan("cubestar", frames=1, blocked=1.5)))


def test_the_command_prints_a_row_per_way() -> None:
    status, out, said = run_command_line("campaign", "tracking", "--frames", "3", "--seed", "5")
    assert status == 0, said
    assert all(way in out for way in WAYS)
