"""The examples of docs/simulators.md, run unchanged; those of a simulator without images, which show nothing of it."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
import runpy
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from unittest import mock

import pytest

from starhil.hil_tests.rig.emulator_process import emulator_command
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from tests.emulator.cli.command_line import log_lines, run_command_line
from tests.emulator.emulator_thread import EmulatorThread
from tests.emulator.truth.simulators import blocks_of_42
from tests.process.conftest import NO_IMAGES
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

PAGE = (Path(__file__).parents[2] / "docs" / "simulators.md").read_text(encoding="utf-8")
FILES = {
    match[2]: match[1]
    for match in re.finditer(r"^```(?:python|toml)\n(# (\S+)\n.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
}

needs_basilisk = pytest.mark.skipif(
    importlib.util.find_spec("Basilisk") is None,
    reason="Basilisk is not installed; pip install 'starhil[basilisk]'",
)


def write_files(folder: Path, *names: str, **instead: str) -> None:
    """Write the files of the page, with the addresses of this run."""
    for name in names:
        text = FILES[name]
        for shown, actual in instead.items():
            text = text.replace({"serial": "/tmp/startracker", "port": "5500", "control": "/tmp/startracker-control",
                                 "can": "socketcand:127.0.0.1:29536/vcan0"}[shown], actual)  # fmt: skip
        (folder / name).write_text(text, encoding="utf-8")


def start(folder: Path, *command: str) -> subprocess.Popen[str]:
    # SIGINT as in a terminal, even if the tests run with it ignored
    return subprocess.Popen(
        [sys.executable, *command], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def ended(program: subprocess.Popen[str]) -> dict[str, list[float]]:
    """Wait for the end of a program; return what it prints."""
    with program:
        try:
            output, errors = program.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            program.kill()
            raise
    assert program.returncode == 0, errors
    return figures_of(output)


def run_here(folder: Path, *command: str) -> dict[str, list[float]]:
    """Run a program in this process, which has imported most of what it needs; return what it prints."""
    output = io.StringIO()
    with (
        contextlib.chdir(folder),
        mock.patch.object(sys, "argv", [*command]),
        contextlib.redirect_stdout(output),
    ):
        runpy.run_path(command[0], run_name="__main__")
    return figures_of(output.getvalue())


def figures_of(output: str) -> dict[str, list[float]]:
    """Return the numbers in a text by the words before them in their line."""
    lines = [re.match(r"(\D+?):? *([-\d].*|\[.*)$", line) for line in output.splitlines()]
    return {
        line[1]: [float(number) for number in re.findall(r"\d+(?:\.\d+)?", line[2])] for line in lines if line
    }


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


@needs_basilisk
def test_basilisk_in_lock_step(tmp_path):
    port = str(free_port())
    write_files(tmp_path, "basilisk.toml", port=port)
    command = emulator_command(profile=str(tmp_path / "basilisk.toml"), settings=NO_IMAGES)
    with EmulatorThread(command) as emulator:
        write_files(tmp_path, "orbit.py", port=port, serial=emulator.ready["serial"])
        figures = run_here(tmp_path, "orbit.py", "60")
    assert figures["attitudes read"][0] > 56
    assert figures["largest error of the rate"][0] < 0.01
    assert figures["within"][1] >= 99.7


@needs_basilisk
def test_basilisk_in_real_time(tmp_path):
    port = str(free_port())
    write_files(tmp_path, "basilisk.toml", port=port)
    command = emulator_command(
        profile=str(tmp_path / "basilisk.toml"),
        settings=["truth.lockstep=false", *NO_IMAGES],
        truth_log=tmp_path / "truth.csv",
        extra=["--clock", "real"],
    )
    with EmulatorThread(command) as emulator:
        write_files(tmp_path, "orbit.py", "obc.py", port=port, serial=emulator.ready["serial"])
        obc = start(tmp_path, "obc.py")
        assert ended(start(tmp_path, "orbit.py", "6", "--real-time")) == {}
        obc.send_signal(signal.SIGINT)
        figures = ended(obc)
    assert figures["attitudes read"][0] >= 3
    assert figures["largest error of the attitude"][0] < 20.0


@needs_basilisk
def test_a_basilisk_feed_without_a_listener_is_reported():
    from starhil.basilisk import StarTrackerFeed, StarTrackerFeedError

    with pytest.raises(StarTrackerFeedError, match="no emulator"):
        StarTrackerFeed(f"tcp:127.0.0.1:{free_port()}")
    with pytest.raises(StarTrackerFeedError, match="must be udp:HOST:PORT"):
        StarTrackerFeed("127.0.0.1:5500")


def send_as_42(server: socket.socket, blocks: list[bytes]) -> None:
    """Send the blocks as 42 does, each after the acknowledge of the one before."""
    connection, _ = server.accept()
    connection.settimeout(PATIENCE_S)
    with connection:
        for block in blocks:
            connection.sendall(block)
            acknowledge = connection.recv(4, socket.MSG_WAITALL)
            if acknowledge != b"Ack\0":
                return


def test_42_in_lock_step_and_its_recording(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        command = emulator_command(
            profile="ideal",
            settings=["truth.kind=42", f"truth.port={server.getsockname()[1]}", "parameters.start_mode=lost_in_space", *NO_IMAGES],
            truth_log=tmp_path / "truth.csv",
            extra=["--clock", "stepped", "--record", str(tmp_path / "recorded")],
        )  # fmt: skip
        with EmulatorThread(command) as emulator:
            write_files(tmp_path, "obc.py", serial=emulator.ready["serial"])
            simulator = threading.Thread(target=send_as_42, args=(server, blocks_of_42(201)), daemon=True)
            simulator.start()
            figures = run_here(tmp_path, "obc.py")
            simulator.join(PATIENCE_S)
            assert not simulator.is_alive()
    assert len((tmp_path / "truth.csv").read_text().splitlines()) == 21
    assert figures["attitudes read"][0] >= 1
    assert figures["largest error of the attitude"][0] < 20.0
    assert figures["largest error of the rate"][0] < 0.01
    status, out, said = run_command_line("replay", str(tmp_path / "recorded"))
    assert (status, log_lines(said)) == (0, [])
    assert "entries played: identical" in out


def test_two_heads_on_one_bus(tmp_path):
    write_files(tmp_path, "first.toml", "second.toml")
    control = tmp_path / "control"
    heads = ["--head", str(tmp_path / "first.toml"), "--head", str(tmp_path / "second.toml")]
    with private_can_bus() as bus:
        command = emulator_command(serial="off", can=bus, extra=[*heads, "--control", f"unix:{control}"])
        with EmulatorThread(command) as emulator:
            assert emulator.ready["can.2"] == emulator.ready["can"] == bus
            assert emulator.ready["seed.2"] != emulator.ready["seed"]
            write_files(tmp_path, "heads.py", can=bus, control=str(control))
            figures = run_here(tmp_path, "heads.py")
    assert figures["attitudes read"] == [30.0, 30.0]
    assert figures["the two heads agree on the body within"][0] < 20.0
