"""What an orbit costs: frames of a device along its orbit, and the cause of each without an attitude.

The sensor looks away from the Earth and turns with the orbit, once per revolution, or it looks in a random direction at rest.
Date, Sun, Moon, Earth, aberration, particles and temperature are those of the profile's orbit. Every frame is solved lost in space.

A frame without a right attitude is solved again without one influence after the other, with the same noise. The influences
that cost it are those without each of which there is an attitude; if there is none without any single one but without all,
several together, and otherwise the stars themselves are too few.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from starhil.emulator.benchmarks.campaign import WRONG_DEG, of_thread, run_parts, store_with_device
from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.device.navigation import observer_velocity
from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.pipeline.messages import FrameRequest, FrameResult
from starhil.emulator.sensor.sky.radiation import default_rates, particle_rate
from starhil.emulator.sensor.sky.view import BodySource
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude, random_attitude
from starid.storage.results import Results

POINTINGS: Final = ("zenith", "random")

TOGETHER: Final = "several together"
STARS: Final = "too few stars"
"""Causes besides the influences of `WITHOUT`."""


@dataclass(frozen=True, slots=True)
class OrbitPlan:
    """A campaign along an orbit; equal plans give equal results."""

    profile: str
    overrides: tuple[str, ...] = ("orbit=leo",)
    seed: int = 1
    frames: int = 1000
    days: float = 1.0
    """Time over which the frames are spread evenly."""
    pointing: str = "zenith"
    """`zenith`: +z away from the Earth, +x along the motion; `random`: at rest in a random direction."""
    chunk: int = 50

    @property
    def chunks(self) -> int:
        """Number of parts, the last of which may be shorter."""
        return math.ceil(self.frames / self.chunk)


def zenith_attitude(orbit: OrbitState) -> tuple[Attitude, Array]:
    """Return the attitude with +z away from the Earth and +x along the motion, and its body rate (3,), rad/s.

    The frame turns about the normal of the orbit, at angular momentum over distance squared.
    """
    position, velocity = orbit.position_m, orbit.velocity_m_s
    up = position / np.linalg.norm(position)
    momentum = np.cross(position, velocity)
    normal = momentum / np.linalg.norm(momentum)
    ahead = np.cross(normal, up)
    attitude = Attitude.from_matrix(np.array([ahead, np.cross(up, ahead), up]))
    return attitude, attitude.matrix @ momentum / float(position @ position)


class OrbitDevice(EcssDevice):
    """The image pipeline of a profile's device along its orbit."""

    BODIES: ClassVar[BodySource] = "ephemeris"

    def __init__(self, plan: OrbitPlan) -> None:
        super().__init__(EcssPlan(plan.profile, plan.overrides, plan.seed))
        if self.orbit is None:
            raise EmulatorError(f"campaign: profile {plan.profile} has no orbit: add --orbit leo")
        self._place = self.orbit.state
        self._plan = plan
        camera, sensor = self.pipeline.camera, SensorModel().with_(**self.profile.sensor)
        self._default_rates = default_rates(camera.width, camera.height, sensor.pixel_um)

    def request(self, number: int) -> FrameRequest:
        plan, thermal = self._plan, self.profile.thermal
        since_s = 86_400.0 * plan.days * number / plan.frames
        unix_s = self.start_unix_s + since_s
        place = self._place(unix_s)
        attitude, rate = zenith_attitude(place)
        if plan.pointing == "random":
            attitude, rate = random_attitude(np.random.default_rng((plan.seed, number))), ZERO_RATE
        radiation = self.profile.radiation
        return FrameRequest(
            index=number,
            truth=TruthState(attitude, rate).completed(unix_s, self.orbit),
            exposure_s=self.exposure_s,
            gain=self.gain,
            settings=self.settings,
            temperature_c=self.mean_c + self.swing_c * math.sin(2.0 * math.pi * since_s / thermal.period_s),
            particles_s=particle_rate(
                radiation.quiet_s, radiation.anomaly_s, place.position_m, unix_s, self._default_rates
            ),
            observer_velocity=observer_velocity(self.parameters, unix_s),
        )

    def outcome(self, request: FrameRequest) -> str:
        """Solve a frame: `correct`, `wrong`, or why there is no attitude."""
        result = self.pipeline.handle(request)
        if not isinstance(result, FrameResult):
            raise EmulatorError(f"campaign: profile {self._plan.profile}: {getattr(result, 'text', result)}")
        if not result.valid:
            return result.reason
        error = Attitude(np.array(result.quaternion_xyzw)).error_to(request.truth.attitude)
        too_far = max(error.cross_boresight_arcsec, error.roll_arcsec) > 3600.0 * WRONG_DEG
        return "wrong" if too_far else "correct"

    def cause(self, request: FrameRequest) -> str:
        """Return what costs a frame that has no right attitude its attitude; see the module."""
        causes = [
            name for name, spared in WITHOUT.items() if self.outcome(spared(self, request)) == "correct"
        ]
        if causes:
            return " or ".join(causes)
        for spared in WITHOUT.values():
            request = spared(self, request)
        return TOGETHER if self.outcome(request) == "correct" else STARS


def _without_body(name: str) -> Callable[[OrbitDevice, FrameRequest], FrameRequest]:
    def spared(device: OrbitDevice, request: FrameRequest) -> FrameRequest:
        del device
        behind = -request.truth.attitude.boresight
        body: dict[str, Any] = {
            "ra_deg": math.degrees(math.atan2(behind[1], behind[0])),
            "dec_deg": math.degrees(math.asin(behind[2])),
            "exclusion_deg": 0.0,
        }
        body |= {"radius_deg": 1.0} if name == "earth" else {"reach_deg": 0.0}
        return replace(request, faults={**request.faults, name: body})

    return spared


WITHOUT: Final[dict[str, Callable[[OrbitDevice, FrameRequest], FrameRequest]]] = {
    "sun": _without_body("sun"),
    "moon": _without_body("moon"),
    "earth": _without_body("earth"),
    "particles": lambda _device, request: replace(request, particles_s=0.0),
    "rate": lambda _device, request: replace(request, truth=replace(request.truth, rate_rad_s=ZERO_RATE)),
    "temperature": lambda _device, request: replace(request, temperature_c=None),
}
"""Influence → the request for the same frame without it."""


def run_chunk(plan: OrbitPlan, chunk: int) -> Results:
    """Solve the frames of a part; return outcomes and causes (n,), the cause of a right attitude being empty."""
    device = of_thread(OrbitDevice, plan)
    numbers = range(chunk * plan.chunk, min((chunk + 1) * plan.chunk, plan.frames))
    outcomes, causes = [], []
    for number in numbers:
        request = device.request(number)
        outcome = device.outcome(request)
        outcomes.append(outcome)
        causes.append("" if outcome == "correct" else device.cause(request))
    return {"outcome": np.array(outcomes, "U24"), "cause": np.array(causes, "U64")}


def run_orbit(plan: OrbitPlan, *, folder: Path | None = None, jobs: int = 1) -> Iterator[Results]:
    """Run a campaign along an orbit, as `starhil.emulator.benchmarks.campaign.run_campaign`."""
    if plan.pointing not in POINTINGS:
        raise EmulatorError(
            f"campaign: pointing must be one of {', '.join(POINTINGS)}, not {plan.pointing!r}"
        )
    store = store_with_device(plan, folder)
    calls = {f"chunk-{chunk:04d}": (run_chunk, plan, chunk) for chunk in range(plan.chunks)}
    for _, results in run_parts(calls, store, jobs):
        yield results


def summarise(results: list[Results]) -> list[dict[str, Any]]:
    """Return one row per cause, the most frequent first; before them the frames with a right attitude, and the wrong ones.

    The frames of a wrong attitude have causes, too.
    """
    outcomes = np.concatenate([part["outcome"] for part in results])
    causes = Counter(str(cause) for part in results for cause in part["cause"] if cause)
    counts = {each: int(np.sum(outcomes == each)) for each in ("correct", "wrong")} | dict(
        causes.most_common()
    )
    return [
        {"cause": name, "frames": count, "share_pct": 100.0 * count / len(outcomes)}
        for name, count in counts.items()
    ]
