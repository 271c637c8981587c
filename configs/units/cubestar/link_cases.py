"""CubeStar's own cases of its links: latency and unsolicited telemetry; raw traffic is in `link_cases.toml`."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal
from starhil.hil_tests.conformance.link_probe import (
    INVALID_PARAMETER,
    LinkProbe,
    checked_values,
)
from starhil.hil_tests.judge.messages import Answer

HOST_TIMEOUT_S: Final = 0.3
"""Shortest time-out in published flight software (AlbertaSat, first version)."""

TIMING: Final = CaseArea[LinkProbe]("timing", "host time-out of AlbertaSat, first version")
UNSOLICITED: Final = CaseArea[LinkProbe](
    "unsolicited",
    "types 10 to 12, start bytes 1F 4F (libCubeObc); serial dialects a and b have none: R20, docs/rules.md",
    intrusive=True,
)
CAN_UNSOLICITED: Final = CaseArea[CanProbe](
    "unsolicited",
    "types 10 to 12 (libCubeObc); their use: R20, docs/rules.md",
    intrusive=True,
    links=("can",),
)

COMBINED: Final = 211
COMBINED_SIZE: Final = 54


# --- time ---


@TIMING.case("reply", "fifty requests are each answered within 300 ms")
def reply_time(probe: LinkProbe) -> None:
    worst = 0.0
    for _ in range(50):
        begin = probe.now()
        probe.expect_alive()
        worst = max(worst, probe.now() - begin)
    check(worst <= HOST_TIMEOUT_S, f"at most {HOST_TIMEOUT_S:g} s", f"{worst:.3f} s")


# --- unsolicited telemetry ---


def _unsolicited_rows(probe: LinkProbe, name: str, rate: float, seconds: float) -> list[Answer]:
    """Return the unsolicited telemetry of a row that arrives within a time."""
    row = probe.unit.telemetry[name]
    probe.command("set_unsolicited", telemetry=row.id, rate=rate)
    try:
        return probe.receive_unsolicited(seconds)
    finally:
        probe.command("set_unsolicited", telemetry=row.id, rate=0.0)


@UNSOLICITED.case("rate", "unsolicited telemetry is sent at its rate, and stops")
def unsolicited(probe: LinkProbe) -> None:
    row = probe.unit.telemetry["identification"]
    messages = _unsolicited_rows(probe, "identification", 10.0, 2.0)
    if not probe.has_unsolicited:
        check(not messages, "no unsolicited telemetry on this link", f"{len(messages)} messages")
        return
    check(18 <= len(messages) <= 22, "18 to 22 messages in 2 s", len(messages))
    check_equal({(item.row_id, len(item.data)) for item in messages}, {(row.id, row.size)}, "row and length")
    after = probe.receive_unsolicited(0.5)
    check(len(after) <= 1, "no more", f"{len(after)} messages")


@UNSOLICITED.case("long", "a long row is sent complete as unsolicited telemetry")
def unsolicited_long(probe: LinkProbe) -> None:
    row = probe.unit.telemetry["star_tracker"]
    messages = _unsolicited_rows(probe, "star_tracker", 5.0, 1.0)
    if not probe.has_unsolicited:
        check(not messages, "no unsolicited telemetry on this link", f"{len(messages)} messages")
        return
    check(len(messages) >= 3, "3 messages or more in 1 s", len(messages))
    check_equal({(item.row_id, len(item.data)) for item in messages}, {(row.id, row.size)}, "row and length")
    for item in messages:
        checked_values(row, item.data)


@UNSOLICITED.case("refused", "unsolicited telemetry of an unknown row is refused", "published error codes")
def unsolicited_refused(probe: LinkProbe) -> None:
    probe.expect_refused("set_unsolicited", INVALID_PARAMETER, telemetry=200, rate=1.0)


@CAN_UNSOLICITED.case(
    "segments", "an unsolicited long row is sent as first, body and last, with counters down to 0"
)
def unsolicited_segments(probe: CanProbe) -> None:
    """star_tracker has 54 bytes, so 8 frames."""
    probe.command("set_unsolicited", telemetry=COMBINED, rate=5.0)
    try:
        probe.receive_unsolicited(1.0)
        frames = probe.unsolicited[:8]
    finally:
        probe.command("set_unsolicited", telemetry=COMBINED, rate=0.0)
    check_equal([frame.id >> 24 for frame in frames], [10, *[11] * 6, 12], "types")
    check_equal(
        [frame.data[-1] if frame.data else -1 for frame in frames], list(range(7, -1, -1)), "counters"
    )
    check_equal(sum(len(frame.data) - 1 for frame in frames), COMBINED_SIZE, "bytes")
