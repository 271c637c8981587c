"""CANopen conformance: all areas, and how one case is run between resets of the communication."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final, Literal

from hil_tests.conformance import (
    canopen_design,
    canopen_eds,
    canopen_emcy,
    canopen_nmt,
    canopen_od,
    canopen_rpdo,
    canopen_sdo,
    canopen_sdo_block,
    canopen_store_lss,
    canopen_sync_time,
    canopen_tpdo,
)
from hil_tests.conformance.canopen_probe import CanopenProbe
from hil_tests.conformance.case import Case, CaseFailed, CaseSkipped

CANOPEN_CASES: Final[tuple[Case[CanopenProbe], ...]] = (
    *canopen_eds.CASES,
    *canopen_nmt.CASES,
    *canopen_sdo.CASES,
    *canopen_sdo_block.CASES,
    *canopen_od.CASES,
    *canopen_sync_time.CASES,
    *canopen_emcy.CASES,
    *canopen_tpdo.CASES,
    *canopen_rpdo.CASES,
    *canopen_store_lss.CASES,
    *canopen_design.CASES,
)

Status = Literal["passed", "failed", "skipped"]


@dataclass(frozen=True)
class CanopenOutcome:
    """What came of one case: expected and seen if it failed, the reason if it was skipped, frames sent and seen."""

    case: Case[CanopenProbe]
    status: Status
    expected: str = ""
    seen: str = ""
    seconds: float = 0.0
    log: tuple[str, ...] = field(default=())


def run_canopen_case(probe: CanopenProbe, case: Case[CanopenProbe]) -> CanopenOutcome:
    """Run one case; an intrusive one begins and ends with the communication reset."""
    probe.log.clear()
    begin = time.perf_counter()
    status: Status = "passed"
    expected = seen = ""
    try:
        if case.intrusive:
            probe.begin_anew()
        else:
            probe.abandon_transfer()
        case.run(probe)
    except CaseFailed as failure:
        status, expected, seen = "failed", failure.expected, failure.seen
    except CaseSkipped as reason:
        status, seen = "skipped", str(reason)
    log = tuple(probe.log)
    if case.intrusive:
        try:
            probe.begin_anew()
        except CaseFailed as failure:
            status, expected, seen = "failed", failure.expected, failure.seen
    return CanopenOutcome(case, status, expected, seen, time.perf_counter() - begin, log)
