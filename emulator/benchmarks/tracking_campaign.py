"""Tracking under hard conditions: a device sees the whole field for some images, and then one that is mostly hidden.

The first images are those from which the device estimates the rate (`device.rate_window`), a period of its update rate apart. From
their attitudes follow the prediction and its uncertainty, as in the device. The last image is solved lost in space, and with the
prediction. One image in twenty has a celestial pole, or RA 0°, in the middle of its field; the others look anywhere, at any roll.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from starhil.emulator.benchmarks.campaign import error_figures, of_thread, run_parts, store_with_device
from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.device.parameters import exposure_period_s
from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.pipeline.messages import FrameRequest, FrameResult
from starhil.emulator.truth.source import TruthState
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude, propagate, random_attitude
from starid.identification.attitude_history import AttitudeHistory
from starid.storage.results import Results

LOST: Final = "lost in space"
TRACKED: Final = "tracking"
WAYS: Final = (LOST, TRACKED)
"""Ways to solve the last image."""

_EVERY: Final = 20
_SPECIAL_DEG: Final = ((0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (359.9999, 40.0), (0.0001, -40.0))
"""Right ascension and declination of every twentieth image in turn, degrees."""

RECORD: Final = np.dtype(
    [
        ("frame", np.int64),
        ("way", "U24"),
        ("valid", np.bool_),
        ("reason", "U24"),
        ("cross_arcsec", np.float64),
        ("roll_arcsec", np.float64),
        ("normalised_squared_error", np.float64),
        ("matched", np.int32),
        ("detect_ms", np.float64),
        ("identify_ms", np.float64),
    ]
)
"""One row per image and way; errors are NaN if the attitude is invalid."""


@dataclass(frozen=True, slots=True)
class TrackingPlan:
    """A campaign of tracking; equal plans give equal results, except for times."""

    profile: str
    overrides: tuple[str, ...] = ()
    seed: int = 1
    frames: int = 1000
    blocked: float = 0.75
    """Share of the last image that an obstruction hides."""
    rate_deg_s: float = 0.0
    """Body rate, degrees per second about a random axis."""
    jump_deg: float = 0.0
    """Largest angle by which a motion that the device does not expect turns the sensor before the last image, degrees."""
    chunk: int = 50

    @property
    def chunks(self) -> int:
        """Number of parts, the last of which may be shorter."""
        return math.ceil(self.frames / self.chunk)


class TrackingDevice(EcssDevice):
    """The device of a profile that tracks."""

    def __init__(self, plan: TrackingPlan) -> None:
        super().__init__(EcssPlan(plan.profile, plan.overrides, plan.seed))
        self._tracking = plan
        self._images = self.profile.device.rate_window
        parameters = self.parameters
        self._period_s = max(1.0 / float(parameters["update_rate"]), exposure_period_s(parameters))

    def rows(self, number: int) -> Iterator[tuple[Any, ...]]:
        """Solve an image in both ways; yield rows of RECORD."""
        plan = self._tracking
        rng = np.random.default_rng((plan.seed, number))
        truth, axis, jump = random_attitude(rng), rng.normal(size=3), rng.normal(size=3)
        if number % _EVERY == 0:
            ra, dec = _SPECIAL_DEG[number // _EVERY % len(_SPECIAL_DEG)]
            truth = Attitude.from_radec_roll(ra, dec, rng.uniform(0.0, 360.0))
        rate = np.radians(plan.rate_deg_s) * axis / np.linalg.norm(axis)
        turn = np.radians(plan.jump_deg) * rng.uniform() * jump / np.linalg.norm(jump)
        edge = {"obstructions": [{"share": plan.blocked, "angle_deg": rng.uniform(-180.0, 180.0)}]}
        history = self._history(number, truth, rate)
        last = self._request(number, self._images, truth.rotated(turn), rate)
        if plan.blocked > 0.0:
            last = replace(last, faults=edge)
        uncertainty = history.uncertainty(0.0) if history.last and history.last[0] < 0.0 else None
        for way in WAYS:
            request = last
            if way == TRACKED and uncertainty is not None:
                request = replace(
                    last,
                    predicted=history.predict(0.0, history.rate()),
                    prediction_covariance=uncertainty[0],
                    prediction_freedom=uncertainty[1],
                    predicted_rate_rad_s=history.rate(),
                )
            result = self._answer(request)
            yield (number, way, result.valid, result.reason, *_errors(result, last.truth.attitude), result.matched,
                   1e3 * result.detect_s, 1e3 * result.identify_s)  # fmt: skip

    def _history(self, number: int, truth: Attitude, rate: Array) -> AttitudeHistory:
        """Return the attitudes of the images before the last one, which is at time 0."""
        history = AttitudeHistory(self._images)
        for image in range(self._images):
            at = (image - self._images) * self._period_s
            result = self._answer(self._request(number, image, propagate(truth, rate, at), rate))
            if result.valid:
                attitude = Attitude(np.array(result.quaternion_xyzw))
                covariance = np.array(result.covariance_rad2)
                history.add(at, attitude, 2.0 * self._period_s, covariance, result.freedom)
        return history

    def _request(self, number: int, image: int, attitude: Attitude, rate: Array) -> FrameRequest:
        return FrameRequest(
            index=number * (self._images + 1) + image,
            truth=TruthState(attitude, rate),
            exposure_s=self.exposure_s,
            gain=self.gain,
            settings=self.settings,
            temperature_c=self.mean_c,
        )

    def _answer(self, request: FrameRequest) -> FrameResult:
        result = self.pipeline.handle(request)
        if not isinstance(result, FrameResult):
            raise EmulatorError(
                f"campaign: profile {self._tracking.profile}: {getattr(result, 'text', result)}"
            )
        return result


def _errors(result: FrameResult, truth: Attitude) -> tuple[float, float, float]:
    """Return the errors across and about the boresight, arcseconds, and the normalised squared error divided by 3."""
    if not result.valid:
        return math.nan, math.nan, math.nan
    error = Attitude(np.array(result.quaternion_xyzw)).error_to(truth)
    vector = error.rotation_vector_rad
    squared = float(vector @ np.linalg.solve(np.array(result.covariance_rad2), vector)) / 3.0
    return error.cross_boresight_arcsec, error.roll_arcsec, squared


def run_chunk(plan: TrackingPlan, chunk: int) -> Results:
    """Solve the images of a part; return rows of RECORD."""
    device = of_thread(TrackingDevice, plan)
    numbers = range(chunk * plan.chunk, min((chunk + 1) * plan.chunk, plan.frames))
    return {"rows": np.array([row for number in numbers for row in device.rows(number)], RECORD)}


def run_tracking(plan: TrackingPlan, *, folder: Path | None = None, jobs: int = 1) -> Iterator[Results]:
    """Run a campaign of tracking, as `starhil.emulator.benchmarks.campaign.run_campaign`."""
    if not 0.0 <= plan.blocked <= 1.0:
        raise EmulatorError(f"campaign: blocked must be a share from 0 to 1, not {plan.blocked}")
    store = store_with_device(plan, folder)
    calls = {f"chunk-{chunk:04d}": (run_chunk, plan, chunk) for chunk in range(plan.chunks)}
    for _, results in run_parts(calls, store, jobs):
        yield results


def summarise(results: list[Results]) -> list[dict[str, Any]]:
    """Return one row per way: the figures of `error_figures`, and median times in milliseconds."""
    rows = np.sort(np.concatenate([part["rows"] for part in results]), order="frame")
    return [
        {
            "way": way,
            **error_figures(solved),
            "detect_ms": float(np.median(solved["detect_ms"])),
            "identify_ms": float(np.median(solved["identify_ms"])),
        }
        for way in WAYS
        for solved in (rows[rows["way"] == way],)
    ]
