from __future__ import annotations

import numpy as np
import pytest

from emulator.campaign import RECORD, CampaignPlan, block_side, run_campaign, run_chunk, summarise
from emulator.errors import EmulatorError

PLAN = CampaignPlan(frames=5, seed=11, chunk=2)
EXACT = [name for name in RECORD.names or () if not name.endswith("_ms")]


def test_every_frame_is_solved_and_close_to_the_truth():
    figures = summarise(np.concatenate(list(run_campaign(PLAN))), PLAN.fov_deg)
    assert (figures["frames"], figures["valid"], figures["wrong"]) == (5, 5, 0)
    assert figures["median_arcsec"] < 20
    assert figures["roll_median_arcsec"] < 100


def test_a_frame_depends_on_plan_and_number_only():
    alone = run_chunk(PLAN, 1)
    other = run_chunk(CampaignPlan(frames=4, seed=11, chunk=4), 0)[2:4]
    assert list(alone["frame"]) == list(other["frame"]) == [2, 3]
    for name in EXACT:
        np.testing.assert_array_equal(alone[name], other[name])


def test_an_interrupted_campaign_goes_on_where_it_stopped(tmp_path):
    chunks = run_campaign(PLAN, folder=tmp_path)
    first = next(chunks)
    chunks.close()
    kept = {file.name: file.stat().st_mtime_ns for file in tmp_path.glob("chunk-*.npy")}
    rows = np.concatenate(list(run_campaign(PLAN, folder=tmp_path)))
    assert kept
    assert all((tmp_path / name).stat().st_mtime_ns == time for name, time in kept.items())
    assert sorted(rows["frame"]) == [0, 1, 2, 3, 4]
    assert first["dec_deg"][0] in rows["dec_deg"]


def test_a_folder_of_another_plan_is_refused(tmp_path):
    next(iter(run_campaign(PLAN, folder=tmp_path)))
    with pytest.raises(EmulatorError, match=r"plan\.json holds another plan"):
        list(run_campaign(CampaignPlan(frames=5, seed=12, chunk=2), folder=tmp_path))


def test_a_damaged_chunk_is_named(tmp_path):
    list(run_campaign(CampaignPlan(frames=1, seed=11), folder=tmp_path))
    file = tmp_path / "chunk-000000.npy"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(EmulatorError, match="chunk-000000"):
        list(run_campaign(CampaignPlan(frames=1, seed=11), folder=tmp_path))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_blocked_share_of_the_image_is_black(share):
    image = np.full((200, 300), 9, np.uint8)
    blocked = block_side(image, share, np.random.default_rng(3))
    assert np.mean(blocked == 0) == pytest.approx(share, abs=0.01)
    assert image.all()


def test_wrong_counts_boresight_and_roll_of_valid_answers_only():
    rows = np.zeros(5, RECORD)
    rows["valid"] = [True, True, True, True, False]
    rows["cross_arcsec"] = [1, 361, 1, 359, np.nan]
    rows["roll_arcsec"] = [1, 1, 361, 359, np.nan]
    rows["frame"] = range(5)
    rows["reason"] = ["ok", "ok", "ok", "ok", "no_match"]
    figures = summarise(rows, 42.0)
    assert figures["wrong_frames"] == [1, 2]
    assert figures["invalid_reasons"] == {"no_match": 1}


@pytest.mark.parametrize("bad", [{"frames": 0}, {"blocked": 1.0}, {"blocked": -0.1}])
def test_a_senseless_plan_is_refused(bad):
    with pytest.raises(EmulatorError, match="campaign"):
        CampaignPlan(**{"frames": 1, "seed": 1, **bad})
