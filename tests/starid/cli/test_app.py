"""The command `starid`: what it imports, and what it shares with `starhil`."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import cv2
import pytest

from starhil.emulator.cli.app import COMMANDS
from starhil.emulator.sensor.renderer import render
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.cli import app, identify, output
from tests.emulator.cli.command_line import run_command_line
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NOT_OF_THE_ENGINE = {
    "aiohttp", "can", "canopen", "construct", "joblib", "matplotlib", "mcap", "serial", "sgp4",
    "scipy.sparse", "scipy.spatial", "sklearn", "starhil", "starid.lab", "starid.identification.thesis",
}  # fmt: skip


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photograph") / "sky.png"
    camera, truth = Camera.from_fov(20.0, 640, 480), Attitude.from_radec_roll(83.8, -1.2, 30.0)
    cv2.imwrite(str(path), render(camera, load_catalog(), truth, seed=1).image)
    return path


@pytest.mark.process
def test_a_photograph_is_identified_without_the_packages_of_the_bench_and_the_laboratory(
    photograph: Path,
) -> None:
    words = ("identify", str(photograph), "--fov", "20", "--json")
    # the first one makes catalogues and indices, for which SciPy searches pairs
    run_command_line(*words, program="starid")
    program = "from starid.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", program, *words],
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert json.loads(done.stdout)["valid"]
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines() if "|" in line}
    assert {"starid.identification.geometric.identifier", "starid.photograph.field_sweep"} <= imported
    assert not {
        name for name in imported for other in NOT_OF_THE_ENGINE if f"{name}.".startswith(f"{other}.")
    }


def test_the_engine_needs_a_part_of_what_the_project_needs() -> None:
    engine = set(PROJECT["dependency-groups"]["engine"])
    assert engine < set(PROJECT["project"]["dependencies"])


def test_a_photograph_is_annotated(photograph: Path, tmp_path: Path) -> None:
    marked = tmp_path / "marked.png"
    status, out, _ = run_command_line(
        "annotate", str(photograph), "--fov", "20", "-o", str(marked), "--json", program="starid"
    )
    assert (status, json.loads(out)["valid"]) == (0, True)
    pixels = cv2.imread(str(marked))
    assert pixels.shape == (480, 640, 3)
    assert (pixels[:, :, 1] != pixels[:, :, 2]).any()  # circles are coloured


def test_no_sub_command_has_two_programs() -> None:
    assert {*COMMANDS} & {*app.COMMANDS} == {"bench"}


@pytest.mark.process
def test_only_the_module_of_the_given_sub_command_is_imported() -> None:
    program = "import sys; from starid.cli import app; app.build_app(['catalog']); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    loaded = {name for name in done.stdout.split() if name in app.COMMANDS.values()}
    assert loaded == {"starid.cli.catalog"}


def test_the_camera_of_a_profile_of_the_emulator_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    ((name, value),) = PROJECT["project"]["entry-points"]["starid.cameras"].items()
    entry = EntryPoint(name, value, "starid.cameras")
    monkeypatch.setattr(identify, "entry_points", lambda group: [entry] if group == entry.group else [])
    assert identify._camera("cubestar").distortion[0] == -0.15


def test_a_profile_that_the_emulator_does_not_have_ends_with_one_line(
    photograph: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ((name, value),) = PROJECT["project"]["entry-points"]["starid.cameras"].items()
    monkeypatch.setattr(identify, "entry_points", lambda group: [EntryPoint(name, value, group)])
    status, out, stderr = run_command_line(
        "identify", str(photograph), "--profile", "cubestarr", program="starid"
    )
    assert (status, out) == (2, "")
    assert stderr.startswith("starid: profile 'cubestarr': not found; ")
    assert stderr.endswith("did you mean cubestar, cubestar-2013?\n")
    assert stderr.count("\n") == 1


def test_an_annotated_photograph_is_named_in_the_output(photograph: Path, tmp_path: Path) -> None:
    marked = tmp_path / "new" / "marked.png"
    status, out, _ = run_command_line(
        "annotate", str(photograph), "--fov", "20", "-o", str(marked), program="starid"
    )
    assert status == 0
    assert out.splitlines()[-1] == f"written: {marked}"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("bench", "--frames", "1", "--seed", "-1"), "'--seed': must be at least 0"),
        (("bench", "--frames", "1", "--budget", "-1"), "'--budget': must be at least 0"),
        (("bench", "--frames", "1", "--solvers", " , "), "--solvers: name at least one"),
        (("bench", "--frames", "1", "-o", "FILE"), "FILE: is not a folder; name one with -o"),
        (("reproduce", "worked-example", "-o", "FILE"), "FILE: is not a folder; name one with -o"),
    ],
)
def test_the_laboratory_rejects_what_it_cannot_do_before_the_work(
    tmp_path: Path, words: tuple[str, ...], why: str
) -> None:
    file = tmp_path / "notes.txt"
    file.touch()
    status, out, stderr = run_command_line(
        *(word.replace("FILE", str(file)) for word in words), program="starid"
    )
    assert (status, out) == (2, "")
    assert stderr.startswith("starid: ")
    assert why.replace("FILE", str(file)) in stderr
    assert stderr.count("\n") == 1


def test_an_extra_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    status, out, said = run_command_line("reproduce", "-o", str(tmp_path), program="starid")
    assert (status, out) == (2, "")
    assert said == "starid: matplotlib is not installed; run: pip install 'starhil[lab]'\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("start", "terminal", "reported"),
    [(False, True, [2, 5]), (True, True, [0, 2, 2, 5]), (False, False, [2]), (True, False, [0])],
)
def test_compiling_is_reported_while_the_number_of_kernels_grows_and_in_a_log_less_often(
    monkeypatch, capsys, start, terminal, reported
):
    """Minutes of compiling filled the logs of CI with a line every 5 s."""
    written = iter((0, 2, 2, 5))
    counted = threading.Event()

    def written_since(_begin_s: float) -> int:
        try:
            return next(written)
        except StopIteration:
            counted.set()
            threading.Event().wait()  # what is printed is complete
            return 5

    monkeypatch.setattr("starid.storage.cache.kernels_written_since", written_since)
    monkeypatch.setattr(output, "PROGRESS_S", 0.001)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with output.compiling_reported(start=start):
        assert counted.wait(PATIENCE_S)
    done = {
        0: "",
        **{number: f", kernels added to the cache: {number}; later runs use them" for number in (2, 5)},
    }
    lines = [rf"{'starting' if start else 'compiling'}: \d+ s{done[number]}\n" for number in reported]
    assert re.fullmatch("".join(lines), capsys.readouterr().err)


def test_kernels_are_no_longer_looked_for_when_none_has_been_compiled_for_long(monkeypatch):
    """To look for them took 10 ms of a benchmark every 5 s."""
    looked = []
    monkeypatch.setattr("starid.storage.cache.kernels_written_since", lambda _begin_s: looked.append(1) or 0)
    monkeypatch.setattr(output, "PROGRESS_S", 0.001)
    monkeypatch.setattr(output, "COMPILED_S", 0.05)
    before = threading.active_count()
    with output.compiling_reported():
        wait_until(lambda: looked and threading.active_count() == before)
