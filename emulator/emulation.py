"""An emulation: device, pipeline, links, truth and clock, opened, started and closed together."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

from starhil.emulator.clock import Clock, SteppedClock, make_clock
from starhil.emulator.device.cycle import Measurement
from starhil.emulator.device.device import Background, Device, outcome, run_at_once
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.state_store import FileStore, MemoryStore, StateStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import close_all
from starhil.emulator.links.base import Link
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.pipeline.imager import ProcessImager, ThreadImager
from starhil.emulator.pipeline.messages import PipelineReady, PipelineSetup
from starhil.emulator.pipeline.worker_process import WorkerProcess
from starhil.emulator.profile import Profile
from starhil.emulator.pump import ClockPump, StepPump
from starhil.emulator.revival import PipelineRevival
from starhil.emulator.symlink_lock import lock_symlink
from starhil.emulator.truth.config import FileConfig, LiveConfig, TruthConfig
from starhil.emulator.truth.file import FileTruth
from starhil.emulator.truth.live import LiveFeed, LiveTruth
from starhil.emulator.truth.source import TruthSource
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import load_unit
from starhil.protocol.values import Value

log = logging.getLogger("starhil.run")

PATIENCE_S: Final = 8.0
"""Time after which a slow start is explained in the log, seconds."""


class Emulation:
    """A device with its pipeline, links, truth and clock.

    Parameters
    ----------
    profile
        Profile of the unit.
    worker
        Pipeline worker that was started earlier; by default one is started here.

    Attributes
    ----------
    icd
        Interface definition of the profile's unit.
    ready_fields
        Fields of the ready line: which port, bus or address was opened for what.
    """

    def __init__(
        self,
        profile: Profile,
        worker: WorkerProcess | None = None,
    ) -> None:
        self.profile = profile
        self.icd = load_unit(profile.unit_source)
        self.clock: Clock = make_clock(profile.run.clock)
        self.imager: ProcessImager | ThreadImager = self._make_imager(worker)
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

    @property
    def requests(self) -> Requests:
        """The device's handling of requests.

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

    def _make_imager(self, worker: WorkerProcess | None) -> ProcessImager | ThreadImager:
        setup = pipeline_setup(self.profile)
        if self.profile.run.worker == "process":
            return ProcessImager(setup, worker or WorkerProcess())
        if worker is not None:
            worker.end()
        return ThreadImager(setup)

    async def open(self) -> None:
        """Open truth and links and switch the device on; its time stands still until `begin`.

        Raises
        ------
        EmulatorError, ProtocolError
            A file, port or bus is not available; one line.
        """
        store = self._open_store()
        truth = await self.open_truth(self.profile.truth)
        stepped = isinstance(self.clock, SteppedClock)
        background = run_at_once if stepped else self._in_background()
        device = Device(self.profile, self.icd, self.clock, self.imager, store, truth, background)
        self._requests = Requests(device)
        device.on_frame.append(_log_frame)
        device.power_on()
        try:
            await self._open_links(self._requests)
        except (EmulatorError, ProtocolError):
            device.withdraw_start()
            raise

    def begin(self) -> None:
        """Let time pass and start the pipeline; `ready` waits for it."""
        device = self.device
        if isinstance(self.clock, SteppedClock):
            transports = [link.transport for link in self.links]
            self.stepper = StepPump(device.scheduler, self.clock, self.imager, transports)
        else:
            self._pump = ClockPump(device.scheduler, self.clock)
            self._pump.start()
        self._revival = PipelineRevival(
            self.imager, device, lambda warm: device.pipeline_ready(camera_constants(warm))
        )
        self._warm_up_task = asyncio.create_task(self._warm_up())

    @property
    def _state_dir(self) -> Path | None:
        """Folder of the state that survives a restart; None to keep it in memory."""
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
        """Build a truth source, with its socket if it is a live feed, and close the previous feed.

        Raises
        ------
        EmulatorError
            A file is invalid or a port is not available; the previous source stays.
        """
        truth = await asyncio.to_thread(config.build, self.clock.now_ns() / 1e9, self.profile.folder)
        if isinstance(truth, FileTruth) and isinstance(config, FileConfig) and config.start == "now":
            truth.start_s = self.clock.now_ns() / 1e9  # reading has taken time
        feed: LiveFeed | None = None
        if isinstance(config, LiveConfig) and isinstance(truth, LiveTruth):
            feed = LiveFeed(truth, lambda: self.clock.now_ns() / 1e9)
            wanted = f"{config.protocol}:{config.host}:{config.port}"
            if config.port != 0 and wanted in (self.ready_fields.get("truth"), self._configured_feed):
                self.close_feed()  # the same port: it must be free first
                await asyncio.sleep(0)  # the loop closes it in its next turn
            where = await feed.start(config.protocol, config.host, config.port)
            self.close_feed()
            self.ready_fields["truth"], self._configured_feed = where, wanted
        else:
            self.close_feed()
        self.feed = feed
        return truth

    def set_truth(self, truth: TruthSource) -> None:
        """Replace the truth source by one without a socket."""
        self.device.cycle.truth = truth
        self.close_feed()

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
        if links.serial.port != "off":
            from starhil.protocol.transports.serial import open_serial

            baud = int(device.parameters["serial_baud"])
            symlink = Path(links.serial.symlink).expanduser() if links.serial.symlink else None
            if symlink is not None:
                self._closers.append(lock_symlink(symlink).close)
            paced = None if links.serial.pace and not stepped else False
            transport = open_serial(links.serial.port, baud, symlink=symlink, paced=paced)
            self.serial = SerialLink(requests, transport, seed)
            self.ready_fields["serial"] = await self.serial.start()
            self.ready_fields["dialect"] = str(device.parameters["serial_dialect"])
        if links.can.channel != "off":
            from starhil.protocol.transports.can import open_can

            self.can = CanLink(
                requests, open_can(links.can.channel), 0.0 if stepped else links.can.frame_gap_s, seed
            )
            self.ready_fields["can"] = await self.can.start()
        if links.canopen.node:
            await self._open_canopen(requests)

    async def _open_canopen(self, requests: Requests) -> None:
        """Open the CANopen link on the bus of the CAN link, or on the bus in its setting."""
        from starhil.emulator.links.canopen import open_canopen
        from starhil.protocol.transports.can import open_can

        channel = self.profile.links.can.channel
        bus = self.ready_fields.get("can") or ("auto" if channel == "off" else channel)
        transport = open_can(bus)
        link = open_canopen(requests, transport, self._state_dir, self.profile.run.seed)
        self.canopen = link
        opened = await link.start()
        self.ready_fields.setdefault("can", opened)
        self.ready_fields["canopen"] = str(requests.device.parameters["canopen_node"])

    @property
    def links(self) -> list[Link]:
        """Links in the order in which they are closed: the CAN link may hold the hub of the bus."""
        return [link for link in (self.serial, self.canopen, self.can) if link is not None]

    async def _warm_up(self) -> None:
        """Wait for the pipeline; the device then leaves the boot mode when its boot time is over."""
        device = self.device
        try:
            self.warm = await self.imager.start()
            log.info("pipeline ready: %d stars, %.2f s", self.warm.stars, self.warm.seconds)
            device.on_mode.append(
                lambda transition: self._awake.set() if transition.before is Mode.BOOT else None
            )
            device.pipeline_ready(camera_constants(self.warm))
        except EmulatorError as error:
            device.withdraw_start()
            raise EmulatorError(f"profile {self.profile.source}: {error}") from None
        except ProtocolError as error:  # a camera constant is outside the limits of its parameter
            device.withdraw_start()
            raise EmulatorError(f"profile {self.profile.source}: camera: {error}") from None
        if isinstance(self.clock, SteppedClock) or device.modes.mode is not Mode.BOOT:
            self._awake.set()

    async def ready(self) -> str:
        """Wait until the device takes commands; return the ready line.

        Raises
        ------
        EmulatorError
            The pipeline cannot start, for example for want of a catalogue; one line.
        """
        awake = asyncio.create_task(self._awake.wait())
        patience = asyncio.get_running_loop().call_later(PATIENCE_S, _warn_of_first_compilation)
        warm_up = self._warm_up_task
        if warm_up is None:
            raise EmulatorError("emulation: not started")
        await asyncio.wait({awake, warm_up}, return_when=asyncio.FIRST_COMPLETED)
        patience.cancel()
        if warm_up.done() and (error := warm_up.exception()) is not None:
            awake.cancel()
            raise error
        await awake
        fields = {**self.ready_fields, "seed": str(self.profile.run.seed), "clock": self.clock.name}
        return "ready " + " ".join(f"{key}={value}" for key, value in fields.items())

    async def close(self) -> None:
        """Close everything: links first, so that no more requests arrive, then the pipeline and the files.

        An error in closing one is logged, and the others are closed all the same.
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


def pipeline_setup(profile: Profile) -> PipelineSetup:
    """Return the pipeline configuration of a profile."""
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


def _warn_of_first_compilation() -> None:
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
