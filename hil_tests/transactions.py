"""What an OBC client returns: acknowledges and readings, with their latency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from starhil.protocol.values import Value


@dataclass(frozen=True)
class Ack:
    """A telecommand was accepted."""

    name: str
    latency_s: float
    """From the request being handed to the port to the last byte of the reply."""


@dataclass(frozen=True)
class Reading:
    """One telemetry row in physical values."""

    name: str
    values: Mapping[str, Value]
    latency_s: float
    """As that of an acknowledge; 0 for unsolicited telemetry."""
    received_unix_s: float
    """OBC's clock when it came, seconds since 1970-01-01 UTC."""
    received_s: float
    """The same on `time.monotonic`, which nobody sets: for intervals."""

    def __getitem__(self, field: str) -> Value:
        """Return the value of a field."""
        return self.values[field]


@dataclass(frozen=True)
class Transaction:
    """What became of one request: for latency figures and reports."""

    name: str
    outcome: str
    """`ok`, the name of an error code, or `no_reply`."""
    latency_s: float
    """Infinite where no reply came."""
