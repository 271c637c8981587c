"""A device on a stepped clock, with a pipeline that sees the truth without rendering images."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from starhil.emulator.device.device import Device
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.state_store import MemoryStore, StateStore
from starhil.emulator.launch import Emulator, RunOptions
from starhil.emulator.profile import Profile
from starhil.emulator.sensor.pipeline import worker_process
from starhil.emulator.sensor.pipeline.client import PipelineReply, PipelineRequest
from starhil.emulator.sensor.pipeline.jpg import compress_image
from starhil.emulator.sensor.pipeline.messages import (
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    JpgRequest,
    MatchedStar,
    Preview,
)
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.truth.source import FixedTruth, TruthSource
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA
from tests.emulator.runs import DirectImager, FakeImager, FirstHead

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)


def star(hip, x, y, magnitude, snr):
    """An identified star where the default camera sees it."""
    (vector,) = DEFAULT_CAMERA.back_project([[x, y]]).tolist()
    return MatchedStar(hip, x, y, magnitude, snr, tuple(vector), (0.0, 0.0, 0.0))


STARS = (
    star(32349, 86.0, 824.6, -1.44, 900.0),
    star(101772, 578.0, 618.6, 0.18, 700.0),
    star(27989, 361.0, 282.7, 0.45, 600.0),
    star(21421, 793.0, 65.7, 0.87, 500.0),
)

COVARIANCE = ((5.3e-11, 0.0, 0.0), (0.0, 5.3e-11, 0.0), (0.0, 0.0, 8.5e-10))
"""Of 1.5″ across the boresight and 6″ about it, rad²."""

PREVIEW = Preview(b"jpeg of a frame", b'{"width": 937, "height": 937, "hips": [32349]}')


@dataclass
class FakePipeline:
    """Answers each request at once: the attitude is the truth, unless it is set to fail."""

    requests: list[PipelineRequest] = field(default_factory=list)
    fail: str = ""
    turn_rad: float = 0.0
    window_rad: float = math.inf
    """Largest error of a prediction from which the attitude is found."""
    last_index: int = -1

    def handle(self, request: PipelineRequest) -> PipelineReply:
        """Answer a request as the pipeline does."""
        self.requests.append(request)
        if isinstance(request, ImageRequest):
            edge = request.edge or 10
            pixels = bytes(n % 251 for n in range(edge)) * edge
            return ImageResult(edge, edge, self.last_index, pixels if self.last_index >= 0 else b"")
        if isinstance(request, JpgRequest):
            return compress_image(request)
        self.last_index = request.index
        if not request.solve:
            return FrameResult(request.index, solved=False)
        tracked = request.predicted is not None
        if self.fail:
            return FrameResult(request.index, reason=self.fail, tracked=tracked, detected=2)
        attitude = request.truth.attitude.rotated((self.turn_rad, 0.0, 0.0))
        if tracked:
            missed = attitude.error_to(request.predicted).rotation_vector_rad
            if np.linalg.norm(missed) > self.window_rad:
                return FrameResult(request.index, reason="prediction_lost", tracked=True, detected=40)
        x, y, z, w = attitude.quaternion_xyzw.tolist()
        return FrameResult(
            request.index,
            valid=True,
            reason="ok",
            tracked=tracked,
            quaternion_xyzw=(x, y, z, w),
            sigma_cross_arcsec=1.5,
            sigma_roll_arcsec=6.0,
            covariance_rad2=COVARIANCE,
            detected=40,
            refused=3,
            matched=35,
            stars=tuple(
                replace(star, icrs=tuple((attitude.matrix.T @ star.vector).tolist())) for star in STARS
            ),
            probability_false=1e-12,
            rms_px=0.1,
            background_dn=8.2,
            noise_dn=0.61,
            preview=PREVIEW if request.preview else None,
        )

    @property
    def frames(self) -> list[FrameRequest]:
        """The requests for frames."""
        return [request for request in self.requests if isinstance(request, FrameRequest)]


class Bench:
    """A device, its stepped clock, and short ways to command and read it."""

    def __init__(
        self,
        profile: Profile | None = None,
        store: StateStore | None = None,
        truth: TruthSource | None = None,
        unit: str = DEFAULT_UNIT,
        clock: SteppedClock | None = None,
    ) -> None:
        self.clock = clock or SteppedClock()
        self.pipeline = FakePipeline()
        self.icd = load_unit(unit)
        self.store = store or MemoryStore()
        self.later: list[Reply] = []
        """Answers that came when a telecommand was done."""
        self.imager = DirectImager(self.pipeline.handle)
        self.device = Device(
            profile or Profile(),
            self.icd,
            self.clock,
            self.imager,
            self.store,
            truth or FixedTruth(ORION),
        )
        self.requests = Requests(self.device)

    def start(self) -> Bench:
        """Power on and boot."""
        self.device.power_on()
        self.device.pipeline_ready({})
        self.step(1.0)
        return self

    def step(self, seconds: float) -> None:
        """Let simulation time pass."""
        end_ns = self.clock.now_ns() + round(seconds * 1e9)
        while (event := self.device.scheduler.pop_due(end_ns)) is not None:
            self.clock.set_ns(max(event.due_ns, self.clock.now_ns()))
            event.action(event.due_ns)
        self.clock.set_ns(end_ns)

    def send(self, name: str, data: bytes | None = None, **values: object) -> list[Reply]:
        """Send a telecommand; return all replies."""
        row = self.icd.telecommands[name]
        request = self.icd.request(row, row.encode(values) if data is None else data)
        answer = self.requests.handle(request)
        if not isinstance(answer, PendingAnswer):
            return answer
        answer.when_done(self.later.extend)
        return []

    def command(self, name: str, **values: object) -> ErrorCode:
        """Send a telecommand; return what it was answered with."""
        reply = self.send(name, **values)[0]
        assert (reply.kind is ReplyKind.ACK) == (reply.code == ErrorCode.OK)
        return ErrorCode(reply.code)

    def read(self, name: str) -> dict:
        """Read telemetry in physical units."""
        return self.icd.telemetry[name].decode(self.data(name))

    def data(self, name: str) -> bytes:
        """Read the bytes of telemetry."""
        (reply,) = self.requests.handle(self.icd.request(self.icd.telemetry[name]))
        assert reply.kind is ReplyKind.TELEMETRY, reply
        return reply.data

    @property
    def mode(self) -> str:
        """Present mode."""
        return self.device.modes.mode.value


@pytest.fixture
def bench() -> Bench:
    """A device in standby."""
    return Bench().start()


@pytest.fixture
def make_bench() -> Callable[..., Bench]:
    """Make devices with custom settings."""
    return Bench


@pytest.fixture
def run(monkeypatch, make_bench):
    """Run a scenario with an emulation that is started and ready."""
    pipeline = make_bench().pipeline
    monkeypatch.setattr(
        "starhil.emulator.run.run.make_pipeline", lambda *_, **__: FakeImager(pipeline.handle)
    )

    def run(scenario, *, clock="stepped", options=None, others=(), ready_within_s=60.0, **overrides):
        def profile(keys):
            links = {"serial": {"port": "auto"}, "can": {"channel": "off"}}
            return Profile.model_validate({"run": {"clock": clock}, "links": links, **keys})

        def first_head():
            return FirstHead(run.launched.run, run.launched.ready_fields)

        run.first_head = first_head

        async def whole():
            profiles = [profile(keys) for keys in (overrides, *others)]
            run.launched = Emulator(profiles, options or RunOptions(control="auto"))
            try:
                await run.launched.start()
                line = await asyncio.wait_for(run.launched.ready(), ready_within_s)
                return await scenario(first_head(), line)
            finally:
                await run.launched.close()

        return asyncio.run(whole())

    run.pipeline = pipeline
    return run


@pytest.fixture
def prompt_pages(monkeypatch):
    """Send the pages of a console their turns without a pause, for tests that ask much and do not look at the pace."""
    monkeypatch.setattr("starhil.emulator.console.viewer.PAUSE_S", 0.0)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests that start workers."""
    for item in items:
        if "worker" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.process)


@pytest.fixture
def worker(monkeypatch):
    """Make workers that run the given programs, one after the other; the last one from then on."""

    def make(*programs):
        waiting = list(programs)
        real = worker_process.subprocess.Popen
        started = []

        def start(command, **options):
            program = waiting.pop(0) if len(waiting) > 1 else waiting[0]
            started.append(real([command[0], "-c", program, *command[-2:]], **options))
            return started[-1]

        monkeypatch.setattr(worker_process.subprocess, "Popen", start)
        process = WorkerProcess()
        process.started = started
        return process

    return make
