"""Recordings of runs: preparing the folder, and replaying it on the stepped clock."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from starhil.emulator.clock import NANOSECONDS, Clock, SteppedClock
from starhil.emulator.control.faults import FaultRequest, Faults
from starhil.emulator.control.scenario import Scenario, load_scenario
from starhil.emulator.device.device import Background, outcome
from starhil.emulator.emulation import Emulation
from starhil.emulator.errors import EmulatorError
from starhil.emulator.pipeline.imager import Imager, PipelineReply, PipelineRequest, ReplyCallback
from starhil.emulator.pipeline.messages import PipelineReady
from starhil.emulator.profile import Profile
from starhil.emulator.tape import (
    EVENTS_FILE,
    RUN_FILE,
    SCENARIO_FILE,
    STATE_FOLDER,
    TRUTH_FILE,
    Done,
    as_json,
    from_json,
)
from starhil.emulator.truth.config import FileConfig, TruthConfig
from starhil.emulator.truth_log import WALL_TIMES, TruthLog
from starhil.emulator.validation_messages import explain
from starhil.protocol.can_framing import CanFrame
from starhil.protocol.transports.base import Receive, ReportError, Transport
from starhil.protocol.transports.paced import SerialTransport

Item = TypeVar("Item", bytes, CanFrame)

_TRUTH: Final[TypeAdapter[TruthConfig]] = TypeAdapter(TruthConfig)
TRUTH_SOURCE_FILE: Final = "truth_source.csv"


def prepare_recording(folder: Path, profile: Profile, scenario: str) -> None:
    """Make the folder of a recording, with copies of all inputs of the run that may change later.

    Raises
    ------
    EmulatorError
        The folder is not empty or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise EmulatorError(f"--record {folder}: not empty; choose another folder")
        values = profile.model_dump(mode="json")
        if isinstance(profile.truth, FileConfig):
            shutil.copyfile(profile.folder / profile.truth.path, folder / TRUTH_SOURCE_FILE)
            values["truth"]["path"] = TRUTH_SOURCE_FILE
        state = profile.folder / profile.run.state_dir if profile.run.state_dir else None
        if state is not None and state.is_dir():
            shutil.copytree(state, folder / STATE_FOLDER)
        if scenario:
            text = load_scenario(scenario).model_dump_json()
            (folder / SCENARIO_FILE).write_text(text, encoding="utf-8")
        run = {
            "starhil": importlib.metadata.version("starhil"),
            "folder": str(profile.folder.resolve()),
            "profile": values,
        }
        (folder / RUN_FILE).write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise EmulatorError(f"--record {folder}: {error.strerror}; choose another folder") from None


class Player:
    """The tape of a recording.

    Parameters
    ----------
    ends_at_once
        Whether slow writes ended at once in the recorded run, as on the stepped clock.
    """

    plays: Final = True

    def __init__(self, *, ends_at_once: bool) -> None:
        self.stepped = SteppedClock()
        self.clock: Clock = self.stepped
        self.sent: dict[str, list[Any]] = {}
        """Items that the device has sent, by link, as JSON."""
        self.receivers: dict[str, Callable[[Any], None]] = {}
        self.pipeline: PlayedImager | None = None
        self.writes: deque[Callable[[], None]] = deque()
        """Functions that end pending slow writes."""
        self._ends_at_once = ends_at_once

    def begin(self) -> None:
        """Do nothing: the entries are played next."""

    def latch(self) -> None:
        """Do nothing: the clock shows the time of the played entry."""

    def write(self, kind: str, **values: Any) -> None:
        """Do nothing: a replay is not recorded."""

    def enter(self, kind: str, **values: Any) -> None:
        """Do nothing: a replay is not recorded."""

    def serial(self, make: Callable[[], SerialTransport]) -> SerialTransport:  # noqa: ARG002 (nothing is opened)
        """Return a serial line that is connected to the tape."""
        return _PlayedSerial("serial", self)

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:  # noqa: ARG002
        """Return a CAN bus that is connected to the tape."""
        return _PlayedTransport(name, self)

    def imager(self, inner: Imager) -> Imager:
        """Return a pipeline whose replies wait for their entries."""
        self.pipeline = PlayedImager(inner)
        return self.pipeline

    def background(self, inner: Background) -> Background:
        """Return a function that runs slow writes at once; their end waits for its entry."""
        if self._ends_at_once:
            return inner

        def background(work: Callable[[], None], done: Done) -> None:
            error = outcome(work)
            self.writes.append(lambda: done(error))

        return background


class _PlayedTransport(Transport[Item]):
    """A port or bus that is connected to the tape."""

    def __init__(self, name: str, player: Player) -> None:
        super().__init__(f"virtual:{name}")  # a bus that no other process can join
        self._name = name
        self._sent = player.sent.setdefault(name, [])
        self._player = player

    async def start(self, on_receive: Receive[Item], on_error: ReportError | None = None) -> None:  # noqa: ARG002
        self._player.receivers[self._name] = on_receive

    async def _open(self) -> None:
        """Do nothing: there is no port."""

    def send(self, item: Item) -> bool:
        self._sent.append(as_json(item))
        return True

    async def drain(self) -> None:
        """Do nothing: items are never pending."""

    async def close(self) -> None:
        """Do nothing: there is no port."""


class _PlayedSerial(_PlayedTransport[bytes], SerialTransport):
    """A serial line that is connected to the tape."""

    def set_baud(self, baud: int) -> None:
        """Do nothing: there is no line."""


class PlayedImager:
    """A pipeline whose replies wait for their entries.

    Parameters
    ----------
    inner
        Renders and solves the frames.
    """

    def __init__(self, inner: Imager) -> None:
        self._inner = inner
        self._arrived: deque[Callable[[], None]] = deque()
        self.pending = 0

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Pass a request to the pipeline."""

        def arrived(reply: PipelineReply) -> None:
            self._arrived.append(lambda: done(reply))

        self.pending += 1
        self._inner.submit(request, arrived)

    async def settle(self) -> None:
        """Wait until the pipeline is idle."""
        await self._inner.settle()

    async def deliver(self) -> None:
        """Deliver the next reply.

        Raises
        ------
        EmulatorError
            The device has sent fewer requests than in the recorded run.
        """
        if not self._arrived:
            await self._inner.settle()
        if not self._arrived:
            raise EmulatorError("replay: the device has requested fewer frames than in the recorded run")
        self.pending -= 1
        self._arrived.popleft()()


@dataclass
class ReplayReport:
    """Outcome of a replay.

    Attributes
    ----------
    entries
        Number of entries played.
    sent
        Number of serial bytes or CAN frames sent, by link.
    differences
        One line for each link or file that differs; empty if all are identical.
    """

    entries: int = 0
    sent: dict[str, int] = field(default_factory=dict)
    differences: list[str] = field(default_factory=list)


def read_run(folder: Path) -> Profile:
    """Read the profile of a recording.

    Raises
    ------
    EmulatorError
        The folder is not a recording, or is one of another version with a different profile.
    """
    path = folder / RUN_FILE
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
        profile = Profile.model_validate_json(json.dumps(run["profile"]))
    except OSError as error:
        raise EmulatorError(
            f"replay {folder}: {RUN_FILE}: {error.strerror}; give a folder made by starhil run --record"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        why = explain(error, Profile) if isinstance(error, ValidationError) else "not a recording"
        raise EmulatorError(f"replay {path}: {why}") from None
    is_copied = isinstance(profile.truth, FileConfig)
    profile._source = (folder if is_copied else Path(run["folder"])) / RUN_FILE  # noqa: SLF001 (private: not a key of the file)
    return profile


def read_events(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a tape.

    Raises
    ------
    EmulatorError
        The file is missing or damaged.
    """
    path = folder / EVENTS_FILE
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                if not line.endswith("\n"):
                    return  # the run was killed while it wrote
                try:
                    yield json.loads(line)
                except ValueError:
                    raise EmulatorError(f"replay {path}: line {number} is damaged") from None
    except OSError as error:
        raise EmulatorError(f"replay {path}: {error.strerror}") from None


async def replay(folder: Path) -> ReplayReport:
    """Play a recording on the stepped clock, and compare sent items and measurements with it.

    Raises
    ------
    EmulatorError
        The folder is not a recording, or the device behaves differently, so that it cannot be continued.
    """
    recorded = read_run(folder)
    player = Player(ends_at_once=recorded.run.clock == "stepped")
    report = ReplayReport()
    with tempfile.TemporaryDirectory(prefix="starhil-replay-") as scratch:
        state = ""
        if recorded.run.state_dir:
            state = str(Path(scratch) / STATE_FOLDER)
            if (folder / STATE_FOLDER).is_dir():
                shutil.copytree(folder / STATE_FOLDER, state)
        truth_log = Path(scratch) / TRUTH_FILE
        links = recorded.links.model_copy(
            update={"serial": recorded.links.serial.model_copy(update={"symlink": ""})}
        )
        run = recorded.run.model_copy(update={"state_dir": state})
        profile = recorded.model_copy(update={"links": links, "run": run})
        emulation = Emulation(profile, tape=player)
        log = TruthLog(truth_log, wall_times=False)
        try:
            await emulation.open()
            emulation.device.on_frame.append(log.write)
            faults = Faults(emulation.device, emulation.links)
            _enter_scenario(folder, emulation, faults)
            warm = await emulation.imager.start()
            play = _Playing(emulation, player, faults, warm)
            expected: dict[str, list[Any]] = {}
            for event in read_events(folder):
                if event["do"] == "out":
                    expected.setdefault(event["link"], []).append(event["data"])
                    continue
                player.stepped.set_ns(max(event["ns"], player.stepped.now_ns()))
                await play.entry(event)
                report.entries += 1
            _compare_sent(expected, player.sent, report)
        finally:
            await emulation.close()
            log.close()
        _compare_truth(folder / TRUTH_FILE, truth_log, report)
    return report


def _enter_scenario(folder: Path, emulation: Emulation, faults: Faults) -> None:
    path = folder / SCENARIO_FILE
    if path.exists():
        scenario = Scenario.model_validate_json(path.read_text(encoding="utf-8"))
        scenario.enter(emulation.device.scheduler, faults, emulation.set_truth, emulation.profile.folder)


class _Playing:
    """Plays entries one by one."""

    def __init__(self, emulation: Emulation, player: Player, faults: Faults, warm: PipelineReady) -> None:
        self._emulation = emulation
        self._player = player
        self._faults = faults
        self._warm = warm

    async def entry(self, event: dict[str, Any]) -> None:
        """Play one entry at the current time."""
        device, player, kind = self._emulation.device, self._player, event["do"]
        if kind == "event":
            due = device.scheduler.pop_due(player.clock.now_ns())
            if due is None:
                raise EmulatorError(_deviation(event, "no event is due"))
            due.action(due.due_ns)
        elif kind == "reply" and player.pipeline is not None:
            await player.pipeline.deliver()
        elif kind == "in":
            player.receivers[event["link"]](from_json(event["data"]))
        elif kind == "stored":
            if not player.writes:
                raise EmulatorError(_deviation(event, "nothing is being written"))
            player.writes.popleft()()
        elif kind == "ready":
            self._emulation.pipeline_ready(self._warm)
        else:
            await self._command(event)

    async def _command(self, event: dict[str, Any]) -> None:
        """Play a feed message or a command on the control channel."""
        emulation, kind = self._emulation, event["do"]
        if kind == "feed" and emulation.feed is not None:
            await emulation.feed.process(event["data"].encode("latin-1"))
        elif kind == "truth":
            config = _TRUTH.validate_json(json.dumps(event["config"]))
            await emulation.play_truth(config, event["start_s"])
        elif kind == "fault":
            self._faults.inject(FaultRequest.model_validate_json(json.dumps(event["request"])))
        elif kind == "clear_faults":
            self._faults.clear()
        else:
            raise EmulatorError(_deviation(event, f"{kind!r} cannot be played"))


def _deviation(event: dict[str, Any], why: str) -> str:
    return f"replay: at {event['ns'] / NANOSECONDS:.6f} s the device behaves differently: {why}"


def _compare_sent(expected: dict[str, list[Any]], sent: dict[str, list[Any]], report: ReplayReport) -> None:
    """Compare the items sent on each link."""
    for link in sorted(expected.keys() | sent.keys()):
        before, now = expected.get(link, []), sent.get(link, [])
        if link == "serial":  # on a serial line only the bytes matter, not how they are divided into items
            before, now = (["".join(pieces)] if pieces else [] for pieces in (before, now))
            report.sent[link] = len(before[0]) // 2 if before else 0
        else:
            report.sent[link] = len(before)
        if before != now:
            at = next(
                (n for n, pair in enumerate(zip(before, now, strict=False)) if pair[0] != pair[1]),
                min(len(before), len(now)),
            )
            report.differences.append(
                f"{link}: differs from message {at + 1} on: {len(before)} recorded, {len(now)} now"
            )


def _compare_truth(recorded: Path, now: Path, report: ReplayReport) -> None:
    """Compare the truth logs, except for wall times."""
    if not recorded.exists():
        return
    before, after = (_rows(path) for path in (recorded, now))
    for number, (one, other) in enumerate(zip(before, after, strict=False), start=1):
        changed = [name for name in one if name not in WALL_TIMES and one[name] != other.get(name)]
        if changed:
            report.differences.append(f"truth log: row {number} differs in {changed[0]}")
            return
    if len(before) != len(after):
        report.differences.append(f"truth log: {len(before)} rows recorded, {len(after)} now")


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
