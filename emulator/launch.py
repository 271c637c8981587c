"""The composition root: builds one or several heads with truth logs, faults, scenario, control channel and console."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from starhil.emulator.clock import make_clock
from starhil.emulator.console.obc import MakeClient, ObcClient
from starhil.emulator.control.channel import ControlServer, ControlTarget
from starhil.emulator.control.faults import Faults
from starhil.emulator.control.scenario import Scenario, load_scenario
from starhil.emulator.emulation import Emulation
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import close_all
from starhil.emulator.output_file import OutputFile
from starhil.emulator.pipeline.worker_process import WorkerProcess
from starhil.emulator.profile import Profile
from starhil.emulator.tape import TRUTH_FILE, Recorder
from starhil.emulator.truth.config import TruthConfig
from starhil.emulator.truth.source import TruthSource
from starhil.emulator.truth_log import TruthLog
from starhil.protocol.errors import ProtocolError

if TYPE_CHECKING:
    from starhil.emulator.console.recorder import McapRecorder


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that are not part of the profile.

    Attributes
    ----------
    truth_log
        CSV file of truth and measurement, one row per frame; one file per head (`path_of_head`).
    overwrite
        Replace an existing truth log.
    control
        `off`, `auto` (a Unix socket that only this user can open), unix:/PATH or HOST:PORT.
    control_token
        Token that each request on the control channel must contain; empty for none.
    scenario
        Name or path of a scenario; empty for none.
    record
        Folder of a recording of the run, for a replay.
    view
        Address of the console: `off`, `auto` (the loopback interface, a free port) or HOST:PORT.
    mcap
        MCAP file of images, truth, telemetry and events; one file per head (`path_of_head`).
    make_client
        Makes the OBC for console and MCAP file; required for these.
    """

    truth_log: Path | None = None
    overwrite: bool = False
    control: str = "off"
    control_token: str = ""
    scenario: str = ""
    record: Path | None = None
    view: str = "off"
    mcap: Path | None = None
    make_client: MakeClient | None = None

    @property
    def watched(self) -> bool:
        """Whether a console or an MCAP file uses the images."""
        return self.view != "off" or self.mcap is not None


class Head:
    """One device of a run, with its faults and truth log.

    Parameters
    ----------
    number
        Number of the head; the first is 1.
    emulation
        Device, pipeline and links.
    """

    def __init__(self, number: int, emulation: Emulation) -> None:
        self.number = number
        self.emulation = emulation
        self._faults: Faults | None = None
        self._truth_logs: list[TruthLog] = []

    @property
    def faults(self) -> Faults:
        """The faults of the head.

        Raises
        ------
        EmulatorError
            The run was not started.
        """
        if self._faults is None:
            raise EmulatorError("run: not started")
        return self._faults

    def open_logs(self, options: RunOptions, recorder: Recorder | None) -> None:
        """Open the truth log and the recording's truth log."""
        wall_times = self.emulation.clock.speed > 0.0
        if options.truth_log is not None:
            path = path_of_head(options.truth_log, self.number)
            self._truth_logs.append(TruthLog(path, overwrite=options.overwrite, wall_times=wall_times))
        if recorder is not None:
            path = recorder.folder / TRUTH_FILE
            self._truth_logs.append(TruthLog(path, wall_times=wall_times, output=recorder.output))

    async def open(self) -> None:
        """Open the links and switch the device on."""
        emulation = self.emulation
        await emulation.open()
        self._faults = Faults(emulation.device, emulation.links)
        for log in self._truth_logs:
            emulation.device.signals.frame_published.connect(log.write)

    def enter(self, scenario: Scenario) -> None:
        """Schedule a scenario; only the first head sets its truth."""
        emulation = self.emulation
        set_truth = emulation.set_truth if self.number == 1 else _leave_truth
        scenario.enter(emulation.device.scheduler, self.faults, set_truth, emulation.profile.folder)

    @property
    def files(self) -> list[OutputFile]:
        """The truth logs."""
        return [log.file for log in self._truth_logs]


class Run:
    """A run of one or several heads, with truth logs, faults, scenario and control channel.

    Parameters
    ----------
    profile
        Profile of the unit, or of the first head.
    options
        Options that are not part of the profile.
    worker
        Pipeline worker that was started earlier; by default one is started here.
    others
        Profiles of further heads on the same truth and clock.

    Attributes
    ----------
    ended
        Set to end the run.

    Raises
    ------
    EmulatorError
        Two heads are incompatible; one line.
    """

    def __init__(
        self,
        profile: Profile,
        options: RunOptions | None = None,
        worker: WorkerProcess | None = None,
        others: Sequence[Profile] = (),
    ) -> None:
        check_heads([profile, *others])
        self.options = options or RunOptions()
        self._recorder: Recorder | None = None
        if self.options.record is not None:
            if others:
                raise EmulatorError("--record: records one head; run the others separately, or omit it")
            self._recorder = Recorder(self.options.record, make_clock(profile.run.clock))
        self.emulation = Emulation(profile, worker, tape=self._recorder, previews=self.options.watched)
        self.heads = [Head(1, self.emulation)]
        for number, other in enumerate(others, start=2):
            emulation = Emulation(other, leader=self.emulation, previews=self.options.watched)
            self.heads.append(Head(number, emulation))
        self.ended = asyncio.Event()
        self.control: ControlServer | None = None
        self._closers: list[Callable[[], object]] = []
        """Closers of console and MCAP file, in the order of opening."""
        self._recorders: list[McapRecorder] = []
        self._rejected = False
        """Whether the start has failed, so that no files are left behind."""

    @property
    def faults(self) -> Faults:
        """The faults of the first head."""
        return self.heads[0].faults

    @property
    def _files(self) -> list[OutputFile]:
        """The files that the run writes."""
        tapes = [] if self._recorder is None or self._recorder.file is None else [self._recorder.file]
        logs = [file for head in self.heads for file in head.files]
        return [*tapes, *(recorder.file for recorder in self._recorders), *logs]

    @property
    def failed(self) -> bool:
        """Whether something could not be written."""
        outputs = [file.output for file in self._files] + [
            head.emulation.device.stored for head in self.heads
        ]
        return any(output.failed for output in outputs)

    async def start(self) -> None:
        """Open files, links and control channel, switch the devices on and start time.

        Raises
        ------
        EmulatorError, ProtocolError
            A file, port or bus is not available; one line.
        """
        with self._rejecting():
            await self._start()

    @contextmanager
    def _rejecting(self) -> Iterator[None]:
        try:
            yield
        except (EmulatorError, ProtocolError):
            self._rejected = True
            raise

    async def _start(self) -> None:
        options = self.options
        if self._recorder is not None:
            from starhil.emulator.replay import prepare_recording

            prepare_recording(self._recorder.folder, self.emulation.profile, options.scenario)
            self._recorder.open()
        scenario = load_scenario(options.scenario) if options.scenario else None
        for head in self.heads:
            head.open_logs(options, self._recorder)
        opened: list[Head] = []
        try:
            for head in self.heads:
                await head.open()
                opened.append(head)
            if scenario is not None:
                for head in self.heads:
                    head.enter(scenario)
            if options.control != "off" or options.watched:
                targets = [ControlTarget(head.emulation, head.faults) for head in self.heads]
                self.control = ControlServer(targets, self.ended.set, options.control_token)
            if self.control is not None and options.control != "off":
                where = await self.control.start(options.control)
                self.emulation.ready_fields["control"] = where
            if self.control is not None and options.watched:
                await self._open_console(self.control)
        except (EmulatorError, ProtocolError):
            for head in opened:
                head.emulation.device.withdraw_start()
            raise
        for head in self.heads:
            head.emulation.begin()

    async def ready(self) -> str:
        """Wait until every device accepts commands; return the ready line.

        The names of the fields of the nth head end in `.n`, except for the first head.

        Raises
        ------
        EmulatorError
            A pipeline cannot start; one line.
        """
        with self._rejecting():
            lines = await asyncio.gather(*(head.emulation.ready() for head in self.heads))
        line = lines[0]
        for head, further in zip(self.heads[1:], (each.split()[1:] for each in lines[1:]), strict=True):
            line += "".join(
                f" {key}.{head.number}={value}"
                for key, _, value in (field.partition("=") for field in further)
                if key != "clock"
            )
        return line

    async def close(self) -> None:
        """Close control channel, console, emulations and logs, even if one fails to close."""
        closers: list[Callable[[], object]] = [*reversed(self._closers)]
        self._closers.clear()
        closers += [head.emulation.close for head in reversed(self.heads)]
        if self.control is not None:
            closers.insert(0, self.control.close)
        if self._recorder is not None and not self._rejected:
            closers.append(self._recorder.end)
        closers += [file.discard if self._rejected else file.close for file in self._files]
        if self._rejected and self._recorder is not None and self._recorder.file is not None:
            closers.append(self._recorder.discard)
        await close_all(closers)

    async def _open_console(self, control: ControlServer) -> None:
        """Open console and MCAP files, with an OBC on the bus of each head."""
        from starhil.emulator.console.obc_link import open_obc

        if self.options.make_client is None:
            raise EmulatorError("run: console and recording need make_client")
        clients = [
            await open_obc(head.emulation, self.options.make_client, self._closers) for head in self.heads
        ]
        if self.options.mcap is not None:
            self._open_recorders(self.options.mcap, clients)
        if self.options.view != "off":
            await self._open_server(control, clients)

    def _open_recorders(self, path: Path, clients: Sequence[ObcClient]) -> None:
        """Start recording each head to its own MCAP file."""
        from starhil.emulator.console.recorder import McapRecorder

        for head, client in zip(self.heads, clients, strict=True):
            own_path = path_of_head(path, head.number)
            recorder = McapRecorder(head.emulation, client, own_path, overwrite=self.options.overwrite)
            self._closers.append(recorder.close)
            self._recorders.append(recorder)
            recorder.start()

    async def _open_server(self, control: ControlServer, clients: Sequence[ObcClient]) -> None:
        """Serve a console for each head."""
        from starhil.emulator.console.console import Console
        from starhil.emulator.console.runs import Runs
        from starhil.emulator.console.server import ConsoleServer
        from starhil.emulator.console.stepping import StepRunner

        stepping, runs = StepRunner(control.execute), Runs()
        self._closers.append(stepping.pause)
        consoles = []
        for head, client in zip(self.heads, clients, strict=True):
            console = Console(head.emulation, head.number, client, stepping, runs)
            self._closers.append(console.close)
            console.start()
            consoles.append(console)
        server = ConsoleServer(consoles)
        self._closers.append(server.close)
        self.emulation.ready_fields["view"] = await server.start(self.options.view)


def path_of_head(path: Path, number: int) -> Path:
    """Return the path of a file of a head: for the second head, `truth.2.csv` instead of `truth.csv`."""
    return path if number == 1 else path.with_name(f"{path.stem}.{number}{path.suffix}")


def with_own_seeds(profiles: Sequence[Profile]) -> list[Profile]:
    """Return the profiles with distinct seeds: a seed that an earlier head has is increased until unused."""
    seeds: set[int] = set()
    found: list[Profile] = []
    for profile in profiles:
        seed = profile.run.seed
        while seed in seeds:
            seed += 1
        seeds.add(seed)
        found.append(profile.model_copy(update={"run": profile.run.model_copy(update={"seed": seed})}))
    return found


def check_heads(profiles: Sequence[Profile]) -> None:
    """Check that several heads can share a truth, a clock and their buses.

    Raises
    ------
    EmulatorError
        They are incompatible; the text names the two profiles and the key to change.
    """
    first = profiles[0]
    taken: dict[tuple[str, str, int], Profile] = {}
    for profile in profiles:
        if profile is not first and profile.run.clock != first.run.clock:
            raise EmulatorError(
                f"--head {profile.source}: run.clock is {profile.run.clock}, but {first.source} has "
                f"{first.run.clock}; heads share a clock, give --clock"
            )
        links = profile.links
        for key, bus, number in (
            ("links.can.address", links.can.channel if links.can.channel != "off" else "", links.can.address),
            ("links.canopen.node", links.can.channel if links.canopen.node else "", links.canopen.node),
            ("links.serial.port", _fixed_port(links.serial.port), 0),
            ("run.state_dir", profile.run.state_dir and str(profile.folder / profile.run.state_dir), 0),
        ):
            if not bus:
                continue
            other = taken.setdefault((key, bus, number), profile)
            if other is not profile:
                value = number or bus
                raise EmulatorError(
                    f"--head {profile.source}: {key} is {value}, as in {other.source}; change one of them"
                )


def _fixed_port(port: str) -> str:
    """Return the port of a serial link if only one head can use it, otherwise an empty text."""
    return "" if port in ("auto", "off") or port.endswith(":0") else port


def _leave_truth(_truth: TruthSource, _config: TruthConfig) -> None:
    """Do nothing: the first head sets the truth."""
