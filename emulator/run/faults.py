"""Fault injection at three levels: optical, device and link."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Self

from pydantic import AfterValidator, Field, model_validator

from starhil.emulator.device.device import Device
from starhil.emulator.device.parameters import memory_bits
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.wire_faults import WireFault, WireFaults
from starhil.emulator.sensor.pipeline.messages import DIRECTION_BITS, CatalogUpset
from starhil.emulator.sensor.sky.objects import SkyObjects
from starhil.emulator.truth.config import Strict
from starhil.protocol.errors import did_you_mean, remedy


def check_sky(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values if they are valid fields of `SkyObjects`; ValueError names the field and the allowed values."""
    try:
        SkyObjects.from_dict(values)
    except EmulatorError as error:
        raise ValueError(str(error)) from None
    return values


SkyValues = Annotated[dict[str, Any], AfterValidator(check_sky)]
"""Fields of `SkyObjects` as decoded from TOML or JSON."""

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

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        if (self.parameter is None) == (self.star is None):
            raise ValueError("give either parameter or star")
        return self


class DeviceFault(Strict):
    """A fault of the device."""

    stuck: bool = False
    """Unresponsive: requests are neither counted nor answered; exposures continue."""
    error: str | None = None
    """Enter the error mode with this error, a name in the enumeration `device_error`."""
    reset: str | None = None
    """Restart now with this cause, a name in the enumeration `reset_cause`."""
    upset: UpsetFault | None = None
    """Flip a bit in memory; undone by a restart or by restoring the parameters."""


class FaultRequest(Strict):
    """One `fault` request; omitted levels keep their faults."""

    optical: SkyValues | None = None
    """Objects in addition to the sky of the profile: fields of `SkyObjects`, or `blocked_share`."""
    device: DeviceFault | None = None
    """Fault of the device."""
    serial: WireFault | None = None
    """Faults of the serial line."""
    can: WireFault | None = None
    """Faults of outgoing CAN frames, including CANopen."""

    def of_bus(self, bus: str) -> WireFault | None:
        """Return the faults of a bus, whose key is its name; None if they stay."""
        fault: WireFault | None = getattr(self, bus)
        return fault


BUSES: Final = tuple(name for name in FaultRequest.model_fields if name not in ("optical", "device"))
"""Names of the buses that faults can affect."""


class Faults:
    """The currently injected faults, also of links that are opened later."""

    def __init__(self, device: Device, links: Mapping[str, AnyLink]) -> None:
        self._device = device
        self._links = links

    @property
    def _wires(self) -> list[tuple[str, WireFaults[Any]]]:
        return [(link.bus, link.wire) for link in self._links.values()]

    def inject(self, request: FaultRequest) -> None:
        """Inject the faults of a request, all or none."""
        self.check(request)
        device = self._device
        if request.optical is not None:
            device.surroundings.faults = dict(request.optical)
        for name, wire in self._wires:
            fault = request.of_bus(name)
            if fault is not None:
                wire.settings = fault
        if request.device is not None:
            device.unresponsive = request.device.stuck
            if request.device.reset is not None:
                device.reset(request.device.reset)
            if request.device.error is not None:
                device.modes.fail(request.device.error)
            if request.device.upset is not None:
                upset = request.device.upset
                if upset.parameter is not None:
                    device.upset_parameter(upset.parameter, upset.bit)
                elif upset.star is not None:
                    device.cycle.upset_catalog(CatalogUpset(upset.star, upset.component, upset.bit))
        device.signals.faults_changed.emit(request.model_dump(mode="json", exclude_unset=True))

    def check(self, request: FaultRequest) -> None:
        """Check that the faults of a request can be injected."""
        enums = self._device.icd.model.enums
        if request.device is not None:
            errors = [name for name, code in enums["device_error"].values.items() if code != NO_ERROR]
            for key, name, known in (
                ("error", request.device.error, errors),
                ("reset", request.device.reset, list(enums["reset_cause"].values)),
            ):
                if name is not None and name not in known:
                    near = did_you_mean(name, known)
                    raise EmulatorError(f"device.{key}: {name!r} is not one of {', '.join(known)}{near}")
            if request.device.upset is not None:
                self._check_upset(request.device.upset)
        there = {name for name, _ in self._wires}
        for name in BUSES:
            if request.of_bus(name) is not None and name not in there:
                raise EmulatorError(
                    f"{name}: this run has no such link; start it with --{name}, or omit this fault"
                )

    def _check_upset(self, upset: UpsetFault) -> None:
        if upset.parameter is not None:
            definition = self._device.icd.parameters.get(upset.parameter)
            if definition is None:
                hint = remedy(upset.parameter, self._device.icd.parameters)
                raise EmulatorError(f"device.upset.parameter: no parameter named {upset.parameter!r}{hint}")
            if upset.bit >= memory_bits(definition):
                raise EmulatorError(
                    f"device.upset.bit: {upset.parameter} has bits 0 to {memory_bits(definition) - 1}"
                )
        elif upset.bit >= DIRECTION_BITS:
            raise EmulatorError(f"device.upset.bit: a direction has bits 0 to {DIRECTION_BITS - 1}")
        elif self._device.profile.run.algorithm != "geometric":
            raise EmulatorError("device.upset.star: only the algorithm geometric keeps directions in memory")

    def clear(self) -> None:
        """End all faults; the error mode ends only by telecommand, and flipped parameters by a restart."""
        device = self._device
        device.surroundings.faults = {}
        device.unresponsive = False
        device.cycle.restore_catalog()
        for _, wire in self._wires:
            wire.settings = WireFault()
        device.signals.faults_changed.emit({})

    def describe(self) -> dict[str, Any]:
        """Return the current faults by level."""
        found: dict[str, Any] = {}
        if self._device.surroundings.faults:
            found["optical"] = self._device.surroundings.faults
        if self._device.unresponsive:
            found["device"] = {"stuck": True}
        if self._device.cycle.upsets:
            stars = [upset.hip for upset in self._device.cycle.upsets]
            found.setdefault("device", {})["upset_stars"] = stars
        for name, wire in self._wires:
            if not wire.settings.none:
                found[name] = wire.settings.model_dump()
        return found
