"""README and walk-through in a shell on a machine with a vcan0 (if need be, in a guest).

`tests/test_docs.py` sends the same frames on any bus.
"""

from __future__ import annotations

import contextlib
import os
import queue
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES_OPTIONS, needs_vcan0
from tests.typed_pages import PAGES, UNASKED, TypedPage, assert_shown, dumped
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.process, pytest.mark.socketcan, needs_vcan0]

HEARTBEAT = 0x705
"""Of the CANopen node, which the pages about other frames do not have."""


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


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """Environment of a user who has the product installed."""
    home = str(tmp_path_factory.mktemp("home"))
    return {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin:/sbin",
        "XDG_STATE_HOME": home,
        "HOME": home,
    }


@contextlib.contextmanager
def running(line: str, environment: dict[str, str]) -> Iterator[Typed]:
    typed = Typed(line, environment)
    try:
        yield typed
    finally:
        typed.end()


@pytest.fixture(scope="module")
def emulator():
    """The emulator that the last page starts; it has all options of the others."""
    run = PAGES["CANopen"].run
    assert all(set(shlex.split(page.run)) <= set(shlex.split(run)) for page in PAGES.values())
    with EmulatorThread([*shlex.split(run), *NO_IMAGES_OPTIONS]) as emulator:
        assert emulator.ready["can"] == "socketcan:vcan0"
        yield


@contextlib.contextmanager
def dump_of(page: TypedPage, environment: dict[str, str]) -> Iterator[Typed]:
    """Type the line that starts candump."""
    with running(page.candump, environment) as dump:
        with running("cangen vcan0 -g 20 -I 7FE", environment):
            dump.skip_past("7FE")  # candump listens
        subprocess.run(["cansend", "vcan0", "7FD#"], check=True, env=environment)
        dump.skip_past("7FD")  # nothing of cangen is under way any more
        yield dump


@pytest.mark.parametrize("name", PAGES)
def test_what_a_page_types_into_a_shell_is_answered_as_shown(name, shell, emulator):
    page = PAGES[name]
    keyboard = subprocess.Popen(["sh", "-e"], stdin=subprocess.PIPE, text=True, env=shell)
    with dump_of(page, shell) as dump, keyboard, keyboard.stdin as line:
        for exchange in page.exchanges:
            print(exchange.typed, file=line, flush=True)
            for shown in (exchange.sent, *exchange.answers):
                frame = dumped(dump.next_line())
                while shown.id != frame.id in {*UNASKED, HEARTBEAT}:
                    frame = dumped(dump.next_line())
                assert_shown(frame, shown, exchange.typed)
    assert keyboard.returncode == 0
