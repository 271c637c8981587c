"""Star identification algorithms on the same rendered images of a profile: geometric, thesis, thesis and refinement.

Each condition renders and detects once, and each algorithm gets the same detections. Its device is that of the profile,
with its parameters, calibration and validation. Lost in space, every image has a random attitude. In sequences, the body
turns; an algorithm is given the prediction that follows from its own last two attitudes, as in the device.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.truth.source import TruthState
from starid.attitude import Attitude, propagate, random_attitude, rate_between
from starid.identification.solution import Solution
from starid.imaging.detection import Detections

WRONG_DEG: Final = 0.1
"""Error in boresight or roll beyond which a refined attitude is wrong, degrees."""

FEATURES_WRONG_DEG: Final = 1.5
"""The same for an attitude from features alone."""

NEAR_DEG: Final = 0.3
"""Error of the boresight that the thesis counts as identified, degrees."""

SEQUENCE: Final = 20
"""Number of images in a sequence."""

PERIOD_S: Final = 1.0
"""Time between images of a sequence, seconds."""

ALGORITHMS: Final[dict[str, tuple[str, ...]]] = {
    "geometric": ("run.algorithm=geometric",),
    "thesis": ("run.algorithm=rsi", "identifier.refinement=false"),
    "thesis + refinement": ("run.algorithm=rsi", "identifier.refinement=true"),
}
"""Name → settings of the profile."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A condition: whether the body is at rest at random attitudes or turns, and what is wrong with the sky."""

    rate_deg_s: float
    false_stars: int = 0
    missing_stars: int = 0
    predicted: bool = True
    """Whether the algorithms are given a prediction while the body turns; otherwise, each image is lost in space."""

    @property
    def name(self) -> str:
        """What the table calls it."""
        motion = "lost in space" if self.rate_deg_s == 0.0 else f"{self.rate_deg_s:g} deg/s"
        if not self.predicted:
            motion += " without predictions"
        return f"{motion}, {self.false_stars} false, {self.missing_stars} missing"


SCENES: Final = (
    *(Scene(rate, *stars) for rate in (0.0, 0.3) for stars in ((0, 0), (5, 0), (30, 0), (0, 5))),
    Scene(0.3, 6, predicted=False),
)


@dataclass(frozen=True, slots=True)
class AlgorithmPlan:
    """What is compared; equal plans give equal results, except for times."""

    profile: str
    frames: int
    seed: int
    overrides: tuple[str, ...] = ()


class Comparison:
    """The devices of all algorithms for one profile."""

    def __init__(self, plan: AlgorithmPlan) -> None:
        self.plan = plan
        own = load_profile(plan.profile, plan.overrides)
        # a profile with options of the thesis's algorithms has none for the geometric one
        skipped = "geometric" if own.run.algorithm != "geometric" and own.identifier else None
        self.devices = {
            name: EcssDevice(EcssPlan(plan.profile, (*plan.overrides, *settings), plan.seed))
            for name, settings in ALGORITHMS.items()
            if name != skipped
        }

    def rows(self, scene: Scene) -> Iterator[dict[str, Any]]:
        """One row per algorithm: shares, errors, times and memory under a condition."""
        tallies = {name: _Tally(device) for name, device in self.devices.items()}
        for number, (request, found, restarted) in enumerate(self._images(scene)):
            for tally in tallies.values():
                tally.add(request, found, number, restarted=restarted, predicted=scene.predicted)
        for name, tally in tallies.items():
            yield {
                "profile": self.plan.profile,
                "scene": scene.name,
                "algorithm": name,
                **tally.figures(name),
            }

    def _images(self, scene: Scene) -> Iterator[tuple[FrameRequest, Detections, bool]]:
        """Requests without a prediction, their detections, and whether a new sequence starts."""
        device = next(iter(self.devices.values()))
        length = 1 if scene.rate_deg_s == 0.0 else SEQUENCE
        attitude, rate = Attitude.identity(), np.zeros(3)
        for number in range(self.plan.frames):
            rng = np.random.default_rng(
                (self.plan.seed, number, scene.false_stars, scene.missing_stars, length)
            )
            if number % length == 0:
                attitude, axis = random_attitude(rng), rng.normal(size=3)
                rate = np.radians(scene.rate_deg_s) * axis / np.linalg.norm(axis)
            else:
                attitude = propagate(attitude, rate, PERIOD_S)
            faintest = device.settings.limiting_magnitude
            sky: dict[str, Any] = {}
            if scene.false_stars:
                sky = {"false_stars": scene.false_stars, "false_star_magnitudes": [1.0, faintest]}
            request = FrameRequest(
                index=number,
                truth=TruthState(attitude, rate),
                exposure_s=device.exposure_s,
                gain=device.gain,
                settings=device.settings,
                faults=sky,
                temperature_c=device.mean_c,
            )
            found = device.pipeline.detections(request)
            yield request, _without(found, scene.missing_stars, rng), number % length == 0


def _without(detections: Detections, missing: int, rng: np.random.Generator) -> Detections:
    """The detections without some of the 25 brightest."""
    brightest = np.argsort(-detections.flux)[:25]
    lost = rng.choice(brightest, size=min(missing, brightest.size), replace=False)
    kept = np.delete(np.arange(detections.flux.size), lost)
    columns: dict[str, Any] = {
        name: value[kept]
        for name, value in vars(detections).items()
        if isinstance(value, np.ndarray) and value.shape[:1] == detections.flux.shape
    }
    return replace(detections, **columns)


class _Tally:
    """One algorithm under one condition."""

    def __init__(self, device: EcssDevice) -> None:
        self._device = device
        self._last: list[tuple[int, Attitude]] = []
        self._errors: list[np.ndarray] = []
        self._normalised: list[np.ndarray] = []
        self._ms: list[float] = []
        self._frames = self._triggers = 0
        self._bytes = 0

    def add(
        self, request: FrameRequest, detections: Detections, number: int, *, restarted: bool, predicted: bool
    ) -> None:
        """Identify the detections of an image."""
        pipeline = self._device.pipeline
        identifier: Any = pipeline.identifier(request)
        self._bytes = int(identifier.database_bytes)
        if restarted:
            self._last = []
            if hasattr(identifier, "reset"):
                identifier.reset()
        expected = self._predicted(number) if predicted else None
        begin = time.thread_time()
        solution = pipeline.solution(detections, replace(request, predicted=expected))
        self._ms.append(1e3 * (time.thread_time() - begin))
        self._frames += 1
        self._triggers += bool(solution.features is not None and solution.features.triggered)
        if solution.valid:
            self._judge(solution, request.truth.attitude)
            self._last = [*self._last[-1:], (number, solution.attitude)]

    def _predicted(self, number: int) -> Attitude | None:
        """The attitude propagated from the last two, as in the device."""
        if len(self._last) < 2:
            return None
        (before, first), (last, second) = self._last
        rate = rate_between(first, second, (last - before) * PERIOD_S)
        return propagate(second, rate, (number - last) * PERIOD_S)

    def _judge(self, solution: Solution, truth: Attitude) -> None:
        error = solution.attitude.error_to(truth)
        vector = error.rotation_vector_rad
        self._errors.append(np.array([error.cross_boresight_arcsec, error.roll_arcsec]) / 3600.0)
        self._normalised.append(vector**2 / np.diag(solution.covariance))

    def figures(self, name: str) -> dict[str, Any]:
        """Figures of the condition: errors of valid attitudes in degrees, times of the processor."""
        errors = np.array(self._errors).reshape(-1, 2)
        limit = FEATURES_WRONG_DEG if name == "thesis" else WRONG_DEG
        across = errors[:, 0] if name == "thesis" else errors.max(axis=1, initial=0.0)
        valid = len(errors)
        return {
            "frames": self._frames,
            "valid": valid,
            "valid_pct": 100.0 * valid / self._frames,
            "wrong": int(np.count_nonzero(across > limit)),
            "within_pct": 100.0 * float(np.mean(errors[:, 0] <= NEAR_DEG)) if valid else None,
            "across_deg": float(np.median(errors[:, 0])) if valid else None,
            "about_deg": float(np.median(errors[:, 1])) if valid else None,
            "normalised_squared_error": float(np.mean(self._normalised)) if valid else None,
            "triggers": self._triggers,
            "median_ms": float(np.median(self._ms)),
            "p99_ms": float(np.percentile(self._ms, 99)),
            "kilobytes": self._bytes / 1000.0,
        }


def run_algorithms(plan: AlgorithmPlan, scenes: tuple[Scene, ...] = SCENES) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table of a profile as they are measured."""
    comparison = Comparison(plan)
    for scene in scenes:
        yield from comparison.rows(scene)
