"""`starhil run` from its first import to the ready line."""

from __future__ import annotations

import asyncio
import gc
import sys

import pytest

from starhil.emulator import cli
from starhil.emulator.cli.run import serve
from tests.emulator.cli.command_line import signals_as_before


@pytest.fixture(autouse=True)
def process_as_before():
    """Let the other tests collect garbage and get signals."""
    with signals_as_before():
        yield
    gc.unfreeze()
    gc.enable()


class Started:
    """What `serve` calls of an emulator, ready at once and ended after its ready line."""

    failed = False

    def __init__(self) -> None:
        self.ended = asyncio.Event()

    async def start(self) -> None:
        pass

    async def ready(self) -> str:
        self.ended.set()
        return "ready"

    async def close(self) -> None:
        pass


@pytest.mark.parametrize(("command", "collected"), [("run", False), ("icd", True)])
def test_only_a_run_imports_without_collecting_garbage(monkeypatch, command, collected):
    states = []
    monkeypatch.setattr(sys, "argv", ["starhil", command, "run.worker=thread"])
    monkeypatch.setattr("starhil.emulator.cli.app.main", lambda: states.append(gc.isenabled()))
    monkeypatch.setattr("signal.signal", lambda *_: None)
    cli.main()
    assert states == [collected]


def test_an_emulator_that_is_ready_collects_garbage_but_not_what_was_imported():
    gc.disable()
    asyncio.run(serve(Started))
    assert gc.isenabled()
    assert gc.get_freeze_count() > 0
