"""The published result of an exposure."""

from __future__ import annotations

from dataclasses import dataclass

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.modes import Mode
from starhil.emulator.pipeline.messages import ZERO, FrameResult, Triple
from starhil.emulator.truth.source import TruthState


@dataclass(frozen=True)
class Measurement:
    """The published result of an exposure.

    Attributes
    ----------
    counter
        Number of published measurements since start-up, including this one.
    mid_ns
        Simulation time of mid-exposure, nanoseconds.
    mid_unix_ns
        Unix time of mid-exposure on the device's clock at publication, nanoseconds.
    published_ns
        Simulation time of publication, nanoseconds.
    mode
        Mode of the device at the exposure.
    truth
        True attitude and rate at mid-exposure.
    result
        Result of the pipeline.
    valid, reason
        Validity after the checks of the device, and the reason if not valid.
    rate_rad_s, rate_valid
        Estimated body rate in the sensor frame, rad/s, and its validity.
    capture_s, detect_s, identify_s
        Modelled times of the steps, seconds.
    late
        Whether the machine took longer than the modelled time.
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
        """Time from mid-exposure to publication, seconds of simulation time."""
        return (self.published_ns - self.mid_ns) / NANOSECONDS
