"""Synchronous OBC client; rows and fields have their names in the interface definition."""

from __future__ import annotations

import functools
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from starhil.hil_tests.client.async_client import DEFAULT_TIMEOUT_S, AsyncObcClient
from starhil.hil_tests.client.images import download_image
from starhil.hil_tests.client.links import (
    DEFAULT_BAUD,
    DEFAULT_DEVICE_ADDRESS,
    DEFAULT_HOST_ADDRESS,
    CanHostLink,
    HostLink,
    SerialHostLink,
)
from starhil.hil_tests.client.loop_thread import LoopThread
from starhil.hil_tests.client.wire_log import WireLog
from starhil.hil_tests.errors import HIDDEN_BEHIND_ONE_LINE, BenchError
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import Reply
from starhil.protocol.unit import load_unit

__tracebackhide__ = HIDDEN_BEHIND_ONE_LINE

Parameters = ParamSpec("Parameters")
T = TypeVar("T")


def _synchronous(
    method: Callable[Concatenate[AsyncObcClient, Parameters], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[ObcClient, Parameters], T]:
    """Return a method of `ObcClient` that runs one of `AsyncObcClient`, or a function of one, in the client's loop."""

    @functools.wraps(method)
    def run(client: ObcClient, /, *args: Parameters.args, **fields: Parameters.kwargs) -> T:
        return client.run(method(client.core, *args, **fields))

    return run


class ObcClient:
    """A synchronous OBC client for scripts, tests and interactive use.

    Its event loop runs in a separate thread.

    Create it with `ObcClient.open(...)` and use it as a context manager::

        with ObcClient.open(serial="/dev/pts/3") as obc:
            obc.command("set_mode", mode="lost_in_space")
            print(obc.wait_for("precise_attitude", lambda reading: reading["valid"], within_s=20))
    """

    def __init__(self, core: AsyncObcClient) -> None:
        self.core = core
        self.icd = core.icd
        """The interface definition of the unit."""
        self.transactions = core.transactions
        """The latest requests, with outcome and latency."""
        self.faults = core.faults
        """The latest invalid inputs."""
        self.stray_replies = core.stray_replies
        """The latest replies without a request."""
        self._loop = LoopThread("obc-client")
        try:
            self.run(core.start())
        except BaseException:
            self._loop.close()
            raise

    @classmethod
    def open(
        cls,
        *,
        serial: str | None = None,
        can: str | None = None,
        dialect: str | None = None,
        baud: int = DEFAULT_BAUD,
        host_address: int = DEFAULT_HOST_ADDRESS,
        device_address: int = DEFAULT_DEVICE_ADDRESS,
        unit: str | InterfaceDefinition = DEFAULT_UNIT,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = 0,
        log: WireLog | None = None,
    ) -> Self:
        """Open a client on a serial port (`/dev/…`, `socket://host:port`) or on a CAN channel.

        On CAN it is a CANopen master if CANopen is the only protocol of the unit there. `unit` is the name of
        a bundled unit, a folder, or a definition.
        """
        if (serial is None) == (can is None):
            raise BenchError("an OBC client needs either a serial port or a CAN channel")
        icd = load_unit(unit) if isinstance(unit, str) else unit
        link: HostLink[Any]
        if serial is not None:
            link = SerialHostLink(icd, serial, dialect=dialect, baud=baud, log=log)
        elif icd.link.can is None and icd.canopen is not None:
            from starhil.hil_tests.client.canopen_link import CanopenHostLink

            link = CanopenHostLink(icd, str(can), log=log)
        else:
            link = CanHostLink(str(can), host_address=host_address, device_address=device_address, log=log)
        return cls(AsyncObcClient(link, icd, timeout_s=timeout_s, retries=retries))

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the client's loop and return its result."""
        return self._loop.run(coroutine)

    def close(self) -> None:
        """Close the link and end the thread; may be called twice."""
        if self._loop.alive:
            self.run(self.core.close())
            self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    read = _synchronous(AsyncObcClient.read)
    telemetry = _synchronous(AsyncObcClient.telemetry)
    command = _synchronous(AsyncObcClient.command)
    command_raw = _synchronous(AsyncObcClient.command_raw)
    set_parameter = _synchronous(AsyncObcClient.set_parameter)
    get_parameter = _synchronous(AsyncObcClient.get_parameter)
    read_parameter = _synchronous(AsyncObcClient.read_parameter)
    wait_for = _synchronous(AsyncObcClient.wait_for)
    wait_unsolicited = _synchronous(AsyncObcClient.wait_unsolicited)
    download_image = _synchronous(download_image)

    def request(
        self,
        identifier: int,
        data: bytes = b"",
        *,
        message_class: str | None = None,
        timeout_s: float | None = None,
    ) -> Reply:
        """Send a request by row ID (and class, if the unit has classes), data as bytes; return the reply."""
        request = self.icd.request_of(identifier, message_class, data)
        return self.run(self.core.transact(request, f"request {identifier}", timeout_s=timeout_s))[0]
