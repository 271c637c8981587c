"""A run: one clock and one truth, and the heads that share them.

::

    Run ── clock     time, which stands still at the end of the boot until the pipelines of all heads are ready
     ├──── wiring    ports, pipelines and slow writes as they are, recorded, or played from a recording
     ├──── truth     where the body points; each head is mounted on it
     ├──── stepper   advances the stepped clock; other clocks advance by themselves
     └──── heads ──┬─ imager ── worker process
                   ├─ device ── cycle, modes, parameters, images, …, joined by device/signals.py
                   ├─ requests ── rows bound to quantities and actions of the device
                   ├─ links ── serial, can, canopen
                   └─ faults

`starhil.emulator.launch` adds what a user asks for: files, scenario, control channel and console.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

from starhil.emulator.device.surroundings import orbit_of
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.table import check_links
from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import SensorPipeline, make_pipeline
from starhil.emulator.run.head import Head
from starhil.emulator.run.pump import StepPump
from starhil.emulator.run.tape import FeedMessage, NewTruth
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from starhil.emulator.simulation.clock import make_clock
from starhil.emulator.simulation.guard import close_all
from starhil.emulator.simulation.threads import in_thread
from starhil.emulator.truth.truth import Truth, TruthHost
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import served


class Run:
    """A run of one or several heads.

    Truth and clock are those of the first profile. The pipeline worker of the first head may have been started
    earlier.
    """

    def __init__(
        self,
        profiles: Sequence[Profile],
        wiring: Wiring | None = None,
        worker: WorkerProcess | None = None,
        *,
        previews: bool = False,
    ) -> None:
        self.profile = profiles[0]
        self.wiring = wiring or Wiring(make_clock(self.profile.run.clock))
        self.clock = self.wiring.clock
        self.stepper: StepPump | None = None
        """Advances the stepped clock, once the run has begun; None with another clock."""
        self.time_passes = asyncio.Event()
        """Set when the pipeline of every head is ready: time then passes beyond the boot."""
        self._switched_on_ns = time.monotonic_ns() if worker is None else worker.started_ns
        """Time at which the devices were switched on, on the monotonic wall clock, nanoseconds."""
        self.heads: list[Head] = []
        """The heads, once the run is open."""
        host = TruthHost(
            self.clock,
            self.profile.run.clock,
            self.profile.start_unix_s,
            self.time_passes,
            self._step_in_lock,
            partial(self.wiring.enter, NewTruth),
            partial(self.wiring.enter, FeedMessage),
            not self.wiring.plays,
        )
        self.truth = Truth(self.profile.truth, self.profile.folder, host)
        units = [(profile, _unit_of(profile)) for profile in profiles]
        repeatable = self.wiring.repeatable
        self._plans: list[tuple[Profile, InterfaceDefinition, SensorPipeline]] = []
        """Profile, unit and pipeline of each head that is not made yet."""
        for profile, icd in units:
            imager = make_pipeline(profile, worker, repeatable=repeatable, previews=previews)
            self._plans.append((profile, icd, imager))
            worker = None

    @property
    def size(self) -> int:
        """Number of heads, also before the run is open."""
        return len(self.heads) + len(self._plans)

    async def open(self) -> None:
        """Make the heads, open links and truth, and let the boot time pass."""
        automatic = "auto"
        while self._plans:
            profile, icd, imager = self._plans[0]
            await in_thread(orbit_of, profile)  # of a file, which may be long; then the head has it at once
            head = Head(len(self.heads) + 1, profile, icd, imager, self.truth, self.wiring, self._start_time)
            self.heads.append(head)
            self._plans.pop(0)
            await head.open_links(automatic)
            if profile.links.can.channel == "auto":
                automatic = head.ready_fields.get("can", automatic)
        await self.truth.open()
        boot_s = min(head.profile.device.boot_s for head in self.heads)
        self.clock.switch_on(self._switched_on_ns, round(boot_s * NANOSECONDS))

    def withdraw_starts(self) -> None:
        """Do not count the last starts of the devices, because the run is rejected."""
        for head in self.heads:
            head.device.withdraw_start()

    def begin(self) -> None:
        """Start the pipelines; time passes beyond the boot when all are ready."""
        if (stepped := self.clock.stepped) is not None:
            devices = [(head.device.scheduler, head.imager) for head in self.heads]
            transports = [link.transport for head in self.heads for link in head.links.values()]
            self.stepper = StepPump(devices, transports, stepped, self.time_passes, self.wiring)
        self.wiring.begin()
        for head in self.heads:
            head.begin()

    def _start_time(self) -> None:
        if self.time_passes.is_set() or self._plans or any(head.warm is None for head in self.heads):
            return
        self.time_passes.set()
        self.clock.start()
        for head in self.heads:
            head.start_time()

    async def _step_in_lock(self, seconds: float) -> None:
        """Advance the clock for a simulator; the events of a replay are on its tape."""
        if self.stepper is not None:
            await self.stepper.step(seconds)

    async def ready(self) -> list[dict[str, str]]:
        """Wait until every device accepts commands; return the fields of the ready line of each."""
        return list(await asyncio.gather(*(head.ready() for head in self.heads)))

    async def close(self) -> None:
        """Stop time and close the heads, the last one first, even if one fails to close."""
        closers: list[Callable[[], object]] = [] if self.stepper is None else [self.stepper.stop]
        closers.append(self.truth.close)
        closers += [head.close for head in reversed(self.heads)]
        closers += [imager.close for _, _, imager in self._plans]
        await close_all(closers)


def _unit_of(profile: Profile) -> InterfaceDefinition:
    """Return the unit of a profile, which must have the requested links."""
    icd = load_unit(profile.unit_source)
    if errors := _unserved(icd):
        raise EmulatorError(*errors)
    check_links(profile, icd)
    return icd


@lru_cache(maxsize=8)
def _unserved(icd: InterfaceDefinition) -> list[str]:
    """Return what keeps a device from serving a definition; the heads of a run, and runs of a campaign, share bundled units."""
    return served(icd)[0]
