"""What acts on a sensor from outside: its true motion, date and orbit, temperature, radiation, and optical faults."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from starhil.emulator.device.power import ThermalModel
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.sensor.sky.radiation import default_rates, particle_rate
from starhil.emulator.sensor.sky.view import has_aberration
from starhil.emulator.truth.orbit import Orbit
from starhil.emulator.truth.source import TruthSource, TruthState
from starhil.protocol.icd.conventions import NANOSECONDS

log = logging.getLogger("starhil.device")


@dataclass(frozen=True)
class Conditions:
    """Conditions of the detector: temperature, °C, and particles per second."""

    temperature_c: float
    particles_s: float


class Surroundings:
    """The surroundings of a sensor; what its truth describes may change during a run."""

    def __init__(
        self, profile: Profile, truth: TruthSource, thermal: ThermalModel, now_ns: Callable[[], int]
    ) -> None:
        self.truth = truth
        self.has_aberration = profile.images.used or bool(has_aberration(profile.sky))
        self.faults: dict[str, Any] = {}
        """Optical faults: fields of the sky objects that differ from the profile's."""
        from starhil.emulator.sensor.model import SensorModel

        self._radiation = profile.radiation
        camera = profile.camera
        self._default_rates = default_rates(
            camera.width, camera.height, float(profile.sensor.get("pixel_um", SensorModel.pixel_um))
        )
        self._start_unix_s = profile.start_unix_s
        self._orbit = orbit_of(profile)
        self._lacks_orbit = False
        self._thermal = thermal
        self._now_ns = now_ns

    def state(self, at_ns: int) -> TruthState:
        """Return the truth with date and orbit at a simulation time in nanoseconds."""
        t_s = at_ns / NANOSECONDS
        state, unix_s = self.truth.state(t_s), self._start_unix_s + t_s
        try:
            completed = state.completed(unix_s, self._orbit)
        except EmulatorError as error:
            if not self._lacks_orbit:
                log.warning("%s; the run continues without an orbit", error)
            self._lacks_orbit = True
            return state.completed(unix_s, None)
        self._lacks_orbit = False
        return completed

    @property
    def has_orbit(self) -> bool:
        """Whether the sensor is on an orbit now."""
        return self.state(self._now_ns()).orbit is not None

    def conditions(self, truth: TruthState) -> Conditions:
        position_m = None if truth.orbit is None else truth.orbit.position_m
        radiation = self._radiation
        particles_s = particle_rate(
            radiation.quiet_s, radiation.anomaly_s, position_m, truth.unix_s, self._default_rates
        )
        return Conditions(self._thermal.state.temperature_c(self._now_ns()), particles_s)


def orbit_of(profile: Profile) -> Orbit | None:
    """Return the true orbit of a profile, or None."""
    if profile.orbit is None:
        return None
    try:
        return profile.orbit.build(profile.start_unix_s, profile.folder)
    except EmulatorError as error:
        raise EmulatorError(f"{profile.source_of(error)}: {error}") from None
