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
