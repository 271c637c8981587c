"""A head: one device with its pipeline, links, faults and stored state.

Clock and truth belong to the run (`starhil.emulator.run`). The steps in the life of a head:

1. It is made: the store is opened and the device is switched on.
2. `open_links` opens ports and buses.
3. `begin` starts the pipeline, which makes the head `warm`; the run lets time pass when all heads are.
4. `ready`: the device has left the boot mode, or waits for the steps of the stepped clock.
5. `close`: links first, so that no more requests arrive, then pipeline, pending writes and files.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from urllib.parse import quote

from starhil.emulator.device.device import Background, Device, constants_to_adopt, outcome, run_at_once
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Transition
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.state_store import FileStore, MemoryStore, StateStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.table import LINKS, LinkSite
from starhil.emulator.links.traffic import Traffic
from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import SensorPipeline
from starhil.emulator.run.faults import Faults
from starhil.emulator.run.pump import ClockPump
from starhil.emulator.run.revival import PipelineRevival
from starhil.emulator.run.tape import PipelineState
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.pipeline.messages import IndexRequest, PipelineReady, camera_constants
from starhil.emulator.sensor.star_count import few_stars
from starhil.emulator.simulation.clock import Clock
from starhil.emulator.simulation.guard import close_all
from starhil.emulator.truth.truth import SensorTruth, Truth
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.values import Value
from starhil.protocol.serial.cubespace import Dialect

log = logging.getLogger("starhil.run")


class Head:
    """One device of a run, with its pipeline, which is not started yet, and the truth of the body on which it is mounted.

    `on_warm` is called when the pipeline is ready, also after a restart.
    """

    def __init__(
        self,
        number: int,
        profile: Profile,
        icd: InterfaceDefinition,
        imager: SensorPipeline,
        truth: Truth,
        wiring: Wiring,
        on_warm: Callable[[], None],
    ) -> None:
        self.number = number
        self.profile = profile
        self.icd = icd
        self.imager = imager
        self.clock: Clock = wiring.clock
        self.links: dict[str, AnyLink] = {}
        """The open links, in the order of opening."""
        self.traffic = Traffic()
        self.ready_fields: dict[str, str] = {}
        """Fields of the ready line: the opened ports and buses."""
        self.warm: PipelineReady | None = None
        """What the pipeline reported when it was last ready; None before."""
        self._wiring = wiring
        self._on_warm = on_warm
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="state")
        self._writes: set[asyncio.Future[EmulatorError | None]] = set()
        self._pump: ClockPump | None = None
        self._warm_up_task: asyncio.Task[None] | None = None
        self._revival: PipelineRevival | None = None
        self._awake = asyncio.Event()
        store: StateStore = MemoryStore() if self._state_dir is None else FileStore(self._state_dir)
        self._closers: list[Callable[[], object]] = [store.close]
        background = run_at_once if self.clock.stepped else self._in_background()
        mount = None if profile.truth.mount is None else profile.truth.mount.build()
        try:
            self.device = Device(
                profile,
                icd,
                self.clock,
                wiring.imager(imager),
                store,
                SensorTruth(truth, mount),
                wiring.background(background),
            )
            self.requests = Requests(self.device)
            self.faults = Faults(self.requests, self.links)
            self.device.signals.frame_published.connect(_log_frame)
            self.device.power_on()
        except EmulatorError:
            store.close()
            raise

    @property
    def _state_dir(self) -> Path | None:
        """Folder for state that survives a restart; None: it is kept in memory."""
        state_dir = self.profile.run.state_dir
        return self.profile.folder / state_dir if state_dir else None

    def _in_background(self) -> Background:
        loop = asyncio.get_running_loop()

        def background(work: Callable[[], None], done: Callable[[EmulatorError | None], None]) -> None:
            def ended(write: asyncio.Future[EmulatorError | None]) -> None:
                self._writes.discard(write)
                done(write.result())

            write = loop.run_in_executor(self._writer, outcome, work)
            self._writes.add(write)
            write.add_done_callback(ended)

        return background

    # --- links ---

    async def open_links(self, automatic: str = "auto") -> None:
        """Open ports and buses; `automatic` is the CAN bus for the channel `auto`, such as that of another head."""
        site = LinkSite(
            self.requests, self._wiring, self._state_dir, automatic, self.ready_fields, self._closers
        )
        for name, kind in LINKS.items():
            if kind.opens(self.profile.links, self.icd):
                link = self.links[name] = kind.make(site)
                self.traffic.add(link)
                await link.start()
                self.ready_fields |= {**link.ready_fields, **self.ready_fields}
        for name, value in self.ready_fields.items():
            if any(character.isspace() for character in value):
                raise EmulatorError(
                    f"{name} {value!r}: must be a name without blanks, which end a field of the ready line"
                )

    def serial_dialect(self) -> Dialect | None:
        """Return the current dialect of the serial line; None without a line or dialects."""
        return self.links["serial"].dialect if "serial" in self.links else None

    # --- pipeline and time ---

    def begin(self) -> None:
        """Start the pipeline; `ready` waits for it."""
        if self.clock.stepped is None:
            self._pump = ClockPump(self.device.scheduler, self._wiring)
        self._revival = PipelineRevival(self.imager, self.device, self.pipeline_ready, self._record)
        self._warm_up_task = asyncio.create_task(self._warm_up())

    async def _warm_up(self) -> None:
        """Wait for the pipeline; after that, the device leaves the boot mode at the end of its boot time."""
        device = self.device
        try:
            warm = await self.imager.start()
            log.info("pipeline ready: %d stars, %.2f s", warm.stars, warm.seconds)
            prepared = await self._rehearse(camera_constants(warm.camera))
            self._record("ready")
            device.signals.mode_changed.connect(self._mode_changed)
            device.signals.restarted.connect(self._device_reset)
            self._adopt(warm)
            if warning := few_stars(
                warm.camera, SensorModel().with_(**self.profile.sensor), device.parameters
            ):
                log.warning("%s", warning)
            if self.device.cycle.index_request() != prepared:  # the OBC has set parameters during the boot
                self._prepare_index()
            self._on_warm()
        except EmulatorError as error:
            raise EmulatorError(f"{self.profile.source_of(error)}: {error}") from None
        except ProtocolError as error:  # a camera constant is outside the limits of its parameter
            raise EmulatorError(f"profile {self.profile.source}: camera: {error}") from None
        if self.clock.stepped or device.modes.mode is not Mode.BOOT:
            self._awake.set()

    async def _rehearse(self, constants: dict[str, Value]) -> IndexRequest:
        """Let the pipeline prepare frames, and wait until it has; return the request for their index."""
        device = self.device
        request = device.cycle.rehearsal(constants_to_adopt(device.parameters, self.profile, constants))
        self.imager.prepare(request)
        await self.imager.settle()
        return replace(request, rehearsal=None)

    def _record(self, kind: str) -> None:
        self._wiring.enter(PipelineState, do=kind)

    def _mode_changed(self, transition: Transition) -> None:
        if transition.before is Mode.BOOT:
            self._awake.set()

    def pipeline_ready(self, warm: PipelineReady) -> None:
        """Pass the camera of a ready pipeline to the device, and the device's parameters to the pipeline."""
        self._adopt(warm)
        self._prepare_index()
        self._on_warm()

    def _adopt(self, warm: PipelineReady) -> None:
        self.warm = warm
        self.device.pipeline_ready(camera_constants(warm.camera))

    def _prepare_index(self) -> None:
        """Have the star index built for the parameters with which the device starts, before its first frame."""
        self.imager.prepare(self.device.cycle.index_request())

    def _device_reset(self, _cause: str) -> None:
        if self.device.warm:
            self._prepare_index()

    def start_time(self) -> None:
        """Run the events of the device from now on."""
        if self._pump is not None:
            self._pump.start()

    async def ready(self) -> dict[str, str]:
        """Wait until the device accepts commands, and publish its ports; return the fields of the ready line, without blanks."""
        awake = asyncio.create_task(self._awake.wait())
        warm_up = self._warm_up_task
        if warm_up is None:
            raise EmulatorError("head: not started")
        await asyncio.wait({awake, warm_up}, return_when=asyncio.FIRST_COMPLETED)
        if warm_up.done() and (error := warm_up.exception()) is not None:
            awake.cancel()
            raise error
        await awake
        for link in self.links.values():
            link.transport.publish()
        profile = self.profile
        chosen = {
            "unit": profile.unit_source,
            "unit_version": self.icd.version,
            "profile": profile.name_or_path,
            "seed": str(profile.run.seed),
            "orbit": "none" if profile.orbit is None else profile.orbit.kind,
        }
        return self.ready_fields | {key: quote(value, safe="/:.~") for key, value in chosen.items()}

    async def close(self) -> None:
        """Close everything, even if closing one of them fails, which is logged."""
        closers: list[Callable[[], object]] = []
        if self._pump is not None:
            closers.append(self._pump.stop)
        if self._warm_up_task is not None:
            closers.append(partial(_cancel, self._warm_up_task))
        if self._revival is not None:
            closers.append(self._revival.close)
        closers += [
            link.close for link in reversed(self.links.values())
        ]  # CAN after CANopen: it may run the hub
        closers += [self.imager.close, self._finish_writing]
        closers += reversed(self._closers)
        self._closers.clear()
        await close_all(closers)

    async def _finish_writing(self) -> None:
        """Wait for the writes in progress, and for those that follow from their outcomes, which arrive in the event loop."""
        while self._writes:
            await asyncio.wait(self._writes)
        self._writer.shutdown(wait=True)


async def _cancel(task: asyncio.Task[None]) -> None:
    """Cancel a task; `ready` has reported its exception."""
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.exception()


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
