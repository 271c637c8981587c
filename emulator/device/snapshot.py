"""State of the device for one row; values shared by several quantities are computed once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from starhil.emulator.device.device import Device
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.power import Phase
from starhil.emulator.device.reported import Reported, reported
from starhil.emulator.pipeline.messages import MatchedStar

Result = TypeVar("Result")


class once(Generic[Result]):  # noqa: N801 (used like a function)
    """A property computed at first use; before Python 3.12, `functools.cached_property` takes a lock."""

    def __init__(self, function: Callable[[Any], Result]) -> None:
        self._function = function
        self.__doc__ = function.__doc__

    def __set_name__(self, _owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, _owner: type | None = None) -> Result:
        """Compute the value and keep it in the instance."""
        result = self._function(instance)
        instance.__dict__[self._name] = result
        return result


class Snapshot:
    """The device at the moment of a request."""

    def __init__(self, device: Device) -> None:
        self.device = device

    @once
    def frame(self) -> Measurement | None:
        """The last measurement, or None if it is outdated or no images are taken in this mode."""
        return self.device.fresh

    @once
    def reported(self) -> Reported:
        """The attitude in the reported frame and the unit's convention."""
        return reported(self.device)

    @once
    def stars(self) -> tuple[MatchedStar, ...]:
        """The identified stars of a valid frame, brightest first."""
        return () if self.frame is None or not self.frame.valid else self.frame.result.stars

    @once
    def clock_ns(self) -> int:
        """The device's clock since the unit's epoch, nanoseconds."""
        return self.device.icd.conventions.reported_ns(self.device.time.unix_ns())

    @once
    def exposure_ns(self) -> int | None:
        """Middle of the exposure on the device clock since the unit's epoch, ns; None without a frame."""
        frame = self.frame
        return None if frame is None else self.device.icd.conventions.reported_ns(frame.mid_unix_ns)

    @once
    def phase(self) -> Phase:
        """The phase of the frame cycle."""
        return self.device.power.phase(self.device.cycle.timing, self.device.clock.now_ns())

    @once
    def uptime_ns(self) -> int:
        """Time since start-up, nanoseconds."""
        return self.device.clock.now_ns() - self.device.started_ns
