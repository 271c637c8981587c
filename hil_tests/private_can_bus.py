"""A CAN bus for one run: vcan0 if the kernel has it, or else a TCP hub on a free port."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from starhil.hil_tests.loop_thread import LoopThread
from starhil.protocol.hub import DEFAULT_BUS, CanHub
from starhil.protocol.transports.can import kernel_can_is_up


class HubThread:
    """A TCP hub on a free port in a thread; a context manager. Clients open `channel`."""

    def __init__(self) -> None:
        self._loop = LoopThread("can-hub")
        self._hub: CanHub | None = None
        self.channel = ""

    def start(self, port: int = 0) -> Self:
        """Start listening; port 0 for a free one."""
        hub = CanHub(port=port)
        self._loop.run(hub.start())
        self._hub = hub
        self.channel = f"socketcand:127.0.0.1:{hub.port}/{DEFAULT_BUS}"
        return self

    @property
    def port(self) -> int:
        """Port of the hub, 0 while it is stopped."""
        return 0 if self._hub is None else self._hub.port

    def stop(self) -> None:
        """Stop the hub; it can be started again."""
        if self._hub is not None:
            self._loop.run(self._hub.close())
            self._hub = None

    def close(self) -> None:
        """End the hub and its thread."""
        self.stop()
        self._loop.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_error: object) -> None:
        self.close()


@contextmanager
def private_can_bus() -> Iterator[str]:
    """Yield the channel of a CAN bus: vcan0 if the kernel has it, or else a private hub."""
    if kernel_can_is_up(DEFAULT_BUS):
        yield DEFAULT_BUS
        return
    with HubThread() as hub:
        yield hub.channel
