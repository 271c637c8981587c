"""README and walk-through in a shell on a machine with a vcan0 (if need be, in a guest)."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.process.conftest import needs_vcan0
from tests.test_docs import UNASKED, Exchange, blocks, dumped, exchanges, fixed

pytestmark = [pytest.mark.process, pytest.mark.socketcan, needs_vcan0]

ROOT = Path(__file__).parents[2]
READY_WITHIN_S = 180.0
PATIENCE_S = 30.0


class Typed:
    """A command line that was typed into a shell and goes on; its output comes line by line."""

    def __init__(self, line: str, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            ["sh", "-c", f"exec {line}"], stdout=subprocess.PIPE, text=True, bufsize=1, env=environment
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self._lines.put(line)

    def next_line(self, within_s: float = PATIENCE_S) -> str:
        return self._lines.get(timeout=within_s)

    def skip_past(self, identifier: str) -> None:
        """Discard the output of candump up to and including a frame."""
        while self.next_line().split()[1] != identifier:
            pass

    def end(self) -> None:
        self._process.terminate()
        self._process.wait()
        self._reader.join()
        self._process.stdout.close()


@pytest.fixture
def shell(tmp_path):
    """Environment of a user who has the product installed."""
    return {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin:/sbin",
        "XDG_STATE_HOME": str(tmp_path),
        "HOME": str(tmp_path),
    }


@contextlib.contextmanager
def running(line: str, environment: dict[str, str]) -> Iterator[Typed]:
    typed = Typed(line, environment)
    try:
        yield typed
    finally:
        typed.end()


@contextlib.contextmanager
def emulator_and_dump(lines: list[str], environment: dict[str, str]) -> Iterator[Typed]:
    """Type the lines that start the emulator and candump; give the dump."""
    (run,) = [line for line in lines if line.startswith("starhil run")]
    (candump,) = [line for line in lines if line.startswith("candump")]
    with running(run, environment) as emulator:
        assert emulator.next_line(READY_WITHIN_S).startswith("ready can=socketcan:vcan0 ")
        with running(candump.removesuffix(" &"), environment) as dump:
            with running("cangen vcan0 -g 20 -I 7FE", environment):
                dump.skip_past("7FE")  # candump listens
            subprocess.run(["cansend", "vcan0", "7FD#"], check=True, env=environment)
            dump.skip_past("7FD")  # nothing of cangen is under way any more
            yield dump


def check(found: list[Exchange], dump: Typed, environment: dict[str, str]) -> None:
    """Type each cansend line.

    Candump must show what the text shows, but for what depends on time and noise.
    """
    for exchange in found:
        subprocess.run(["sh", "-c", exchange.typed], check=True, env=environment)
        for shown in (exchange.sent, *exchange.answers):
            frame = dumped(dump.next_line())
            while shown.id != frame.id in UNASKED:
                frame = dumped(dump.next_line())
            assert (hex(frame.id), frame.extended, len(frame.data)) == (
                hex(shown.id),
                shown.extended,
                len(shown.data),
            ), exchange.typed
            assert fixed(frame) == fixed(shown), exchange.typed


def test_the_walk_through_with_can_utils(shell):
    (start,) = [
        b.text
        for b in blocks("walkthrough.md")
        if b.heading == "1. CAN with can-utils" and b.language == "sh"
    ]
    found = exchanges({"Identification", "Mode and attitude", "Unsolicited telemetry", "Refusals"})
    assert len(found) == 10
    with emulator_and_dump(start.splitlines(), shell) as dump:
        check(found, dump, shell)


def test_the_walk_through_with_a_canopen_node(shell):
    (start,) = [b.text for b in blocks("walkthrough.md") if b.heading == "2. CANopen" and b.language == "sh"]
    text = (ROOT / "docs" / "walkthrough.md").read_text(encoding="utf-8")
    (candump,) = re.findall(r"`(candump vcan0,\S+)`", text)
    found = exchanges({"With cansend"})
    assert len(found) == 10
    with emulator_and_dump([*start.splitlines(), candump], shell) as dump:
        check(found, dump, shell)


def test_the_readme(shell):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text[text.index("**SocketCAN**") : text.index("**Where the kernel has no CAN**")]
    lines = [line.strip() for line in section.splitlines() if line.startswith("    ")]
    sent = [line for line in lines if line.startswith("cansend")]
    assert len(sent) == 3
    with emulator_and_dump(lines, shell) as dump:
        for line, answer, size in zip(sent, (0x05800401, 0x02600401, 0x05E60401), (8, 0, 6), strict=True):
            subprocess.run(["sh", "-c", line], check=True, env=shell)
            assert f"{dumped(dump.next_line()).id:08X}#" in line
            frame = dumped(dump.next_line())
            assert (hex(frame.id), len(frame.data)) == (hex(answer), size), line
