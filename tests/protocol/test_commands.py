"""The commands `starhil icd` and `starhil hub` as a user runs them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest

from starhil.protocol.unit import load_unit
from tests.candump import read_candump
from tests.emulator.cli.command_line import run_command_line
from tests.waiting import PATIENCE_S

STARHIL = [sys.executable, "-c", "from starhil.emulator.cli.app import main; main()"]


def test_export_writes_stdout_or_a_whole_file(tmp_path: Path) -> None:
    status, text, said = run_command_line("icd", "export", "markdown")
    assert (status, said) == (0, "")
    file = tmp_path / "icd.md"
    assert run_command_line("icd", "export", "markdown", "-o", str(file)) == (0, "", "")
    assert file.read_text() == text
    assert list(tmp_path.iterdir()) == [file]


def test_list_prints_every_row_and_parameter() -> None:
    done = json.loads(run_command_line("icd", "list", "--json")[1])
    icd = load_unit()
    assert [(row["id"], row["name"], row["size"]) for row in done["rows"]] == [
        (r.id, r.name, r.size) for r in icd.rows
    ]
    assert [parameter["name"] for parameter in done["parameters"]] == list(icd.parameters)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("icd", "export", "html", "-o", "/proc/does/not/exist/icd.html"),
            "starhil: /proc/does/not/exist/icd.html: its folder cannot be created",
        ),
        (
            ("icd", "export", "html", "--unit", "/does/not/exist"),
            "starhil: unit '/does/not/exist': not found; give a path, or one of: cubestar",
        ),
        (("hub", "--host", "203.0.113.1", "--port", "1"), "starhil: CAN hub: cannot listen at 203.0.113.1:1"),
    ],
)
def test_bad_input_is_one_line_and_exit_status_2(arguments: tuple[str, ...], message: str) -> None:
    status, _, said = run_command_line(*arguments)
    assert status == 2
    assert said.startswith(message)
    assert said.count("\n") == 1


@pytest.mark.process
def test_the_hub_as_a_process_serves_two_clients_logs_and_ends_on_sigterm(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    with subprocess.Popen(
        [*STARHIL, "hub", "--port", "0", "--log", str(log)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            ready = process.stdout.readline()
            assert ready.startswith("ready can=socketcand:127.0.0.1:")
            port = int(ready.rpartition(":")[2].partition("/")[0])
            message = can.Message(arbitration_id=0x08AA0401, data=b"\x1f\x02")
            with (
                can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="vcan0") as one,
                can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="vcan0") as two,
            ):
                one.send(message)
                received = two.recv(10)
            assert received is not None
            assert (received.arbitration_id, received.data) == (0x08AA0401, b"\x1f\x02")
        finally:
            process.send_signal(signal.SIGTERM)
        last = process.stdout.read()
        assert process.wait(PATIENCE_S) == 0
    assert last == "frames=1 delivered=1 dropped=0 errors=0\n"
    assert [(channel, frame.id, frame.data) for channel, frame in read_candump(log)] == [
        ("vcan0", 0x08AA0401, b"\x1f\x02")
    ]
