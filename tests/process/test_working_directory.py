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

STARHIL = installed_command()
STARID = str(Path(STARHIL).with_name("starid"))
USES_NUMBA = [sys.executable, "-P", "-c", "import starid.kernels.jit"]
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


def test_the_processes_of_a_pool_import_nothing_from_the_working_directory(was_run):
    words = ("endurance", "--unit", "nos3", "--lives", "2", "--steps", "1", "--jobs", "2", "--rendered", "0")
    status, _, errors = run_command_line(*words)
    assert (status, was_run.exists()) == (0, False), errors
    assert "PYTHONSAFEPATH" not in os.environ  # which the command has for these processes alone


@needs_others
@pytest.mark.parametrize(
    ("name", "commands"),
    [(".numba_config.yaml", [USES_NUMBA, [STARHIL, "unit", "list"]]), ("matplotlibrc", [[STARID, "--help"]])],
    ids=[".numba_config.yaml", "matplotlibrc"],
)
def test_settings_of_libraries_that_another_user_has_put_there_are_not_obeyed(
    tmp_path, monkeypatch, name, commands
):
    """With `chrome_trace`, numba replaced any file of the user by a trace."""
    settings, precious = tmp_path / name, tmp_path / "precious"
    settings.write_text(f"chrome_trace: {precious}\n")
    precious.write_text("precious")
    monkeypatch.chdir(tmp_path)
    os.chown(settings, OTHER_USER, OTHER_USER)
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert re.search(
            rf"{re.escape(str(settings))}: belongs to user 12345, and \w+ would obey it", done.stderr
        )
        assert precious.read_text() == "precious"
    os.chown(settings, os.geteuid(), -1)
    assert subprocess.run(commands[-1], capture_output=True, check=False).returncode == 0
