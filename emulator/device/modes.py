"""The mode machine: modes, the transitions between them, and the commands that it refuses.

::

    boot ──(pipeline warm, boot time over)──► standby ◄──command── error
                                              │    ▲
                                       command│    │command
                                              ▼    │
                     lost_in_space ──(attitude found)──► tracking
                           ▲                               │
                           └───(tracking lost, command)────┘

Standby, lost_in_space and tracking can be commanded. Tracking needs an attitude to start from, found since the
last start and not older than `device.PREDICTION_LIMIT_S`. Only a reset leads to boot, and only a fault to error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Mode(StrEnum):
    """Modes of the device, with their names in the interface definition."""

    BOOT = "boot"
    STANDBY = "standby"
    LOST_IN_SPACE = "lost_in_space"
    TRACKING = "tracking"
    ERROR = "error"

    @property
    def makes_frames(self) -> bool:
        """Whether frames are exposed and solved in this mode."""
        return self in {Mode.LOST_IN_SPACE, Mode.TRACKING}


_RUNNING: Final = frozenset(Mode) - {Mode.BOOT, Mode.ERROR}
COMMANDABLE_MODES: Final[dict[Mode, frozenset[Mode]]] = {
    **dict.fromkeys(_RUNNING, _RUNNING),
    Mode.BOOT: frozenset(),
    Mode.ERROR: frozenset({Mode.STANDBY}),
}
"""Mode → modes that can be commanded from it (docs/rules.md, R13)."""


class Cause(StrEnum):
    """Cause of a mode change."""

    RESET = "reset"
    BOOTED = "booted"
    COMMAND = "command"
    ATTITUDE_FOUND = "attitude_found"
    TRACKING_LOST = "tracking_lost"
    TRACKING_DISABLED = "tracking_disabled"
    FAULT = "fault"


@dataclass(frozen=True)
class Transition:
    """A change of mode; from error to error if only the cause of the error changes."""

    before: Mode
    after: Mode
    cause: Cause


class Modes:
    """The current mode, and the rules for changing it."""

    def __init__(self, on_change: Callable[[Transition], None] | None = None) -> None:
        self.mode = Mode.BOOT
        self.error = ""
        """Name in `device_error` of the error; empty in any other mode."""
        self._on_change = on_change

    def command(self, mode: Mode, *, has_attitude: bool) -> bool:
        """Change the mode by telecommand; return False if this is not allowed. Tracking needs an attitude to start from."""
        if mode not in COMMANDABLE_MODES[self.mode] or (mode is Mode.TRACKING and not has_attitude):
            return False
        self._enter(mode, Cause.COMMAND)
        return True

    def reset(self) -> None:
        """Enter the boot mode."""
        self._enter(Mode.BOOT, Cause.RESET)

    def booted(self) -> None:
        """Leave the boot mode, unless a fault has already done so."""
        if self.mode is Mode.BOOT:
            self._enter(Mode.STANDBY, Cause.BOOTED)

    def fail(self, why: str) -> None:
        """Enter the error mode."""
        self._enter(Mode.ERROR, Cause.FAULT, why)

    def solved(self, *, valid: bool, tracked: bool, tracking_enabled: bool) -> None:
        """Change the mode according to the result of an exposure.

        An attitude was `tracked` if it was solved from a prediction, not lost in space.
        """
        if self.mode is Mode.LOST_IN_SPACE and valid and tracking_enabled:
            self._enter(Mode.TRACKING, Cause.ATTITUDE_FOUND)
        elif self.mode is Mode.TRACKING and not valid and tracked:
            self._enter(Mode.LOST_IN_SPACE, Cause.TRACKING_LOST)
        elif self.mode is Mode.TRACKING and not tracking_enabled:
            self._enter(Mode.LOST_IN_SPACE, Cause.TRACKING_DISABLED)

    def _enter(self, after: Mode, cause: Cause, error: str = "") -> None:
        changed = (self.mode, self.error) != (after, error)
        before, self.mode, self.error = self.mode, after, error
        if self._on_change is not None and changed:
            self._on_change(Transition(before, after, cause))
