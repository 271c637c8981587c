"""The cache folder: its size limit, what goes first, and the command that shows and clears it."""

from __future__ import annotations

import json
import os
import re
import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.pipeline.messages import (
    Failure,
    IndexReady,
    IndexRequest,
    PipelineReady,
    PipelineSetup,
)
from starhil.protocol.files.bundled import bundled, bundled_units
from starid.storage import cache
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.runs import CAMERA
from tests.waiting import PATIENCE_S

MEGABYTE = np.zeros(125_000)


@dataclass
class StandIn:
    """A pipeline that does nothing, and what was asked of it; or the failure with which it does not start."""

    failure: Failure | None = None
    setups: list[PipelineSetup] = field(default_factory=list)
    requests: list[IndexRequest] = field(default_factory=list)

    def make(self, setup: PipelineSetup, _helper: object = None) -> tuple[StandIn, PipelineReady] | Failure:
        self.setups.append(setup)
        return self.failure or (self, PipelineReady(CAMERA, 5, 0.0))

    def handle(self, request: IndexRequest) -> IndexReady:
        self.requests.append(request)
        return IndexReady()


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    stand_in = StandIn()
    monkeypatch.setattr("starhil.emulator.sensor.pipeline.pipeline.make_pipeline", stand_in.make)
    return stand_in


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for 3 MB."""
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("STARHIL_CACHE_LIMIT_MB", "3.1")
    return tmp_path / "cache"


def name(number: int) -> str:
    return f"hipparcos-{number:016x}"


def keep(*numbers: int) -> None:
    """Have tables of a megabyte each computed and cached, as of one second after the other."""
    for number in numbers:
        cache.cached_tables(name(number), lambda: {"a": MEGABYTE})


def age(folder: Path, **seconds: int) -> None:
    for key, value in seconds.items():
        os.utime(folder / f"{name(int(key[1:]))}.npz", (value, value))


def kept(folder: Path) -> set[int]:
    return {int(path.stem.partition("-")[2], 16) for path in folder.glob("hipparcos-*.npz")}


def test_the_least_recently_used_goes_when_the_limit_is_passed(folder: Path) -> None:
    keep(1, 2, 3)
    age(folder, n1=1000, n2=2000, n3=3000)
    keep(1)  # used again
    keep(4)
    assert kept(folder) == {1, 3, 4}


def test_a_newly_computed_file_is_kept_even_beyond_the_limit(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STARHIL_CACHE_LIMIT_MB", "0.5")
    keep(1, 2)
    assert kept(folder) == {2}


def test_foreign_files_are_neither_counted_nor_removed(folder: Path) -> None:
    folder.mkdir()
    (folder / "notes.bin").write_bytes(bytes(9_000_000))
    (folder / "index-mine.bin").write_bytes(bytes(9_000_000))
    keep(1, 2, 3)
    assert kept(folder) == {1, 2, 3}
    assert CliRunner().invoke(build_app(["cache"]), ["cache", "clear"]).exit_code == 0
    assert {path.name for path in folder.iterdir()} == {"notes.bin", "index-mine.bin"}


def test_info_shows_files_size_and_limit(folder: Path) -> None:
    keep(1, 2)
    age(folder, n1=2000, n2=1000)
    content = json.loads(CliRunner().invoke(build_app(["cache"]), ["cache", "info", "--json"]).stdout)
    assert (content["folder"], content["limit_bytes"]) == (str(folder), 3_100_000)
    assert [item["name"] for item in content["files"]] == [f"{name(2)}.npz", f"{name(1)}.npz"]
    assert content["bytes"] == sum(path.stat().st_size for path in folder.iterdir())
    shown = CliRunner().invoke(build_app(["cache"]), ["cache"]).stdout
    assert "2.0 MB of 3.1 MB in 2 files" in shown


def test_an_empty_cache_is_shown_and_cleared(folder: Path) -> None:
    assert "0.0 MB of 3.1 MB in 0 files" in CliRunner().invoke(build_app(["cache"]), ["cache", "info"]).stdout
    assert "removed 0 of 0 files" in CliRunner().invoke(build_app(["cache"]), ["cache", "clear"]).stdout


def test_a_limit_that_is_not_a_number_is_reported_and_the_default_used(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for text in ("much", "-1", "nan", "inf"):
        monkeypatch.setenv("STARHIL_CACHE_LIMIT_MB", text)
        assert cache.size_limit() == 500_000_000
    assert "must be a number of megabytes" in caplog.text


def test_kernels_are_counted_from_a_time_on(folder: Path) -> None:
    machine_code = folder / "kernels" / "0123456789abcdef" / "package"
    machine_code.mkdir(parents=True)
    for number, written_s in enumerate((1000, 2000, 3000)):
        path = machine_code / f"kernel-{number}.nbc"
        path.write_bytes(b"code")
        os.utime(path, (written_s, written_s))
        path.with_suffix(".part").write_bytes(b"being written")
    assert [cache.kernels_written_since(begin_s) for begin_s in (0, 2000, 4000)] == [3, 2, 0]


def test_warming_the_cache_starts_a_pipeline_that_needs_every_kernel_and_the_index_of_the_device(
    folder: Path, pipeline: StandIn
) -> None:
    status, out, said = run_command_line("cache", "warm", "cubestar")
    assert (status, said) == (0, "")
    assert out.startswith("0 kernels added to ")
    assert str(folder) in out
    ((setup,), (request,)) = pipeline.setups, pipeline.requests
    assert (setup.previews, setup.sky) == (True, load_profile("cubestar").sky)
    settings = request.settings
    assert (settings.limiting_magnitude, settings.focal_length, settings.centroid_x) == (4.2, 1247.35, 470.32)


def test_the_cache_is_warmed_for_all_profiles_and_units_in_one_process(
    folder: Path, pipeline: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process for each of them took five times as long."""
    started: list[object] = []
    monkeypatch.setattr("starhil.emulator.sensor.pipeline.worker_process.subprocess.Popen", started.append)
    assert run_command_line("cache", "warm")[::2] == (0, "")
    assert started == []
    count = len(bundled("profile")) + len(bundled_units())
    assert (len(pipeline.setups), len(pipeline.requests)) == (count, count)
    assert {setup.algorithm for setup in pipeline.setups} == {"geometric", "rsi"}


def test_the_cache_is_warmed_for_a_unit_in_the_working_directory(
    folder: Path, pipeline: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    assert run_command_line("unit", "new", "mine")[0] == 0
    assert run_command_line("cache", "warm", "--unit", "mine")[::2] == (0, "")
    assert len(pipeline.requests) == 1


def test_warming_the_cache_reports_its_progress(
    folder: Path, pipeline: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported = threading.Event()

    def count(_since: float) -> int:
        reported.set()
        return 7

    def make(setup: PipelineSetup, _helper: object = None) -> tuple[StandIn, PipelineReady] | Failure:
        reported.wait(PATIENCE_S)
        return pipeline.make(setup)

    monkeypatch.setattr("starhil.emulator.sensor.pipeline.pipeline.make_pipeline", make)
    monkeypatch.setattr("starid.cli.output.PROGRESS_S", 0.05)
    monkeypatch.setattr("starid.storage.cache.kernels_written_since", count)
    _, _, said = run_command_line("cache", "warm", "cubestar")
    assert re.match(r"starting: \d+ s, kernels added to the cache: 7; later runs use them\n", said)


def test_a_failure_to_warm_the_cache_is_one_line(folder: Path, pipeline: StandIn) -> None:
    pipeline.failure = Failure("no catalogue")
    status, out, said = run_command_line("cache", "warm")
    assert (status, out, said.count("\n")) == (2, "", 1)
    assert said.endswith("cubestar.toml: no catalogue\n")


def test_a_loop_of_links_does_not_stop_the_cache(folder):
    folder.mkdir()
    (folder / f"{name(1)}.npz").symlink_to(f"{name(1)}.npz")
    cache.cached_tables(name(2), lambda: {"a": MEGABYTE})
    assert run_command_line("cache", "clear")[0] == 0
    assert not (folder / f"{name(2)}.npz").exists()
