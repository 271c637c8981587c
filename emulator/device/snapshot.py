"""The device at one moment: all that a row reports.

A quantity is a function of a `Snapshot`. Its fields are immutable values, and none of them refers to the device or a
clock: a row describes one moment, although the clock runs on while its bytes are packed. Values that several quantities
share are computed from the fields once, at first use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from starhil.emulator.device.counters import Acknowledge, Counters
from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.parameters import ParameterState
from starhil.emulator.device.power import FrameTiming, Phase, PowerModel, ThermalState
from starhil.emulator.device.reported import Reported, reported
from starhil.emulator.device.stored_images import FileState, ImageState, StoredFile
from starhil.emulator.profile.sections import DeviceConfig
from starhil.emulator.sensor.pipeline.messages import MatchedStar, Quaternion
from starhil.protocol.icd.codec import Field
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.values import Parameter, Value

Result = TypeVar("Result")


class once(Generic[Result]):  # noqa: N801 (used like a function)
    """A property computed at first use; before Python 3.12, `functools.cached_property` takes a lock."""

    def __init__(self, function: Callable[[Any], Result]) -> None:
        self.function = function
        self.__doc__ = function.__doc__

    def __set_name__(self, _owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, _owner: type | None = None) -> Result:
        """Compute the value and keep it in the instance."""
        result = self.function(instance)
        instance.__dict__[self._name] = result
        return result


@dataclass(frozen=True)
class Constants:
    """What does not change while the emulator runs."""

    conventions: Conventions
    """How the unit reports attitude, vectors and time."""
    identity: DeviceConfig
    """Table `[device]` of the profile."""
    health: Mapping[str, float]
    """Table `[health]` of the profile."""
    image_size: tuple[int, int]
    """Columns and rows of the pixel array."""
    power: PowerModel
    """Current and power in each phase."""
    rate_fields: tuple[tuple[Field, int, float], ...]
    """Integer fields that report a body rate: field, axis, and factor from rad/s to the field's unit."""


@dataclass(frozen=True)
class Snapshot:
    """The device at one moment, as values that do not change."""

    constants: Constants
    """What does not change while the emulator runs."""
    now_ns: int
    """Simulation time, nanoseconds."""
    uptime_ns: int
    """Time since start-up, nanoseconds."""
    unix_ns: int
    """The device's clock as Unix time, nanoseconds."""
    clock_set: bool
    """Whether the clock has been set since start-up."""
    reset_cause: str
    """Why the device restarted, as named in the interface definition."""
    boot_count: int
    """Starts since the parameter store was created."""
    mode: Mode
    """Mode of the device."""
    error: str
    """Why the mode is `error`; empty in any other mode."""
    mode_changes: int
    """Mode changes since start-up."""
    frame: Measurement | None
    """The last measurement, or None if it is outdated or no images are taken in this mode."""
    frames: int
    """Frames since start-up."""
    frames_valid: int
    """Frames with a valid attitude since start-up."""
    valid_in_a_row: int
    """Valid attitudes in a row, up to the last frame."""
    last_quaternion: Quaternion
    """Quaternion of the last valid frame, for a unit whose quaternions may have any sign."""
    timing: FrameTiming
    """Timing of the exposures."""
    thermal: ThermalState
    """Temperature of the unit."""
    parameters: ParameterState
    """The parameters of the device by name."""
    selected: Parameter | None
    """The parameter that a telecommand has selected; None if there is none with `selected_id`."""
    selected_id: int
    """ID of the selected parameter."""
    store_fault: bool
    """Whether the stored parameters were damaged at start-up."""
    accepted: Mapping[str, Mapping[str, Value]]
    """Last accepted values of the telecommands that telemetry reports, by telecommand and field."""
    counters: Counters
    """Counters and flags of the links."""
    acknowledge: Acknowledge
    """Outcome of the last telecommand."""
    images: ImageState
    """Capture and download of images."""
    files: FileState
    """The list of files, and the loaded block."""

    @once
    def file_updating(self) -> bool:
        """Whether the current file of the list is still being looked up."""
        return self.now_ns < self.files.looked_up_ns

    @once
    def file(self) -> StoredFile | None:
        """The current file of the list; None until it has been looked up, and at the end of the list."""
        files, position = self.images.files, self.files.position
        return None if self.file_updating or position >= len(files) else files[position]

    @once
    def erasing(self) -> bool:
        """Whether all files are being erased."""
        return self.now_ns < self.files.erased_ns

    @once
    def reported(self) -> Reported:
        """The attitude in the reported frame and the unit's convention."""
        conventions = self.constants.conventions
        return reported(self.frame, self.mode, self.parameters, conventions, self.last_quaternion)

    @once
    def stars(self) -> tuple[MatchedStar, ...]:
        """The identified stars of a valid frame, brightest first."""
        return () if self.frame is None or not self.frame.valid else self.frame.result.stars

    @once
    def clock_ns(self) -> int:
        """The device's clock since the unit's epoch, nanoseconds."""
        return self.constants.conventions.reported_ns(self.unix_ns)

    @once
    def exposure_ns(self) -> int | None:
        """Middle of the exposure on the device's clock since the unit's epoch, ns; None without a frame."""
        frame = self.frame
        return None if frame is None else self.constants.conventions.reported_ns(frame.mid_unix_ns)

    @once
    def phase(self) -> Phase:
        """The phase of the frame cycle."""
        return self.constants.power.phase(self.timing, self.now_ns)
