"""The published result of an exposure."""

from __future__ import annotations

from dataclasses import dataclass

from starhil.emulator.device.modes import Mode
from starhil.emulator.sensor.pipeline.messages import ZERO, FrameResult, Triple
from starhil.emulator.truth.source import TruthState
from starhil.protocol.icd.conventions import NANOSECONDS


@dataclass(frozen=True)
class Measurement:
    """The published result of an exposure."""

    counter: int
    """Number of published measurements since start-up, including this one."""
    mid_ns: int
    """Simulation time of mid-exposure, nanoseconds."""
    mid_unix_ns: int
    """Unix time of mid-exposure on the device's clock at publication, nanoseconds."""
    published_ns: int
    """Simulation time of publication, nanoseconds."""
    mode: Mode
    """Mode of the device at the exposure."""
    truth: TruthState
    """Truth of the sensor at mid-exposure."""
    result: FrameResult
    """Result of the pipeline."""
    valid: bool
    reason: str
    """Validity after the checks of the device, and the reason if not valid."""
    rate_rad_s: Triple = ZERO
    rate_valid: bool = False
    """Estimated body rate in the sensor frame, rad/s, and its validity."""
    capture_s: float = 0.0
    detect_s: float = 0.0
    identify_s: float = 0.0
    """Modelled times of the steps, seconds."""
    period_s: float = 0.0
    """Time between frames, seconds."""
    clock_error_ns: int = 0
    """Time of exposure on the device's clock minus that of the simulation, nanoseconds."""
    late: bool = False
    """Whether the machine took longer than the modelled time."""

    @property
    def latency_s(self) -> float:
        """Time from mid-exposure to publication, seconds of simulation time."""
        return (self.published_ns - self.mid_ns) / NANOSECONDS
