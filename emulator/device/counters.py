"""Counters, error flags and the acknowledge of the last telecommand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault

_FLAG_OF_FAULT: Final[dict[FaultKind, str]] = {
    FaultKind.UART_PROTOCOL: "uart_protocol_error",
    FaultKind.UART_OVERLONG: "uart_protocol_error",
    FaultKind.UART_INCOMPLETE: "uart_incomplete",
    FaultKind.UART_SHORT: "uart_protocol_error",
    FaultKind.UART_CHECK: "uart_check_error",
    FaultKind.UART_ADDRESS: "uart_address_error",
    FaultKind.CAN_SEQUENCE: "can_telecommand_error",
    FaultKind.CAN_INCOMPLETE: "can_telecommand_error",
    FaultKind.CAN_LENGTH: "can_telecommand_error",
    FaultKind.CAN_TYPE: "can_telecommand_error",
    FaultKind.CAN_OVERLONG: "can_telecommand_error",
}


@dataclass(frozen=True)
class Counters:
    """Counters and flags of the links since they were last cleared; whatever is counted makes new ones."""

    telecommands: int = 0
    """Telecommands received."""
    telemetry: int = 0
    """Telemetry requests received."""
    flags: frozenset[str] = frozenset()
    """Names of the flags in communication_status that are set."""
    faults: Mapping[FaultKind, int] = field(default_factory=lambda: MappingProxyType({}))
    """Number of faults of each kind, for the log and the control channel."""

    def with_telecommand(self) -> Counters:
        return Counters((self.telecommands + 1) & 0xFFFF, self.telemetry, self.flags, self.faults)

    def with_telemetry(self) -> Counters:
        return Counters(self.telecommands, (self.telemetry + 1) & 0xFFFF, self.flags, self.faults)

    def with_fault(self, fault: LinkFault) -> Counters:
        """Count input that was not a valid message."""
        faults = {**self.faults, fault.kind: self.faults.get(fault.kind, 0) + 1}
        flags = self.flags | {_FLAG_OF_FAULT[fault.kind]}
        return replace(self, flags=flags, faults=MappingProxyType(faults))

    def with_overrun(self) -> Counters:
        """Set the flag for a telecommand that arrived before the previous one was done."""
        return replace(self, flags=self.flags | {"telecommand_overrun"})


@dataclass(frozen=True)
class Acknowledge:
    """Outcome of the last telecommand."""

    last_telecommand: int = 0
    """ID of the telecommand; 0 before the first."""
    processed: bool = True
    """Whether it has been processed."""
    error: ErrorCode = ErrorCode.OK
    """Its result."""
    parameter_index: int = 0
    """Index of the field because of which it was refused with `invalid_parameter`."""
