"""The real device with its real links in simulated time: fast and reproducible."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Self

from starhil.emulator.device.device import Device
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.state_store import MemoryStore
from starhil.emulator.launch.simulated_loop import SimulatedLoop
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.canopen import CanopenLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.profile import Profile
from starhil.emulator.run.pump import ClockPump
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.client import PipelineReply, PipelineRequest
from starhil.emulator.sensor.pipeline.jpg import compress_image
from starhil.emulator.sensor.pipeline.messages import (
    FrameResult,
    ImageRequest,
    ImageResult,
    JpgRequest,
    MatchedStar,
    as_quaternion,
)
from starhil.emulator.truth.source import FixedTruth
from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.canopen_probe import CanopenProbe
from starhil.hil_tests.conformance.canopen_suite import canopen_suite
from starhil.hil_tests.conformance.link_probe import ProbeTimes
from starhil.hil_tests.conformance.runner import Outcome, run_case
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.hil_tests.conformance.suites import can_suite, serial_suite, settings_of
from starhil.hil_tests.judge.canopen import entries
from starhil.hil_tests.judge.definition import read_unit, unit_of
from starhil.protocol.export import eds
from starhil.protocol.files.bundled import DEFAULT_UNIT, find_unit
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.paced import PacedTransport
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from tests.emulator.runs import DirectImager
from tests.protocol.canopen.conftest import import_eds

BAUD = 115200


class LoopClock:
    """Simulation time of the device, from the loop."""

    name = "real"
    speed = 1.0
    stepped = None

    def __init__(self, loop: SimulatedLoop) -> None:
        self._loop = loop
        self.running = self

    def now_ns(self) -> int:
        return round(self._loop.time() * NANOSECONDS)


class MemoryTransport(PacedTransport):
    """Joins the device to the tester without a wire; bytes take their time."""

    def __init__(self, *, paced: bool) -> None:
        super().__init__("virtual:memory", BAUD if paced else None)
        self.out: deque[Any] = deque()
        self.on_arrival: Callable[[], None] = lambda: None

    async def _open(self) -> None:
        """There is no port."""

    def _has_peer(self) -> bool:
        return True

    def _write(self, data: bytes) -> int:
        self._put(data)
        return len(data)

    def _put(self, item: Any) -> None:
        self.out.append(item)
        self.on_arrival()

    def send(self, item: Any) -> bool:
        if self._pace is not None:
            return super().send(item)
        self._put(item)
        return True

    def deliver(self, item: Any) -> None:
        """Hand an item to the device."""
        self._receive(item)

    async def drain(self) -> None:
        """Nothing waits here."""

    async def close(self) -> None:
        """Nothing to give back."""


class SimulatedPort:
    """The tester's end of a memory transport: the same calls as a live port."""

    def __init__(self, unit: SimulatedUnit) -> None:
        self._unit = unit

    def send(self, item: Any) -> None:
        self._unit.loop.call_soon(self._unit.transport.deliver, item)

    def receive(self, timeout_s: float) -> Any:
        loop, transport = self._unit.loop, self._unit.transport
        if not transport.out and timeout_s > 0:
            transport.on_arrival = loop.stop
            expiry = loop.call_later(timeout_s, loop.stop)
            loop.run_forever()
            expiry.cancel()
            transport.on_arrival = lambda: None
        else:
            loop.call_soon(loop.stop)
            loop.run_forever()
        return transport.out.popleft() if transport.out else None

    def now(self) -> float:
        return self._unit.loop.time()


STARS = (
    MatchedStar(32349, 86.0, 824.6, -1.44, 900.0, (-0.283, 0.264, 0.922), (0.0, 0.0, 1.0)),
    MatchedStar(27989, 361.0, 282.7, 0.45, 600.0, (-0.086, -0.149, 0.985), (0.0, 0.0, 1.0)),
)


class TruthImager:
    """A pipeline that returns the truth without rendering images."""

    def __init__(self) -> None:
        self.last = -1

    def handle(self, request: PipelineRequest) -> PipelineReply:
        if isinstance(request, ImageRequest):
            edge = request.edge or 10
            pixels = bytes(
                (row * 7 + column * 3 + self.last) % 256 for row in range(edge) for column in range(edge)
            )
            return ImageResult(edge, edge, self.last, pixels if self.last >= 0 else b"")
        if isinstance(request, JpgRequest):
            return compress_image(request)
        self.last = request.index
        if not request.solve:
            return FrameResult(request.index, solved=False)
        return FrameResult(
            request.index, valid=True, reason="ok", tracked=request.predicted is not None,
            quaternion_xyzw=as_quaternion(request.truth.attitude), sigma_cross_arcsec=1.5, sigma_roll_arcsec=6.0,
            covariance_rad2=((5.3e-11, 0.0, 0.0), (0.0, 5.3e-11, 0.0), (0.0, 0.0, 8.5e-10)), detected=40,
            refused=3, matched=35, stars=STARS, probability_false=1e-12, rms_px=0.1, background_dn=8.2, noise_dn=0.61,
        )  # fmt: skip


LINKS: dict[str, Callable[..., Any]] = {"serial": SerialLink, "can": CanLink, "canopen": CanopenLink}
SUITES: dict[str, Callable[..., Any]] = {"serial": serial_suite, "can": can_suite, "canopen": canopen_suite}


class SimulatedUnit:
    """A device in simulated time, with one link and a probe on it; a context manager.

    `damage` is called with the unit before the device is switched on: it is how mutants are made. Another way is to
    have the device serve another definition than that of the tester: a folder, in `served`. `parameters` are those of the profile; the
    others have the unit's defaults, as of `starhil conformance --start`. `icd` is the definition of the unit, if it has been read.
    """

    def __init__(
        self,
        link: str,
        damage: Callable[[SimulatedUnit], None] | None = None,
        dialect: str = "b",
        unit: str | Path = DEFAULT_UNIT,
        served: Path | None = None,
        parameters: Mapping[str, Any] | None = None,
        icd: InterfaceDefinition | None = None,
    ) -> None:
        self.loop = SimulatedLoop()
        self.kind = link
        self.dialect = dialect
        self.icd = icd or load_unit(unit)
        self.judged = (
            read_unit(unit) if icd is None and isinstance(unit, str) else unit_of(self.icd, find_unit(unit))
        )
        self._served = self.icd if served is None else load_unit(served)
        self._damage = damage
        self._parameters = parameters or {}

    def __enter__(self) -> Self:
        asyncio.set_event_loop(self.loop)
        self.loop.run_until_complete(self._start())
        port = SimulatedPort(self)
        times = ProbeTimes(answer_s=0.5, quiet_s=0.1, boot_s=5.0, image_s=10.0)
        self.probe: SerialProbe | CanProbe | CanopenProbe
        unit = self.judged
        if self.kind == "canopen":
            node = int(self.icd.parameters["canopen_node"].default)
            text = eds.render(self.icd)
            self.probe = CanopenProbe(port, node, import_eds(text, node), text, entries(unit, unit.canopen))
            self.loop.run_until_complete(asyncio.sleep(1.0))
            return self
        if self.kind == "serial":
            self.probe = SerialProbe(
                port, unit, dialect=self.dialect, baud=BAUD, times=times, settings=settings_of(unit)
            )
        else:
            self.probe = CanProbe(port, unit, times=times, settings=settings_of(unit))
        self.probe.sleep(1.0)
        return self

    async def _start(self) -> None:
        self.imager = DirectImager(TruthImager().handle)
        attitude = Attitude.from_radec_roll(83.8, -1.2, 0.0)
        links = {"serial": {"dialect": self.dialect}}
        profile = Profile.model_validate({"links": links, "parameters": self._parameters})
        self.store = MemoryStore()
        self.device = Device(
            profile, self._served, LoopClock(self.loop), self.imager, self.store, FixedTruth(attitude)
        )
        self.requests = Requests(self.device)
        self.transport = MemoryTransport(paced=self.kind == "serial")
        self.link = LINKS[self.kind](self.requests, self.transport)
        if self._damage is not None:
            self._damage(self)
        self.device.power_on()
        await self.link.start()
        self.pump = ClockPump(self.device.scheduler, Wiring(self.device.clock))
        self.pump.start()
        self.device.pipeline_ready({})

    def __exit__(self, *error: object) -> None:
        self.pump.stop()
        self.loop.run_until_complete(self.link.close())
        self.loop.close()
        asyncio.set_event_loop(None)


def outcomes(link: str, unit: str | Path, dialect: str = "b") -> Iterator[Outcome]:
    """Yield the outcomes of the cases of a link."""
    with SimulatedUnit(link, dialect=dialect, unit=unit) as simulated:
        for case in SUITES[link](simulated.judged):
            yield run_case(simulated.probe, case)


@cache
def healthy_outcomes(link: str, unit: str, dialect: str = "b") -> tuple[Outcome, ...]:
    """Return the outcomes of the cases of an intact bundled unit, for all modules that look at them."""
    return tuple(outcomes(link, unit, dialect))
