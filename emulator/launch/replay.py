"""Recordings of runs: preparing the folder, and replaying it on the stepped clock."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from starhil.emulator.control.scenario import Scenario
from starhil.emulator.device.device import Background, outcome
from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.launch.machine import other_machine
from starhil.emulator.launch.recording import copy_state, read_recorded, read_run, validated
from starhil.emulator.launch.replay_differences import difference_of_truth, difference_sent, units_sent
from starhil.emulator.launch.replay_fields import FieldDifference, differing_fields
from starhil.emulator.links.traffic import Decoder, WireItem
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from starhil.emulator.run.head import Head
from starhil.emulator.run.recorder import (
    EVENTS_FILE,
    SCENARIO_FILE,
    STATE_FOLDER,
    TRUTH_FILE,
    Done,
)
from starhil.emulator.run.tape import (
    AwaitedPhase,
    ClearedFaults,
    End,
    Entry,
    Event,
    FeedMessage,
    Line,
    LinkItem,
    NewFaults,
    NewTruth,
    Note,
    PipelineAnswer,
    PipelineState,
    Stored,
)
from starhil.emulator.run.truth_log import TruthLog
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.client import (
    PipelineClient,
    PipelineReply,
    PipelineRequest,
    ReplyCallback,
)
from starhil.emulator.sensor.pipeline.messages import PipelineEnded, PipelineReady
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.simulation.guard import call_guarded
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.files.user_file import open_user_file
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.unit import check_runs_no_code
from starid.errors import StaridError

MAX_LINE: Final = 4_000_000
"""Longest line of a tape, bytes: some times a request on the control channel, or what waits for a link."""

Item = TypeVar("Item", bytes, CanFrame)


class _DeviationError(EmulatorError):
    """The device behaves differently, so that the recording cannot be played further."""


class Player(Wiring):
    """Connects a run to a recording instead of the world.

    `ends_at_once`: whether slow writes ended at once in the recorded run, as on the stepped clock.
    """

    plays = repeatable = True

    def __init__(self, *, ends_at_once: bool) -> None:
        self.stepped = SteppedClock()
        super().__init__(self.stepped)
        self.passed: list[WireItem] = []
        """Items that the device has received and sent."""
        self.receivers: dict[str, Callable[[Any], None]] = {}
        """Function of each open link that takes its input."""
        self.pipeline: PlayedPipeline | None = None
        self.writes: deque[Callable[[], None]] = deque()
        """Functions that end pending slow writes."""
        self._ends_at_once = ends_at_once

    def serial(self, name: str, make: Callable[[], SerialTransport]) -> SerialTransport:  # noqa: ARG002 (nothing is opened)
        """Return a serial line that is connected to the tape."""
        return _PlayedSerial(name, self)

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:  # noqa: ARG002
        """Return a CAN bus that is connected to the tape."""
        return _PlayedTransport(name, self)

    def pass_item(self, link: str, item: bytes | CanFrame, *, outgoing: bool) -> None:
        """Keep an item that passes a link now, for the comparison."""
        self.passed.append(WireItem(self.stepped.now_ns() / NANOSECONDS, link, outgoing, item))

    def imager(self, inner: PipelineClient) -> PipelineClient:
        """Return a pipeline whose replies wait for their entries."""
        self.pipeline = PlayedPipeline(inner)
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

    immediate = True

    def __init__(self, name: str, player: Player) -> None:
        super().__init__(f"virtual:{name}")  # a bus that no other process can join
        self._name = name
        self._player = player

    async def _open(self) -> None:
        self._player.receivers[self._name] = self._receive

    def send(self, item: Item) -> bool:
        self._player.pass_item(self._name, item, outgoing=True)
        return True

    async def close(self) -> None:
        self._player.receivers.pop(self._name, None)


class _PlayedSerial(_PlayedTransport[bytes], SerialTransport):
    """A serial line that is connected to the tape."""

    def set_baud(self, baud: int) -> None:
        """Take the bytes at any bit rate: they have their times on the tape."""


class PlayedPipeline:
    """A pipeline whose replies wait for their entries."""

    def __init__(self, inner: PipelineClient) -> None:
        self._inner = inner
        self._arrived: deque[tuple[ReplyCallback, PipelineReply]] = deque()
        self.pending = 0

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        def arrived(reply: PipelineReply) -> None:
            self._arrived.append((done, reply))

        self.pending += 1
        self._inner.submit(request, arrived)

    async def settle(self) -> None:
        """Wait until the pipeline is idle."""
        await self._inner.settle()

    async def deliver(self, ended: PipelineEnded | None) -> None:
        """Deliver the next reply, or `ended` in its place.

        _DeviationError if the device has sent fewer requests than in the recorded run.
        """
        if not self._arrived:
            await self._inner.settle()
        if not self._arrived:
            raise _DeviationError("it requests fewer frames than in the recorded run")
        self.pending -= 1
        done, reply = self._arrived.popleft()
        done(ended or reply)


@dataclass
class ReplayReport:
    """Outcome of a replay."""

    entries: int = 0
    sent: dict[str, int] = field(default_factory=dict)
    """Number of serial bytes or CAN frames sent, by link."""
    differences: list[str] = field(default_factory=list)
    """One line for each link or file that differs, is missing or is truncated, and one if the recording is of another machine.

    Empty if all are identical.
    """
    fields: list[FieldDifference] = field(default_factory=list)
    """Fields of messages that differ, by link, row and field."""


def read_events(folder: Path) -> Iterator[tuple[str, Entry]]:
    """Yield the entries of a tape, whose times do not decrease, each with file and line."""
    path = folder / EVENTS_FILE
    last_ns = 0
    with explained(f"replay {path}: cannot be read"), open_user_file(path) as file:
        for number, line in enumerate(iter(lambda: file.readline(MAX_LINE), b""), start=1):
            where = f"{path}: line {number}"
            if len(line) == MAX_LINE:
                raise EmulatorError(
                    f"replay {where}: longer than {MAX_LINE / 1e6:g} MB; the recording is damaged"
                )
            if not line.endswith(b"\n"):
                return  # the run was killed while it wrote
            entry = validated(Line, line, where).root
            if entry.ns < last_ns:
                why = f"time {entry.ns} ns is before that of the entry above, {last_ns} ns; the recording is damaged"
                raise EmulatorError(f"replay {where}: {why}")
            last_ns = entry.ns
            yield where, entry


async def replay(
    folder: Path, profile: Profile | None = None, unit: str | None = None, settings: Sequence[str] = ()
) -> ReplayReport:
    """Play a recording on the stepped clock, and compare sent items and measurements with it.

    The device may have another profile than the recorded one, another unit, or other values of the recorded profile's keys
    (`settings`, as `section.key=value`); `run` except the algorithm, and `links`, are as recorded. A recorded unit with a
    Python file of its own, or camera, is rejected, because others may have made the recording.
    """
    recording_of = read_run(folder)
    recorded = recording_of.profile
    if unit is not None:
        recorded = recorded.model_copy(update={"unit": unit})
    elif profile is None:
        check_runs_no_code(recorded.unit_source, f"replay {folder}: the recording")
    if profile is None and not any(setting.startswith("images.capture") for setting in settings):
        _check_opens_no_camera(recorded, folder)
    if settings and profile is None:
        profile = recorded.with_overrides(settings)
    player = Player(ends_at_once=recorded.run.clock == "stepped")
    report = ReplayReport()
    with tempfile.TemporaryDirectory(prefix="starhil-replay-") as scratch:
        state = ""
        if recorded.run.state_dir:
            state = str(Path(scratch) / STATE_FOLDER)
            with explained(f"replay {folder / STATE_FOLDER}: cannot be read"):
                copy_state(folder / STATE_FOLDER, Path(state))
        truth_log = Path(scratch) / TRUTH_FILE
        links = recorded.links.model_copy(
            update={"serial": recorded.links.serial.model_copy(update={"symlink": ""})}
        )
        played = recorded if profile is None else profile
        run = recorded.run.model_copy(update={"state_dir": state, "algorithm": played.run.algorithm})
        again = Run([played.model_copy(update={"links": links, "run": run})], player)
        log = TruthLog(truth_log, wall_times=False)
        try:
            await again.open()
            (head,) = again.heads
            head.device.signals.frame_published.connect(log.write)
            if (folder / SCENARIO_FILE).exists():
                text = read_recorded(folder / SCENARIO_FILE)
                scenario = validated(Scenario, text, folder / SCENARIO_FILE)
                head.device.scheduler.add(scenario.prepare(head, again.truth))
            pipeline = player.pipeline
            if pipeline is None:
                raise EmulatorError("replay: the run has no pipeline")
            play = _Playing(again, head, player, pipeline, await head.imager.start())
            recording = await play.entries(folder, report)
            to_the_end = not report.differences
            new_decoder = partial(Decoder, head.icd, head.serial_dialect)
            for link in sorted({each.bus for each in recording} | set(player.receivers)):
                before, now = (
                    [each for each in items if each.bus == link] for items in (recording, player.passed)
                )
                report.sent[link] = len(list(units_sent(before)))
                if difference := difference_sent(before, now, new_decoder, to_the_end=to_the_end):
                    report.differences.append(f"{link}: {difference}")
                    report.fields += differing_fields(link, before, now, new_decoder, to_the_end=to_the_end)
        finally:
            await again.close()
            log.close()
        if difference := difference_of_truth(folder / TRUTH_FILE, truth_log, to_the_end=to_the_end):
            report.differences.append(difference)
    if report.differences and (machine := other_machine(recording_of.machine)):
        report.differences.append(machine)
    return report


def _check_opens_no_camera(recorded: Profile, folder: Path) -> None:
    """Check that the images of a recording are not from a camera, file, address or pipeline that OpenCV would open.

    Others may have named it, and it has other images now.
    """
    capture = recorded.images.capture
    if capture != "":
        raise EmulatorError(
            f"replay {folder}: images.capture: the recording took images from {capture!r}, which it does not contain; give a "
            "profile of your own: --profile"
        )


class _Playing:
    def __init__(
        self, run: Run, head: Head, player: Player, pipeline: PlayedPipeline, warm: PipelineReady
    ) -> None:
        self.truth = run.truth
        self.head = head
        self.player = player
        self.pipeline = pipeline
        self.warm = warm
        self.ended = False
        """Whether the entry `end` was played."""

    async def entries(self, folder: Path, report: ReplayReport) -> list[WireItem]:
        """Play a tape to its end, or to the entry at which the device deviates; return what passed the links until there."""
        recording: list[WireItem] = []
        stepped = self.player.stepped
        for where, entry in read_events(folder):
            if isinstance(entry, LinkItem):
                outgoing = entry.do == "out"
                recording.append(WireItem(entry.ns / NANOSECONDS, entry.link, outgoing, entry.item))
                if outgoing:
                    continue
            if self.ended:
                raise EmulatorError(f"replay {where}: comes after the entry `end`; the recording is damaged")
            stepped.set_ns(entry.ns)
            try:
                await self._play(entry)
            except _DeviationError as deviation:
                at = f"at {entry.ns / NANOSECONDS:.6f} s the device behaves differently"
                report.differences.append(f"{where}: {at}: {deviation}")
                return recording
            except (EmulatorError, ProtocolError, StaridError) as error:
                raise EmulatorError(f"replay {where}: {error}") from None
            report.entries += not self.ended
        if not self.ended:
            report.differences.append(
                f"{folder / EVENTS_FILE}: truncated at {stepped.now_ns() / NANOSECONDS:.6f} s: the run was killed, or lines are missing"
            )
        return recording

    async def _play(self, entry: Entry) -> None:
        """Play an entry at the current time; _DeviationError if the device behaves differently, so that this is impossible."""
        device, player = self.head.device, self.player
        match entry:
            case Event():
                due = device.scheduler.pop_due(player.clock.now_ns())
                if due is None:
                    raise _DeviationError("no event is due")
                call_guarded("event", due.action, due.due_ns)
            case PipelineAnswer():
                await self.pipeline.deliver(None if entry.ended is None else PipelineEnded(entry.ended))
            case PipelineState(do="ready"):
                self.head.pipeline_ready(self.warm)
            case PipelineState(do="pipeline_lost"):
                device.pipeline_lost()
            case PipelineState():
                device.pipeline_given_up()
            case Stored():
                if not player.writes:
                    raise _DeviationError("nothing is being written")
                player.writes.popleft()()
            case Note():
                pass
            case End():
                self.ended = True
            case _:
                await self._play_input(entry)

    async def _play_input(
        self, entry: LinkItem | FeedMessage | NewTruth | NewFaults | ClearedFaults | AwaitedPhase
    ) -> None:
        """Play what came from outside, as `_play` does."""
        match entry:
            case LinkItem():
                receive = self.player.receivers.get(entry.link)
                if receive is None:
                    raise _DeviationError(f"the link {entry.link} is off")
                self.player.pass_item(entry.link, entry.item, outgoing=False)
                receive(entry.item)
            case FeedMessage():
                if self.truth.feed is None:
                    raise _DeviationError("there is no live feed")
                await self.truth.feed.process(entry.data.encode("latin-1"))
            case NewTruth():
                await self.truth.set(entry.config, entry.start_s)
            case NewFaults():
                self.head.faults.inject(entry.request)
            case ClearedFaults():
                self.head.faults.clear()
            case AwaitedPhase():
                self.head.device.cycle.at_phase(entry.phase, lambda _due_ns: None)
