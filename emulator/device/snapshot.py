"""One look at the device for one row: what several of its quantities share is computed once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from starhil.emulator.device.cycle import Measurement
from starhil.emulator.device.device import Device
from starhil.emulator.device.reported import Reported, reported
from starhil.emulator.pipeline.messages import MatchedStar

Result = TypeVar("Result")


class once(Generic[Result]):  # noqa: N801 (used like a function)
    """A property that is computed at first use; `functools.cached_property` takes a lock each time, until Python 3.12."""

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
    """The device at the moment of a request.

    Attributes
    ----------
    device
        The device.
    """

    def __init__(self, device: Device) -> None:
        self.device = device

    @once
    def frame(self) -> Measurement | None:
        """The last measurement, or None if it is out of date or the mode makes no images."""
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
        """Middle of the exposure on the device's clock since the unit's epoch, nanoseconds; None without a frame."""
        frame = self.frame
        return None if frame is None else self.device.icd.conventions.reported_ns(frame.mid_unix_ns)

    @once
    def uptime_ns(self) -> int:
        """Time since start-up, nanoseconds."""
        return self.device.clock.now_ns() - self.device.started_ns
