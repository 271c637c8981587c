"""The conformance cases: our slave passes all of them, and every mutant of it fails the case that is named with it."""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.runner import run_case
from tests.planted import Edit, LostAimError, planted
from tests.protocol.canopen.conftest import shared_dictionary
from tests.protocol.canopen.mutants import MUTANTS

pytestmark = pytest.mark.long


def case_of(mutant):
    return next(case for case in CANOPEN_CASES if case.id == f"canopen.{mutant.case}")


@pytest.mark.parametrize("case", CANOPEN_CASES, ids=lambda case: case.id)
def test_our_slave_passes_and_safe_cases_change_nothing(simulated_probe, case):
    """A case that is not intrusive sends nothing but SDO requests that read, and frames that are no request."""
    probe = simulated_probe(shared_dictionary("cubestar"))
    outcome = run_case(probe, case)
    assert (outcome.status, outcome.expected, outcome.seen) == ("passed", "", ""), "\n".join(outcome.log)
    for frame in () if case.intrusive else [line.split(" -> ")[1] for line in probe.log if " -> " in line]:
        identifier, _, data = frame.partition("#")
        assert identifier in {"62C", "62D", "0000062C"}, frame
        first = int(data[:2], 16) if len(data) == 16 else 0x80
        assert first >> 5 in {2, 3, 4, 5, 7} or data[2:] == "0" * 14, frame


def test_a_value_of_a_wrong_size_fails_its_case_and_does_not_end_the_run(simulated_probe):
    probe = simulated_probe()
    probe.try_read = lambda *_entry: b"\x01\x02\x03"
    defaults = next(case for case in CANOPEN_CASES if case.id == "canopen.od.defaults")
    assert run_case(probe, defaults).status == "failed"


def test_consecutive_cases_are_independent(simulated_probe):
    probe = simulated_probe()
    failed = [
        case.id
        for case in (*CANOPEN_CASES, *reversed(CANOPEN_CASES))
        if run_case(probe, case).status != "passed"
    ]
    assert failed == []


def test_identifiers_are_unique_and_name_their_area():
    identifiers = [case.id for case in CANOPEN_CASES]
    assert len(set(identifiers)) == len(identifiers) >= 140
    assert all(case.id.startswith(f"{case.area}.") and case.clause and case.title for case in CANOPEN_CASES)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_mutant_is_caught_by_its_case(simulated_probe, mutant):
    with mutant.planted():
        assert run_case(simulated_probe(), case_of(mutant)).status == "failed"


def test_a_slave_that_was_a_mutant_is_healthy_again(simulated_probe):
    probe = simulated_probe()
    with MUTANTS[0].planted():
        assert run_case(probe, case_of(MUTANTS[0])).status == "failed"
    for each in (probe, simulated_probe()):
        assert run_case(each, case_of(MUTANTS[0])).status == "passed"


def test_there_are_enough_mutants():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 40


def test_mutant_that_no_longer_applies_is_an_error():
    with (
        pytest.raises(LostAimError, match="0 times"),
        planted(Edit("canopen.sdo", "no such text", "")),
    ):
        pass
