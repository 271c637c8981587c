"""Frames of a performance campaign per ECSS-E-ST-60-20C: the device of a profile under one influence at a time.

Every frame is rendered, detected and identified, lost in space, by the image pipeline of the device with the
parameters of the profile. A frame depends only on the plan, the name of its condition and its number, so a
campaign can be interrupted and resumed, and run in any number of processes.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from starhil.emulator.benchmarks.campaign import WRONG_DEG, of_thread, run_parts, store_with_device
from starhil.emulator.benchmarks.hard_sky import direction_around
from starhil.emulator.device.device import adopt_camera, profile_defaults
from starhil.emulator.device.navigation import observer_velocity
from starhil.emulator.device.parameters import Parameters, exposure_period_s
from starhil.emulator.device.power import FrameTiming, PowerModel
from starhil.emulator.device.surroundings import orbit_of
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.pipeline.messages import (
    FrameRequest,
    FrameResult,
    SolverSettings,
    camera_constants,
)
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.sensor.sky.view import BodySource
from starhil.emulator.sensor.star_count import few_stars
from starhil.emulator.truth.source import TruthState
from starhil.protocol.unit import load_unit
from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude
from starid.camera import Camera
from starid.storage.results import Results

RATES_DEG_S: Final = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
SUN_DEG: Final = (0.0, 10.0, 20.0, 30.0, 35.0, 45.0, 60.0, 90.0)
MOON_DEG: Final = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
EARTH_DEG: Final = (-20.0, -10.0, 0.0, 10.0, 20.0, 25.0, 35.0)
FALSE_STARS: Final = (0.0, 5.0, 10.0, 20.0, 50.0, 100.0)
PARTICLES_S: Final = (0.0, 100.0, 300.0, 1000.0, 3000.0)
EARTH_RADIUS_DEG: Final = 64.0
"""Angular radius of the Earth's disc from an altitude of 700 km."""
_RATE_DIGITS: Final = 9

REST: Final = "rest"
STATIC: Final = "static"
THERMAL: Final = "thermal"
DATED: Final = "dated"
YEAR_S: Final = 365.25 * 86_400.0
INFLUENCES: Final = {
    "rate": ("body rate", "°/s", RATES_DEG_S),
    "sun": ("Sun from the boresight", "°", SUN_DEG),
    "moon": ("Moon from the boresight", "°", MOON_DEG),
    "earth": ("limb of the bright Earth from the boresight", "°", EARTH_DEG),
    "false_stars": ("false stars in each frame", "", FALSE_STARS),
    "particles": ("particles on the detector", "/s", PARTICLES_S),
}
"""Name of an influence → description, unit and values."""


@dataclass(frozen=True, slots=True)
class EcssPlan:
    """A performance campaign; equal plans give equal results."""

    profile: str
    overrides: tuple[str, ...] = ()
    seed: int = 1
    fields: int = 80
    positions: int = 4
    repeats: int = 4
    """Number of directions in the sky, sub-pixel positions for each, and frames for each position, to separate the
    kinds of error."""
    thermal_points: int = 12
    """Number of points of the orbit for each direction, for the thermo-elastic error."""
    dates: int = 6
    dated_repeats: int = 2
    """Number of dates over a year for each direction, and of frames for each date, for the aberration residual."""
    rest_frames: int = 2000
    """Number of frames at rest, at random attitudes and points of the orbit."""
    frames: int = 100
    """Number of frames at each value of an influence."""
    chunk: int = 50
    """Frames per part; a resumed campaign repeats only unfinished parts."""

    @property
    def thermal_fields(self) -> int:
        """Number of directions for the thermo-elastic error."""
        return max(2, self.fields * 3 // 10)

    @property
    def dated_fields(self) -> int:
        """Number of directions for the aberration residual."""
        return max(2, self.fields // 2)

    def conditions(self) -> list[Condition]:
        static = Condition(STATIC, STATIC, 0.0, self.fields * self.positions * self.repeats)
        thermal = Condition(THERMAL, THERMAL, 0.0, self.thermal_fields * self.thermal_points)
        dated = Condition(DATED, DATED, 0.0, self.dated_fields * self.dates * self.dated_repeats)
        rest = Condition(REST, REST, 0.0, self.rest_frames)
        varied = [
            Condition(f"{name}-{value:g}", name, value, self.frames)
            for name, (_, _, values) in INFLUENCES.items()
            for value in values
        ]
        return [static, thermal, dated, rest, *varied]

    def device(self) -> tuple[Profile, Parameters, Camera]:
        """Return the profile, and the parameters and the camera of its device, as far as no pipeline is needed."""
        profile = load_profile(self.profile, self.overrides)
        icd = load_unit(profile.unit_source)
        return (
            profile,
            Parameters(icd, profile_defaults(profile, icd)),
            Camera.from_dict(profile.camera_values),
        )

    def warning(self) -> str:
        """Return a warning if the camera sees too few stars, or an empty text."""
        profile, parameters, camera = self.device()
        return few_stars(camera.to_dict(), SensorModel().with_(**profile.sensor), parameters)


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition of a campaign: name, influence and its value, number of frames."""

    name: str
    influence: str
    value: float
    frames: int

    @property
    def stream(self) -> int:
        """Seed component that makes its random numbers independent of other conditions'."""
        return int.from_bytes(hashlib.sha256(self.name.encode()).digest()[:4], "little")


@dataclass
class _FrameConditions:
    attitude: Attitude
    rate_rad_s: np.ndarray
    point: float | None = None
    """Point of the orbit, as a share of it; None: at the mean temperature."""
    sky: dict[str, Any] = field(default_factory=dict)
    particles_s: float = 0.0
    unix_s: float | None = None
    field_number: int = 0
    condition_number: int = 0


class EcssDevice:
    """The image pipeline of a profile's device, with the device's parameters and temperatures in flight."""

    BODIES: ClassVar[BodySource] = "typed"
    """Without a date in its request a frame has no aberration, and bodies only where a condition puts them."""

    def __init__(self, plan: EcssPlan) -> None:
        self.plan = plan
        profile = load_profile(plan.profile, [*plan.overrides, "run.clock=stepped", f"run.seed={plan.seed}"])
        self.profile = profile
        icd = load_unit(profile.unit_source)
        setup = pipeline_setup(profile)
        sky = {**setup.sky, "bodies": self.BODIES, "aberration": True}
        self.pipeline = Pipeline(replace(setup, sky=sky))
        self.start_unix_s, self.orbit = profile.start_unix_s, orbit_of(profile)
        parameters = self.parameters = Parameters(icd, profile_defaults(profile, icd))
        adopt_camera(parameters, profile, camera_constants(self.pipeline.camera.to_dict()))
        self.settings = SolverSettings.of(parameters)
        self.exposure_s = float(parameters["exposure"]) / 1000.0
        self.gain = float(parameters["analog_gain"])
        self.max_rate_deg_s = float(parameters["max_rate"])
        timing, thermal = profile.timing, profile.thermal
        busy_s = timing.busy_s(self.exposure_s, tracking=True)
        period_s = max(1.0 / float(parameters["update_rate"]), exposure_period_s(parameters))
        cycle = FrameTiming(True, 0, busy_s, period_s)  # noqa: FBT003 (running)
        self.power_w = PowerModel(profile.power).mean_power_w(cycle)
        self.mean_c = thermal.mounting_c + thermal.heating_c_w * self.power_w
        self.swing_c = thermal.swing_c

    def solve(self, condition: Condition, number: int) -> tuple[_FrameConditions, FrameResult]:
        """Render and solve a frame under a condition; return its conditions and the result."""
        rng = np.random.default_rng((self.plan.seed, condition.stream, number))
        frame = _CONDITIONS[condition.influence](self, condition, number, rng)
        temperature_c = self.mean_c
        if frame.point is not None:
            temperature_c += self.swing_c * math.sin(2.0 * math.pi * frame.point)
        request = FrameRequest(
            index=condition.stream * 1_000_000 + number,
            truth=TruthState(frame.attitude, frame.rate_rad_s),
            exposure_s=self.exposure_s,
            gain=self.gain,
            settings=self.settings,
            faults=frame.sky,
            temperature_c=temperature_c,
            particles_s=frame.particles_s,
        )
        if frame.unix_s is not None:
            truth = request.truth.completed(frame.unix_s, self.orbit)
            assumed = observer_velocity(self.parameters, frame.unix_s)  # by the device
            request = replace(request, truth=truth, observer_velocity=assumed)
        result = self.pipeline.handle(request)
        if not isinstance(result, FrameResult):
            raise EmulatorError(f"campaign: profile {self.plan.profile}: {getattr(result, 'text', result)}")
        return frame, result

    def field_attitude(self, condition: Condition, number: int) -> Attitude:
        """Return the attitude of a field, the same for all its frames."""
        return random_attitude(np.random.default_rng((self.plan.seed, condition.stream, number, 1)))


def _at_rest(
    device: EcssDevice, condition: Condition, _number: int, rng: np.random.Generator
) -> _FrameConditions:
    del device, condition
    return _FrameConditions(random_attitude(rng), np.zeros(3), float(rng.uniform()))


def _static(
    device: EcssDevice, condition: Condition, number: int, _rng: np.random.Generator
) -> _FrameConditions:
    plan = device.plan
    position, _ = divmod(number, plan.repeats)
    field_number, condition_number = divmod(position, plan.positions)
    chosen = np.random.default_rng((plan.seed, condition.stream, position, 2))
    shift = chosen.uniform(-0.5, 0.5, 2) * device.pipeline.camera.pixel_scale_rad
    attitude = device.field_attitude(condition, field_number).rotated((*shift, 0.0))
    return _FrameConditions(attitude, np.zeros(3), None, {}, 0.0, None, field_number, condition_number)


def _thermal(
    device: EcssDevice, condition: Condition, number: int, _rng: np.random.Generator
) -> _FrameConditions:
    field_number, point = divmod(number, device.plan.thermal_points)
    attitude = device.field_attitude(condition, field_number)
    return _FrameConditions(
        attitude, np.zeros(3), point / device.plan.thermal_points, {}, 0.0, None, field_number, point
    )


def _on_a_date(
    device: EcssDevice, condition: Condition, number: int, _rng: np.random.Generator
) -> _FrameConditions:
    plan = device.plan
    seen, _ = divmod(number, plan.dated_repeats)
    field_number, date = divmod(seen, plan.dates)
    attitude = device.field_attitude(condition, field_number)
    unix_s = device.start_unix_s + YEAR_S * date / plan.dates
    return _FrameConditions(attitude, np.zeros(3), None, {}, 0.0, unix_s, field_number, date)


def _turning(
    _device: EcssDevice, condition: Condition, _number: int, rng: np.random.Generator
) -> _FrameConditions:
    attitude, axis = random_attitude(rng), rng.normal(size=3)
    rate = np.radians(condition.value) * axis / np.linalg.norm(axis)
    return _FrameConditions(attitude, rate, float(rng.uniform()))


def _near(body: str) -> Callable[[EcssDevice, Condition, int, np.random.Generator], _FrameConditions]:
    def near(
        device: EcssDevice, condition: Condition, number: int, rng: np.random.Generator
    ) -> _FrameConditions:
        frame = _at_rest(device, condition, number, rng)
        away_deg = condition.value + (EARTH_RADIUS_DEG if body == "earth" else 0.0)
        ra_deg, dec_deg = direction_around(frame.attitude, (away_deg, away_deg), rng)
        frame.sky = {body: {"ra_deg": ra_deg, "dec_deg": dec_deg}}
        if body == "earth":
            frame.sky[body]["radius_deg"] = EARTH_RADIUS_DEG
        return frame

    return near


def _false_stars(
    device: EcssDevice, condition: Condition, number: int, rng: np.random.Generator
) -> _FrameConditions:
    frame = _at_rest(device, condition, number, rng)
    faintest = device.settings.limiting_magnitude
    frame.sky = {
        "false_stars": int(condition.value),
        "false_star_magnitudes": [min(1.0, faintest), faintest],
    }
    return frame


def _particles(
    device: EcssDevice, condition: Condition, number: int, rng: np.random.Generator
) -> _FrameConditions:
    frame = _at_rest(device, condition, number, rng)
    frame.particles_s = condition.value
    return frame


_CONDITIONS: Final[
    dict[str, Callable[[EcssDevice, Condition, int, np.random.Generator], _FrameConditions]]
] = {
    STATIC: _static,
    THERMAL: _thermal,
    DATED: _on_a_date,
    REST: _at_rest,
    "rate": _turning,
    "sun": _near("sun"),
    "moon": _near("moon"),
    "earth": _near("earth"),
    "false_stars": _false_stars,
    "particles": _particles,
}
"""Influence → function that makes the conditions of a frame."""


def run_part(plan: EcssPlan, condition: Condition, chunk: int) -> Results:
    """Solve the frames of a part; return their outcomes.

    With them come errors and stated uncertainties, arcseconds, numbers of field and condition, and attitude matrices.
    """
    device = of_thread(EcssDevice, plan)
    numbers = range(chunk * plan.chunk, min((chunk + 1) * plan.chunk, condition.frames))
    errors = np.full((len(numbers), 3), np.nan)
    stated = np.full((len(numbers), 2), np.nan)
    outcome = np.zeros(len(numbers), dtype="U24")
    labels = np.zeros((len(numbers), 3), dtype=np.int64)
    to_sensor = np.zeros((len(numbers), 3, 3))
    for row, number in enumerate(numbers):
        frame, result = device.solve(condition, number)
        labels[row] = frame.field_number, frame.condition_number, result.detected
        to_sensor[row] = frame.attitude.matrix
        outcome[row] = result.reason
        if not result.valid:
            continue
        error = Attitude(np.array(result.quaternion_xyzw)).error_to(frame.attitude)
        errors[row] = error.rotation_vector_rad * ARCSEC_PER_RAD
        stated[row] = result.sigma_cross_arcsec, result.sigma_roll_arcsec
        too_far = max(error.cross_boresight_arcsec, error.roll_arcsec) > 3600.0 * WRONG_DEG
        rate_deg_s = round(float(np.degrees(np.linalg.norm(frame.rate_rad_s))), _RATE_DIGITS)
        if rate_deg_s > device.max_rate_deg_s:
            outcome[row] = "rate_too_high"
        else:
            outcome[row] = "wrong" if too_far else "correct"
    return {
        "outcome": outcome,
        "error_arcsec": errors,
        "stated_arcsec": stated,
        "labels": labels,
        "to_sensor": to_sensor,
    }


def run_ecss(
    plan: EcssPlan, *, folder: Path | None = None, jobs: int = 1, only: str = ""
) -> Iterator[tuple[str, int, Results]]:
    """Run a campaign, or one of its conditions, as `run_campaign`.

    Yields condition name, chunk number and results of each part as it finishes.
    """
    store = store_with_device(plan, folder)
    named = {f"{condition.name}-{chunk:04d}": (condition, chunk) for condition, chunk in parts(plan, only)}
    calls = {name: (run_part, plan, *part) for name, part in named.items()}
    for name, results in run_parts(calls, store, jobs):
        condition, chunk = named[name]
        yield condition.name, chunk, results


def parts(plan: EcssPlan, only: str = "") -> list[tuple[Condition, int]]:
    """Return all parts of a campaign, or of one of its conditions."""
    return [
        (condition, chunk)
        for condition in plan.conditions()
        if only in ("", condition.name)
        for chunk in range(math.ceil(condition.frames / plan.chunk))
    ]
