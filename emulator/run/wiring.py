"""How a run is connected to the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from starhil.emulator.device.device import Background
from starhil.emulator.run.tape import TimedEntry
from starhil.emulator.sensor.pipeline.client import PipelineClient
from starhil.emulator.simulation.clock import Clock
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport


class Wiring:
    """Connects a run to the world: directly. A recorder or a player takes the place of these connections."""

    plays = False
    """Whether a recording is played, so that no sockets are opened."""
    records = False
    """Whether a tape of the run is written."""
    repeatable = False
    """Whether results must not depend on the speed of the machine."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def serial(self, name: str, make: Callable[[], SerialTransport]) -> SerialTransport:  # noqa: ARG002 (the name is for others)
        """Return the transport of a link that carries bytes."""
        return make()

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:  # noqa: ARG002 (the name is for others)
        return make()

    def imager(self, inner: PipelineClient) -> PipelineClient:
        return inner

    def background(self, inner: Background) -> Background:
        """Return the function that runs slow writes."""
        return inner

    # --- the tape, which only a recorder writes ---

    def begin(self) -> None:
        """Process what arrived while the links were being opened."""

    def latch(self) -> None:
        """Let the clock show the present time."""

    def enter(self, entry: type[TimedEntry], **values: Any) -> None:
        """Record an input that has arrived now."""

    def write(self, entry: type[TimedEntry], **values: Any) -> None:
        """Record what happens at the time of the clock."""
