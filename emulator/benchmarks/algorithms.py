"""Star identification algorithms on the same rendered images of a profile: geometric, thesis, thesis and refinement.

Each condition renders and detects once, and each algorithm gets the same detections. Its device is that of the profile,
with its parameters, calibration and validation. Lost in space, every image has a random attitude. In sequences, the body
turns; an algorithm is given the prediction that follows from its own last two attitudes, as in the device. The images of a
sequence are alike, so that standard errors of shares are those of independent sequences.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.truth.source import TruthState
from starid.arithmetic.arrays import Indices, Mask
from starid.attitude import Attitude, propagate, random_attitude, rate_between
from starid.identification.solution import Solution
from starid.identification.thesis.ablations import Part, without
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
    false_per_star: int = 0
    """Number of false stars for each detection of a star."""
    second: bool = False
    """Sequences of two images, of which only the second counts."""

    @property
    def length(self) -> int:
        """Number of images in a sequence."""
        if self.second:
            return 2
        return 1 if self.rate_deg_s == 0.0 else SEQUENCE

    def images(self, frames: int) -> int:
        """Return how many images are made for a number of images that count."""
        return 2 * frames if self.second else frames

    @property
    def name(self) -> str:
        """What the table calls it."""
        motion = "lost in space" if self.rate_deg_s == 0.0 else f"{self.rate_deg_s:g} deg/s"
        if not self.predicted:
            motion += " without predictions"
        if self.second:
            motion += ", second image"
        if self.false_per_star:
            return f"{motion}, {self.false_per_star} false for each star"
        return f"{motion}, {self.false_stars} false, {self.missing_stars} missing"


SCENES: Final = (
    *(Scene(rate, *stars) for rate in (0.0, 0.3) for stars in ((0, 0), (5, 0), (30, 0), (0, 5))),
    Scene(2.0),
    Scene(0.3, 6, predicted=False),
    Scene(0.3, false_per_star=6, predicted=False, second=True),
)


@dataclass(frozen=True, slots=True)
class AlgorithmPlan:
    """What is compared; equal plans give equal results, except for times."""

    profile: str
    frames: int
    seed: int
    overrides: tuple[str, ...] = ()
    without: Part | None = None
    """Part of the thesis's algorithms that is taken away."""


class Comparison:
    """The devices of all algorithms for one profile."""

    def __init__(self, plan: AlgorithmPlan) -> None:
        self.plan = plan
        own = load_profile(plan.profile, plan.overrides)
        # a profile with options of the thesis's algorithms has none for the geometric one
        apart = own.run.algorithm != "geometric" and own.identifier
        skipped = "geometric" if apart or plan.without else None
        self.devices = {
            name: EcssDevice(EcssPlan(plan.profile, (*plan.overrides, *settings), plan.seed))
            for name, settings in ALGORITHMS.items()
            if name != skipped
        }

    def rows(self, scene: Scene, advance: Callable[[], object]) -> Iterator[dict[str, Any]]:
        """One row per algorithm: shares, errors, times and memory under a condition; `advance` is called after each image."""
        tallies = {name: _Tally(device, scene, self.plan.without) for name, device in self.devices.items()}
        for image in self._images(scene):
            for tally in tallies.values():
                tally.add(image)
            advance()
        for name, tally in tallies.items():
            yield {
                "profile": self.plan.profile,
                "scene": scene.name,
                "algorithm": name,
                **tally.figures(name),
            }

    def _images(self, scene: Scene) -> Iterator[_Image]:
        device = next(iter(self.devices.values()))
        attitude, rate = Attitude.identity(), np.zeros(3)
        for number in range(scene.images(self.plan.frames)):
            rng = np.random.default_rng(
                (self.plan.seed, number, scene.false_stars, scene.missing_stars, scene.length)
            )
            if number % scene.length == 0:
                attitude, axis = random_attitude(rng), rng.normal(size=3)
                rate = np.radians(scene.rate_deg_s) * axis / np.linalg.norm(axis)
            else:
                attitude = propagate(attitude, rate, PERIOD_S)
            request = FrameRequest(
                index=number,
                truth=TruthState(attitude, rate),
                exposure_s=device.exposure_s,
                gain=device.gain,
                settings=device.settings,
                temperature_c=device.mean_c,
            )
            count = scene.false_stars
            if scene.false_per_star:
                count = scene.false_per_star * len(device.pipeline.detections(request)[0])
            if count:
                faintest = device.settings.limiting_magnitude
                sky = {"false_stars": count, "false_star_magnitudes": [1.0, faintest]}
                request = replace(request, faults=sky)
            found, false = device.pipeline.detections(request)
            kept = _kept(found, scene.missing_stars, rng)
            yield _Image(number, request, _rows(found, kept), false[kept])


@dataclass(frozen=True, eq=False)
class _Image:
    """An image of a scene: its request without a prediction, its detections, and which of them are false stars."""

    number: int
    request: FrameRequest
    found: Detections
    false: Mask


def _kept(detections: Detections, missing: int, rng: np.random.Generator) -> Indices:
    """Rows of the detections without some of the 25 brightest."""
    brightest = np.argsort(-detections.flux)[:25]
    lost = rng.choice(brightest, size=min(missing, brightest.size), replace=False)
    return np.delete(np.arange(detections.flux.size), lost)


def _rows(detections: Detections, rows: Indices) -> Detections:
    columns: dict[str, Any] = {
        name: value[rows]
        for name, value in vars(detections).items()
        if isinstance(value, np.ndarray) and value.shape[:1] == detections.flux.shape
    }
    return replace(detections, **columns)


class _Tally:
    """One algorithm under one condition."""

    def __init__(self, device: EcssDevice, scene: Scene, part: Part | None) -> None:
        self._device = device
        self._scene = scene
        self._part = part
        self._last: list[tuple[int, Attitude]] = []
        self._errors: list[tuple[float, float]] = []
        """Of each image across and about the boresight, degrees; infinite without an attitude."""
        self._normalised: list[np.ndarray] = []
        self._sequence: list[int] = []
        """Of each valid attitude, its sequence."""
        self._stated: list[float] = []
        self._ms: list[float] = []
        self._in_region = self._triggers = 0
        self._kept = np.zeros((2, 2), dtype=np.int64)
        """Detections by whether they are false stars, and whether the filter kept them."""
        self._identifier: Any = None

    def add(self, image: _Image) -> None:
        pipeline, place = self._device.pipeline, image.number % self._scene.length
        if self._identifier is None:
            intact: Any = pipeline.identifier(image.request)
            self._identifier = without(self._part, intact) if self._part else intact
        if place == 0:
            self._last = []
            if hasattr(self._identifier, "reset"):
                self._identifier.reset()
        expected = self._predicted(image.number) if self._scene.predicted else None
        request = replace(image.request, predicted=expected)
        begin = time.thread_time()
        solution = pipeline.solution(image.found, request, self._identifier)
        elapsed_ms = 1e3 * (time.thread_time() - begin)
        if solution.valid:
            self._last = [*self._last[-1:], (image.number, solution.attitude)]
        if self._scene.second and place == 0:
            return
        self._ms.append(elapsed_ms)
        if solution.valid:
            self._judge(solution, image.request.truth.attitude)
            self._sequence.append(image.number // self._scene.length)
        else:
            self._errors.append((math.inf, math.inf))
        if solution.features is not None:
            self._in_region += solution.valid and solution.features.search == "rsi"
            self._triggers += solution.features.triggered
            kept = np.ones(image.false.size, dtype=np.int64)
            kept[list(solution.features.removed_index)] = 0
            np.add.at(self._kept, (image.false.astype(np.int64), kept), 1)

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
        self._errors.append((error.cross_boresight_arcsec / 3600.0, error.roll_arcsec / 3600.0))
        self._normalised.append(vector**2 / np.diag(solution.covariance))
        self._stated.append(solution.cross_boresight_sigma_arcsec / 3600.0)

    def _share(self, name: str, images: Mask) -> dict[str, float | None]:
        """Share of images, and its standard error from independent sequences, None if there is only one; in percent."""
        length = 1 if self._scene.second else self._scene.length
        shares = [np.mean(images[at : at + length]) for at in range(0, images.size, length)]
        error = float(np.std(shares, ddof=1) / math.sqrt(len(shares))) if len(shares) > 1 else None
        return {
            f"{name}_pct": 100.0 * float(np.mean(images)),
            f"{name}_error_pct": None if error is None else 100.0 * error,
        }

    def _squared_error_sampling(self) -> float | None:
        """Standard error of the normalised squared error, from independent sequences; None if there are fewer than two."""
        each, sequence = np.mean(np.array(self._normalised).reshape(-1, 3), axis=1), np.array(self._sequence)
        excess = [float(np.sum(each[sequence == one] - each.mean())) for one in np.unique(sequence)]
        count = len(excess)
        return (
            math.sqrt(count / (count - 1) * float(np.sum(np.square(excess)))) / len(each)
            if count > 1
            else None
        )

    def figures(self, name: str) -> dict[str, Any]:
        """Figures of the condition: shares of all images, errors of valid attitudes in degrees, times of the processor."""
        each = np.array(self._errors)
        is_valid = np.isfinite(each[:, 0])
        right = each[:, 0] <= FEATURES_WRONG_DEG if name == "thesis" else each.max(axis=1) <= WRONG_DEG
        errors, valid = each[is_valid], int(np.count_nonzero(is_valid))
        true, false = self._kept
        return {
            "frames": len(each),
            "valid": valid,
            **self._share("valid", is_valid),
            "wrong": int(np.count_nonzero(is_valid & ~right)),
            **self._share("right", right),
            **self._share("within", each[:, 0] <= NEAR_DEG),
            "across_deg": float(np.median(errors[:, 0])) if valid else None,
            "about_deg": float(np.median(errors[:, 1])) if valid else None,
            "stated_deg": float(np.median(self._stated)) if valid else None,
            "normalised_squared_error": float(np.mean(self._normalised)) if valid else None,
            "normalised_squared_error_error": self._squared_error_sampling(),
            "in_region": self._in_region,
            "triggers": self._triggers,
            "true_kept_pct": 100.0 * true[1] / true.sum() if true.sum() else None,
            "false_kept_pct": 100.0 * false[1] / false.sum() if false.sum() else None,
            "median_ms": float(np.median(self._ms)),
            "p99_ms": float(np.percentile(self._ms, 99)),
            "kilobytes": self._identifier.database_bytes / 1000.0,
        }


def run_algorithms(
    plan: AlgorithmPlan, scenes: tuple[Scene, ...] = SCENES, advance: Callable[[], object] = lambda: None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table of a profile as they are measured; `advance` is called after each image."""
    comparison = Comparison(plan)
    for scene in scenes:
        yield from comparison.rows(scene, advance)
