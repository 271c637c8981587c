"""What a user can add to a run: logs, recording, scenario, control channel and console."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from starhil.emulator.console.obc import MakeClient
from starhil.emulator.console.recorders import RECORDERS
from starhil.emulator.control.channel import ControlServer
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.table import LINKS
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from starhil.emulator.run.recorder import TRUTH_FILE, Recorder
from starhil.emulator.run.truth_log import TruthLog
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from starhil.emulator.simulation.clock import make_clock
from starhil.emulator.simulation.guard import close_all
from starhil.emulator.simulation.output_file import OutputFile
from starhil.emulator.simulation.threads import in_thread


@dataclass(frozen=True)
class ConsoleOptions:
    """Options of console and recorders, which use images and have an OBC on the bus of each head."""

    make_client: MakeClient
    view: str = "off"
    """Address of the console: `off`, `auto` (the loopback interface, a free port) or HOST:PORT."""
    view_token: str = ""
    """Token of pages that may look but not command; empty for none."""
    command_token: str = ""
    """Token of pages that may command; empty: a random one."""
    files: tuple[Path, ...] = ()
    """Files of recorders (`RECORDERS`); each is one file per head (`path_of_head`)."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of a run that are not part of the profile."""

    truth_log: Path | None = None
    """CSV file of truth and measurement, one row per frame; one file per head (`path_of_head`)."""
    overwrite: bool = False
    """Replace an existing truth log."""
    control: str = "off"
    """`off`, `auto` (a Unix socket that only this user can open), unix:/PATH or HOST:PORT."""
    control_token: str = ""
    """Token that each request on the control channel must contain; empty for none."""
    scenario: str = ""
    """Name or path of a scenario; empty for none."""
    record: Path | None = None
    """Folder of a recording of the run, for a replay."""
    console: ConsoleOptions | None = None
    """Console and recorders; None for neither."""


class Emulator:
    """A run with truth logs, recording, scenario, control channel and console.

    Truth and clock are those of the first profile. A pipeline worker may have been started earlier.
    """

    def __init__(
        self,
        profiles: Sequence[Profile],
        options: RunOptions | None = None,
        worker: WorkerProcess | None = None,
        wiring: Wiring | None = None,
    ) -> None:
        check_heads(profiles)
        self.options = options = options or RunOptions()
        self._recorder: Recorder | None = None
        if options.record is not None:
            if len(profiles) > 1:
                raise EmulatorError("--record: records one head; run the others separately, or omit it")
            wiring = self._recorder = Recorder(
                options.record, wiring or Wiring(make_clock(profiles[0].run.clock))
            )
        self.run = Run(profiles, wiring, worker, previews=options.console is not None)
        self.ended = asyncio.Event()
        """Set to end the run."""
        self.control: ControlServer | None = None
        self.ready_fields: dict[str, str] = {}
        """Addresses of control channel and console."""
        self._closers: list[Callable[[], object]] = []
        """Closers of console and recorders, in the order of opening."""
        self._files: list[OutputFile] = []
        """Logs and recordings that the run writes."""
        self._rejected = False
        """Whether the start has failed, so that no files are left behind."""

    @property
    def failed(self) -> bool:
        """Whether something could not be written."""
        outputs = [file.output for file in self._files] + [head.device.stored for head in self.run.heads]
        return any(output.failed for output in outputs)

    async def start(self) -> None:
        """Open files, links and control channel, switch the devices on and start time."""
        with self._rejecting():
            await self._start(self.options, self.run)

    @contextmanager
    def _rejecting(self) -> Iterator[None]:
        try:
            yield
        except Exception:
            self._rejected = True
            self.run.withdraw_starts()
            raise

    async def _start(self, options: RunOptions, run: Run) -> None:
        if self._recorder is not None:
            from starhil.emulator.launch.recording import prepare_recording

            prepare_recording(self._recorder.folder, run.profile, options.scenario)
            self._files.append(self._recorder.open())
        scenario = load_scenario(options.scenario) if options.scenario else None
        logs = self._open_logs()
        await run.open()
        for number, log in logs:
            run.heads[number - 1].device.signals.frame_published.connect(log.write)
        if scenario is not None:
            for head in run.heads:
                truth = run.truth if head.number == 1 else None
                events = await in_thread(scenario.prepare, head, truth)
                head.device.scheduler.add(events)
        if options.control != "off" or options.console is not None:
            self.control = ControlServer(run, self.ended.set, options.control_token)
            if options.control != "off":
                self.ready_fields["control"] = await self.control.start(options.control)
            if options.console is not None:
                await self._open_console(options.console, self.control)
        run.begin()

    def _open_logs(self) -> list[tuple[int, TruthLog]]:
        """Open the truth logs, each with the number of its head, and that of the recording."""
        options, run = self.options, self.run
        wall_times = run.clock.speed > 0.0
        logs = []
        if options.truth_log is not None:
            for number in range(1, run.size + 1):
                path = path_of_head(options.truth_log, number)
                logs.append((number, TruthLog(path, overwrite=options.overwrite, wall_times=wall_times)))
                self._files.append(logs[-1][1].file)
        if self._recorder is not None:
            path = self._recorder.folder / TRUTH_FILE
            logs.append((1, TruthLog(path, wall_times=wall_times, output=self._recorder.output)))
            self._files.append(logs[-1][1].file)
        return logs

    async def ready(self) -> str:
        """Wait until every device accepts commands; return the ready line.

        The names of the fields of the nth head end in `.n`, except for the first head.
        """
        with self._rejecting():
            first, *others = await self.run.ready()
        truth = {"truth": self.run.truth.address} if self.run.truth.address else {}
        fields = {**truth, **self.run.heads[0].ready_fields, **self.ready_fields, **first}
        fields["clock"] = self.run.clock.name
        for number, further in enumerate(others, start=2):
            fields |= {f"{key}.{number}": value for key, value in further.items()}
        return "ready " + " ".join(f"{key}={value}" for key, value in fields.items())

    async def close(self) -> None:
        """Close control channel, console, heads and logs, even if one fails to close.

        First of all, nothing more is received: closing takes many turns of the loop, which a storm of requests makes long.
        """
        for head in self.run.heads:
            for link in head.links.values():
                link.transport.stop_receiving()
        recorder = self._recorder
        closers: list[Callable[[], object]] = [*reversed(self._closers), self.run.close]
        self._closers.clear()
        if self.control is not None:
            closers.insert(0, self.control.close)
        if recorder is not None and not self._rejected:
            closers.append(recorder.end)
        closers += [file.discard if self._rejected else file.close for file in self._files]
        if self._rejected and recorder is not None and recorder.file is not None:
            closers.append(recorder.discard)
        await close_all(closers)

    async def _open_console(self, options: ConsoleOptions, control: ControlServer) -> None:
        """Open console and recorders, with an OBC on the bus of each head."""
        from starhil.emulator.console.events import EventLog
        from starhil.emulator.console.obc_link import open_obc

        logs = [EventLog(head) for head in self.run.heads]
        clients = [await open_obc(head, options.make_client, self._closers) for head in self.run.heads]
        for file in options.files:
            for head, client, events in zip(self.run.heads, clients, logs, strict=True):
                path = path_of_head(file, head.number)
                recorder = RECORDERS[file.suffix].make(head, client, events, path, self.options.overwrite)
                self._closers.append(recorder.close)
                self._files.append(recorder.file)
                recorder.start()
        if options.view != "off":
            from starhil.emulator.console.console import Console
            from starhil.emulator.console.reported_runs import ReportedRuns
            from starhil.emulator.console.server import ConsoleServer
            from starhil.emulator.console.stepping import StepRunner

            stepping, runs = StepRunner(control.execute), ReportedRuns()
            self._closers.append(stepping.pause)
            consoles = []
            for head, client in zip(self.run.heads, clients, strict=True):
                console = Console(self.run, head, client, logs, stepping, runs)
                self._closers.append(console.close)
                console.start()
                consoles.append(console)
            server = ConsoleServer(consoles, options.view_token, options.command_token)
            self._closers.append(server.close)
            self.ready_fields |= await server.start(options.view)


def path_of_head(path: Path, number: int) -> Path:
    """Return the path of a file of a head: for the second head, `truth.2.csv` instead of `truth.csv`."""
    return path if number == 1 else path.with_name(f"{path.stem}.{number}{path.suffix}")


def with_own_seeds(profiles: Sequence[Profile]) -> list[Profile]:
    """Return the profiles with distinct seeds: a seed that an earlier head has is increased until unused."""
    seeds: set[int] = set()
    seeded: list[Profile] = []
    for profile in profiles:
        seed = profile.run.seed
        while seed in seeds:
            seed += 1
        seeds.add(seed)
        seeded.append(profile.model_copy(update={"run": profile.run.model_copy(update={"seed": seed})}))
    return seeded


def check_heads(profiles: Sequence[Profile]) -> None:
    """Check that several heads can share a truth, a clock and their buses."""
    first = profiles[0]
    taken: dict[tuple[str, str, int], Profile] = {}
    for profile in profiles:
        if profile is not first and profile.run.clock != first.run.clock:
            raise EmulatorError(
                f"--head {profile.source}: run.clock is {profile.run.clock}, but {first.source} has "
                f"{first.run.clock}; heads share a clock, give --clock"
            )
        for key, bus, number in (
            *(kind.exclusive(profile.links) for kind in LINKS.values()),
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
