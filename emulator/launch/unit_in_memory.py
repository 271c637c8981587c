"""A unit that runs in memory on the stepped clock: power, surroundings and the device's end of its links."""

from __future__ import annotations

import asyncio
import logging
import os
import resource
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from starhil.emulator.device.device import PIPELINE_ENDED
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch.emulator import Emulator, RunOptions
from starhil.emulator.links.table import LINKS
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from starhil.emulator.run.faults import FaultRequest
from starhil.emulator.run.head import Head
from starhil.emulator.run.pump import MAX_STEP_S
from starhil.emulator.run.tape import ClearedFaults, NewFaults
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.client import WorkerClient
from starhil.emulator.sensor.pipeline.error_model import ErrorModel
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.truth.config import TruthConfig
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.validation import problems
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport

Item = TypeVar("Item", bytes, CanFrame)

QUEUE_LIMIT: Final = 5000
DESCRIPTOR_LIMIT: Final = 4
MEMORY_LIMIT_BYTES: Final = 64 * 2**20
"""A life may queue so many events, and add so many descriptors and bytes to those in use after its first power-on."""
STATE_FOLDER: Final = "state"
LONGEST_STANDSTILL_S: Final = 120.0
"""Wall time for which the successor of a killed pipeline may use no processor time before it is ready, seconds; a busy machine
may let it wait, but not for so long."""
RESTART_LOOK_S: Final = 0.01
"""Wall time between two looks at a pipeline that is restarted, seconds; at each, processes and the event loop have their turn."""
RESTARTING_STEP_S: Final = 0.1
"""Longest step while the pipeline is restarted, whose pauses are of the event loop, seconds."""
TRUTH: Final[TypeAdapter[TruthConfig]] = TypeAdapter(TruthConfig)


class MemoryTransport(Transport[Item]):
    """The device's end of a link without a wire."""

    immediate: ClassVar[bool] = True

    def __init__(self, description: str, now_s: Callable[[], float]) -> None:
        super().__init__(description)
        self._now_s = now_s
        self.sent: list[tuple[float, Item]] = []
        """Items that the device has sent and that have not been read, each with its time, seconds."""
        self.reads = True
        """Whether the peer reads; otherwise what the device sends is dropped, as on a pty without a reader."""

    async def _open(self) -> None:
        """Do nothing: there is no port."""

    def send(self, item: Item) -> bool:
        count = len(item) if isinstance(item, bytes) else 1
        if not self.reads:
            self.statistics.dropped += count
            return False
        self.statistics.sent += count
        self.sent.append((self._now_s(), item))
        return True

    def deliver(self, item: Item) -> None:
        self._receive(item)

    async def drain(self) -> None:
        """Return at once: nothing waits."""

    async def close(self) -> None:
        """Do nothing: there is no port."""


class MemorySerial(MemoryTransport[bytes], SerialTransport):
    """The device's end of a serial line."""

    def set_baud(self, baud: int) -> None:
        """Do nothing: bytes take no time."""


class MemoryWiring(Wiring):
    """Connects a run to transports in memory."""

    repeatable = True

    def __init__(
        self, lines: Mapping[str, MemorySerial], buses: Mapping[str, MemoryTransport[CanFrame]]
    ) -> None:
        super().__init__(SteppedClock())
        self._lines = lines
        self._buses = buses

    def serial(self, name: str, make: Callable[[], SerialTransport]) -> SerialTransport:  # noqa: ARG002 (no port is opened)
        return self._lines[name]

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:  # noqa: ARG002 (no bus is opened)
        return self._buses[name]


class _InternalErrors(logging.Handler):
    """Collects what the emulator logs as internal errors."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


class UnitUnderTest:
    """An emulated unit in memory, with the open links and the keys of a profile.

    The folder of its state is best in memory too (tmpfs). Images are `rendered` and solved in a process; otherwise
    the pipeline is an error model. `record` is the folder of a recording of the time since power was last switched
    on.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        unit: str,
        links: tuple[str, ...],
        profile: Mapping[str, Any],
        seed: int,
        folder: Path,
        *,
        rendered: bool = False,
        record: Path | None = None,
    ) -> None:
        self.links = links
        run = {
            **profile.get("run", {}),
            "seed": seed,
            "clock": "stepped",
            "worker": "process" if rendered else "error_model",
            "state_dir": str(folder.resolve() / STATE_FOLDER),
        }
        channels: dict[str, dict[str, str | int]] = {}
        for name, kind in LINKS.items():
            section, key = kind.key.split(".")
            with_bus = name in links or (name == "can" and icd.canopen_only)
            channels[section] = {key: kind.usual(icd) if with_bus else kind.off}
        table = {**profile, "unit": unit, "run": run, "links": channels}
        try:
            self.profile = Profile.model_validate(table)
        except ValidationError as error:
            raise EmulatorError(*map(str, problems(error, Profile, table))) from None
        for name, value in self.profile.parameters.items():
            if name in icd.device_parameters:
                icd.device_parameters[name].check(value)
        self._folder = folder
        self._record = record
        self._emulator: Emulator | None = None
        self.frames = 0
        self.exposed_s = 0.0
        """Number of images solved in all, and the sum of their periods, seconds."""
        self._unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
        self._transports: dict[str, MemoryTransport[Any]] = {}
        self._first: tuple[int, int] | None = None
        """Descriptors and memory, bytes, in use when power was first on."""
        self._errors = _InternalErrors()
        logging.getLogger("starhil.internal").addHandler(self._errors)

    @property
    def run(self) -> Run:
        """The run; power must be on."""
        if self._emulator is None:
            raise EmulatorError("endurance: power is off")
        return self._emulator.run

    @property
    def head(self) -> Head:
        """The head of the run; power must be on."""
        return self.run.heads[0]

    # --- power ---

    async def power_on(self) -> None:
        """Switch the unit on and wait until the emulator is ready; simulation time begins at zero."""
        reads = {name: transport.reads for name, transport in self._transports.items()}
        self._emulator = None
        lines = {
            name: MemorySerial(name, self._time_s) for name, kind in LINKS.items() if kind.carries is bytes
        }
        buses: dict[str, MemoryTransport[CanFrame]] = {
            name: MemoryTransport(f"virtual:{name}", self._time_s)
            for name, kind in LINKS.items()
            if kind.carries is CanFrame
        }
        self._transports = {**lines, **buses}
        for name, transport in self._transports.items():
            transport.reads = reads.get(name, True)
        if self._record is not None:
            shutil.rmtree(self._record, ignore_errors=True)
        options = RunOptions(record=self._record)
        self._emulator = Emulator([self.profile], options, wiring=MemoryWiring(lines, buses))
        await self._emulator.start()
        self.head.device.signals.frame_published.connect(self._count_frame)
        await self._emulator.ready()
        self._first = self._first or (self.open_descriptors(), self.memory_bytes())

    async def power_off(self, *, factory: bool = False) -> None:
        """Switch the unit off; `factory` deletes its stored state."""
        if self._emulator is not None:
            await self._emulator.close()
        if factory:
            shutil.rmtree(self._folder / STATE_FOLDER, ignore_errors=True)

    # --- time and links ---

    @property
    def now_s(self) -> float:
        """Simulation time since power was switched on, seconds."""
        return self.run.clock.now_ns() / NANOSECONDS

    def _time_s(self) -> float:
        """Return the simulation time; it is zero while the run is being opened."""
        return 0.0 if self._emulator is None else self.now_s

    def _count_frame(self, measurement: Measurement) -> None:
        self.frames += 1
        self.exposed_s += measurement.period_s

    async def step(self, seconds: float, *, most: int | None = None) -> None:
        """Let simulation time pass, and the same time of the event loop; end early after about `most` events in the unit."""
        stepper = self.run.stepper
        if stepper is None:
            raise EmulatorError("endurance: the clock is not stepped")
        left, chunk, done = seconds, seconds if most is None else 1.0, 0
        while left > 0.0:
            chunk = min(left, chunk, RESTARTING_STEP_S if self._is_restarting() else MAX_STEP_S)
            done += await stepper.step(chunk)
            await asyncio.sleep(chunk)
            left -= chunk
            if most is not None and done >= most:
                break
            chunk *= 2.0 if most is None or done < most // 4 else 1.0

    def _is_restarting(self) -> bool:
        device = self.head.device
        return not device.warm and device.modes.error != PIPELINE_ENDED

    def deliver(self, link: str, item: bytes | CanFrame) -> None:
        self._transports[link].deliver(item)

    def take(self, link: str) -> list[tuple[float, Any]]:
        """Return what the device has sent on a link since the last call, each item with its time, seconds."""
        sent = self._transports[link].sent
        taken = list(sent)
        sent.clear()
        return taken

    def is_late(self, link: str) -> bool:
        return self.head.links[link].wire.holds

    # --- surroundings ---

    async def set_truth(self, truth: Mapping[str, Any]) -> None:
        """Replace the truth by a table as `[truth]` in a profile."""
        await self.run.truth.set(TRUTH.validate_python(dict(truth)))

    def fault(self, fault: Mapping[str, Any]) -> None:
        """Inject faults, a request as on the control channel."""
        request = FaultRequest.model_validate(dict(fault))
        self.run.wiring.enter(NewFaults, request=request)
        self.head.faults.inject(request)

    def clear_faults(self) -> None:
        self.run.wiring.enter(ClearedFaults)
        self.head.faults.clear()

    async def end_pipeline(self) -> bool:
        """End the image pipeline; return whether it has been restarted.

        A process is killed, and its successor awaited, which takes no simulation time, and as much other time as it needs.
        """
        imager, device = self.head.imager, self.head.device
        if isinstance(imager, ErrorModel):
            imager.end("pipeline: ended by an endurance run")
            return True
        if not isinstance(imager, WorkerClient) or not isinstance(imager.worker, WorkerProcess):
            raise EmulatorError("endurance: the pipeline is in a thread, which cannot be ended")
        imager.worker.process.kill()
        for ready in (False, True):
            spent, since_s = -1.0, time.monotonic()
            while device.warm is not ready:
                if device.modes.error == PIPELINE_ENDED:
                    return False
                if (now_spent := _processor_time_s(imager.worker.process.pid)) != spent:
                    spent, since_s = now_spent, time.monotonic()
                if time.monotonic() - since_s > LONGEST_STANDSTILL_S:
                    return False
                await asyncio.sleep(RESTART_LOOK_S)
                time.sleep(RESTART_LOOK_S)
        return True

    def set_disk(self, *, full: bool) -> None:
        """Set whether this process can write to files; by the kernel, so that it concerns every writer."""
        _, hard = self._unlimited
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard) if full else self._unlimited)

    def set_peer(self, link: str, *, reads: bool) -> None:
        self._transports[link].reads = reads

    # --- what the bus does not show ---

    def defect(self) -> str:
        """Return an internal error that was logged, or what has grown since power was first switched on; empty if nothing."""
        if self._errors.texts:
            return f"internal error: {self._errors.texts[0]}"
        if (queued := self.queued_events()) > QUEUE_LIMIT:
            return f"{queued} events are queued"
        descriptors, memory_bytes = self._first or (0, 0)
        if (found := self.open_descriptors()) > descriptors + DESCRIPTOR_LIMIT:
            return f"{found} descriptors are open, {descriptors} at the start"
        added = self.memory_bytes() - memory_bytes
        return f"{added >> 20} MiB of memory more than at the start" if added > MEMORY_LIMIT_BYTES else ""

    def open_descriptors(self) -> int:
        """Return the number of open file descriptors of this process."""
        return len(list(Path("/proc/self/fd").iterdir()))

    def queued_events(self) -> int:
        return self.head.device.scheduler.count

    def memory_bytes(self) -> int:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * resource.getpagesize()

    def dispose(self) -> None:
        """Remove the log handler and the limit of files."""
        logging.getLogger("starhil.internal").removeHandler(self._errors)
        self.set_disk(full=False)


def _processor_time_s(process: int) -> float:
    """Return the processor time of a process, seconds; 0 if it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def links_of(icd: InterfaceDefinition) -> tuple[str, ...]:
    return tuple(name for name, kind in LINKS.items() if kind.is_of(icd))
