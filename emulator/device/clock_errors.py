"""Errors of the device's clock and of its latency: drift, jitter of the time tags, jumps, a stuck second."""

from __future__ import annotations

import random
from typing import Annotated, Final

from pydantic import Field

from starhil.emulator.device.power import ThermalModel
from starhil.emulator.profile.sections import ClockConfig, Drift, DriftByTemperature, Jitter
from starhil.emulator.simulation.config_model import Strict
from starhil.protocol.icd.conventions import NANOSECONDS

REFERENCE_C: Final = 25.0
"""Temperature at which the oscillator has its nominal drift, °C."""
PPM: Final = 1e-6


class ClockFault(Strict):
    """A fault of the clock, or of the latency."""

    drift_ppm: Drift | None = None
    """Drift of the clock, instead of that in the profile's `[clock]`."""
    drift_ppm_c: DriftByTemperature | None = None
    """Its change by temperature, likewise."""
    jitter_s: Jitter | None = None
    """Standard deviation of the time tags of exposures, likewise."""
    latency_jitter_s: Jitter | None = None
    """Largest additional delay of a result, likewise."""
    latency_s: Jitter = 0.0
    """Delay of every result."""
    jump_s: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    """Jump of the clock, once."""
    stuck_second: bool = False
    """The whole seconds of the clock stand still; their fraction goes on."""

    @property
    def lasting(self) -> dict[str, float | bool]:
        """The keys that were given, but the jump, which happens once."""
        return self.model_dump(exclude_unset=True, exclude={"jump_s"})


NO_FAULT: Final = ClockFault()


class ClockErrors:
    """How wrong the clock is: as the profile says, unless a fault overrides it."""

    def __init__(self, config: ClockConfig, thermal: ThermalModel, seed: int) -> None:
        self._config = config
        self._thermal = thermal
        self._seed = seed
        self.fault = NO_FAULT

    def _of(self, key: str) -> float:
        given: float | None = getattr(self.fault, key)
        own: float = getattr(self._config, key)
        return own if given is None else given

    def gained_ns(self, from_ns: int, to_ns: int) -> int:
        """Return what the clock gains between two simulation times, nanoseconds; the thermal state does not change between them."""
        ppm, ppm_c = self._of("drift_ppm"), self._of("drift_ppm_c")
        if ppm_c and from_ns != to_ns:
            ppm += ppm_c * (self._thermal.state.mean_c(from_ns, to_ns) - REFERENCE_C)
        return round((to_ns - from_ns) * ppm * PPM) if ppm else 0

    def tag_error_ns(self, index: int) -> int:
        """Return the random error of the time tag of an exposure, nanoseconds."""
        sigma_s = self._of("jitter_s")
        return round(sigma_s * NANOSECONDS * self._random("tag", index).gauss()) if sigma_s else 0

    def latency_ns(self, index: int) -> int:
        """Return the additional delay of the result of an exposure, nanoseconds."""
        most_s = self._of("latency_jitter_s")
        random_s = most_s * self._random("latency", index).random() if most_s else 0.0
        return round((self.fault.latency_s + random_s) * NANOSECONDS)

    def _random(self, what: str, index: int) -> random.Random:
        return random.Random(f"{what} {self._seed} {index}")  # noqa: S311 (errors, not secrets)
