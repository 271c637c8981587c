"""One look at the device for one row: what several of its quantities share is computed once."""

from __future__ import annotations

from functools import cached_property

from starhil.emulator.device.cycle import Measurement
from starhil.emulator.device.device import Device
from starhil.emulator.device.reported import Reported, reported
from starhil.emulator.pipeline.messages import MatchedStar


class Snapshot:
    """The device at the moment of a request.

    Attributes
    ----------
    device
        The device.
    """

    def __init__(self, device: Device) -> None:
        self.device = device

    @cached_property
    def frame(self) -> Measurement | None:
        """The last measurement, or None if it is out of date or the mode makes no images."""
        return self.device.fresh

    @cached_property
    def reported(self) -> Reported:
        """The attitude in the reported frame and the unit's convention."""
        return reported(self.device)

    @cached_property
    def stars(self) -> tuple[MatchedStar, ...]:
        """The identified stars of a valid frame, brightest first."""
        return () if self.frame is None or not self.frame.valid else self.frame.result.stars

    @cached_property
    def clock_ns(self) -> int:
        """The device's clock since the unit's epoch, nanoseconds."""
        return self.device.icd.conventions.reported_ns(self.device.time.unix_ns())

    @cached_property
    def exposure_ns(self) -> int | None:
        """Middle of the exposure on the device's clock since the unit's epoch, nanoseconds; None without a frame."""
        frame = self.frame
        return None if frame is None else self.device.icd.conventions.reported_ns(frame.mid_unix_ns)

    @cached_property
    def uptime_ns(self) -> int:
        """Time since start-up, nanoseconds."""
        return self.device.clock.now_ns() - self.device.started_ns
