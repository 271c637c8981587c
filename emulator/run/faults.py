"""Fault injection at four levels: optical, device, telemetry and link."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Self

from pydantic import BeforeValidator, Field, model_validator

from starhil.emulator.device.clock_errors import NO_FAULT, ClockFault
from starhil.emulator.device.cycle import Phase
from starhil.emulator.device.device import Device
from starhil.emulator.device.parameters import memory_bits
from starhil.emulator.device.requests import Requests
from starhil.emulator.device.telemetry_faults import MAX_FAULTS, TelemetryFault
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.table import BUSES
from starhil.emulator.links.wire_faults import WireFault, WireFaults
from starhil.emulator.sensor.pipeline.messages import DIRECTION_BITS, CatalogUpset
from starhil.emulator.sensor.sky.tables import OPTICAL_FAULT
from starhil.emulator.simulation.config_model import Strict
from starhil.protocol.errors import did_you_mean, remedy
from starhil.protocol.files.validation import TableOf
from starhil.protocol.icd import InterfaceDefinition

NO_ERROR: Final = 0
"""Value in `device_error` that means no error."""


class UpsetFault(Strict):
    """A bit flipped by a particle in the memory of the device: in a parameter or in a star's direction."""

    parameter: str | None = None
    """Name of the parameter."""
    star: Annotated[int, Field(ge=1, le=200_000)] | None = None
    """Hipparcos number of the star."""
    component: Annotated[int, Field(ge=0, le=2)] = 0
    """Component of the star's direction: 0, 1 or 2 for x, y or z."""
    bit: Annotated[int, Field(ge=0, le=63)]
    """Bit number, 0 for the least significant; components of directions have 32 bits."""
    stored: bool = False
    """Flip it in the memory that survives a restart. A parameter then changes at the next restart, until parameters are saved or
    the saved ones deleted; a star changes at once, until all faults are ended."""

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        if (self.parameter is None) == (self.star is None):
            raise ValueError("give either parameter or star")
        return self


def _nothing(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Effect:
    """What a fault of the device does, declared beside its key; called with the device, and the value of the key."""

    inject: Callable[[Device, Any], object]
    end: Callable[[Device], object] = _nothing
    """Ends a fault that lasts."""
    active: Callable[[Device], Mapping[str, Any]] = lambda _device: {}
    """Returns how a fault that lasts is reported; empty if there is none."""
    check: Callable[[Device, Any], object] = _nothing
    """Raises EmulatorError if the fault cannot be injected."""
    enum: str = ""
    """Enumeration of the names that the key takes; empty if it takes others."""
    no_fault: int | None = None
    """Value in the enumeration that is no fault."""
    ends_at_restart: bool = False
    """Whether it is injected after a restart in the same request, which would end it."""

    def names(self, icd: InterfaceDefinition) -> list[str]:
        return [name for name, code in icd.model.enums[self.enum].values.items() if code != self.no_fault]


def _stick(device: Device, stuck: bool) -> None:
    device.unresponsive = stuck


def _upset(device: Device, upset: UpsetFault) -> None:
    if upset.parameter is not None:
        device.upset_parameter(upset.parameter, upset.bit, stored=upset.stored)
    elif upset.star is not None:
        device.cycle.upset_catalog(CatalogUpset(upset.star, upset.component, upset.bit), stored=upset.stored)


def _upset_stars(device: Device) -> dict[str, Any]:
    stars = [upset.hip for upset in device.cycle.upsets]
    return {"upset_stars": stars} if stars else {}


def _check_upset(device: Device, upset: UpsetFault) -> None:
    if upset.parameter is not None:
        definition = device.icd.parameters.get(upset.parameter)
        if definition is None:
            hint = remedy(upset.parameter, device.icd.parameters)
            raise EmulatorError(f"device.upset.parameter: no parameter named {upset.parameter!r}{hint}")
        if upset.bit >= memory_bits(definition):
            raise EmulatorError(
                f"device.upset.bit: {upset.parameter} has bits 0 to {memory_bits(definition) - 1}"
            )
    elif upset.bit >= DIRECTION_BITS:
        raise EmulatorError(f"device.upset.bit: a direction has bits 0 to {DIRECTION_BITS - 1}")
    elif device.profile.run.algorithm != "geometric":
        raise EmulatorError("device.upset.star: only the algorithm geometric keeps directions in memory")


class DeviceFault(Strict):
    """A fault of the device: each key has its effect beside it."""

    stuck: Annotated[
        bool,
        Effect(
            _stick,
            lambda device: _stick(device, stuck=False),
            lambda device: {"stuck": True} if device.unresponsive else {},
        ),
    ] = False
    """Unresponsive: requests are neither counted nor answered; exposures continue."""
    error: Annotated[
        str | None,
        Effect(
            lambda device, why: device.modes.fail(why),
            enum="device_error",
            no_fault=NO_ERROR,
            ends_at_restart=True,
        ),
    ] = None
    """Enter the error mode with this error, a name in the enumeration `device_error`."""
    reset: Annotated[str | None, Effect(lambda device, cause: device.reset(cause), enum="reset_cause")] = None
    """Restart now with this cause, a name in the enumeration `reset_cause`."""
    upset: Annotated[
        UpsetFault | None,
        Effect(
            _upset,
            lambda device: device.cycle.restore_catalog(),
            _upset_stars,
            _check_upset,
            ends_at_restart=True,
        ),
    ] = None
    """Flip a bit in memory; undone by a restart or by restoring the parameters, unless it is `stored`."""


EFFECTS: Final[Mapping[str, Effect]] = {
    name: effect
    for name, field in DeviceFault.model_fields.items()
    for effect in field.metadata
    if isinstance(effect, Effect)
}
"""Effects of the keys of `DeviceFault`."""


def as_list(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


class FaultRequest(Strict):
    """One `fault` request; omitted levels keep their faults."""

    phase: Phase | None = None
    """Inject at the begin, the middle or the end of the next exposure that begins; omitted: now."""

    optical: Annotated[dict[str, Any], TableOf(OPTICAL_FAULT)] | None = None
    """Objects in addition to the sky of the profile: fields of `SkyObjects`, or `blocked_share`."""
    device: DeviceFault | None = None
    """Fault of the device."""
    telemetry: (
        Annotated[list[TelemetryFault], BeforeValidator(as_list), Field(max_length=MAX_FAULTS)] | None
    ) = None
    """Faults in the content of telemetry: a table, or a list of them."""
    clock: ClockFault | None = None
    """Faults of the device's clock, and of the latency."""
    serial: WireFault | None = None
    can: WireFault | None = None
    """Faults of outgoing CAN frames, including CANopen."""

    def of_bus(self, bus: str) -> WireFault | None:
        """Return the faults of a bus, whose key is its name; None if they stay."""
        fault: WireFault | None = getattr(self, bus)
        return fault


def _values(fault: DeviceFault) -> Iterator[tuple[str, Effect, Any]]:
    """Yield the keys of a fault that are given, each with its effect and its value."""
    for key, effect in EFFECTS.items():
        if (value := getattr(fault, key)) is not None:
            yield key, effect, value


class Faults:
    """The currently injected faults, also of links that are opened later."""

    def __init__(self, requests: Requests, links: Mapping[str, AnyLink]) -> None:
        self._device = requests.device
        self._telemetry = requests.faults
        self._links = links
        self._cleared = 0
        """How often all faults were ended."""

    @property
    def _wires(self) -> list[tuple[str, WireFaults[Any]]]:
        return [(link.bus, link.wire) for link in self._links.values()]

    def inject(self, request: FaultRequest) -> None:
        """Inject the faults of a request, all or none, now or at its phase."""
        self.check(request)
        if request.phase is None:
            self._inject(request)
        else:
            cleared = self._cleared
            self._device.cycle.at_phase(
                request.phase, lambda _due_ns: self._inject(request) if cleared == self._cleared else None
            )

    def _inject(self, request: FaultRequest) -> None:
        device = self._device
        if request.optical is not None:
            device.surroundings.faults = dict(request.optical)
        if request.telemetry is not None:
            self._telemetry.inject(request.telemetry, device.clock.now_ns())
        if request.clock is not None:
            device.fail_clock(request.clock)
        for name, wire in self._wires:
            fault = request.of_bus(name)
            if fault is not None:
                wire.settings = fault
        if request.device is not None:
            effects = sorted(_values(request.device), key=lambda item: item[1].ends_at_restart)
            for _, effect, value in effects:
                effect.inject(device, value)
        device.signals.faults_changed.emit(request.model_dump(mode="json", exclude_unset=True))

    def check(self, request: FaultRequest) -> None:
        if request.phase is not None:
            self._device.cycle.check_awaits()
        if request.device is not None:
            for key, effect, value in _values(request.device):
                if effect.enum and value not in (known := effect.names(self._device.icd)):
                    near = did_you_mean(value, known)
                    raise EmulatorError(f"device.{key}: {value!r} is not one of {', '.join(known)}{near}")
                effect.check(self._device, value)
        satellites = (request.optical or {}).get("satellites")
        if satellites is not None and not self._device.surroundings.has_orbit:
            raise EmulatorError(
                "optical.satellites: they are seen from an orbit; start the run with one, such as --orbit leo"
            )
        shown = {name: link.shown_in_replies for name, link in self._links.items()}
        for fault in request.telemetry or ():
            self._telemetry.check(fault, shown)
        there = {name for name, _ in self._wires}
        for name in BUSES:
            if request.of_bus(name) is not None and name not in there:
                raise EmulatorError(
                    f"{name}: this run has no such link; start it with --{name}, or omit this fault"
                )

    def clear(self) -> None:
        """End all faults, and those that wait for their phase.

        The error mode ends only by telecommand, and flipped parameters by a restart or as `UpsetFault.stored` says.
        """
        self._cleared += 1
        device = self._device
        device.surroundings.faults = {}
        self._telemetry.inject((), device.clock.now_ns())
        device.fail_clock(NO_FAULT)
        for effect in EFFECTS.values():
            effect.end(device)
        for _, wire in self._wires:
            wire.settings = WireFault()
        device.signals.faults_changed.emit({})

    def describe(self) -> dict[str, Any]:
        active: dict[str, Any] = {}
        if self._device.surroundings.faults:
            active["optical"] = self._device.surroundings.faults
        if of_device := {k: v for effect in EFFECTS.values() for k, v in effect.active(self._device).items()}:
            active["device"] = of_device
        if faults := self._telemetry.settings:
            active["telemetry"] = [fault.model_dump(exclude_unset=True) for fault in faults]
        if of_clock := self._device.clock_errors.fault.lasting:
            active["clock"] = of_clock
        for name, wire in self._wires:
            if not wire.settings.none:
                active[name] = wire.settings.model_dump()
        return active
