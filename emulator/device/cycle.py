"""The frame cycle: when the sensor exposes, what it asks of the pipeline, and when a result becomes known.

A frame begins on a grid of the update period, exposes, is read out, detected and identified; the times of these steps are
those of the profile's `[timing]`, so that on the stepped clock the same run gives the same bytes. On the other clocks a
result that the machine has not ready in time is published when it comes, and flagged. Where the machine falls behind by
`MAX_PENDING` frames, or at high rates by the modelled time of a frame's steps, exposures are left out: what the machine
could not look at says nothing about the sky, so the last attitude stands until it is too old, and tracking goes on from it.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from starhil.emulator.clock import NANOSECONDS, DeviceTime
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.parameters import Parameters, exposure_period_s
from starhil.emulator.device.rate import RateEstimator
from starhil.emulator.device.scheduler import Event, Scheduler
from starhil.emulator.pipeline.imager import Imager, PipelineReply
from starhil.emulator.pipeline.messages import (
    ZERO,
    Failure,
    FrameRequest,
    FrameResult,
    Quaternion,
    SolverSettings,
    Triple,
)
from starhil.emulator.profile import TimingConfig
from starhil.emulator.truth.source import FixedTruth, TruthSource, TruthState
from starid.attitude import Attitude, propagate

log = logging.getLogger("starhil.device")

MAX_PENDING: Final = 2
"""Requests in the pipeline at which the next exposure is left out; more, where more fit into the time modelled for them."""


@dataclass(frozen=True)
class Measurement:
    """A frame as published.

    Attributes
    ----------
    counter
        Frames published since start-up, this one included.
    mid_ns
        Run time of the middle of the exposure, nanoseconds.
    mid_unix_ns
        The same on the device's clock as it stood when the frame was published.
    published_ns
        Run time at which it was published, nanoseconds.
    mode
        Mode of the device when the frame was exposed.
    truth
        What the sensor looked at in the middle of the exposure.
    result
        What the pipeline made of it.
    valid, reason
        As the device reports it, after its own checks.
    rate_rad_s, rate_valid
        Body rate estimated from the stars, sensor frame, radians a second.
    capture_s, detect_s, identify_s
        Modelled times of the steps.
    late
        The machine took longer than the model.
    """

    counter: int
    mid_ns: int
    mid_unix_ns: int
    published_ns: int
    mode: Mode
    truth: TruthState
    result: FrameResult
    valid: bool
    reason: str
    rate_rad_s: Triple = ZERO
    rate_valid: bool = False
    capture_s: float = 0.0
    detect_s: float = 0.0
    identify_s: float = 0.0
    period_s: float = 0.0
    late: bool = False

    @property
    def latency_s(self) -> float:
        """From the middle of the exposure to the result being known, seconds of run time."""
        return (self.published_ns - self.mid_ns) / NANOSECONDS


@dataclass
class _Frame:
    """A frame on its way."""

    index: int
    start_ns: int
    mid_ns: int
    mode: Mode
    truth: TruthState
    exposure_s: float
    period_s: float
    tracking: bool
    result: FrameResult | None = None
    waiting_since_ns: int | None = None
    """When a result without stars would have been known, if none had come by then."""
    late: bool = False
    """The machine took longer than the model."""
    finished_ns: int | None = None
    """When its result became known."""


class FrameCycle:
    """Exposes frame after frame while it runs.

    Parameters
    ----------
    publish
        Called with each measurement in its turn.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        imager: Imager,
        parameters: Parameters,
        timing: TimingConfig,
        time: DeviceTime,
        publish: Callable[[Measurement], None],
        rate_window: int,
    ) -> None:
        self._scheduler = scheduler
        self._imager = imager
        self._parameters = parameters
        self._timing = timing
        self._time = time
        self._now_ns = time.clock.now_ns
        self._publish = publish
        self._rate_window = rate_window
        self._rates = RateEstimator()
        self._next: Event | None = None
        self._generation = 0
        self._in_flight: deque[_Frame] = deque()
        self._grid_ns = 0
        self._failure = ""
        """What the pipeline said of the last frame if it could not do it."""
        self.truth: TruthSource = FixedTruth(Attitude.identity())
        self.mode: Callable[[], Mode] = lambda: Mode.STANDBY
        self.faults: Callable[[int], dict[str, Any]] = lambda _index: {}
        self.after_exposure: Callable[[], None] | None = None
        """Called once when the next frame has gone to the pipeline."""
        self.index = 0
        """Number of the next frame of the run; never goes back, so that no two frames share their noise."""
        self.published = 0
        self.left_out = 0
        """Exposures since start-up for which the machine had no time."""

    @property
    def running(self) -> bool:
        """Whether frames are being exposed."""
        return self._next is not None

    def start(self) -> None:
        """Begin to expose, now."""
        if not self.running:
            self._grid_ns = self._now_ns()
            self._next = self._scheduler.at(self._grid_ns, self._begin)

    def stop(self) -> None:
        """Stop; frames on their way are dropped."""
        if self._next is not None:
            self._next.cancel()
            self._next = None
        self._generation += 1
        self._in_flight.clear()

    def reset(self) -> None:
        """Stop and forget all attitudes, as a restart of the device does."""
        self.stop()
        self._rates.clear()
        self.published = self.left_out = 0

    def retime(self) -> None:
        """Take a new update rate into use at once."""
        if self._next is not None:
            self._next.cancel()
            start_ns = max(self._now_ns(), min(self._next.due_ns, self._grid_ns + self._period_ns()))
            self._next = self._scheduler.at(start_ns, self._begin)

    def has_fix(self, within_s: float) -> bool:
        """Whether there is an attitude to track from that is not older than `within_s`."""
        last = self._rates.last
        return last is not None and self._now_ns() - last[0] <= within_s * NANOSECONDS

    def _exposure_s(self) -> float:
        return float(self._parameters["exposure"]) / 1000.0

    def _period_ns(self) -> int:
        """Time from exposure to exposure; a rate rounded to single precision does not make exposures overlap."""
        period_s = 1.0 / float(self._parameters["update_rate"])
        return round(max(period_s, exposure_period_s(self._parameters)) * NANOSECONDS)

    def _identify_s(self, *, tracking: bool) -> float:
        return self._timing.identify_tracking_s if tracking else self._timing.identify_lost_s

    def _processing_ns(self, *, tracking: bool) -> int:
        """Modelled time from the end of an exposure to a result without stars."""
        timing = self._timing
        seconds = timing.readout_s + timing.detect_s + self._identify_s(tracking=tracking)
        return round(seconds * NANOSECONDS)

    def _begin(self, due_ns: int) -> None:
        """Open the shutter, and plan the next opening on the grid."""
        self._grid_ns = due_ns
        period_ns = self._period_ns()
        now_ns = self._now_ns()
        missed = max(0, (now_ns - due_ns) // period_ns)
        self.left_out += missed
        self._next = self._scheduler.at(due_ns + (missed + 1) * period_ns, self._begin)
        if self._imager.pending >= max(MAX_PENDING, self._processing_ns(tracking=True) / period_ns):
            self.left_out += 1
            return
        exposure_s = self._exposure_s()
        start_ns = due_ns + int(self._parameters["delay_time"]) * 1_000_000
        end_ns = start_ns + round(exposure_s * NANOSECONDS)
        mode, generation = self.mode(), self._generation
        mid_ns = start_ns + round(exposure_s * NANOSECONDS / 2)

        def close(close_ns: int) -> None:
            if generation == self._generation:
                self._end(close_ns, start_ns, mid_ns, mode, exposure_s, period_ns / NANOSECONDS)

        self._scheduler.at(end_ns, close)

    def _end(
        self, end_ns: int, start_ns: int, mid_ns: int, mode: Mode, exposure_s: float, period_s: float
    ) -> None:
        """Close the shutter: what was seen goes to the pipeline."""
        truth = self.truth.state(mid_ns / NANOSECONDS)
        predicted = self._predict(mid_ns) if mode is Mode.TRACKING else None
        frame = _Frame(self.index, start_ns, mid_ns, mode, truth, exposure_s, period_s, predicted is not None)
        request = self.request(truth, exposure_s, predicted)
        self._in_flight.append(frame)
        ready_ns = end_ns + self._processing_ns(tracking=frame.tracking)
        generation = self._generation

        def arrived(answer: PipelineReply) -> None:
            if generation == self._generation:
                self._arrived(frame, answer)

        def ready(due_ns: int) -> None:
            if generation == self._generation:
                self._ready(frame, due_ns)

        self._imager.submit(request, arrived)
        self._scheduler.at(ready_ns, ready)
        if self.after_exposure is not None:
            then, self.after_exposure = self.after_exposure, None
            then()

    def request(
        self, truth: TruthState, exposure_s: float, predicted: Attitude | None, *, solve: bool = True
    ) -> FrameRequest:
        """Make the request for the next frame of the run."""
        index = self.index
        self.index += 1
        parameters = self._parameters
        chosen: dict[str, Any] = {name: parameters[name] for name in _SETTINGS}
        settings = SolverSettings(**chosen)
        x, y, z = truth.rate_rad_s.tolist()
        return FrameRequest(
            index=index,
            attitude_xyzw=as_quaternion(truth.attitude),
            rate_rad_s=(x, y, z),
            exposure_s=exposure_s,
            gain=float(parameters["analog_gain"]),
            solve=solve,
            predicted_xyzw=None if predicted is None else as_quaternion(predicted),
            settings=settings,
            faults=self.faults(index),
        )

    def _predict(self, mid_ns: int) -> Attitude | None:
        """Where the sensor is expected to look; None until a rate is known, which takes two fixes."""
        last = self._rates.last
        rate = self._rates.rate(self._rate_window)
        if last is None or rate is None:
            return None
        if not self._parameters["prediction_enable"]:
            return last[1]
        return propagate(last[1], np.array(rate), (mid_ns - last[0]) / NANOSECONDS)

    def _arrived(self, frame: _Frame, answer: PipelineReply) -> None:
        if isinstance(answer, FrameResult):
            frame.result, self._failure = answer, ""
        else:
            text = answer.text if isinstance(answer, Failure) else "unexpected answer"
            if text != self._failure:  # once, not with every frame
                log.warning("frame %d: %s", frame.index, text)
            self._failure = text
            frame.result = FrameResult(frame.index, reason="processing_error")
        if frame.waiting_since_ns is not None:
            self._ready(frame, frame.waiting_since_ns)

    def _ready(self, frame: _Frame, due_ns: int) -> None:
        """Publish when the modelled detection of all stars is done, or as soon as the result comes after that."""
        if frame.result is None:
            frame.waiting_since_ns = due_ns
            return
        known_ns = due_ns + round(self._timing.detect_per_star_s * frame.result.detected * NANOSECONDS)
        now_ns = self._now_ns()
        if known_ns > now_ns:
            generation = self._generation

            def finish(finish_ns: int) -> None:
                if generation == self._generation:
                    self._finish(frame, finish_ns)

            self._scheduler.at(known_ns, finish)
            return
        if frame.waiting_since_ns is not None:
            frame.late = True
            known_ns = now_ns
        self._finish(frame, known_ns)

    def _finish(self, frame: _Frame, known_ns: int) -> None:
        """Publish a frame, after those that were exposed before it."""
        frame.finished_ns = known_ns
        while self._in_flight and self._in_flight[0].finished_ns is not None:
            first = self._in_flight.popleft()
            self._publish_frame(first, max(known_ns, first.finished_ns or 0))

    def _publish_frame(self, frame: _Frame, published_ns: int) -> None:
        result = frame.result or FrameResult(frame.index)
        timing = self._timing
        detect_s = timing.detect_s + timing.detect_per_star_s * result.detected
        identify_s = self._identify_s(tracking=frame.tracking)
        valid, reason, rate = self._judge(frame, result, detect_s + identify_s)
        self.published += 1
        self._publish(
            Measurement(
                counter=self.published,
                mid_ns=frame.mid_ns,
                mid_unix_ns=self._time.unix_ns(frame.mid_ns),
                published_ns=published_ns,
                mode=frame.mode,
                truth=frame.truth,
                result=result,
                valid=valid,
                reason=reason,
                rate_rad_s=rate or ZERO,
                rate_valid=rate is not None and valid,
                capture_s=frame.exposure_s + timing.readout_s,
                detect_s=detect_s,
                identify_s=identify_s,
                period_s=frame.period_s,
                late=frame.late,
            )
        )

    def _judge(
        self, frame: _Frame, result: FrameResult, processing_s: float
    ) -> tuple[bool, str, Triple | None]:
        """Return whether the device stands by a result, why not, and the rate."""
        if not result.valid:
            return False, result.reason, None
        self._rates.add(frame.mid_ns, Attitude(np.array(result.quaternion_xyzw)), frame.period_s)
        rate = result.rate_rad_s or self._rates.rate(self._rate_window)
        if processing_s * 1000.0 > float(self._parameters["detection_timeout"]):
            return False, "timeout", rate
        if rate is not None and np.linalg.norm(rate) > np.radians(float(self._parameters["max_rate"])):
            return False, "rate_too_high", rate
        return True, "ok", rate


_SETTINGS: Final = tuple(SolverSettings.__dataclass_fields__)


def as_quaternion(attitude: Attitude) -> Quaternion:
    """Return the quaternion of an attitude as plain numbers."""
    x, y, z, w = attitude.quaternion_xyzw.tolist()
    return (x, y, z, w)
