"""The conformance cases: our slave passes all of them, and every mutant of it fails some."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.runner import run_case

pytestmark = pytest.mark.long


def mutant_names() -> list[str]:
    """Names of the mutants, without importing them: what pytest shows as the cases of the test."""
    tree = ast.parse(Path(__file__).with_name("mutants.py").read_text(encoding="utf-8"))
    return [
        call.args[0].value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Mutant"
    ]


@pytest.mark.parametrize("case", CANOPEN_CASES, ids=lambda case: case.id)
def test_our_slave_passes(simulated_probe, case):
    outcome = run_case(simulated_probe(), case)
    assert (outcome.status, outcome.expected, outcome.seen) == ("passed", "", ""), "\n".join(outcome.log)


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


def test_safe_cases_change_nothing(simulated_probe):
    """A case that is not intrusive sends nothing but SDO requests that read, and frames that are no request."""
    for case in CANOPEN_CASES:
        if case.intrusive:
            continue
        probe = simulated_probe()
        run_case(probe, case)
        sent = [line.split(" -> ")[1] for line in probe.log if " -> " in line]
        for frame in sent:
            identifier, _, data = frame.partition("#")
            assert identifier in {"62C", "62D", "0000062C"}, f"{case.id}: {frame}"
            first = int(data[:2], 16) if len(data) == 16 else 0x80
            assert first >> 5 in {2, 3, 4, 5, 7} or data[2:] == "0" * 14, f"{case.id}: {frame}"


@pytest.mark.parametrize("name", mutant_names())
def test_mutant_is_caught(simulated_probe, mutants, name):
    mutant = next(mutant for mutant in mutants.MUTANTS if mutant.name == name)
    probe = simulated_probe(mutants.load(mutant))
    likely_first = sorted(CANOPEN_CASES, key=lambda case: case.area != f"canopen.{mutant.area}")
    for case in likely_first:
        probe.port.budget = probe.port.MAX_FRAMES
        if run_case(probe, case).status == "failed":
            return
    pytest.fail("no case fails")


def test_unchanged_copy_is_not_caught(simulated_probe, mutants):
    probe = simulated_probe(mutants.load(None))
    assert [case.id for case in CANOPEN_CASES if run_case(probe, case).status != "passed"] == []


def test_there_are_enough_mutants(mutants):
    names = [mutant.name for mutant in mutants.MUTANTS]
    assert len(set(names)) == len(names) >= 40


def test_mutant_that_no_longer_applies_is_an_error(mutants):
    with pytest.raises(ValueError, match="0 times"):
        mutants.load(mutants.Mutant("x", "sdo", "sdo", "no such text", ""))
