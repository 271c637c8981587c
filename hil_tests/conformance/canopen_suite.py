"""CANopen conformance: the cases of all areas."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from starhil.hil_tests.conformance import canopen_eds, canopen_od
from starhil.hil_tests.conformance.canopen_dialogue import dialogue_cases
from starhil.hil_tests.conformance.canopen_probe import NO_RTR, PDO_OFF, START, CanopenProbe
from starhil.hil_tests.conformance.canopen_unit import canopen_unit_cases
from starhil.hil_tests.conformance.case import Case, CaseArea, cases_of, check, check_equal, on_link
from starhil.hil_tests.conformance.suites import suite
from starhil.hil_tests.judge.canopen import SYNC
from starhil.hil_tests.judge.definition import Unit

DESIGN: Final = CaseArea[CanopenProbe]("design", "interface definition: canopen.toml", intrusive=True)
"""Behaviour of this product beyond CiA 301."""


@DESIGN.case("attitude", "TPDOs with the same sequence number are of one sample")
def attitude(probe: CanopenProbe) -> None:
    marker = probe.find("object named sequence", lambda item: item.name == "sequence" and item.pdo_mappable)
    can_ids: list[int] = []
    probe.quiet()
    for index in probe.pdo_indices(0x1800):
        mapped = probe.number(index + 0x200, 0) and probe.number(index + 0x200, 1) >> 8
        if mapped == marker.index << 8 | marker.subindex:
            probe.set(index, 2, 1, 1)
            can_id = 0x3E0 + len(can_ids)
            probe.set(index, 1, PDO_OFF | NO_RTR | can_id)
            probe.set(index, 1, NO_RTR | can_id)
            can_ids.append(can_id)
    check(len(can_ids) >= 2, "two TPDOs that begin with the sequence number", len(can_ids))
    probe.nmt(START)
    for _ in range(5):
        probe.drain()
        probe.send(SYNC)
        heads = {probe.expect(can_id, "TPDO")[:2] for can_id in can_ids}
        check_equal(len(heads), 1, "sequence numbers and flags after one SYNC:")


def _dialogues(name: str) -> list[Case[CanopenProbe]]:
    return dialogue_cases(Path(__file__).with_name(f"canopen_{name}_cases.toml"))


_GENERAL: Final = (
    *cases_of(canopen_eds), *_dialogues("nmt"), *_dialogues("sdo"), *cases_of(canopen_od), *_dialogues("emcy"),
    *_dialogues("pdo"), *DESIGN.cases, *_dialogues("store"), *_dialogues("lss"),
)  # fmt: skip
CANOPEN_CASES: Final = on_link("canopen", _GENERAL)
"""Cases of CiA 301, for any unit."""


def canopen_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on CANopen; raises BenchError if it has no node."""
    return suite(unit, "CANopen", unit.canopen, _cases, dialogue_cases)


def _cases(unit: Unit) -> list[Case[Any]]:
    return [*_GENERAL, *canopen_unit_cases(unit)]
