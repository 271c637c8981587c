"""Power and temperature of the unit: phases of the frame cycle, their currents, and the resulting heating."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from starhil.emulator.profile.sections import PowerConfig, ThermalConfig
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.arithmetic.elementary import cos, exp, sin

MILLI: Final = 1e-3


class Phase(StrEnum):
    """Phases of the frame cycle, with their names in the interface definition."""

    IDLE = "idle"
    IMAGER_ON = "imager_on"
    EXPOSURE = "exposure"
    TRANSFER = "transfer"


@dataclass(frozen=True)
class FrameTiming:
    """Timing of the frames."""

    running: bool
    """Whether the sensor is exposing."""
    start_ns: int
    """Start of the last exposure, simulation time."""
    busy_s: float
    """Time from the start of an exposure to the end of its processing, seconds."""
    period_s: float
    """Time between frames, seconds."""


@dataclass(frozen=True)
class PowerModel:
    """Current and power of the unit in each phase.

    The imager is switched on before an exposure. After exposure and processing, the result is transferred,
    and the unit is idle until the imager is switched on for the next frame. If the period is too short for
    all phases, idle is shortened first, then the transfer.
    """

    config: PowerConfig
    """Table `[power]` of the profile."""

    def durations_s(self, timing: FrameTiming) -> dict[Phase, float]:
        """Return the duration of each phase in a period, beginning with the exposure."""
        if not timing.running:
            return {Phase.IDLE: timing.period_s}
        left = timing.period_s
        lasting = {}
        for phase, duration_s in (
            (Phase.EXPOSURE, timing.busy_s),
            (Phase.IMAGER_ON, self.config.imager_on_s),
            (Phase.TRANSFER, self.config.transfer_s),
            (Phase.IDLE, math.inf),
        ):
            lasting[phase] = min(duration_s, left)
            left -= lasting[phase]
        return lasting

    def phase(self, timing: FrameTiming, now_ns: int) -> Phase:
        if not timing.running:
            return Phase.IDLE
        since_s = ((now_ns - timing.start_ns) / NANOSECONDS) % timing.period_s
        lasting = self.durations_s(timing)
        for phase in (Phase.EXPOSURE, Phase.TRANSFER, Phase.IDLE):
            if since_s < lasting[phase]:
                return phase
            since_s -= lasting[phase]
        return Phase.IMAGER_ON

    def current_a(self, phase: Phase) -> float:
        milliamperes: float = getattr(self.config, f"{phase}_ma")
        return milliamperes * MILLI

    def power_w(self, phase: Phase) -> float:
        return self.current_a(phase) * self.config.voltage_v

    def mean_power_w(self, timing: FrameTiming) -> float:
        """Return the power averaged over a period, watts."""
        lasting = self.durations_s(timing)
        energy = math.fsum(self.power_w(phase) * seconds for phase, seconds in lasting.items())
        return energy / timing.period_s


@dataclass(frozen=True)
class ThermalState:
    """Temperature of the unit while its mean power does not change.

    It is the temperature of the mounting, which follows the orbit, plus heating by power, which follows the mean power
    with one time constant.
    """

    config: ThermalConfig
    """Table `[thermal]` of the profile."""
    since_ns: int = 0
    """Simulation time of the last change of the mean power."""
    rise_c: float = 0.0
    towards_c: float = 0.0
    """Heating at that time, and that to which it tends, degrees."""

    def heating_c(self, now_ns: int) -> float:
        """Return the heating at a simulation time, degrees."""
        elapsed_s = max(now_ns - self.since_ns, 0) / NANOSECONDS
        left = exp(-elapsed_s / self.config.time_constant_s)
        return self.towards_c + (self.rise_c - self.towards_c) * left

    def mounting_c(self, now_ns: int) -> float:
        """Return the temperature of the mounting, °C."""
        config = self.config
        turn = 2.0 * math.pi * (now_ns / NANOSECONDS) / config.period_s
        return config.mounting_c + config.swing_c * sin(turn)

    def temperature_c(self, now_ns: int) -> float:
        """Return the temperature of detector and lens, °C."""
        return self.mounting_c(now_ns) + self.heating_c(now_ns)

    def mean_c(self, from_ns: int, to_ns: int) -> float:
        """Return the mean temperature of detector and lens between two simulation times, °C."""
        config = self.config
        span_s = (to_ns - from_ns) / NANOSECONDS
        turn, time_s = 2.0 * math.pi / config.period_s, config.time_constant_s
        one_s, other_s = ((ns - self.since_ns) / NANOSECONDS for ns in (from_ns, to_ns))
        swing = cos(turn * from_ns / NANOSECONDS) - cos(turn * to_ns / NANOSECONDS)
        fall = exp(-max(one_s, 0.0) / time_s) - exp(-max(other_s, 0.0) / time_s)
        heating = self.towards_c + (self.rise_c - self.towards_c) * time_s * fall / span_s
        return config.mounting_c + config.swing_c * swing / (turn * span_s) + heating


class ThermalModel:
    """The thermal state, which a change of the mean power replaces."""

    def __init__(self, config: ThermalConfig) -> None:
        self.state = ThermalState(config)

    def start(self, now_ns: int, power_w: float) -> None:
        self._change(now_ns, 0.0, power_w)

    def set_power(self, now_ns: int, power_w: float) -> None:
        self._change(now_ns, self.state.heating_c(now_ns), power_w)

    def _change(self, now_ns: int, rise_c: float, power_w: float) -> None:
        config = self.state.config
        self.state = ThermalState(config, now_ns, rise_c, power_w * config.heating_c_w)
