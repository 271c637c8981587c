"""A run: device, pipeline, links, truth feed and control channel put together, started and ended."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from starhil.emulator.clock import Clock, SteppedClock, make_clock
from starhil.emulator.control.channel import ControlServer
from starhil.emulator.control.faults import Faults
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.cycle import Measurement
from starhil.emulator.device.device import Background, Device, do_at_once, outcome
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.state_store import FileStore, MemoryStore, StateStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import one_line
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.pipeline.imager import ProcessImager, ThreadImager
from starhil.emulator.pipeline.messages import PipelineReady, PipelineSetup
from starhil.emulator.pipeline.worker_process import WorkerProcess
from starhil.emulator.profile import Profile
from starhil.emulator.pump import ClockPump, StepPump
from starhil.emulator.revival import PipelineRevival
from starhil.emulator.symlink_lock import claim_symlink
from starhil.emulator.truth.config import FileConfig, LiveConfig, TruthConfig
from starhil.emulator.truth.file import FileTruth
from starhil.emulator.truth.live import LiveFeed, LiveTruth
from starhil.emulator.truth.source import TruthSource
from starhil.emulator.truth_log import TruthLog
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition, load_icd
from starhil.protocol.values import Value

if TYPE_CHECKING:
    from starhil.emulator.links.canopen import CanopenLink

log = logging.getLogger("starhil.run")

PATIENCE_S: Final = 8.0
"""Time after which a start that takes long is explained, seconds."""


@dataclass(frozen=True)
class RunOptions:
    """What a run has beside its profile.

    Attributes
    ----------
    truth_log
        CSV file of truth and measurement a frame.
    overwrite
        Replace a truth log that exists.
    control
        `off`, `auto` (a Unix socket for this user alone), unix:/PATH or HOST:PORT.
    control_token
        What each request on the control channel has to carry; empty: nothing.
    scenario
        Name or path of a scenario; empty: none.
    """

    truth_log: Path | None = None
    overwrite: bool = False
    control: str = "off"
    control_token: str = ""
    scenario: str = ""


class Emulation:
    """One emulator with all that belongs to it.

    Parameters
    ----------
    profile
        What it is.
    options
        What the run has beside.
    icd
        Interface definition; by default the product's own.
    worker
        A worker that was started before; by default one is started here.
    """

    def __init__(
        self,
        profile: Profile,
        options: RunOptions | None = None,
        icd: InterfaceDefinition | None = None,
        worker: WorkerProcess | None = None,
    ) -> None:
        self.profile = profile
        self.options = options or RunOptions()
        self.clock: Clock = make_clock(profile.run.clock)
        self.imager: ProcessImager | ThreadImager = self._make_imager(worker)
        self._icd = icd
        self._device: Device | None = None
        self.serial: SerialLink | None = None
        self.can: CanLink | None = None
        self.canopen: CanopenLink | None = None
        self.feed: LiveFeed | None = None
        self._feed_wanted = ""
        """Where the feed was to listen, in the profile's words."""
        self.warm: PipelineReady | None = None
        self.ready_words: dict[str, str] = {}
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="state")
        self._closers: list[Callable[[], object]] = []
        self._pump: ClockPump | None = None
        self.stepper: StepPump | None = None
        self.faults = Faults(self)
        self.control: ControlServer | None = None
        self.ended = asyncio.Event()
        self._warming: asyncio.Task[None] | None = None
        self._revival: PipelineRevival | None = None
        self._awake = asyncio.Event()

    @property
    def device(self) -> Device:
        """The device.

        Raises
        ------
        EmulatorError
            The run was not started.
        """
        if self._device is None:
            raise EmulatorError("emulation: not started")
        return self._device

    def _make_imager(self, worker: WorkerProcess | None) -> ProcessImager | ThreadImager:
        setup = pipeline_setup(self.profile)
        if self.profile.run.worker == "process":
            return ProcessImager(setup, worker or WorkerProcess())
        if worker is not None:
            worker.end()
        return ThreadImager(setup)

    async def start(self) -> None:
        """Bring up truth, device and links, in this order; the pipeline warms behind.

        Raises
        ------
        EmulatorError, ProtocolError
            A file, port or bus cannot be had; one line.
        """
        icd = self._icd or load_icd()
        store = self._open_store()
        truth = await self.open_truth(self.profile.truth)
        stepped = isinstance(self.clock, SteppedClock)
        background = do_at_once if stepped else self._in_background()
        device = Device(self.profile, icd, self.clock, self.imager, store, truth, background)
        self._device = device
        if self.options.truth_log is not None:
            truth_log = TruthLog(self.options.truth_log, overwrite=self.options.overwrite)
            device.on_frame.append(truth_log.write)
            self._closers.append(truth_log.close)
        device.on_frame.append(_log_frame)
        scenario = load_scenario(self.options.scenario) if self.options.scenario else None
        device.power_on()
        try:
            await self._open_links(device)
            if scenario is not None:
                scenario.enter(self)
            if self.options.control != "off":
                self.control = ControlServer(self, self.ended.set, self.options.control_token)
                self.ready_words["control"] = await self.control.start(self.options.control)
        except (EmulatorError, ProtocolError):
            device.start_refused()
            raise
        if isinstance(self.clock, SteppedClock):
            transports = [link.transport for link in self._links()]
            self.stepper = StepPump(device.scheduler, self.clock, self.imager, transports)
        else:
            self._pump = ClockPump(device.scheduler, self.clock)
            self._pump.start()
        self._revival = PipelineRevival(
            self.imager, device, lambda warm: device.pipeline_ready(camera_constants(warm))
        )
        self._warming = asyncio.create_task(self._warm_up())

    @property
    def _state_dir(self) -> Path | None:
        """Folder of what survives a restart; None where nothing does."""
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

    async def open_truth(self, config: TruthConfig) -> TruthSource:
        """Make a truth source, with its socket if it is a live feed; the feed before it is closed.

        Raises
        ------
        EmulatorError
            A file is bad or a port cannot be had; the source before it stays.
        """
        truth = await asyncio.to_thread(config.build, self.clock.now_ns() / 1e9, self.profile.folder)
        if isinstance(truth, FileTruth) and isinstance(config, FileConfig) and config.start == "now":
            truth.start_s = self.clock.now_ns() / 1e9  # reading has taken time
        feed: LiveFeed | None = None
        if isinstance(config, LiveConfig) and isinstance(truth, LiveTruth):
            feed = LiveFeed(truth, lambda: self.clock.now_ns() / 1e9)
            wanted = f"{config.protocol}:{config.host}:{config.port}"
            if config.port != 0 and wanted in (self.ready_words.get("truth"), self._feed_wanted):
                self.close_feed()  # the same port: it has to be free first
                await asyncio.sleep(0)  # … and is so when the loop has come around
            where = await feed.start(config.protocol, config.host, config.port)
            self.close_feed()
            self.ready_words["truth"], self._feed_wanted = where, wanted
        else:
            self.close_feed()
        self.feed = feed
        return truth

    def close_feed(self) -> None:
        """Close the socket of the live feed, if there is one: another truth has taken its place."""
        if self.feed is not None:
            self.feed.close()
            self.feed = None
        self._feed_wanted = ""
        self.ready_words.pop("truth", None)

    async def _open_links(self, device: Device) -> None:
        links, seed = self.profile.links, self.profile.run.seed
        stepped = isinstance(self.clock, SteppedClock)  # what leaves at one run time leaves at once
        if links.serial.port != "off":
            from starhil.protocol.transports.serial import open_serial

            baud = int(device.parameters["serial_baud"])
            symlink = Path(links.serial.symlink).expanduser() if links.serial.symlink else None
            if symlink is not None:
                self._closers.append(claim_symlink(symlink).close)
            paced = None if links.serial.pace and not stepped else False
            transport = open_serial(links.serial.port, baud, symlink=symlink, paced=paced)
            self.serial = SerialLink(device, transport, seed)
            self.ready_words["serial"] = await self.serial.start()
            self.ready_words["dialect"] = str(device.parameters["serial_dialect"])
        if links.can.channel != "off":
            from starhil.protocol.transports.can import open_can

            self.can = CanLink(
                device, open_can(links.can.channel), 0.0 if stepped else links.can.frame_gap_s, seed
            )
            self.ready_words["can"] = await self.can.start()
        if links.canopen.node:
            await self._open_canopen(device)

    async def _open_canopen(self, device: Device) -> None:
        """Let the CANopen node join the bus of the CAN link, or the one that it would have."""
        from starhil.emulator.links.canopen import open_canopen
        from starhil.protocol.transports.can import open_can

        channel = self.profile.links.can.channel
        bus = self.ready_words.get("can") or ("auto" if channel == "off" else channel)
        transport = open_can(bus)
        self.canopen = open_canopen(device, transport, self._state_dir, self.profile.run.seed)
        taken = await self.canopen.start()
        self.ready_words.setdefault("can", taken)
        self.ready_words["canopen"] = str(device.parameters["canopen_node"])

    def _links(self) -> list[SerialLink | CanopenLink | CanLink]:
        """Return the links of the run in the order in which they are closed: the CAN link may hold the hub of the bus."""
        return [link for link in (self.serial, self.canopen, self.can) if link is not None]

    async def _warm_up(self) -> None:
        """Wait for the pipeline, then for boot to end."""
        device = self.device
        try:
            self.warm = await self.imager.start()
            log.info("pipeline ready: %d stars, %.2f s", self.warm.stars, self.warm.seconds)
            device.on_mode.append(
                lambda transition: self._awake.set() if transition.before is Mode.BOOT else None
            )
            device.pipeline_ready(camera_constants(self.warm))
        except EmulatorError as error:
            device.start_refused()
            raise EmulatorError(f"profile {self.profile.source}: {error}") from None
        except ProtocolError as error:  # a constant of the camera is beyond what its parameter can be
            device.start_refused()
            raise EmulatorError(f"profile {self.profile.source}: camera: {error}") from None
        if isinstance(self.clock, SteppedClock) or device.modes.mode is not Mode.BOOT:
            self._awake.set()

    async def ready(self) -> str:
        """Wait until the device takes commands; return the ready line.

        Raises
        ------
        EmulatorError
            The pipeline cannot be made: a missing catalogue, a camera that cannot be.
        """
        awake = asyncio.create_task(self._awake.wait())
        patience = asyncio.get_running_loop().call_later(PATIENCE_S, _tell_of_first_start)
        warming = self._warming
        if warming is None:
            raise EmulatorError("emulation: not started")
        await asyncio.wait({awake, warming}, return_when=asyncio.FIRST_COMPLETED)
        patience.cancel()
        if warming.done() and (error := warming.exception()) is not None:
            awake.cancel()
            raise error
        await awake
        words = {**self.ready_words, "seed": str(self.profile.run.seed), "clock": self.clock.name}
        return "ready " + " ".join(f"{key}={value}" for key, value in words.items())

    async def close(self) -> None:
        """End everything: links first, so that nothing new comes in, then the pipeline and the files.

        A part that does not close is logged, and keeps no other one open.
        """
        async with AsyncExitStack() as stack:
            for close in self._closers:  # entered in the reverse order: the last one is closed first
                stack.push_async_callback(_close_guarded, close)
            self._closers.clear()
            stack.push_async_callback(_close_guarded, partial(self._writer.shutdown, wait=True))
            stack.push_async_callback(_close_guarded, self.imager.close)
            stack.push_async_callback(_close_guarded, self.close_feed)
            if self.control is not None:
                stack.push_async_callback(_close_guarded, self.control.close)
            for link in reversed(self._links()):
                stack.push_async_callback(_close_guarded, link.close)
            if self._revival is not None:
                stack.push_async_callback(_close_guarded, self._revival.close)
            if self._warming is not None:
                stack.push_async_callback(_close_guarded, partial(_cancel, self._warming))
            if self._pump is not None:
                stack.push_async_callback(_close_guarded, self._pump.stop)


async def _close_guarded(close: Callable[[], object]) -> None:
    """Close one part; what that raises is logged."""
    try:
        closing = close()
        if inspect.isawaitable(closing):
            await closing
    except Exception as error:  # the other parts are to be closed still
        what = str(error) if isinstance(error, (EmulatorError, ProtocolError)) else one_line(error)
        log.error("closing: %s", what)  # noqa: TRY400 (one line)
        log.debug("closing", exc_info=True)


async def _cancel(task: asyncio.Task[None]) -> None:
    """End a task; what it has raised was reported by `ready`."""
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.exception()


def pipeline_setup(profile: Profile) -> PipelineSetup:
    """What the pipeline of a profile is made of."""
    path = profile.catalog.path
    return PipelineSetup(
        camera=profile.camera.values(),
        sensor=dict(profile.sensor),
        sky=dict(profile.sky),
        identifier=dict(profile.identifier),
        catalog_path=str(profile.folder / Path(path).expanduser()) if path else "",
        epoch=profile.catalog.epoch,
        algorithm=profile.run.algorithm,
        seed=profile.run.seed,
        build_in_background=profile.run.clock != "stepped",
    )


def camera_constants(warm: PipelineReady) -> dict[str, Value]:
    """Parameters that say of the camera what its optics are: a calibrated unit."""
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


def _tell_of_first_start() -> None:
    log.warning("a first start compiles its kernels, about a minute; the links answer already")


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
