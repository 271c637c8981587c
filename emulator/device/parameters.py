"""The parameters of the device: checked against the interface definition, stored and restored."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from starhil.emulator.device.navigation import perigee_below_surface
from starhil.emulator.errors import EmulatorError
from starhil.protocol.icd import FieldError, InterfaceDefinition
from starhil.protocol.icd.codec import STRUCT_CODES
from starhil.protocol.icd.values import MessageError, Parameter, Value

ParameterValue = bool | int | float | str

ORDERED_PARAMETERS: Final[tuple[tuple[str, str], ...]] = (("min_star_pixels", "max_star_pixels"),)
"""Pairs whose first parameter must not exceed the second."""

ORBIT_SIZE: Final = ("orbit_semi_major_axis", "orbit_eccentricity")
"""Parameters on which the perigee depends."""

PERIOD_ROUNDING: Final = 1e-6
"""Fraction by which rounding to single precision may shorten a period."""


def exposure_period_s(parameters: Mapping[str, ParameterValue]) -> float:
    """Return the minimum time from exposure to exposure, seconds: delay plus exposure time.

    Read-out and processing overlap with the next exposure and do not count.
    """
    return (float(parameters["exposure"]) + float(parameters["delay_time"])) / 1000.0


def memory_format(definition: Parameter) -> str:
    """Return the format of a parameter in memory, for `struct`."""
    return "<" + STRUCT_CODES["u8" if definition.type in ("bool", "enum8") else definition.type]


def memory_bits(definition: Parameter) -> int:
    return 8 * struct.calcsize(memory_format(definition))


def flipped_number(value: float, wire_format: str, bit: int) -> float:
    """Return a number with one bit of its memory flipped, 0 the least significant."""
    whole = wire_format[-1] not in "fd"
    raw = bytearray(struct.pack(wire_format, int(value) if whole else value))
    raw[bit // 8] ^= 1 << bit % 8
    return float(struct.unpack(wire_format, raw)[0])


def _contradiction(values: Mapping[str, ParameterValue]) -> tuple[tuple[str, ...], str] | None:
    """Return the names of parameters that contradict each other, with the reason, or None."""
    for low, high in ORDERED_PARAMETERS:
        if float(values[low]) > float(values[high]):
            return (low, high), f"{low} {values[low]} is above {high} {values[high]}"
    axis_km, eccentricity = (float(values.get(name, 0.0)) for name in ORBIT_SIZE)
    if perigee_below_surface(axis_km, eccentricity):
        return ORBIT_SIZE, (
            f"orbit_semi_major_axis {axis_km:g} km and orbit_eccentricity {eccentricity:g} describe an orbit that intersects "
            "the Earth; set a perigee above 6378 km, or the semi-major axis to 0"
        )
    rate, needed_s = float(values["update_rate"]), exposure_period_s(values)
    if needed_s * rate > 1.0 + PERIOD_ROUNDING:
        return ("update_rate", "exposure", "delay_time"), (
            f"{rate:g} Hz leaves {1000.0 / rate:.4g} ms per frame, exposure {values['exposure']} ms and delay_time "
            f"{values['delay_time']} ms take {1000.0 * needed_s:g} ms; "
            f"set update_rate to {1.0 / needed_s:.4g} Hz or less, or shorten them"
        )
    return None


@dataclass(frozen=True, eq=False)
class ParameterState(Mapping[str, ParameterValue]):
    """The values of all parameters at one moment, by name."""

    current: Mapping[str, ParameterValue]
    """The values."""
    defaults: Mapping[str, ParameterValue]
    """The defaults for this device."""
    stored: Mapping[str, ParameterValue]
    """The stored values."""

    def __getitem__(self, name: str) -> ParameterValue:
        return self.current[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.current)

    def __len__(self) -> int:
        return len(self.current)

    @property
    def differs_from_store(self) -> bool:
        """Whether a restart would change any value."""
        return {**self.defaults, **self.stored} != self.current


class Parameters(Mapping[str, ParameterValue]):
    """All parameters, each always within its limits.

    `defaults` are those of this device that differ from the definition. `on_change` is called after each change with
    the names of the changed parameters.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        defaults: Mapping[str, Value] | None = None,
        on_change: Callable[[frozenset[str]], None] = lambda _names: None,
    ) -> None:
        self._definitions = icd.device_parameters
        standard: dict[str, ParameterValue] = {name: p.default for name, p in icd.device_parameters.items()}
        self._on_change = on_change
        try:
            own = MappingProxyType(standard | self._checked(standard, defaults or {}))
        except MessageError as error:
            raise EmulatorError(f"parameters.{error}") from None
        self.state = ParameterState(own, own, MappingProxyType({}))
        """The present values; each change makes a new state."""

    def __getitem__(self, name: str) -> ParameterValue:
        return self.state.current[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.state.current)

    def __len__(self) -> int:
        return len(self.state.current)

    def number(self, name: str) -> float:
        return self._definitions[name].to_number(self[name])

    def definition(self, name: str) -> Parameter:
        """Return type, unit, limits and description of a parameter."""
        return self._definitions[name]

    def set(self, changes: Mapping[str, Value]) -> None:
        """Set parameters, all or none; MessageError if a value is outside its limits, or two values contradict each other."""
        self._assign(self._checked(self, changes))

    def flip_bit(self, name: str, bit: int) -> bool:
        """Flip a bit of a parameter in memory, as a particle does; return whether the result is valid.

        An invalid value is replaced by the default, because the device checks its parameters.
        """
        definition = self._definitions[name]
        flipped = flipped_number(self.number(name), memory_format(definition), bit)
        try:
            self.set({name: flipped})
        except MessageError:
            self._assign({name: self.state.defaults[name]})
            return False
        return True

    def flip_stored(self, name: str, bit: int) -> ParameterValue | None:
        """Flip a bit of a stored value, or of the default if none is stored; return the result, None if it is invalid."""
        definition, stored = self._definitions[name], self.state.stored
        value = definition.to_number(stored.get(name, self.state.defaults[name]))
        try:
            flipped = definition.check(flipped_number(value, memory_format(definition), bit))
        except MessageError:
            self.mark_stored({key: kept for key, kept in stored.items() if key != name})
            return None
        self.mark_stored({**stored, name: flipped})
        return flipped

    def set_defaults(self) -> None:
        self._assign(self.state.defaults)

    def adopt_defaults(self, defaults: Mapping[str, Value]) -> None:
        """Replace some defaults, and values that are still at their default."""
        before = self.state.defaults
        checked = self._checked(before, defaults)
        follow = {name: value for name, value in checked.items() if self[name] == before[name]}
        self.state = replace(self.state, defaults=MappingProxyType({**before, **checked}))
        self._assign(follow)

    def restore(self, stored: Mapping[str, object]) -> list[str]:
        """Set all parameters to stored values, or to their defaults; return the ignored names.

        Unknown parameters and invalid values are ignored. Contradictions are checked for all stored values
        together, and the change is reported once.
        """
        defaults = self.state.defaults
        allowed: dict[str, Value] = {}
        for name, value in stored.items():
            if name in self._definitions and isinstance(value, (bool, int, float, str)):
                with contextlib.suppress(MessageError):
                    allowed[name] = self._definitions[name].check(value)
        accepted: dict[str, ParameterValue] = {}
        try:
            accepted = self._checked(defaults, allowed)
        except MessageError:  # if two values contradict each other, the later one is ignored
            for name, value in allowed.items():
                with contextlib.suppress(MessageError):
                    accepted |= self._checked({**defaults, **accepted}, {name: value})
        self.mark_stored(accepted)
        self._assign({**defaults, **accepted})
        return [name for name in stored if name not in accepted]

    def mark_stored(self, stored: Mapping[str, ParameterValue]) -> None:
        self.state = replace(self.state, stored=MappingProxyType(dict(stored)))

    def _checked(
        self, base: Mapping[str, ParameterValue], changes: Mapping[str, Value]
    ) -> dict[str, ParameterValue]:
        checked = {name: self._definitions[name].check(value) for name, value in changes.items()}
        result = {**base, **checked}
        found = _contradiction(result)
        if found is not None:
            names, why = found
            culprit = next((name for name in names if base[name] != result[name]), names[0])
            raise FieldError(f"{culprit}: {why}")
        return checked

    def _assign(self, values: Mapping[str, ParameterValue]) -> None:
        changed = frozenset(name for name, value in values.items() if self[name] != value)
        if changed:
            self.state = replace(self.state, current=MappingProxyType({**self.state.current, **values}))
            self._on_change(changed)
