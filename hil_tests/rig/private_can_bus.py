"""A CAN bus for one run: vcan0 if the kernel has it, or else a TCP hub on a free port."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from starhil.hil_tests.client.loop_thread import LoopThread
from starhil.protocol.transports.can import kernel_can_is_up
from starhil.protocol.transports.hub import DEFAULT_BUS, CanHub


@contextmanager
def hub_thread(port: int = 0) -> Iterator[str]:
    """Run a TCP hub in a thread, on a free port if `port` is 0; yield the channel that clients open."""
    with closing(LoopThread("can-hub")) as loop:
        hub = CanHub(port=port)
        loop.run(hub.start())
        try:
            yield f"socketcand:127.0.0.1:{hub.port}/{DEFAULT_BUS}"
        finally:
            loop.run(hub.close())


@contextmanager
def private_can_bus() -> Iterator[str]:
    """Yield the channel of a CAN bus: vcan0 if the kernel has it, or else a private hub."""
    if kernel_can_is_up(DEFAULT_BUS):
        yield DEFAULT_BUS
        return
    with hub_thread() as channel:
        yield channel
