"""The leaderboard: every solver in every kind of row, what they take, and solvers that anyone adds."""

from __future__ import annotations

import json
import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from starid.camera import Camera
from starid.catalog import load_catalog
from starid.cli.app import build_app
from starid.errors import StaridError
from starid.identification.geometric.pattern_index import field_solid_angle
from starid.identification.solution import Reason, Solution
from starid.lab.classic.registry import CLASSICS
from starid.lab.leaderboard import comparison as bench
from starid.lab.leaderboard import peers
from starid.lab.leaderboard.peers import ALL, make_solver
from starid.lab.leaderboard.report import markdown, ranked, right, write_leaderboard
from starid.lab.leaderboard.scenes import SceneMaker, SceneSettings

pytestmark = [pytest.mark.long, pytest.mark.lowest("matplotlib")]

PIXEL = 1.0

ORACLE = """
from starid.lab.leaderboard.peers import Reply, Solver, Stopwatch

def make(camera, stars):
    def solve(scene):
        watch = Stopwatch()
        return Reply(scene.attitude.matrix, *watch.read())
    return Solver(solve, database_bytes=12_000)

def liar(camera, stars):
    def solve(scene):
        watch = Stopwatch()
        return Reply(scene.attitude.rotated([0.1, 0.0, 0.0]).matrix, *watch.read())
    return Solver(solve)

def nothing(camera, stars):
    return None
"""


class Classic:
    """What a published algorithm has beside its answers."""

    database_bytes, build_seconds = 1, 0.1


@pytest.fixture
def oracle(tmp_path, monkeypatch):
    (tmp_path / "oracle.py").write_text(ORACLE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return "oracle:make"


def entry(solver: str, *, valid: float, wrong: int, cpu: float, row: str = "0.5") -> dict:
    return {
        "row": row, "solver": solver, "frames": 10, "valid_pct": valid, "wrong": wrong, "boresight_median_arcsec": 9.0,
        "floor_ratio": 1.0, "median_ms": cpu, "p99_ms": 2.0 * cpu, "cpu_median_ms": cpu, "cpu_p99_ms": 2.0 * cpu,
        "ill_conditioned": min(wrong, 1), "sky": True,
    }  # fmt: skip


def test_wrong_answers_rank_below_missing_ones_and_slow_below_fast() -> None:
    entries = [
        entry("wrong", valid=100.0, wrong=1, cpu=0.1),
        entry("slow", valid=100.0, wrong=0, cpu=5.0),
        entry("silent", valid=10.0, wrong=0, cpu=0.1),
        entry("fast", valid=100.0, wrong=0, cpu=1.0),
    ]
    order = [item["solver"] for item in ranked({"rows": entries}, "0.5")]
    assert order == ["fast", "slow", "silent", "wrong"]
    assert right(entries[0]) == pytest.approx(90.0)
    assert right(entry("silent", valid=0.0, wrong=0, cpu=0.1) | {"sky": False}) == pytest.approx(100.0)


def test_the_report_names_every_solver_row_and_omission(tmp_path) -> None:
    answer = {
        "date": "2026-01-02",
        "frames": 20,
        "seed": 3,
        "rows": [entry("one", valid=100.0, wrong=0, cpu=1.0), entry("two", valid=50.0, wrong=2, cpu=1.0, row="8°")],
        "solvers": [
            {"solver": "one", "field_deg": 42.0, "limit_v": 5.5, "database_kb": 120.0, "build_s": 0.1, "memory_mb": 3.0},
            {"solver": "two", "field_deg": 8.0, "limit_v": 7.5, "database_kb": None, "build_s": 2.0, "memory_mb": 0.0},
        ],
        "skipped": {"three": "not installed: pip install three"},
        "versions": {"one": "1.0", "two": "custom"},
    }  # fmt: skip
    text = markdown(answer, "a command")
    for words in (
        "`a command`",
        "## 0.5",
        "## 8°",
        "| one | **10** of 20 | 100.0 | 0 (0) |",
        "| two | **10** of 20 | 30.0 | 2 (1) |",
        "| one | 42° | 5.5 | 120 |",
        "three: skipped",
        "2026-01-02, seed 3. Versions: one 1.0, two custom.",
    ):
        assert words in text
    paths = write_leaderboard(answer, tmp_path / "out", "a command")
    assert json.loads((tmp_path / "out" / "leaderboard.json").read_text()) == answer
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths if path.suffix == ".png")


def test_a_solver_of_ones_own_is_measured_like_the_others(oracle) -> None:
    answer = bench.run(4, 5, own=[oracle, "oracle:liar"], rows=["0.5", "8°, V ≤ 7.5, 0.5"])
    for row in answer["rows"]:
        assert (row["valid_pct"], row["wrong"]) == (100.0, 0 if row["solver"] == oracle else 4)
    assert [(item["solver"], item["field_deg"]) for item in answer["solvers"]] == [
        (name, width) for width in (42.0, 8.0) for name in (oracle, "oracle:liar")
    ]
    assert answer["solvers"][0]["database_kb"] == pytest.approx(12.0)
    assert answer["versions"][oracle] == "custom"


def test_settings_of_ruststartracker_scale_with_the_field(monkeypatch) -> None:
    """Three pixels, and some twenty stars per field to look up, whether the field is 8° or 42° wide."""
    made = []
    fake = types.ModuleType("ruststartracker")
    fake.CameraParameters = lambda *_: None
    fake.StarTracker = lambda *_, **settings: made.append(settings)
    monkeypatch.setitem(sys.modules, "ruststartracker", fake)
    stars = load_catalog().brighter_than(8.0)
    for width, side in ((8.0, 512), (42.0, 937)):
        camera = Camera.from_fov(width, side, side)
        make_solver("ruststartracker", camera, stars)
        settings = made.pop()
        assert settings["inter_star_angle_tolerance"] == pytest.approx(3.0 * camera.pixel_scale_rad)
        looked_up = np.count_nonzero(stars.v <= settings["max_lookup_magnitude"])
        share = field_solid_angle(camera) / (4.0 * np.pi)
        assert looked_up * share == pytest.approx(20.0, rel=0.02)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("astrology", "MODULE:FUNCTION"),
        ("no_such_module:make", "PYTHONPATH"),
        ("oracle:nothing", "NoneType"),
        ("os:path", "not callable"),
        (":make", "Empty module name"),
    ],
)
def test_a_solver_that_is_none_is_named(oracle, name: str, words: str) -> None:
    with pytest.raises(StaridError, match=words):
        bench.run(1, 1, own=[name], rows=["0.5"])


def test_every_row_of_the_leaderboard_has_its_field_and_limit() -> None:
    fields = bench._by_field(bench.LEADERBOARD, Camera.from_fov())
    assert sorted(round(camera.fov_deg) for camera, _ in fields) == [8, 20, 42, 42, 62]
    assert sorted(row for rows in fields.values() for row in rows) == sorted(bench.LEADERBOARD)
    assert set(bench.STANDARD) <= set(fields[Camera.from_fov(), bench.PEER_LIMIT_V])
    assert set(CLASSICS) < set(ALL)


def test_the_papers_scenes_match_their_sensors() -> None:
    cameras = {
        row: camera
        for (camera, _), rows in bench._by_field(bench.PAPERS, Camera.from_fov()).items()
        for row in rows
    }
    assert {(round(camera.fov_deg, 6), camera.width) for camera in cameras.values()} == {
        (12.0, 1024),
        (12.0, 2048),
        (20.0, 1024),
        (8.0, 512),
    }
    assert cameras["8°, V ≤ 7.5, 1, 0.4 mag"].width == 512


def test_a_field_is_drawn_until_it_has_its_least_number_of_stars() -> None:
    maker = SceneMaker(Camera.from_fov(12.0), load_catalog().brighter_than(6.0))
    for least in (0, 12, 25):
        rng = np.random.default_rng(1)
        counts = [len(maker.scene(SceneSettings(6.0, least_stars=least), rng).flux) for _ in range(30)]
        assert least <= min(counts) < least + 12


@pytest.mark.parametrize("raw", [False, True])
def test_raw_answers_are_not_verified_and_all_know_the_noise(
    monkeypatch: pytest.MonkeyPatch, raw: bool
) -> None:
    calls: list[object] = []

    class Noting(Classic):
        def identify(self, *arguments):
            calls.append(None if arguments[2] is None else float(arguments[2][0]))
            return Solution.invalid(Reason.NO_MATCH)

    def made(*_, **options):
        calls.append(options["verify"])
        return Noting()

    monkeypatch.setattr(peers, "make_identifier", made)
    bench.run(1, 5, own=["pyramid"], rows=["2"], raw=raw)
    assert calls[0] is not raw
    assert calls[-1] == 2.0


@pytest.mark.parametrize(("name", "even"), [("pyramid", False), ("pyramid-even", True)])
def test_a_suffix_asks_for_evenly_spread_guide_stars(monkeypatch, name: str, even: bool) -> None:
    calls = []
    monkeypatch.setattr(
        peers, "make_identifier", lambda *words, **options: calls.append((*words, options)) or Classic()
    )
    make_solver(name, Camera.from_fov(20.0), load_catalog().brighter_than(5.0))
    ((algorithm, _, options),) = calls
    assert algorithm == "pyramid"
    assert options["even"] is even
    assert options["verify"]


@pytest.mark.parametrize(
    "row", ["dense, mirrored sky", "1000–1500 random points", "tracking, 1 star, 2 false"]
)
def test_where_there_is_no_sky_every_answer_is_wrong(oracle, row: str) -> None:
    (entry,) = bench.run(3, 5, own=[oracle], rows=[row])["rows"]
    assert (entry["wrong"], entry["sky"], right(entry)) == (3, False, 0.0)


def test_no_solver_answers_a_mirrored_sky() -> None:
    (entry,) = bench.run(3, 5, rows=["dense, mirrored sky"])["rows"]
    assert (entry["valid_pct"], entry["wrong"], right(entry)) == (0.0, 0, 100.0)
    maker = SceneMaker(Camera.from_fov(), load_catalog().brighter_than(8.0))
    assert len(maker.scene(bench.ROWS["dense, mirrored sky"], np.random.default_rng(1)).flux) >= 1000


def test_scenes_keep_only_the_brightest_and_dense_ones_hold_a_thousand() -> None:
    camera, stars = Camera.from_fov(), load_catalog().brighter_than(8.0)
    maker = SceneMaker(camera, stars)
    few = maker.scene(SceneSettings(5.5, 0.0, magnitude_noise=0.0, kept=3), np.random.default_rng(1))
    many = maker.scene(SceneSettings(5.5, 0.0, magnitude_noise=0.0), np.random.default_rng(1))
    brightest = np.sort(many.flux)[-3:]
    assert sorted(few.flux) == pytest.approx(brightest)
    dense = bench.ROWS["dense, V ≤ 7.8, 0.5"]
    counts = [len(maker.scene(dense, np.random.default_rng(seed)).flux) for seed in range(5)]
    assert np.median(counts) >= 1000


def test_a_tracking_row_gives_a_prediction_some_pixels_off(monkeypatch: pytest.MonkeyPatch) -> None:
    offsets = []

    def made(name, camera, stars, **_):
        solver = make_solver("geometric", camera, stars)

        def track(scene, predicted, window_px):
            offsets.append(predicted.error_to(scene.attitude).total_arcsec)
            assert window_px == pytest.approx(20.0)
            return solver.track(scene, predicted, window_px)

        return type(solver)(solver.solve, track=track)

    monkeypatch.setattr(bench, "make_solver", made)
    answer = bench.run(12, 3, rows=["tracking, 3 stars"])
    scale = math.degrees(Camera.from_fov().pixel_scale_rad) * 3600.0
    assert len(offsets) == 12
    assert 1.0 * scale < np.median(offsets) < 9.0 * scale
    assert answer["rows"][0]["wrong"] == 0


def test_published_algorithms_take_part_and_are_never_wrong_when_verified() -> None:
    answer = bench.run(2, 4, own=["pyramid", "oriented-svd"], rows=["0.5", "20°, V ≤ 6.5, 0.5"])
    assert all(row["wrong"] == 0 for row in answer["rows"])
    assert sum(row["valid_pct"] for row in answer["rows"]) >= 300.0
    assert all(item["database_kb"] > 0 and item["build_s"] > 0 for item in answer["solvers"])


def test_the_command_writes_report_data_and_pictures(tmp_path, oracle) -> None:
    words = [
        "bench",
        "--frames",
        "2",
        "--solvers",
        oracle,
        "--row",
        "0.5",
        "-o",
        str(tmp_path / "board"),
        "--json",
    ]
    result = CliRunner().invoke(build_app(words), words)
    assert result.exit_code == 0
    assert json.loads(result.stdout)["rows"][0]["valid_pct"] == 100.0
    assert {path.name for path in (tmp_path / "board").iterdir()} == {
        "leaderboard.md", "leaderboard.json", "rates.png", "times.png",
    }  # fmt: skip


def test_the_solver_of_the_documents_works_as_it_stands(tmp_path, monkeypatch) -> None:
    text = (Path(__file__).parents[4] / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    program = text.split("```python\n")[1].split("```")[0]
    assert len(program.splitlines()) <= 30
    (tmp_path / "my_solver.py").write_text(program)
    monkeypatch.syspath_prepend(str(tmp_path))
    answer = bench.run(2, 5, own=["my_solver:make"], rows=["0.5"])
    assert (answer["rows"][0]["valid_pct"], answer["rows"][0]["wrong"]) == (100.0, 0)
    assert answer["solvers"][0]["database_kb"] > 0
