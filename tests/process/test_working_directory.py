"""Python files in the working directory, where others may have put them, are not run by what a command starts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, hub_command, installed_command
from tests.emulator.cli.command_line import run_command_line
from tests.users import OTHER_USER, needs_others

pytestmark = pytest.mark.process

MODULES = ("starhil", "starid", "numpy", "multiprocessing", "json", "struct", "sitecustomize")


@pytest.fixture
def was_run(tmp_path, monkeypatch):
    """Work in a folder with modules that leave a mark; return the path of the mark."""
    mark, folder = tmp_path / "mark", tmp_path / "work"
    folder.mkdir()
    for module in MODULES:
        (folder / f"{module}.py").write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(3)\n")
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return mark


def test_the_image_pipeline_imports_nothing_from_the_working_directory(was_run):
    WorkerProcess().end()
    assert not was_run.exists()


def test_a_process_that_the_bench_starts_imports_nothing_from_the_working_directory(was_run):
    with EmulatorProcess(hub_command()) as hub:
        assert hub.ready["can"]
    assert not was_run.exists()


def test_a_command_leaves_the_environment_as_it_is(monkeypatch, tmp_path):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.chdir(tmp_path)
    run_command_line("endurance", "--unit", "nos3", "--lives", "1", "--steps", "1", "--rendered", "0")
    assert "PYTHONSAFEPATH" not in os.environ


def test_the_processes_of_a_pool_import_nothing_from_the_working_directory(was_run):
    words = ["endurance", "--unit", "nos3", "--lives", "2", "--steps", "1", "--jobs", "2", "--rendered", "0"]
    done = subprocess.run([installed_command(), *words], capture_output=True, text=True, check=False)
    assert (done.returncode, was_run.exists()) == (0, False), done.stderr


@needs_others
@pytest.mark.parametrize("name", [".numba_config.yaml", "matplotlibrc"])
def test_settings_of_libraries_that_another_user_has_put_there_are_not_obeyed(tmp_path, monkeypatch, name):
    """With `chrome_trace`, numba replaced any file of the user by a trace."""
    settings, precious = tmp_path / name, tmp_path / "precious"
    settings.write_text(f"chrome_trace: {precious}\n")
    precious.write_text("precious")
    monkeypatch.chdir(tmp_path)
    uses_numba = [sys.executable, "-P", "-c", "import starid.kernels.jit"]
    commands = [
        [installed_command(), "unit", "list"],
        [str(Path(installed_command()).with_name("starid")), "--help"],
    ]
    os.chown(settings, OTHER_USER, OTHER_USER)
    for command in [uses_numba, *commands]:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert re.search(
            rf"{re.escape(str(settings))}: belongs to user 12345, and \w+ would obey it", done.stderr
        )
        assert precious.read_text() == "precious"
    for command in commands:
        os.chown(settings, os.geteuid(), -1)
        assert subprocess.run(command, capture_output=True, check=False).returncode == 0
