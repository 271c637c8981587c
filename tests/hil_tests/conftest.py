"""A TCP hub in a thread for tests of the bench."""

from __future__ import annotations

import asyncio
import threading

import pytest

from protocol.hub import CanHub


@pytest.fixture
def hub():
    """Channel of a CAN hub at a free port."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    server = CanHub(port=0)
    asyncio.run_coroutine_threadsafe(server.start(), loop).result()
    yield f"socketcand:127.0.0.1:{server.port}/vcan0"
    asyncio.run_coroutine_threadsafe(server.close(), loop).result()
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()
