"""Tables of raw traffic on any link with the expected answers, or with the flags set in `communication_status`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

from starhil.hil_tests.conformance.can_probe import CanWire
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal
from starhil.hil_tests.conformance.link_probe import LinkProbe
from starhil.protocol.values import Value

ProbeType = TypeVar("ProbeType", bound=LinkProbe)
WireType = TypeVar("WireType", bound=LinkProbe | CanWire)

FLAG_NAMES: Final = (
    "telecommand_overrun",
    "uart_protocol_error",
    "uart_incomplete",
    "i2c_telemetry_error",
    "i2c_telecommand_error",
    "can_telecommand_error",
)


@dataclass(frozen=True)
class Exchange:
    """Raw traffic and the answers to it.

    Attributes
    ----------
    id, title, clause
        As in a case; clause None: the clause of the area.
    sent
        Raw traffic, in the format of `LinkProbe.send_text`.
    answers
        All expected answers, in the format of `LinkProbe.expect_exactly`.
    pause_s
        Pause after each item, s.
    """

    id: str
    title: str
    sent: tuple[str, ...]
    answers: tuple[str, ...] = ()
    clause: str | None = None
    pause_s: float = 0.0


def add_exchange_cases(
    area: CaseArea[WireType], rows: Iterable[Exchange], *, intrusive: bool = False
) -> None:
    """Add one case per row."""
    for row in rows:
        area.case(row.id, row.title, row.clause, intrusive=intrusive)(partial(_exchange, row))


def _exchange(row: Exchange, probe: LinkProbe | CanWire) -> None:
    probe.expecting(*row.answers)
    for text in row.sent:
        probe.send_text(text)
        probe.sleep(row.pause_s)
    for answer in row.answers:
        probe.expect_exactly(answer)
    probe.expect_silence("no more was requested")
    # an incomplete message ends at the start of the next one
    probe.expect_alive()


@dataclass(frozen=True)
class FlagRow:
    """Malformed traffic and the flags that it sets.

    Attributes
    ----------
    id, title
        Name of the case, and the defect of the traffic.
    sent
        Raw traffic, in the format of `LinkProbe.send_text`.
    flags
        Exactly these flags must be set.
    pause_s
        Silence expected before the flags are read, s; None to read them at once.
    """

    id: str
    title: str
    sent: tuple[str, ...]
    flags: frozenset[str]
    pause_s: float | None = 0.0


def check_flags(probe: LinkProbe, expected: frozenset[str]) -> dict[str, Value]:
    """Read `communication_status` and return it; fail the case unless exactly these flags are set."""
    status = probe.telemetry("communication_status")
    seen = {flag for flag in FLAG_NAMES if status[flag]}
    check(seen == expected, f"flags {_names(expected)}", _names(seen))
    return status


def add_flag_cases(area: CaseArea[ProbeType], rows: Iterable[FlagRow]) -> None:
    """Add one case per row."""
    for row in rows:
        area.case(row.id, f"{row.title} sets its flag and is not counted")(partial(_flags, row))


def _flags(row: FlagRow, probe: LinkProbe) -> None:
    probe.command("clear_counters")
    for text in row.sent:
        probe.send_text(text)
    if row.pause_s is not None:
        probe.expect_silence("no request was made", max(row.pause_s, probe.times.quiet_s))
    status = check_flags(probe, row.flags)
    counts = (status["telecommand_count"], status["telemetry_count"])
    check_equal(counts, (0, 1), "counts of telecommands and telemetry")
    probe.command("clear_counters")
    check_flags(probe, frozenset())


def _names(flags: Iterable[str]) -> str:
    return ", ".join(sorted(flags)) or "none"
