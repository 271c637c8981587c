"""`starid catalog` as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from starid.cli.app import main

pytestmark = pytest.mark.long


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["starid", "catalog", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


def test_summary_as_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["stars"] == 117_957
    assert summary["brightest_hip"] == 32349
    assert summary["epoch"] == 2026.0
    assert 4800 < summary["count_to_v"]["6"] < 5300


def test_one_star_as_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--star", "91262", "--star", "32349", "--epoch", "2000", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["epoch"] == 2000.0
    vega, sirius = answer["stars"]
    assert (vega["hip"], sirius["hip"]) == (91262, 32349)
    assert vega["ra_deg"] == pytest.approx(279.2347, abs=1e-3)
    assert vega["dec_deg"] == pytest.approx(38.7837, abs=1e-3)
    assert vega["v"] == pytest.approx(0.03, abs=0.06)
    assert vega["absolute_v"] == pytest.approx(0.6, abs=0.06)


def test_belt_of_orion_in_a_cone(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--cone", "84.05", "-1.2", "1.6", "--limit", "3", "--json") == 0
    assert [s["hip"] for s in json.loads(capsys.readouterr().out)["stars"]] == [26311, 26727, 25930]


def test_human_readable_tables(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--cone", "84.05", "-1.2", "1.6", "--rows", "2") == 0
    out = capsys.readouterr().out
    assert "26311" in out
    assert "fainter ones" in out
    assert run(monkeypatch) == 0
    assert "117957" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--star", "999999"], "HIP 999999"),
        (["--star", "32349", "--limit", "-2"], "HIP 32349"),
        (["--star", "1", "--cone", "1", "2", "3"], "exclude each other"),
        (["--cone", "1", "95", "3"], "Dec within"),
        (["--cone", "1", "2", "0"], "radius"),
        (["--epoch", "9"], "epoch"),
        (["--path", "nowhere.dat"], "nowhere.dat: no such file"),
    ],
)
def test_bad_input_ends_in_one_line_and_status_2(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *arguments, "--json") == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("starid: ")
    assert captured.err.count("\n") == 1
    assert words in captured.err
