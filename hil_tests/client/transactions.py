"""Transactions of an OBC client: acknowledgements and readings, with latency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from starhil.hil_tests.errors import HIDDEN_BEHIND_ONE_LINE
from starhil.protocol.icd.values import Value

__tracebackhide__ = HIDDEN_BEHIND_ONE_LINE


@dataclass(frozen=True)
class Ack:
    """A telecommand was accepted; acknowledgements of the same telecommand are equal."""

    name: str
    latency_s: float = field(compare=False)
    """Time from passing the request to the port until the last byte of the reply, s."""
    answered: bool = field(default=True, compare=False)
    """Whether the unit acknowledges this telecommand on this link; otherwise it was only sent."""


@dataclass(frozen=True)
class Reading:
    """One telemetry row in physical values; readings with the same values are equal, whenever they came."""

    name: str
    values: Mapping[str, Value]
    latency_s: float = field(compare=False)
    """Latency of the reply, s; 0 for unsolicited telemetry."""
    received_unix_s: float = field(compare=False)
    """Time of reception on the OBC's clock, seconds since 1970-01-01 UTC."""
    received_s: float = field(compare=False)
    """Time of reception on `time.monotonic`, s; for intervals."""

    def __getitem__(self, name: str) -> Value:
        """Return the value of a field; UnknownNameError suggests similar names."""
        return self.values[name]


@dataclass(frozen=True)
class Transaction:
    """Outcome of one request."""

    name: str
    outcome: str
    """`ok`, the name of an error code, or `no_reply`."""
    latency_s: float
    """Seconds; infinite without a reply."""
