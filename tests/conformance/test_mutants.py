"""Every mutant of the device is caught, and by the case that is meant to catch it."""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.runner import run_case
from tests.conformance import mutants_can, mutants_parts, mutants_requests, mutants_serial
from tests.conformance.mutant_seams import MUTANTS, Mutant
from tests.conformance.simulated import SimulatedUnit
from tests.conformance.test_healthy import SUITES

pytestmark = pytest.mark.long

_TABLES = (mutants_serial, mutants_can, mutants_requests, mutants_parts)
"""They enter their mutants in MUTANTS."""
CASES = {case.id: case for suite in SUITES.values() for case in suite}


def test_there_are_enough_of_them():
    assert len({mutant.name for mutant in MUTANTS}) >= 40


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.link}: {mutant.name}")
def test_a_mutant_is_caught_by_its_case(mutant: Mutant):
    with SimulatedUnit(mutant.link, mutant.damage) as unit:
        outcome = run_case(unit.probe, CASES[mutant.caught_by])
    assert outcome.status == "failed", f"{mutant.caught_by} passed on a device where {mutant.name}"
    assert outcome.expected
    assert outcome.seen
