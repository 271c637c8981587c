"""The composition root: makes an emulation with its truth log, faults, scenario and control channel."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from starhil.emulator.control.channel import ControlServer
from starhil.emulator.control.faults import Faults
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.emulation import Emulation
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import close_all
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
    """

    truth_log: Path | None = None
    overwrite: bool = False
    control: str = "off"
    control_token: str = ""
    scenario: str = ""


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
        self.emulation = Emulation(profile, worker)
        self.options = options or RunOptions()
        self.ended = asyncio.Event()
        self.control: ControlServer | None = None
        self._faults: Faults | None = None
        self._truth_log: TruthLog | None = None

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
            wall_times = self.emulation.clock.speed > 0.0
            self._truth_log = TruthLog(options.truth_log, overwrite=options.overwrite, wall_times=wall_times)
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
        except (EmulatorError, ProtocolError):
            device.withdraw_start()
            raise
        emulation.begin()

    async def close(self) -> None:
        """Close the control channel, the emulation and the truth log, whatever fails to close."""
        closers: list[Callable[[], object]] = [self.emulation.close]
        if self.control is not None:
            closers.insert(0, self.control.close)
        if self._truth_log is not None:
            closers.append(self._truth_log.close)
        await close_all(closers)
