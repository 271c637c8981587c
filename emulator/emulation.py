"""An emulation: device, pipeline, links, truth and clock."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from urllib.parse import quote

from starhil.emulator.clock import NANOSECONDS, Clock, SteppedClock, make_clock
from starhil.emulator.device.device import Background, Device, outcome, run_at_once
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.state_store import FileStore, MemoryStore, StateStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import close_all
from starhil.emulator.links.base import Link
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.pipeline.imager import PipelineImager, ProcessImager, ThreadImager
from starhil.emulator.pipeline.messages import PipelineReady, PipelineSetup
from starhil.emulator.pipeline.worker_process import WorkerProcess
from starhil.emulator.profile import Profile
from starhil.emulator.pump import ClockPump, StepPump
from starhil.emulator.revival import PipelineRevival
from starhil.emulator.symlink_lock import lock_symlink
from starhil.emulator.tape import LatchedClock, Tape
from starhil.emulator.truth.config import Config42, FeedConfig, FileConfig, TruthConfig
from starhil.emulator.truth.feed import LiveFeed
from starhil.emulator.truth.file import FileTruth
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.mount import mounted
from starhil.emulator.truth.source import FixedTruth, RateTruth, SlewTruth, TruthSource
from starhil.protocol.can_framing import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import load_unit
from starhil.protocol.icd_bindings import unbound
from starhil.protocol.serial_stack import chosen_dialect
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.values import IcdError, Value
from starid.attitude import Attitude

log = logging.getLogger("starhil.run")


class Emulation:
    """A device with its pipeline, links, truth and clock.

    Parameters
    ----------
    profile
        Profile of the unit.
    worker
        Pipeline worker that was started earlier; by default one is started here.
    leader
        The first head, for a further head, which shares its clock and truth.
    tape
        Records the run, or plays a recording.
    previews
        Whether frames may be displayed.

    Attributes
    ----------
    icd
        Interface definition of the profile's unit.
    ready_fields
        Fields of the ready line: the opened ports, buses and addresses.
    heads
        The heads that share clock and truth, the leader first.
    body_truth
        Truth of the body on which the heads are mounted.
    time_passes
        Set when the pipeline of every head is ready, which starts the clock.
    """

    def __init__(
        self,
        profile: Profile,
        worker: WorkerProcess | None = None,
        leader: Emulation | None = None,
        tape: Tape | None = None,
        previews: bool = False,
    ) -> None:
        self.profile = profile
        self._previews = previews
        self.icd = load_unit(profile.unit_source)
        missing = unbound(self.icd)
        if missing:
            raise EmulatorError(missing[0])
        self._check_links()
        self.tape = tape
        self.leader = leader or self
        self.heads: list[Emulation] = [] if leader is None else leader.heads
        self.heads.append(self)
        self.body_truth: TruthSource = FixedTruth(Attitude.identity())
        self.clock: Clock = make_clock(profile.run.clock) if leader is None else leader.clock
        if tape is not None:
            self.clock = tape.clock
        self.imager: PipelineImager = self._make_imager(worker)
        self._requests: Requests | None = None
        self.serial: SerialLink | None = None
        self.can: CanLink | None = None
        self.canopen: Link | None = None
        self.feed: LiveFeed | None = None
        self._configured_feed = ""
        """Address of the live feed as configured: `ready_fields` has the actual one."""
        self.warm: PipelineReady | None = None
        self.ready_fields: dict[str, str] = {}
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="state")
        self._closers: list[Callable[[], object]] = []
        self._pump: ClockPump | None = None
        self.stepper: StepPump | None = None
        self._warm_up_task: asyncio.Task[None] | None = None
        self._revival: PipelineRevival | None = None
        self._awake = asyncio.Event()
        self.time_passes: asyncio.Event = asyncio.Event() if leader is None else leader.time_passes

    @property
    def requests(self) -> Requests:
        """Request handling of the device.

        Raises
        ------
        EmulatorError
            The emulation is not open.
        """
        if self._requests is None:
            raise EmulatorError("emulation: not open")
        return self._requests

    @property
    def device(self) -> Device:
        """The device.

        Raises
        ------
        EmulatorError
            The emulation is not open.
        """
        return self.requests.device

    def _make_imager(self, worker: WorkerProcess | None) -> PipelineImager:
        setup = replace(
            pipeline_setup(self.profile, repeatable=self.tape is not None), previews=self._previews
        )
        if self.profile.run.worker == "process":
            return ProcessImager(setup, worker or WorkerProcess())
        if worker is not None:
            worker.end()
        if self.profile.run.worker == "error_model":
            from starhil.emulator.pipeline.error_model import ErrorModelImager

            return ErrorModelImager(setup)
        return ThreadImager(setup)

    async def open(self) -> None:
        """Open truth and links and switch the device on; time is stopped until every head is ready.

        Raises
        ------
        EmulatorError, ProtocolError
            A file, port or bus is not available; one line.
        """
        store = self._open_store()
        if self.leader is self:
            self.body_truth = await self._open_truth(self.profile.truth)
        truth = self._mounted(self.leader.body_truth, self.profile.truth)
        stepped = isinstance(self.clock, SteppedClock)
        background = run_at_once if stepped else self._in_background()
        if self.tape is not None:
            background = self.tape.background(background)
        imager = self.imager if self.tape is None else self.tape.imager(self.imager)
        device = Device(self.profile, self.icd, self.clock, imager, store, truth, background)
        self._requests = Requests(device)
        device.signals.frame_published.connect(_log_frame)
        device.power_on()
        try:
            await self._open_links(self._requests)
        except (EmulatorError, ProtocolError):
            device.withdraw_start()
            raise

    def begin(self) -> None:
        """Start the pipeline; `ready` waits for it."""
        device = self.device
        if isinstance(self.clock, SteppedClock):
            if self.leader is self:
                stepped = [(head.device.scheduler, head.imager) for head in self.heads]
                transports = [link.transport for head in self.heads for link in head.links]
                self.stepper = StepPump(stepped, self.clock, self.time_passes, transports, self.tape)
        else:
            passing = self.clock.source if isinstance(self.clock, LatchedClock) else self.clock
            self._pump = ClockPump(device.scheduler, passing, self.tape)
        if self.tape is not None:
            self.tape.begin()
        self._revival = PipelineRevival(self.imager, device, self.pipeline_ready)
        self._warm_up_task = asyncio.create_task(self._warm_up())

    @property
    def _state_dir(self) -> Path | None:
        """Folder for state that survives a restart; None: it is kept in memory."""
        state_dir = self.profile.run.state_dir
        return self.profile.folder / Path(state_dir).expanduser() if state_dir else None

    def _open_store(self) -> StateStore:
        folder = self._state_dir
        store: StateStore = MemoryStore() if folder is None else FileStore(folder)
        self._closers.append(store.close)
        return store

    def _in_background(self) -> Background:
        loop = asyncio.get_running_loop()

        def background(work: Callable[[], None], done: Callable[[EmulatorError | None], None]) -> None:
            def run() -> None:
                loop.call_soon_threadsafe(done, outcome(work))

            self._writer.submit(run)

        return background

    async def change_truth(self, config: TruthConfig) -> None:
        """Replace the truth of all heads, as on the control channel.

        Raises
        ------
        EmulatorError
            A file is invalid or a port is not available; the previous source stays.
        """
        leader = self.leader
        truth = await leader._open_truth(config)  # noqa: SLF001 (of this class)
        self._record_entry(
            "truth", config=config.model_dump(mode="json"), start_s=getattr(truth, "start_s", self._now_s())
        )
        leader.replace_truth(truth, config)

    async def play_truth(self, config: TruthConfig, start_s: float) -> None:
        """Replace the truth as in a recorded command, with time zero of its motion at `start_s` seconds."""
        truth = await self._open_truth(config)
        if isinstance(truth, FileTruth | SlewTruth):
            truth.start_s = start_s
        elif isinstance(truth, RateTruth):
            truth = replace(truth, start_s=start_s)
        self.replace_truth(truth, config)

    def set_truth(self, truth: TruthSource, config: TruthConfig) -> None:
        """Replace the truth of all heads by a source without a socket, as in a scenario."""
        self.leader.close_feed()
        self.leader.replace_truth(truth, config)

    def replace_truth(self, truth: TruthSource, config: TruthConfig) -> None:
        """Replace the truth of all heads."""
        self.body_truth = truth
        for head in self.heads:
            head.device.surroundings.truth = head._mounted(truth, config)  # noqa: SLF001 (of this class)

    def _mounted(self, truth: TruthSource, config: TruthConfig) -> TruthSource:
        """Return the truth of this head, with the mount in a configuration, or else in its profile."""
        mount = config.mount or self.profile.truth.mount
        return mounted(truth, None if mount is None else mount.build())

    async def _open_truth(self, config: TruthConfig) -> TruthSource:
        """Build a truth source, with a socket for a live feed, and close the previous feed."""
        truth = await asyncio.to_thread(config.build, self._now_s(), self.profile.folder)
        if isinstance(truth, FileTruth) and isinstance(config, FileConfig) and config.start == "now":
            truth.start_s = self._now_s()  # reading has taken time
        feed: LiveFeed | None = None
        if isinstance(config, FeedConfig) and isinstance(truth, LiveTruth):
            truth.set_clock_speed(make_clock(self.profile.run.clock).speed)  # not of a replay's clock
            step = self._step_in_lock if self._is_lockstep(config) else None
            feed = LiveFeed(truth, self._now_s, step, self._message_received)
            if self.tape is not None and self.tape.plays:
                self.feed = feed  # its messages come from the tape
                return truth
            protocol = "udp" if config.socket == "udp" else "tcp"
            wanted = f"{protocol}:{config.host}:{config.port}"
            if config.port != 0 and wanted in (self.ready_fields.get("truth"), self._configured_feed):
                self.close_feed()  # the same port: it must be free first
                await asyncio.sleep(0)  # the loop closes it in its next turn
            where = await feed.start(config.socket, config.host, config.port)
            self.close_feed()
            self.ready_fields["truth"], self._configured_feed = where, wanted
        else:
            self.close_feed()
        self.feed = feed
        return truth

    def _record_entry(self, kind: str, **values: object) -> None:
        """Record an entry on the tape, if there is one."""
        if self.tape is not None:
            self.tape.enter(kind, **values)

    def _message_received(self, data: bytes) -> None:
        """Record a message of the feed; until time passes, each message replaces the earlier ones."""
        self._record_entry("feed", data=data.decode("latin-1"))
        if not self.time_passes.is_set() and self.feed is not None and self.feed.truth.timeline == "anchor":
            self.feed.truth.begin_timeline()

    def _now_s(self) -> float:
        """Return the simulation time, seconds."""
        return self.clock.now_ns() / NANOSECONDS

    def _is_lockstep(self, config: FeedConfig) -> bool:
        """Return whether the messages of a feed advance the clock."""
        stepped = self.profile.run.clock == "stepped"
        if isinstance(config, Config42):
            return stepped
        if config.lockstep and not stepped:
            raise EmulatorError(
                f"truth.lockstep: the clock must be stepped, not {self.clock.name}; run with --clock stepped"
            )
        return config.lockstep

    async def _step_in_lock(self, seconds: float) -> None:
        """Advance the clock for a simulator."""
        if self.tape is not None and self.tape.plays:
            return  # the events of the step are on the tape
        if self.stepper is not None:
            await self.stepper.step(seconds)

    def close_feed(self) -> None:
        """Close the socket of the live feed, if there is one."""
        if self.feed is not None:
            self.feed.close()
            self.feed = None
        self._configured_feed = ""
        self.ready_fields.pop("truth", None)

    async def _open_links(self, requests: Requests) -> None:
        device = requests.device
        links, seed = self.profile.links, self.profile.run.seed
        stepped = isinstance(
            self.clock, SteppedClock
        )  # no time passes between two frames or bytes of one event
        if links.serial.port != "off" and self.icd.link.serial is not None:
            from starhil.protocol.transports.serial import open_serial

            baud = int(device.parameters["serial_baud"])
            symlink = Path(links.serial.symlink).expanduser() if links.serial.symlink else None
            if symlink is not None:
                self._closers.append(lock_symlink(symlink).close)
            paced = None if links.serial.pace and not stepped else False

            def open_port() -> SerialTransport:
                return open_serial(links.serial.port, baud, symlink=symlink, paced=paced)

            transport = open_port() if self.tape is None else self.tape.serial(open_port)
            self.serial = SerialLink(requests, transport, seed)
            self.ready_fields["serial"] = await self.serial.start()
            if self.serial.dialect is not None:
                self.ready_fields["dialect"] = self.serial.dialect.value
        if links.can.channel != "off" and self.icd.link.can is not None:
            gap_s = 0.0 if stepped else links.can.frame_gap_s
            self.can = CanLink(requests, self._can_transport("can", links.can.channel), gap_s, seed)
            self.ready_fields["can"] = await self.can.start()
        if self._canopen_wanted:
            await self._open_canopen(requests)

    @property
    def _canopen_wanted(self) -> bool:
        """Return whether a node is requested, or CANopen is the only link of the unit."""
        links = self.profile.links
        return bool(links.canopen.node) or (self.icd.canopen_only and links.can.channel != "off")

    def _check_links(self) -> None:
        """Check that the unit has at least one of the requested links; log those that it lacks.

        Raises
        ------
        EmulatorError
            The unit has none of them, no CANopen node though one is requested, or not the requested dialect.
        """
        links, has, name = self.profile.links, self.icd.link, self.icd.name
        canopen = self.icd.canopen is not None
        if links.canopen.node and not canopen:
            raise EmulatorError(f"links.canopen.node: unit {name} has no CANopen")
        if "dialect" in links.serial.model_fields_set:
            try:
                chosen_dialect(self.icd, links.serial.dialect)
            except IcdError as error:
                raise EmulatorError(f"links.serial.dialect: {error}") from None
        asked = {"serial.port": links.serial.port, "can.channel": links.can.channel}
        there = {"serial.port": has.serial is not None, "can.channel": has.can is not None or canopen}
        wanted = [key for key, value in asked.items() if value != "off"]
        if wanted and not links.canopen.node and not any(there[key] for key in wanted):
            raise EmulatorError(f"links.{wanted[0]}: unit {name} has none of the links requested")
        for key in wanted:
            if asked[key] != "auto" and not there[key]:
                log.warning("links.%s: unit %s has no such link; it is not opened", key, name)

    def _can_transport(self, name: str, channel: str) -> Transport[CanFrame]:
        """Return the transport of a CAN link, connected to the tape if there is one."""
        from starhil.protocol.transports.can import open_can

        return open_can(channel) if self.tape is None else self.tape.can(name, lambda: open_can(channel))

    async def _open_canopen(self, requests: Requests) -> None:
        """Open the CANopen link on the bus of the CAN link, or on the configured bus."""
        from starhil.emulator.links.canopen import open_canopen

        channel = self.profile.links.can.channel
        bus = self.ready_fields.get("can") or ("auto" if channel == "off" else channel)
        transport = self._can_transport("canopen", bus)
        link = open_canopen(requests, transport, self._state_dir, self.profile.run.seed)
        self.canopen = link
        opened = await link.start()
        self.ready_fields.setdefault("can", opened)
        self.ready_fields["canopen"] = str(requests.device.parameters["canopen_node"])

    @property
    def links(self) -> list[Link]:
        """Links in closing order; the CAN link is last because it may run the hub of the bus."""
        return [link for link in (self.serial, self.canopen, self.can) if link is not None]

    async def _warm_up(self) -> None:
        """Wait for the pipeline; after that, the device leaves the boot mode at the end of its boot time."""
        device = self.device
        try:
            warm = await self.imager.start()
            log.info("pipeline ready: %d stars, %.2f s", warm.stars, warm.seconds)
            self._record_entry("ready")
            device.signals.mode_changed.connect(
                lambda transition: self._awake.set() if transition.before is Mode.BOOT else None
            )
            self.pipeline_ready(warm)
        except EmulatorError as error:
            device.withdraw_start()
            raise EmulatorError(f"profile {self.profile.source}: {error}") from None
        except ProtocolError as error:  # a camera constant is outside the limits of its parameter
            device.withdraw_start()
            raise EmulatorError(f"profile {self.profile.source}: camera: {error}") from None
        if isinstance(self.clock, SteppedClock) or device.modes.mode is not Mode.BOOT:
            self._awake.set()

    def pipeline_ready(self, warm: PipelineReady) -> None:
        """Pass the camera of a ready pipeline to the device; time starts when every head has one."""
        self.warm = warm
        self.device.pipeline_ready(camera_constants(warm))
        if self.time_passes.is_set() or any(head.warm is None for head in self.heads):
            return
        self.time_passes.set()
        self.clock.start()
        for head in self.heads:
            if head._pump is not None:  # noqa: SLF001 (of this class)
                head._pump.start()  # noqa: SLF001

    async def ready(self) -> str:
        """Wait until the device accepts commands; return the ready line.

        Raises
        ------
        EmulatorError
            The pipeline cannot start, for example because there is no catalogue; one line.
        """
        awake = asyncio.create_task(self._awake.wait())
        warm_up = self._warm_up_task
        if warm_up is None:
            raise EmulatorError("emulation: not started")
        await asyncio.wait({awake, warm_up}, return_when=asyncio.FIRST_COMPLETED)
        if warm_up.done() and (error := warm_up.exception()) is not None:
            awake.cancel()
            raise error
        await awake
        unit = quote(self.profile.unit_source, safe="/:.~")  # a field has no blanks
        fields = {
            **self.ready_fields,
            "unit": unit,
            "seed": str(self.profile.run.seed),
            "clock": self.clock.name,
        }
        return "ready " + " ".join(f"{key}={value}" for key, value in fields.items())

    async def close(self) -> None:
        """Close everything: links first, so that no more requests arrive, then pipeline and files.

        If closing one of them fails, the error is logged and the others are closed.
        """
        closers: list[Callable[[], object]] = []
        if self._pump is not None:
            closers.append(self._pump.stop)
        if self._warm_up_task is not None:
            closers.append(partial(_cancel, self._warm_up_task))
        if self._revival is not None:
            closers.append(self._revival.close)
        closers += [link.close for link in self.links]
        closers += [self.close_feed, self.imager.close, partial(self._writer.shutdown, wait=True)]
        closers += reversed(self._closers)
        self._closers.clear()
        await close_all(closers)


async def _cancel(task: asyncio.Task[None]) -> None:
    """Cancel a task; `ready` has reported its exception."""
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.exception()


def pipeline_setup(profile: Profile, *, repeatable: bool = False) -> PipelineSetup:
    """Return the pipeline configuration of a profile; `repeatable`: results independent of machine speed."""
    path = profile.catalog.path
    return PipelineSetup(
        camera=profile.camera.values(),
        sensor=dict(profile.sensor),
        sky=dict(profile.sky),
        identifier=dict(profile.identifier),
        catalog_path=str(profile.folder / Path(path).expanduser()) if path else "",
        epoch=profile.epoch,
        algorithm=profile.run.algorithm,
        seed=profile.run.seed,
        build_in_background=profile.run.clock != "stepped" and not repeatable,
        dark_frames=profile.device.dark_frames,
        images=profile.images.resolved(profile.folder),
    )


def camera_constants(warm: PipelineReady) -> dict[str, Value]:
    """Return the camera parameters of a calibrated unit: focal length, centre and distortion, in pixels."""
    camera = warm.camera
    k1, k2, p1, p2, _ = camera["distortion"]
    focal_x, focal_y = camera["focal_px"]
    return {
        "focal_length": (focal_x * focal_y) ** 0.5,
        "centroid_x": camera["centre_px"][0],
        "centroid_y": camera["centre_px"][1],
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
    }


def _log_frame(measurement: Measurement) -> None:
    log.debug(
        "frame %d %s %s: %d detected, %d matched, %.1f ms",
        measurement.counter,
        measurement.mode,
        measurement.reason,
        measurement.result.detected,
        measurement.result.matched,
        measurement.latency_s * 1e3,
    )
