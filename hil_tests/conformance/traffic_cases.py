"""Conformance on any link: latency, unsolicited telemetry, recovery from noise and floods."""

from __future__ import annotations

import random
from typing import Final

from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import INVALID_PARAMETER, Answer, LinkProbe, checked_values
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.protocol.can_framing import CanFrame

HOST_TIMEOUT_S: Final = 0.3
"""Shortest time-out in published flight software (AlbertaSat, first version)."""

TIMING: Final = CaseArea[LinkProbe]("timing", "host time-out of AlbertaSat, first version")
UNSOLICITED: Final = CaseArea[LinkProbe](
    "unsolicited",
    "types 10 to 12, start bytes 1F 4F (libCubeObc); serial dialects a and b have none: R20, docs/rules.md",
    intrusive=True,
)
RECOVERY: Final = CaseArea[LinkProbe]("recovery", rule(9))


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
    row = probe.icd.telemetry[name]
    probe.command("set_unsolicited", telemetry=row.id, rate=rate)
    try:
        return probe.receive_unsolicited(seconds)
    finally:
        probe.command("set_unsolicited", telemetry=row.id, rate=0.0)


@UNSOLICITED.case("rate", "unsolicited telemetry is sent at its rate, and stops")
def unsolicited(probe: LinkProbe) -> None:
    row = probe.icd.telemetry["identification"]
    seen = _unsolicited_rows(probe, "identification", 10.0, 2.0)
    if isinstance(probe, SerialProbe) and probe.dialect != "c":
        check(not seen, f"no unsolicited telemetry in dialect {probe.dialect}", f"{len(seen)} messages")
        return
    check(18 <= len(seen) <= 22, "18 to 22 messages in 2 s", len(seen))
    check_equal({(item.row_id, len(item.data)) for item in seen}, {(row.id, row.size)}, "row and length")
    after = probe.receive_unsolicited(0.5)
    check(len(after) <= 1, "no more", f"{len(after)} messages")


@UNSOLICITED.case("long", "a long row is sent complete as unsolicited telemetry")
def unsolicited_long(probe: LinkProbe) -> None:
    row = probe.icd.telemetry["star_tracker"]
    seen = _unsolicited_rows(probe, "star_tracker", 5.0, 1.0)
    if isinstance(probe, SerialProbe) and probe.dialect != "c":
        check(not seen, f"no unsolicited telemetry in dialect {probe.dialect}", f"{len(seen)} messages")
        return
    check(len(seen) >= 3, "3 messages or more in 1 s", len(seen))
    check_equal({(item.row_id, len(item.data)) for item in seen}, {(row.id, row.size)}, "row and length")
    for item in seen:
        checked_values(row, item.data)


@UNSOLICITED.case("refused", "unsolicited telemetry of an unknown row is refused", "published error codes")
def unsolicited_refused(probe: LinkProbe) -> None:
    probe.expect_refused("set_unsolicited", INVALID_PARAMETER, telemetry=200, rate=1.0)


# --- recovery ---


@RECOVERY.case("noise", "after noise the next valid request is answered")
def noise(probe: LinkProbe) -> None:
    rng = random.Random(7)  # noqa: S311 -- noise, not a secret
    if isinstance(probe, SerialProbe):
        for _ in range(20):
            probe.send(rng.randbytes(200).replace(b"\x7f", b"\x00"))
            probe.sleep(0.01)
    elif isinstance(probe, CanProbe):
        for _ in range(400):
            kind = rng.choice((0, 2, 3, 5, 6, 9, 13, 20, 31))
            can_id = kind << 24 | rng.randrange(256) << 16 | probe.host << 8 | probe.device
            probe.send(CanFrame(can_id, rng.randbytes(rng.randrange(9))))
    probe.sleep(probe.times.quiet_s)
    probe.drain()
    probe.expect_alive()


@RECOVERY.case("flood", "a flood of requests is answered completely and in order", rule(10))
def flood(probe: LinkProbe) -> None:
    rows = [probe.icd.telemetry[name] for name in ("identification", "communication_status")]
    for _ in range(100):
        for row in rows:
            probe.post(row.id)
    for _ in range(100):
        for row in rows:
            probe.expect_telemetry(row.id, 2.0)
