"""Counters, error flags and the acknowledge of the last telecommand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault

_FLAG_OF_FAULT: Final[dict[FaultKind, str]] = {
    FaultKind.UART_PROTOCOL: "uart_protocol_error",
    FaultKind.UART_OVERLONG: "uart_protocol_error",
    FaultKind.UART_INCOMPLETE: "uart_incomplete",
    FaultKind.UART_CHECK: "uart_check_error",
    FaultKind.UART_ADDRESS: "uart_address_error",
    FaultKind.CAN_SEQUENCE: "can_telecommand_error",
    FaultKind.CAN_INCOMPLETE: "can_telecommand_error",
    FaultKind.CAN_LENGTH: "can_telecommand_error",
    FaultKind.CAN_TYPE: "can_telecommand_error",
    FaultKind.CAN_OVERLONG: "can_telecommand_error",
}


@dataclass
class Counters:
    """Counters and flags of the links since they were last cleared."""

    telecommands: int = 0
    telemetry: int = 0
    flags: set[str] = field(default_factory=set)
    """Names of the flags in communication_status that are set."""
    faults: dict[FaultKind, int] = field(default_factory=dict)
    """Number of faults of each kind, for the log and the control channel."""

    def count_fault(self, fault: LinkFault) -> None:
        """Count input that was not a valid message."""
        self.faults[fault.kind] = self.faults.get(fault.kind, 0) + 1
        self.flags.add(_FLAG_OF_FAULT[fault.kind])

    def overrun(self) -> None:
        """Set the flag for a telecommand that arrived before the previous one was done."""
        self.flags.add("telecommand_overrun")

    def clear(self) -> None:
        """Set everything to zero."""
        self.telecommands = self.telemetry = 0
        self.flags.clear()
        self.faults.clear()


@dataclass
class Acknowledge:
    """Outcome of the last telecommand."""

    last_telecommand: int = 0
    processed: bool = True
    error: ErrorCode = ErrorCode.OK
    parameter_index: int = 0

    def end(self, error: ErrorCode = ErrorCode.OK, parameter_index: int = 0) -> None:
        """Record the outcome."""
        self.processed = True
        self.error = error
        self.parameter_index = parameter_index
