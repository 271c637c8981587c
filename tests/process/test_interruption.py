"""A signal that ends a session or a conformance run leaves no process or folder, and its reports."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, installed_command
from starhil.hil_tests.rig.temporary_folder import temporary_folder
from tests.process.conftest import NO_IMAGES_OPTIONS, NO_IMAGES_TABLES
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.process

SESSION = "[[step]]\nread = 'identification'\n[[step]]\nwait_s = 600\n[[step]]\nread = 'device_status'\n"


@pytest.fixture(autouse=True)
def ctrl_c_is_not_ignored():
    """Processes inherit an ignored signal: SIGINT from a shell's background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def descendants(pid: int) -> set[int]:
    """Processes that a process has started, and those that these have."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
            except (FileNotFoundError, ProcessLookupError):
                continue
            parents[int(folder.name)] = int(fields[1])
    family, wave = set(), {pid}
    while wave:
        wave = {child for child, parent in parents.items() if parent in wave}
        family |= wave
    return family


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def interrupt(words: list, number: signal.Signals, folder: Path, processes: int) -> int:
    """Start a command, send it a signal once a line of its run is out; it has started so many processes then.

    Return its exit status when all is over.
    """
    command = [installed_command(), *map(str, words)]
    environment = {**os.environ, "TMPDIR": str(folder)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        lines = iter(process.stdout)
        assert any(line.startswith("✓") for line in lines), "the run did not begin"
        family = descendants(process.pid)
        assert len(family) >= processes
        process.send_signal(number)
        process.wait(timeout=PATIENCE_S)
        process.stdout.close()
    wait_until(lambda: not any(alive(pid) for pid in family))
    return process.returncode


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("session", signal.SIGTERM),
        ("conformance", signal.SIGINT),
        ("conformance", signal.SIGKILL),
    ],
    ids=str,
)
def test_a_signal_leaves_no_process_and_no_folder_behind(name, number, tmp_path):
    script, quick, junit, html, scratch = (
        tmp_path / each for each in ("s.toml", "quick.toml", "j.xml", "c.html", "scratch")
    )
    scratch.mkdir()
    script.write_text(SESSION, encoding="ascii")
    quick.write_text(NO_IMAGES_TABLES)
    words = {
        "session": ["session", script, "--log", tmp_path / "log"],
        "conformance": ["conformance", "serial.data", "serial.modes", "--html", html, "--verbose"],
    }[name]
    if number is signal.SIGKILL:
        processes = 2  # the emulator, and the worker that makes its images
    else:
        words, processes = [*words, "--profile", quick], 1
    status = interrupt([*words, "--start", "--serial", "auto", "--junit", junit], number, scratch, processes)
    if number is signal.SIGKILL:
        with temporary_folder("starhil-", base=scratch):  # the next run clears away what this one could not
            left = list(scratch.iterdir())
        assert len(left) == 1
        return
    assert status == 128 + number
    assert list(scratch.iterdir()) == []
    suite = ET.parse(junit).getroot()
    reasons = [item.get("message") for item in suite.iter("skipped")]
    assert int(suite.get("tests")) > len(reasons) > 0
    assert reasons[-1] == f"not run: interrupted by {number.name}"
    if name == "conformance":
        assert f"interrupted by {number.name}" in html.read_text()


def test_an_emulator_ends_when_its_parent_is_killed_before_the_ready_line(tmp_path):
    text = (
        "import subprocess, sys, time\n"
        "from starhil.hil_tests.rig.emulator_process import emulator_command\n"
        f"child = subprocess.Popen(emulator_command(state_dir={str(tmp_path)!r}), stdout=subprocess.DEVNULL)\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(1e6)\n"
    )
    with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        parent.kill()
    wait_until(lambda: not alive(child))


def test_an_emulator_ends_while_a_file_is_read_that_the_control_channel_named(tmp_path):
    control, reading = tmp_path / "control", tmp_path / "reading"
    text = (
        "import sys, time\n"
        "from starhil.emulator.cli.app import main\n"
        "from starhil.emulator.truth import reading_process\n"
        f"reading_process.read_truth_file = lambda *_: (open({str(reading)!r}, 'w').close(), time.sleep(1e6))\n"
        "sys.argv[1:] = ['run', 'ideal', '--serial', 'off', '--can', 'off', "
        f"'--control', 'unix:{control}', *{NO_IMAGES_OPTIONS}]\n"
        "sys.exit(main())\n"
    )
    with (
        EmulatorProcess([sys.executable, "-c", text]),
        socket.socket(socket.AF_UNIX) as peer,
    ):  # ends by SIGTERM
        peer.connect(str(control))
        peer.sendall(b'{"do": "set_truth", "truth": {"kind": "file", "path": "/"}}\n')
        wait_until(reading.exists)


@pytest.mark.parametrize("started", [0, 1])
def test_a_start_that_is_interrupted_before_all_output_is_read_ends_the_emulator(started, monkeypatch):
    readers, start = [], threading.Thread.start

    def start_or_interrupt(thread):
        if len(readers) == started:
            raise KeyboardInterrupt
        readers.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_or_interrupt)
    process = EmulatorProcess([sys.executable, "-c", "import time; time.sleep(600)"])
    with pytest.raises(KeyboardInterrupt), process:
        pass
    assert not process.running
    assert not any(each.is_alive() for each in readers)


def test_an_interrupted_start_ends_the_emulator():
    text = "import os, signal, time; os.kill(os.getppid(), signal.SIGINT); time.sleep(600)"
    process = EmulatorProcess([sys.executable, "-c", text])
    with pytest.raises(KeyboardInterrupt), process:
        pass
    assert not process.running
