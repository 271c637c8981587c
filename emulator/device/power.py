"""Power and temperature of the unit: phases of the frame cycle, their currents, and the resulting heating."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.profile_sections import PowerConfig, ThermalConfig

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
    start_ns: int
    """Start of the last exposure, simulation time."""
    busy_s: float
    """Time from the start of an exposure to the end of its processing, seconds."""
    period_s: float


class PowerModel:
    """Current and power of the unit in each phase.

    The imager is switched on before an exposure. After exposure and processing, the result is transferred,
    and the unit is idle until the imager is switched on for the next frame. If the period is too short for
    all phases, idle is shortened first, then the transfer.
    """

    def __init__(self, config: PowerConfig) -> None:
        self._config = config
        self._current_ma: dict[Phase, float] = {phase: getattr(config, f"{phase}_ma") for phase in Phase}

    def durations_s(self, timing: FrameTiming) -> dict[Phase, float]:
        """Return the duration of each phase in a period, beginning with the exposure."""
        if not timing.running:
            return {Phase.IDLE: timing.period_s}
        left = timing.period_s
        lasting = {}
        for phase, wanted in (
            (Phase.EXPOSURE, timing.busy_s),
            (Phase.IMAGER_ON, self._config.imager_on_s),
            (Phase.TRANSFER, self._config.transfer_s),
            (Phase.IDLE, math.inf),
        ):
            lasting[phase] = min(wanted, left)
            left -= lasting[phase]
        return lasting

    def phase(self, timing: FrameTiming, now_ns: int) -> Phase:
        """Return the phase at a simulation time."""
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
        """Return the current in a phase, amperes."""
        return self._current_ma[phase] * MILLI

    def power_w(self, phase: Phase) -> float:
        """Return the power in a phase, watts."""
        return self.current_a(phase) * self._config.voltage_v

    def mean_power_w(self, timing: FrameTiming) -> float:
        """Return the power averaged over a period, watts."""
        lasting = self.durations_s(timing)
        energy = sum(self.power_w(phase) * seconds for phase, seconds in lasting.items())
        return energy / timing.period_s


class ThermalModel:
    """Temperature of the unit: the mounting's temperature, which follows the orbit, plus heating by power.

    The heating follows the mean power with one time constant.
    """

    def __init__(self, config: ThermalConfig) -> None:
        self._config = config
        self._rise_c = 0.0
        self._towards_c = 0.0
        self._since_ns = 0

    def start(self, now_ns: int, power_w: float) -> None:
        """Start at the temperature of the mounting."""
        self._rise_c = 0.0
        self._since_ns = now_ns
        self._towards_c = power_w * self._config.heating_c_w

    def set_power(self, now_ns: int, power_w: float) -> None:
        """Change the mean power."""
        self._rise_c = self._temperature_rise(now_ns)
        self._since_ns = now_ns
        self._towards_c = power_w * self._config.heating_c_w

    def _temperature_rise(self, now_ns: int) -> float:
        elapsed_s = max(now_ns - self._since_ns, 0) / NANOSECONDS
        left = math.exp(-elapsed_s / self._config.time_constant_s)
        return self._towards_c + (self._rise_c - self._towards_c) * left

    def mounting_c(self, now_ns: int) -> float:
        """Return the temperature of the mounting, °C."""
        config = self._config
        turn = 2.0 * math.pi * (now_ns / NANOSECONDS) / config.period_s
        return config.mounting_c + config.swing_c * math.sin(turn)

    def temperature_c(self, now_ns: int) -> float:
        """Return the temperature of detector and lens, °C."""
        return self.mounting_c(now_ns) + self._temperature_rise(now_ns)
