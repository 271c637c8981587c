"""State that the services of a node share: time, NMT state, frames to send and events to report."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.dictionary import Dictionary

UNCONFIGURED_NODE: int = 0xFF
"""Node ID of a node without one, which LSS must assign."""


class NmtState(IntEnum):
    """NMT states with the numbers that error control reports."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class EventKind(StrEnum):
    """Kinds of events that a node reports to its application."""

    STATE = "state"
    RESET_NODE = "reset_node"
    RESET_COMMUNICATION = "reset_communication"
    EMERGENCY = "emergency"
    NODE_LOST = "node_lost"
    NODE_FOUND = "node_found"
    NODE_BOOTED = "node_booted"
    GUARDING_LOST = "guarding_lost"
    GUARDING_FOUND = "guarding_found"
    TIME = "time"
    BIT_RATE = "bit_rate"
    NODE_ID = "node_id"
    STORED = "stored"
    RESTORED = "restored"
    STORAGE_ERROR = "storage_error"
    REFUSED = "refused"
    FAULT = "fault"


@dataclass(frozen=True)
class SlaveEvent:
    """An event of a node."""

    kind: EventKind
    now: float
    """Time of the event, s, on the caller's clock."""
    value: float = 0
    """NMT state, node ID, error code, bit/s, or Unix time in s."""
    detail: str = ""


class Context:
    """Shared by the services of one node, which sets `now` before it calls a service."""

    def __init__(self, dictionary: Dictionary, node_id: int) -> None:
        self.dictionary = dictionary
        self.node_id = node_id
        self.now = 0.0
        self.state = NmtState.INITIALISING
        self.frames: list[CanFrame] = []
        self.events: list[SlaveEvent] = []

    def send(self, cob_id: int, data: bytes) -> None:
        """Send a data frame with an 11-bit CAN ID."""
        self.frames.append(CanFrame(cob_id, data, extended=False))

    def report(self, kind: EventKind, value: float = 0, detail: str = "") -> None:
        self.events.append(SlaveEvent(kind, self.now, value, detail))

    @property
    def communicates(self) -> bool:
        """Whether SDO, SYNC, TIME and EMCY work: PRE-OPERATIONAL or OPERATIONAL."""
        return self.state in {NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL}
