"""The worker is started before anything else is imported."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from starhil.emulator.profile import load_profile
from starhil.emulator.profile.pipeline_setup import make_pipeline
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.long

AHEAD = """
import sys
{app}
from starhil.emulator.sensor.pipeline import worker_process
class Worker:
    def __init__(self):
        print("worker", "typer" in sys.modules, "pydantic" in sys.modules)
        raise KeyboardInterrupt
worker_process.WorkerProcess = Worker
from starhil.emulator.cli import main
sys.argv[1:] = {arguments}
main()
"""


NO_APP = (
    "import types; sys.modules['starhil.emulator.cli.app'] = types.SimpleNamespace(main=lambda: print('app'))"
)
"""Instead of the command line that would be imported then."""


def python(program):
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_before_the_event_loop_ends_a_run_as_a_later_one_does(number):
    sent = f"import signal; signal.raise_signal({int(number)})"
    program = f"import signal; signal.signal({int(number)}, signal.SIG_DFL)\n"  # nohup would have it ignored
    program += AHEAD.replace("raise KeyboardInterrupt", sent)
    ended = python(program.format(app="", arguments=["run", "ideal"]))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("worker")


@pytest.mark.process
@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (["run", "demo"], "worker False False\n"),
        (["run", "--help"], "app\n"),
        (["run", "ideal", "--set", "run.worker=error_model"], "app\n"),
        (["run", "quick.toml"], "app\n"),
        ([], "app\n"),
    ],
)
def test_only_a_run_with_a_worker_starts_it_before_anything_else_is_imported(
    arguments, printed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("quick.toml").write_text('extends = "ideal"\n[run]\nworker = "error_model"\n')
    assert python(AHEAD.format(app=NO_APP, arguments=arguments)).stdout == printed


@pytest.mark.process
def test_ctrl_c_in_a_terminal_does_not_reach_the_worker():
    worker = WorkerProcess()
    try:
        assert os.getpgid(worker.process.pid) == worker.process.pid
    finally:
        worker.process.kill()
        worker.end()


@pytest.mark.process
def test_a_machine_without_room_for_a_worker_is_an_error_of_one_line():
    """Before the command line was read, it was a traceback."""
    program = AHEAD.replace(
        "raise KeyboardInterrupt", "raise BlockingIOError(11, 'Resource temporarily unavailable')"
    )
    ended = python(program.format(app="", arguments=["run", "demo"]))
    assert (ended.returncode, ended.stderr) == (2, "starhil: Resource temporarily unavailable\n")


def test_a_worker_that_was_started_ahead_is_taken_once(monkeypatch):
    from starhil.emulator.sensor.pipeline import worker_process

    monkeypatch.setattr(worker_process, "WorkerProcess", object)
    worker_process.start_ahead()
    first, second = worker_process.take_worker(), worker_process.take_worker()
    assert (type(first), second) == (object, None)


@pytest.mark.process
def test_a_worker_that_a_run_does_not_need_is_not_waited_for():
    """It went on to import numba and numpy, and the run waited two seconds for it."""
    worker = WorkerProcess()
    make_pipeline(load_profile("ideal", ["run.worker=error_model"]), worker, repeatable=False, previews=False)
    assert worker.process.returncode == -signal.SIGKILL
