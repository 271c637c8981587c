"""A node whose EDS lacks what is optional: what needs a missing object is skipped, and only a contradiction fails."""

from __future__ import annotations

from copy import deepcopy

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.runner import run_case
from tests.protocol.canopen.conftest import simulated_probe

pytestmark = pytest.mark.long

OPTIONAL = (0x1003, 0x1006, 0x1010, 0x1011, 0x1012, 0x1015, 0x1016, 0x1019, 0x1021)
PDOS = range(0x1400, 0x1C00)
OWN = range(0x2000, 0x10000)

SMALLER = {
    # removed from the EDS, cases that fail because the node or the rest of the EDS has it, skipped at least, a reason
    "optional objects": (OPTIONAL, {"canopen.od.no-object"}, 20, "the EDS has no object 1016h"),
    "PDOs": (PDOS, {"canopen.eds.pdo-count", "canopen.design.attitude"}, 24, "no PDO from 1800h on"),
    "own objects": (OWN, {"canopen.eds.mapping"}, 15, "the EDS has no object for an RPDO that accepts its limits"),
}  # fmt: skip


@pytest.mark.parametrize("name", SMALLER)
def test_what_needs_an_object_that_the_eds_lacks_is_skipped(name: str) -> None:
    removed, contradicted, skipped, reason = SMALLER[name]
    probe = simulated_probe()
    probe.od = deepcopy(probe.od)  # the file is read once for all tests
    for index in removed:
        if index in probe.od:
            del probe.od[index]
    outcomes = {case.id: run_case(probe, case) for case in CANOPEN_CASES}
    assert {key for key, outcome in outcomes.items() if outcome.status == "failed"} == contradicted
    reasons = [outcome.seen for outcome in outcomes.values() if outcome.status == "skipped"]
    assert len(reasons) >= skipped
    assert reason in reasons


@pytest.mark.parametrize(
    ("case_id", "reason"),
    [("canopen.eds.stored", "no EDS file"), ("canopen.lss.fastscan", "the EDS has no LSS")],
)
def test_what_needs_the_file_or_lss_is_skipped_without(case_id: str, reason: str) -> None:
    probe = simulated_probe()
    probe.od = deepcopy(probe.od)  # the file is read once for all tests
    probe.eds = ""
    probe.od.device_information.LSS_supported = False
    (case,) = [case for case in CANOPEN_CASES if case.id == case_id]
    outcome = run_case(probe, case)
    assert (outcome.status, outcome.seen) == ("skipped", reason)
