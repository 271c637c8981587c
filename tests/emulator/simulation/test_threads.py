"""Computations in threads: their results and errors, and the end of a process that does not wait for them."""

import asyncio
import subprocess
import sys

import pytest

from starhil.emulator.simulation.threads import in_thread
from tests.waiting import PATIENCE_S

ENDLESS = """
import asyncio, time
from starhil.emulator.simulation.threads import in_thread

async def main():
    with __import__("contextlib").suppress(TimeoutError):
        await asyncio.wait_for(in_thread(time.sleep, 1e6), 0.1)

asyncio.run(main())
"""


def test_a_call_in_a_thread_returns_its_result_and_raises_its_error():
    async def scenario():
        assert await in_thread(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            await in_thread(divmod, 7, 0)

    asyncio.run(scenario())


def test_the_end_of_a_process_does_not_wait_for_a_call():
    assert subprocess.run([sys.executable, "-c", ENDLESS], timeout=PATIENCE_S, check=False).returncode == 0


SILENT = """
import asyncio, socket, time
from starhil.emulator.simulation.threads import run_loop

socket.getaddrinfo = lambda *_arguments: time.sleep(1e6)  # a name server that does not answer

async def main():
    with __import__("contextlib").suppress(TimeoutError):
        await asyncio.wait_for({}, 0.1)

run_loop(main())
"""


@pytest.mark.parametrize(
    "waiting", ["asyncio.open_connection('host.example', 1)", "asyncio.to_thread(time.sleep, 1e6)"]
)
def test_the_end_of_a_run_does_not_wait_for_a_name_server_or_a_driver(waiting):
    """A look-up, which a request for a truth can begin, delayed the end by 14 s."""
    program = SILENT.format(waiting)
    assert subprocess.run([sys.executable, "-c", program], timeout=PATIENCE_S, check=False).returncode == 0
