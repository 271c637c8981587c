"""The composition root: makes an emulation with its truth log, faults, scenario, control channel and console."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from starhil.emulator.console.obc import MakeClient, ObcClient, ObcPort
from starhil.emulator.control.channel import ControlServer
from starhil.emulator.control.faults import Faults
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.emulation import Emulation
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import close_all
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.pipeline.worker_process import WorkerProcess
from starhil.emulator.profile import Profile
from starhil.emulator.truth_log import TruthLog
from starhil.protocol.errors import ProtocolError


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that are not part of the profile.

    Attributes
    ----------
    truth_log
        CSV file of truth and measurement, one row per frame.
    overwrite
        Replace an existing truth log.
    control
        `off`, `auto` (a Unix socket for this user alone), unix:/PATH or HOST:PORT.
    control_token
        Token that each request on the control channel must carry; empty for none.
    scenario
        Name or path of a scenario; empty for none.
    view
        Address of the console: `off`, `auto` (the loopback interface, a free port) or HOST:PORT.
    record
        MCAP file of images, truth, telemetry and events.
    make_client
        Makes the OBC of console and recording; needed for these two.
    """

    truth_log: Path | None = None
    overwrite: bool = False
    control: str = "off"
    control_token: str = ""
    scenario: str = ""
    view: str = "off"
    record: Path | None = None
    make_client: MakeClient | None = None

    @property
    def watched(self) -> bool:
        """Whether a console or a recording looks at the frames."""
        return self.view != "off" or self.record is not None


class Run:
    """An emulation with its truth log, faults, scenario and control channel.

    Parameters
    ----------
    profile
        Profile of the unit.
    options
        Options that are not part of the profile.
    worker
        Pipeline worker that was started earlier; by default one is started here.

    Attributes
    ----------
    ended
        Set when the run is to end.
    """

    def __init__(
        self, profile: Profile, options: RunOptions | None = None, worker: WorkerProcess | None = None
    ) -> None:
        self.options = options or RunOptions()
        self.emulation = Emulation(profile, worker, previews=self.options.watched)
        self.ended = asyncio.Event()
        self.control: ControlServer | None = None
        self._faults: Faults | None = None
        self._truth_log: TruthLog | None = None
        self._closers: list[Callable[[], object]] = []
        """Closers of console and recording, in the order of opening."""

    @property
    def faults(self) -> Faults:
        """The faults of the run.

        Raises
        ------
        EmulatorError
            The run was not started.
        """
        if self._faults is None:
            raise EmulatorError("run: not started")
        return self._faults

    async def start(self) -> None:
        """Open files, links and control channel, switch the device on and let time pass.

        Raises
        ------
        EmulatorError, ProtocolError
            A file, port or bus is not available; one line.
        """
        options = self.options
        scenario = load_scenario(options.scenario) if options.scenario else None
        if options.truth_log is not None:
            self._truth_log = TruthLog(options.truth_log, overwrite=options.overwrite)
        emulation = self.emulation
        await emulation.open()
        device = emulation.device
        self._faults = Faults(device, emulation.links)
        if self._truth_log is not None:
            device.on_frame.append(self._truth_log.write)
        try:
            if scenario is not None:
                scenario.enter(device.scheduler, self._faults, emulation.set_truth, emulation.profile.folder)
            if options.control != "off":
                self.control = ControlServer(emulation, self._faults, self.ended.set, options.control_token)
                emulation.ready_fields["control"] = await self.control.start(options.control)
            if options.watched:
                await self._open_console(self._faults)
        except (EmulatorError, ProtocolError):
            device.withdraw_start()
            raise
        emulation.begin()

    async def close(self) -> None:
        """Close the control channel, the emulation and the truth log, whatever fails to close."""
        closers: list[Callable[[], object]] = [*reversed(self._closers), self.emulation.close]
        self._closers.clear()
        if self.control is not None:
            closers.insert(0, self.control.close)
        if self._truth_log is not None:
            closers.append(self._truth_log.close)
        await close_all(closers)

    async def _open_console(self, faults: Faults) -> None:
        """Open console and recording, with an OBC on the bus of the run."""
        options, emulation = self.options, self.emulation
        client = await self._open_obc()
        if options.record is not None:
            from starhil.emulator.console.recorder import Recorder

            recorder = Recorder(emulation, client, options.record, overwrite=options.overwrite)
            self._closers.append(recorder.close)
            recorder.start()
        if options.view != "off":
            from starhil.emulator.console.console import Console
            from starhil.emulator.console.server import ConsoleServer

            control = ControlServer(emulation, faults, self.ended.set)
            console = Console(emulation, control.execute, client)
            self._closers.append(console.close)
            console.start()
            server = ConsoleServer(console)
            self._closers.append(server.close)
            emulation.ready_fields["view"] = await server.start(options.view)

    async def _open_obc(self) -> ObcClient:
        """Open an OBC on the CAN bus of the run, or on a link of its own if the unit has no bus there.

        Raises
        ------
        EmulatorError
            The caller has given no `make_client`.
        """
        make_client, emulation = self.options.make_client, self.emulation
        if make_client is None:
            raise EmulatorError("run: console and recording need make_client")
        device, has = emulation.device, emulation.icd.link
        bus: Literal["can", "serial", ""] = "can" if has.can is not None else ""
        where = emulation.ready_fields["can"] if emulation.can is not None else ""
        own: SerialLink | CanLink | None = None
        from starhil.protocol.transports.can import open_can
        from starhil.protocol.transports.serial import open_serial

        if bus and not where:
            where = f"virtual:starhil-console-{os.getpid()}"
            own = CanLink(emulation.requests, open_can(where))
        elif not bus and has.serial is not None:
            bus = "serial"
            own = SerialLink(emulation.requests, open_serial("auto", paced=False))
        if own is not None:
            self._closers.append(own.close)
            where = await own.start()
        port = ObcPort(
            bus,
            where,
            emulation.icd,
            device_address=lambda: int(device.parameters["can_address"]),
            dialect=lambda: own.dialect if isinstance(own, SerialLink) else None,
        )
        client = make_client(port)
        self._closers.append(client.close)
        await client.start()
        return client
