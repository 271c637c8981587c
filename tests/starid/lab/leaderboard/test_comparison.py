"""`starid bench`: one table for every solver, with the keys that were promised."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from starid.attitude import Attitude
from starid.cli.app import build_app
from starid.errors import StaridError
from starid.identification.solution import Reason, Solution
from starid.lab.leaderboard import peers
from starid.lab.leaderboard.comparison import ROWS, Tally, run
from starid.lab.leaderboard.peers import Reply
from starid.lab.leaderboard.scenes import Scene

pytestmark = pytest.mark.long

PROMISED = [
    "row", "solver", "frames", "valid_pct", "wrong", "boresight_median_arcsec", "floor_ratio", "median_ms", "p99_ms",
]  # fmt: skip
OWN = ("geometric", "lsi", "rsi")


def test_every_solver_of_our_own_answers_the_same_scenes() -> None:
    rows = run(4, 5, own=OWN, rows=["0.5"])["rows"]
    assert [row["solver"] for row in rows] == list(OWN)
    rows += run(4, 5, own=["geometric"], rows=["100 random points"])["rows"]
    for row in rows:
        assert list(row)[: len(PROMISED)] == PROMISED
        assert row["frames"] == 4
        assert row["wrong"] == 0
        assert 0.0 < row["median_ms"] <= row["p99_ms"]
        assert 0.0 < row["cpu_median_ms"] <= row["cpu_p99_ms"]
        if row["row"] == "0.5":
            assert row["valid_pct"] >= 75.0
            assert row["floor_ratio"] == pytest.approx(1.0, abs=0.1)
        else:
            assert row["valid_pct"] == 0.0
            assert row["floor_ratio"] is None


@pytest.mark.parametrize(
    ("off_truth", "off_fit", "counts"),
    [(0.05, 0.2, (0, 0)), (0.2, 0.05, (1, 1)), (0.2, 0.2, (1, 0)), (0.05, 0.05, (0, 0))],
)
def test_an_answer_off_the_truth_is_wrong_even_where_the_true_matches_give_no_better(
    off_truth: float, off_fit: float, counts: tuple[int, int]
) -> None:
    attitude = Attitude.from_radec_roll(10.0, 20.0, 30.0)
    truth, fit = (attitude.rotated([0.0, np.radians(angle), 0.0]) for angle in (off_truth, off_fit))
    scene = Scene(truth, np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.int64), 0.5)
    tally = Tally("tracking, 3 stars", "geometric")
    tally.add(scene, fit, Reply(attitude.matrix, 1e-3, 1e-3))
    report = tally.report()
    assert (report["wrong"], report["ill_conditioned"]) == counts


class Recorder:
    """An identifier that notes how many frames it remembers at each."""

    def __init__(self) -> None:
        self.remembered = 0
        self.notes: list[int] = []

    def reset(self) -> None:
        self.remembered = 0

    def identify(self, *_: object) -> Solution:
        self.notes.append(self.remembered)
        self.remembered += 1
        return Solution.invalid(Reason.NO_MATCH)


def test_a_row_does_not_depend_on_the_rows_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder()
    monkeypatch.setattr(peers, "make_identifier", lambda *_, **__: recorder)
    run(2, 5, own=["lsi"], rows=["0.5", "1"])
    # one scene when it is made, then a warm-up and two scenes a row
    assert recorder.notes == [0, *[0, 1, 2] * 2]


def test_json_is_one_object_and_repeats_with_the_seed() -> None:
    runner = CliRunner()
    words = ["bench", "--frames", "3", "--seed", "9", "--row", "2, 5, 3", "--json"]
    first, second = (json.loads(runner.invoke(build_app(words), words).stdout) for _ in range(2))
    assert first["seed"] == 9
    assert first["versions"].keys() == {"geometric"}
    for one, other in zip(first["rows"], second["rows"], strict=True):
        same = {key for key in one if not key.endswith("_ms")}
        assert {key: one[key] for key in same} == {key: other[key] for key in same}


def test_a_solver_that_is_over_its_budget_answers_no_more() -> None:
    (row,) = run(5, 5, rows=["0.5"], budget_s=1e-9)["rows"]
    assert row["frames"] == 1


def test_clutter_keeps_to_its_share_of_the_field() -> None:
    answer = run(6, 5, rows=["0.5, 200 false in half the field"])
    assert answer["rows"][0]["wrong"] == 0
    assert answer["rows"][0]["valid_pct"] >= 80.0


@pytest.mark.parametrize(
    ("frames", "rows", "own", "words"),
    [
        (0, ["0.5"], ["geometric"], "--frames 0"),
        (1, ["7"], ["geometric"], "'7'"),
        (1, ["0.5"], ["astrology"], "'astrology'"),
    ],
)
def test_bad_options_are_named(frames: int, rows: list[str], own: list[str], words: str) -> None:
    assert "7" not in ROWS
    with pytest.raises(StaridError, match=words):
        run(frames, 1, rows=rows, own=own)
