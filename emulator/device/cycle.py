"""The exposure cycle: start of exposures, requests to the pipeline, and publication of results.

Exposures start on a grid of the update period. Read-out, detection and identification take the times in the
profile's `[timing]`, so that on the stepped clock the same run gives the same bytes. Processing starts after the exposure, or with
the next one (`timing.overlapped`). On other clocks, a result that
the machine delivers later is published when it arrives, and flagged as late. If the machine falls behind by
`MAX_PENDING` requests or, at high rates, by the modelled time of the steps, exposures are skipped: the last
attitude stays valid until it is too old, and tracking continues from it.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal, TypeAlias, TypeVar

import numpy as np

from starhil.emulator.device.clock_errors import ClockErrors
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode, Modes
from starhil.emulator.device.navigation import observer_velocity
from starhil.emulator.device.parameters import Parameters, exposure_period_s
from starhil.emulator.device.power import FrameTiming
from starhil.emulator.device.signals import Signals
from starhil.emulator.device.surroundings import Surroundings
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.sensor.pipeline.client import PipelineClient, PipelineReply
from starhil.emulator.sensor.pipeline.messages import (
    ZERO,
    CatalogUpset,
    Failure,
    FrameRequest,
    FrameResult,
    IndexRequest,
    SolverSettings,
    Triple,
)
from starhil.emulator.simulation.clock import DeviceTime
from starhil.emulator.simulation.scheduler import Action, Event, Scheduler
from starhil.emulator.truth.source import TruthState
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.icd.values import Value
from starid.arithmetic.arrays import Array
from starid.arithmetic.matrices import length
from starid.attitude import Attitude
from starid.identification.attitude_history import AttitudeHistory

log = logging.getLogger("starhil.device")

Argument = TypeVar("Argument")

MAX_PENDING: Final = 2
"""Number of pending requests at which exposures are skipped; more if more fit into the modelled time."""

MAX_AWAITED: Final = 256
"""Largest number of actions that await a phase of the next exposure, of which there may be none for any time."""

LONGEST_GAP_PERIODS: Final = 2.5
"""Longest gap between two attitudes from which a rate is estimated, update periods."""


Phase: TypeAlias = Literal["exposure", "mid_frame", "readout"]
"""Begin, middle and end of an exposure."""


@dataclass
class _Frame:
    """An exposure that has not been published yet."""

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
    """Modelled time of a result without stars, if the result has not arrived by then; otherwise None."""
    late: bool = False
    """Whether the machine took longer than the modelled time."""
    finished_ns: int | None = None
    """Time at which the result is complete; None before."""


class FrameCycle:
    """Takes exposures while it is running, and reports their results in the order of the exposures."""

    def __init__(
        self,
        profile: Profile,
        scheduler: Scheduler,
        imager: PipelineClient,
        time: DeviceTime,
        clock_errors: ClockErrors,
        parameters: Parameters,
        modes: Modes,
        surroundings: Surroundings,
        signals: Signals,
    ) -> None:
        self._timing = profile.timing
        self._scheduler = scheduler
        self._imager = imager
        self._time = time
        self._clock_errors = clock_errors
        self._start_unix_ns = round(profile.start_unix_s * NANOSECONDS)
        self._now_ns = time.clock.now_ns
        self._parameters = parameters
        self._modes = modes
        self._surroundings = surroundings
        self._signals = signals
        self._history = AttitudeHistory(profile.device.rate_window, NANOSECONDS)
        self._next: Event | None = None
        self._generation = 0
        self._in_flight: deque[_Frame] = deque()
        self._grid_ns = 0
        self._failure = ""
        """Error text of the last request if the pipeline failed, so that an error is logged only once."""
        self._warned_of_aberration = False
        self._awaiting: list[tuple[Phase, Action]] = []
        """What is to be done in the next exposure, and in which phase."""
        self.upsets: tuple[CatalogUpset, ...] = ()
        """Bits flipped in the star catalogue since start-up."""
        self._stored_upsets: tuple[CatalogUpset, ...] = ()
        """Those flipped where the catalogue is stored, which a restart does not undo."""
        self.pipeline_starts = 0
        """How often the pipeline has been started."""
        self.index = 0
        """Index of the next exposure; never reset, so that no two exposures have the same noise."""
        self.published = 0
        self.skipped = 0
        """Exposures skipped since start-up because the machine fell behind."""

    @property
    def running(self) -> bool:
        return self._next is not None

    @property
    def timing(self) -> FrameTiming:
        """Timing of the exposures, for the power model."""
        tracking = self._modes.mode is Mode.TRACKING
        return FrameTiming(
            self.running,
            self._grid_ns + int(self._parameters["delay_time"]) * 1_000_000,
            self._timing.busy_s(self.exposure_s, tracking=tracking),
            self._period_ns() / NANOSECONDS,
        )

    def start(self) -> None:
        if not self.running:
            self._grid_ns = self._now_ns()
            self._next = self._scheduler.at(self._grid_ns, self._start_exposure)

    def stop(self) -> None:
        """Stop, and drop exposures that have not been published."""
        if self._next is not None:
            self._next.cancel()
            self._next = None
        self._generation += 1
        self._in_flight.clear()

    def _until_stopped(self, act: Callable[[Argument], None]) -> Callable[[Argument], None]:
        """Return an action that has no effect once the cycle has been stopped."""
        generation = self._generation

        def act_unless_stopped(argument: Argument) -> None:
            if generation == self._generation:
                act(argument)

        return act_unless_stopped

    def reset(self) -> None:
        """Stop and discard all attitudes, because the device restarts."""
        self.stop()
        self._history.clear()
        self.published = self.skipped = 0
        self.upsets = self._stored_upsets

    def check_awaits(self) -> None:
        """Check that one more action can await a phase."""
        if len(self._awaiting) >= MAX_AWAITED:
            raise EmulatorError(
                f"phase: {MAX_AWAITED} requests await the next exposure already, and none has begun (mode {self._modes.mode.value})"
            )

    def at_phase(self, phase: Phase, action: Action) -> None:
        """Do something once, at a phase of the next exposure that begins; EmulatorError if too much awaits one."""
        self.check_awaits()
        self._awaiting.append((phase, action))

    def retime(self) -> None:
        """Apply a new update rate at once."""
        if self._next is not None:
            self._next.cancel()
            start_ns = max(self._now_ns(), min(self._next.due_ns, self._grid_ns + self._period_ns()))
            self._next = self._scheduler.at(start_ns, self._start_exposure)

    def upset_catalog(self, upset: CatalogUpset, *, stored: bool = False) -> None:
        """Flip a bit in the star catalogue, or where it is stored."""
        self.upsets += (upset,)
        if stored:
            self._stored_upsets += (upset,)

    def restore_catalog(self) -> None:
        """Undo the flipped bits of the star catalogue."""
        self.upsets = self._stored_upsets = ()

    def has_fix(self, within_s: float) -> bool:
        """Return whether there is an attitude not older than `within_s`."""
        last = self._history.last
        return last is not None and self._now_ns() - last[0] <= within_s * NANOSECONDS

    @property
    def exposure_s(self) -> float:
        """Exposure time, seconds."""
        return float(self._parameters["exposure"]) / 1000.0

    def _period_ns(self) -> int:
        """Return the time between exposures, which must not overlap even if the rate is rounded to f32."""
        period_s = 1.0 / float(self._parameters["update_rate"])
        return round(max(period_s, exposure_period_s(self._parameters)) * NANOSECONDS)

    def _identify_s(self, *, tracking: bool) -> float:
        return self._timing.identify_tracking_s if tracking else self._timing.identify_lost_s

    def _ready_ns(self, start_ns: int, exposure_s: float, period_s: float, *, tracking: bool) -> int:
        """Return the modelled time of a result without stars, from the start of the exposure."""
        timing = self._timing
        processed_from_s = period_s if timing.overlapped else exposure_s + timing.readout_s
        return start_ns + round((processed_from_s + timing.processing_s(tracking=tracking)) * NANOSECONDS)

    def _start_exposure(self, due_ns: int) -> None:
        """Start an exposure and schedule the next one on the grid."""
        self._grid_ns = due_ns
        period_ns = self._period_ns()
        now_ns = self._now_ns()
        missed = max(0, (now_ns - due_ns) // period_ns)
        self.skipped += missed
        self._next = self._scheduler.at(due_ns + (missed + 1) * period_ns, self._start_exposure)
        processing_s = self._timing.readout_s + self._timing.processing_s(tracking=True)
        if self._imager.pending >= max(MAX_PENDING, processing_s * NANOSECONDS / period_ns):
            self.skipped += 1
            return
        exposure_s = self.exposure_s
        start_ns = due_ns + int(self._parameters["delay_time"]) * 1_000_000
        end_ns = start_ns + round(exposure_s * NANOSECONDS)
        mid_ns = start_ns + round(exposure_s * NANOSECONDS / 2)
        for phase, action in self._awaiting:
            at_ns = {"exposure": start_ns, "mid_frame": mid_ns, "readout": end_ns}[phase]
            self._scheduler.at(at_ns, action)
        self._awaiting.clear()
        begun = (start_ns, mid_ns, self._modes.mode, exposure_s, period_ns / NANOSECONDS)
        self._scheduler.at(end_ns, self._until_stopped(lambda _: self._end_exposure(*begun)))

    def _end_exposure(
        self, start_ns: int, mid_ns: int, mode: Mode, exposure_s: float, period_s: float
    ) -> None:
        """End an exposure and request its result from the pipeline."""
        truth = self._surroundings.state(mid_ns)
        predicted = self._predict(mid_ns) if mode is Mode.TRACKING else None
        frame = _Frame(self.index, start_ns, mid_ns, mode, truth, exposure_s, period_s, predicted is not None)
        request = self._request(start_ns, truth, exposure_s, predicted, self._assumed_velocity(mid_ns))
        if predicted is not None and self._parameters["prediction_enable"]:
            covariance, freedom = self._history.uncertainty(mid_ns) or (None, math.inf)
            request = replace(
                request,
                prediction_covariance=covariance,
                prediction_freedom=freedom,
                predicted_rate_rad_s=self._history.rate(),
            )
        self._in_flight.append(frame)
        ready_ns = self._ready_ns(start_ns, exposure_s, period_s, tracking=frame.tracking)
        self._imager.submit(request, self._until_stopped(partial(self._result_arrived, frame)))
        self._scheduler.at(ready_ns, self._until_stopped(partial(self._schedule_publication, frame)))
        self._signals.exposed.emit(frame.index)

    def _assumed_velocity(self, mid_ns: int) -> Array | None:
        """Return the velocity with which the device corrects aberration; None if the sky has none."""
        velocity = observer_velocity(self._parameters, self._time.unix_ns(mid_ns) / NANOSECONDS)
        if velocity is None or self._surroundings.has_aberration:
            return velocity
        if not self._warned_of_aberration:
            self._warned_of_aberration = True
            log.warning(
                "corrects_aberration has no effect: the sky has no aberration; give it a date, sky.date or sky.bodies=ephemeris"
            )
        return None

    def index_request(self) -> IndexRequest:
        """Return the request for the star index of the current parameters."""
        return IndexRequest(SolverSettings.of(self._parameters), self.upsets)

    def rehearsal(self, constants: Mapping[str, Value]) -> IndexRequest:
        """Return the request to prepare frames with the present parameters.

        `constants` are parameters that the device is going to take from the camera.
        """
        parameters, now_ns = {**self._parameters, **constants}, self._now_ns()
        truth = self._surroundings.state(now_ns)
        conditions = self._surroundings.conditions(truth)
        settings = SolverSettings.of(parameters)
        frame = FrameRequest(
            index=0,
            truth=truth,
            exposure_s=float(parameters["exposure"]) / 1000.0,
            gain=float(parameters["analog_gain"]),
            settings=settings,
            temperature_c=conditions.temperature_c,
            particles_s=conditions.particles_s,
            observer_velocity=self._assumed_velocity(now_ns),
        )
        return IndexRequest(settings, self.upsets, frame)

    def single_frame(self, mid_ns: int) -> FrameRequest:
        """Return the request for an exposure that is not solved, with a given simulation time of mid-exposure."""
        exposure_s = self.exposure_s
        start_ns = mid_ns - round(exposure_s * NANOSECONDS / 2)
        return self._request(start_ns, self._surroundings.state(mid_ns), exposure_s, None, None, solve=False)

    def _request(
        self,
        start_ns: int,
        truth: TruthState,
        exposure_s: float,
        predicted: Attitude | None,
        velocity: Array | None,
        *,
        solve: bool = True,
    ) -> FrameRequest:
        """Return the request for the next exposure, tracked from a predicted attitude if there is one."""
        index = self.index
        self.index += 1
        parameters = self._parameters
        conditions = self._surroundings.conditions(truth)
        return FrameRequest(
            index=index,
            truth=truth,
            exposure_s=exposure_s,
            gain=float(parameters["analog_gain"]),
            solve=solve,
            predicted=predicted,
            settings=SolverSettings.of(parameters),
            faults=self._surroundings.faults,
            temperature_c=conditions.temperature_c,
            particles_s=conditions.particles_s,
            upsets=self.upsets,
            observer_velocity=velocity,
            begin_s=start_ns / NANOSECONDS,
            pipeline_starts=self.pipeline_starts,
        )

    def _predict(self, mid_ns: int) -> Attitude | None:
        """Return the predicted attitude; None until a rate is known, because a wrong prediction costs a frame."""
        rate = self._history.rate()
        if rate is None:
            return None
        return self._history.predict(mid_ns, rate if self._parameters["prediction_enable"] else None)

    def _result_arrived(self, frame: _Frame, answer: PipelineReply) -> None:
        if isinstance(answer, FrameResult):
            frame.result, self._failure = answer, ""
        else:
            text = answer.text if isinstance(answer, Failure) else "unexpected answer"
            if text != self._failure:  # once, not for every exposure
                log.warning("frame %d: %s", frame.index, text)
            self._failure = text
            frame.result = FrameResult(frame.index, reason="processing_error")
        if frame.waiting_since_ns is not None:
            self._schedule_publication(frame, frame.waiting_since_ns)

    def _schedule_publication(self, frame: _Frame, due_ns: int) -> None:
        """Publish at the modelled end of detection, or as soon as a late result arrives."""
        if frame.result is None:
            frame.waiting_since_ns = due_ns
            return
        complete_ns = due_ns + round(self._timing.detect_per_star_s * frame.result.detected * NANOSECONDS)
        complete_ns += self._clock_errors.latency_ns(frame.index)
        now_ns = self._now_ns()
        if complete_ns > now_ns:
            self._scheduler.at(complete_ns, self._until_stopped(partial(self._publish_in_order, frame)))
            return
        if frame.waiting_since_ns is not None:
            frame.late = True
            complete_ns = now_ns
        self._publish_in_order(frame, complete_ns)

    def _publish_in_order(self, frame: _Frame, complete_ns: int) -> None:
        """Publish a result, after the results of all earlier exposures."""
        frame.finished_ns = complete_ns
        while self._in_flight and self._in_flight[0].finished_ns is not None:
            first = self._in_flight.popleft()
            self._publish_frame(first, max(complete_ns, first.finished_ns or 0))

    def _publish_frame(self, frame: _Frame, published_ns: int) -> None:
        result = frame.result or FrameResult(frame.index)
        timing = self._timing
        detect_s = timing.detect_s + timing.detect_per_star_s * result.detected
        identify_s = self._identify_s(tracking=frame.tracking)
        valid, reason, rate = self._assess(frame, result, detect_s + identify_s)
        mid_unix_ns = self._time.unix_ns(frame.mid_ns) + self._clock_errors.tag_error_ns(frame.index)
        self.published += 1
        self._signals.frame_published.emit(
            Measurement(
                counter=self.published,
                mid_ns=frame.mid_ns,
                mid_unix_ns=mid_unix_ns,
                clock_error_ns=mid_unix_ns - self._start_unix_ns - frame.mid_ns,
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

    def _assess(
        self, frame: _Frame, result: FrameResult, processing_s: float
    ) -> tuple[bool, str, Triple | None]:
        """Return the validity of a result after the checks of the device, the reason, and the rate."""
        if not result.valid:
            if frame.tracking:
                self._history.interrupt()
            return False, result.reason, None
        attitude = Attitude(np.array(result.quaternion_xyzw))
        known = None if result.covariance_rad2 is None else np.array(result.covariance_rad2)
        gap_s = LONGEST_GAP_PERIODS * frame.period_s
        self._history.add(frame.mid_ns, attitude, gap_s, known, result.freedom)
        rate = result.rate_rad_s or self._history.rate()
        if processing_s * 1000.0 > float(self._parameters["detection_timeout"]):
            return False, "timeout", rate
        if rate is not None and length(np.array(rate)) > math.radians(float(self._parameters["max_rate"])):
            return False, "rate_too_high", rate
        return True, "ok", rate
