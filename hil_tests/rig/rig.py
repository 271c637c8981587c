"""Access to the unit under test: clients and logs on its links, and the emulator if there is one."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from starhil.hil_tests.attitude import Quaternion, unit
from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.client.async_client import DEFAULT_TIMEOUT_S
from starhil.hil_tests.client.links import DEFAULT_BAUD, DEFAULT_DEVICE_ADDRESS, DEFAULT_HOST_ADDRESS
from starhil.hil_tests.client.wire_log import WireLog
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.links import BUSES
from starhil.hil_tests.rig.control import ControlClient
from starhil.hil_tests.rig.emulator_process import EmulatorProcess
from starhil.protocol.can.frame import bus_name
from starhil.protocol.icd import InterfaceDefinition

OFF: Final = "off"
"""A link that is not used, in options of all commands."""


def links_to_use(
    serial: str | None, can: str | None, by_default: tuple[str | None, str | None] = (None, None)
) -> tuple[str | None, str | None]:
    """Return serial port and CAN channel to use, None for a link that is not: `OFF`, or not named beside one that is.

    `by_default` holds for links of which nothing is said, if none is named.
    """
    if {serial, can} <= {None, OFF}:
        serial, can = (
            default if named is None else named
            for named, default in zip((serial, can), by_default, strict=True)
        )
    return None if serial == OFF else serial, None if can == OFF else can


def check_links(serial: str | None, can: str | None, options: str, *, start: bool) -> None:
    """Raise an error if no link is in use, naming the `options` that give one unless an emulator is started.

    The CAN channel `auto` is a bus whether or not one is started; the serial port `auto` is that of the one that is.
    """
    if serial is None and can is None:
        remedy = "the emulator needs --serial auto or --can auto" if start else f"use {options}, or --start"
        raise BenchError(f"no link: {remedy}")
    if serial == "auto" and not start:
        raise BenchError("--serial auto needs --start; otherwise name the port")


@dataclass(frozen=True)
class LinkOptions:
    """Options of the links and of the clients.

    `serial` and `can` are port and channel, None if the link is not used, `auto` for those on the ready line of the emulator
    that the bench started.
    """

    serial: str | None = None
    can: str | None = None
    dialect: str | None = None
    baud: int = DEFAULT_BAUD
    host_address: int = DEFAULT_HOST_ADDRESS
    device_address: int = DEFAULT_DEVICE_ADDRESS
    timeout_s: float = DEFAULT_TIMEOUT_S
    retries: int = 0

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links in use: `serial`, `can` or both."""
        return tuple(name for name in BUSES if getattr(self, name) is not None)


class Rig:
    """Clients of one unit: a context manager that opens them on first use and closes them all.

    On exit it raises `EmulatorProcessError` if the emulator ended unexpectedly or does not end cleanly.

    The bench starts and ends `emulator`, a process that has not been started; `control` is the control channel of one that
    runs already; `log_folder` gets `serial.log` and `can.log`.
    """

    def __init__(
        self,
        options: LinkOptions,
        icd: InterfaceDefinition,
        *,
        emulator: EmulatorProcess | None = None,
        control: str | None = None,
        log_folder: Path | None = None,
    ) -> None:
        self.options = options
        self.links = options.links
        self.icd = icd
        self.emulator = emulator
        self._control_address = control
        self.log_folder = log_folder
        self.logs: dict[str, WireLog] = {}
        self._clients: dict[str, ObcClient] = {}
        self._stack = ExitStack()

    def client(self, link: str) -> ObcClient:
        """Return the client on a link, opened at the first call."""
        if link not in self.links:
            raise BenchError(f"this bench has no {link} link; it has {' and '.join(self.links)}")
        if link not in self._clients:
            self._clients[link] = self._open(link)
        return self._clients[link]

    def _open(self, link: str) -> ObcClient:
        port = self._port(link)
        if self.log_folder is not None and link not in self.logs:
            bus = bus_name(port) if link == "can" else ""
            self.logs[link] = self._stack.enter_context(WireLog(self.log_folder / f"{link}.log", bus))
        others: dict[str, None] = dict.fromkeys(BUSES)
        options = {**vars(self.options), **others, link: port}
        return ObcClient.open(**options, unit=self.icd, log=self.logs.get(link))

    def _port(self, link: str) -> str:
        port = str(getattr(self.options, link))
        if self.emulator is None or port != "auto":
            return port
        if link not in self.emulator.ready:
            raise BenchError(
                f"the emulator did not open a {link} link; its ready line has {self.emulator.ready}"
            )
        return self.emulator.ready[link]

    @property
    def _own_emulator(self) -> EmulatorProcess:
        if self.emulator is None:
            raise BenchError("only an emulator that the bench started can do this: use --start")
        return self.emulator

    def close_clients(self) -> None:
        """Close all clients; they are opened again on next use."""
        clients, self._clients = list(self._clients.values()), {}
        for client in clients:
            client.close()

    def control(self, action: str, keys: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request on the control channel of the emulator, and return its answer.

        Raises BenchError: the request was rejected, or there is no control channel.
        """
        address = self._control_address or self._own_emulator.ready["control"]
        with ControlClient(address) as channel:
            return channel.do(action, **keys)

    @property
    def has_control_of_another(self) -> bool:
        """Whether the bench has the control channel of an emulator that it did not start."""
        return self._control_address is not None

    def restart(self, how: str) -> None:
        """End the emulator by SIGTERM (`term`) or SIGKILL (`kill`) and start it again.

        Raises BenchError: the unit is not an emulator that the bench started.
        """
        emulator = self._own_emulator
        self.close_clients()
        emulator.restart(signal.SIGKILL if how == "kill" else signal.SIGTERM)

    def __enter__(self) -> Self:
        if self.log_folder is not None:
            self.log_folder.mkdir(parents=True, exist_ok=True)
        if self.emulator is not None:
            self._stack.enter_context(self.emulator)
        self._stack.callback(self.close_clients)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


class ControlledTruth:
    """The true attitude over time, by the control channel of the emulator."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig

    def at(self, time_s: float) -> Quaternion:
        """Return the attitude at a Unix time of the device's clock."""
        return unit(self._rig.control("truth", {"unix_s": time_s})["quaternion_xyzw"])
