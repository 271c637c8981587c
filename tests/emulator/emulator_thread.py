"""`starhil run` in a thread of the tests: what it imports and the kernels are loaded already, where a process needs seconds for them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any
from unittest import mock

from starhil.emulator.launch import Emulator
from starhil.emulator.profile.pipeline_setup import make_pipeline
from starhil.hil_tests.client.loop_thread import LoopThread
from starhil.hil_tests.errors import EmulatorProcessError
from starhil.hil_tests.rig.emulator_process import REJECTED, EmulatorProcess, parse_ready_line
from starhil.protocol.errors import OneLineError
from tests.emulator.cli.command_line import run_command_line


class EmulatorThread(EmulatorProcess):
    """In place of an emulator process, from the same command line; what kills a process ends it in good order."""

    _running: Emulator
    _stack: ExitStack

    def start(self) -> EmulatorThread:
        with ExitStack() as stack:
            loop = stack.enter_context(closing(LoopThread("emulator")))
            emulator = loop.run(_made(_maker(self.command)))
            stack.callback(lambda: loop.run(emulator.close()))
            try:
                self.ready = parse_ready_line(loop.run(_ready(emulator)))
            except OneLineError as error:
                raise EmulatorProcessError(str(error)) from None
            self._running, self._stack = emulator, stack.pop_all()
        return self

    @property
    def running(self) -> bool:
        return True

    def stop(self) -> None:
        self._stack.close()
        if self._running.failed:
            raise EmulatorProcessError("the emulator could not write a file")

    kill = stop


def _maker(command: list[str]) -> Callable[[], Emulator]:
    """Return what makes the emulator of a command line; a worker process is replaced by a thread."""
    makers: list[Callable[[], Emulator]] = []

    def note(make: Callable[[], Emulator]) -> int:
        makers.append(make)
        return 0

    with (
        mock.patch("starhil.emulator.cli.run.serve", lambda make: make),
        mock.patch("starhil.emulator.simulation.threads.run_loop", note),
    ):
        status, _, errors = run_command_line(*command[command.index("run") :])
    if status:
        raise EmulatorProcessError(errors.strip().removeprefix(REJECTED))
    return makers[0]


def _in_thread(profile: Any, worker: None, **options: bool) -> Any:
    if profile.run.worker == "process":
        profile = profile.model_copy(update={"run": profile.run.model_copy(update={"worker": "thread"})})
    return make_pipeline(profile, worker, **options)


async def _made(make: Callable[[], Emulator]) -> Emulator:
    with mock.patch("starhil.emulator.run.run.make_pipeline", _in_thread):
        return make()


async def _ready(emulator: Emulator) -> str:
    await emulator.start()
    return await emulator.ready()
