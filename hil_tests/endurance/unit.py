"""What a run needs of a unit: power, surroundings, simulated time, and the unit's end of its links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from starhil.protocol.can.frame import CanFrame


class LiveUnit(Protocol):
    """A unit with its power and surroundings, in simulated time."""

    links: tuple[str, ...]

    @property
    def now_s(self) -> float:
        """Simulation time since power was switched on, seconds."""

    @property
    def frames(self) -> int:
        """Number of images solved in all."""

    @property
    def exposed_s(self) -> float:
        """Simulation time in which images were taken, in all, seconds: the sum of their periods."""

    async def power_on(self) -> None:
        """Switch the unit on."""

    async def power_off(self, *, factory: bool = False) -> None:
        """Switch the unit off; `factory` deletes its stored state."""

    async def step(self, seconds: float, *, most: int | None = None) -> None:
        """Let time pass, or less, after about `most` events."""

    def deliver(self, link: str, item: bytes | CanFrame) -> None:
        """Pass bytes or a frame to the unit."""

    def take(self, link: str) -> list[tuple[float, Any]]:
        """Return what the unit has sent, and when, seconds."""

    def is_late(self, link: str) -> bool:
        """Return whether output on a link that faults have delayed has still to come."""

    async def set_truth(self, truth: Mapping[str, Any]) -> None:
        """Replace the truth."""

    def fault(self, fault: Mapping[str, Any]) -> None:
        """Inject faults."""

    def clear_faults(self) -> None:
        """End all faults."""

    async def end_pipeline(self) -> bool:
        """End the image pipeline unexpectedly; return whether the unit has restarted it."""

    def set_disk(self, *, full: bool) -> None:
        """Set whether files can be written."""

    def set_peer(self, link: str, *, reads: bool) -> None:
        """Set whether the peer of a link reads."""

    def defect(self) -> str:
        """Return what is wrong inside and does not show on the bus, such as an error or a leak; empty if nothing is."""
