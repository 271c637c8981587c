"""The units that ship pass the cases that their definitions yield."""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.runner import run_cases
from starhil.hil_tests.conformance.suites import serial_suite
from starhil.protocol.icd import load_unit
from tests.conformance.simulated import SimulatedUnit

UNITS = ("sagitta", "nos3", "st16", "cubestar-gen2")


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_that_ships_passes_every_case_of_its_definition(unit: str) -> None:
    cases = serial_suite(load_unit(unit))
    with SimulatedUnit("serial", unit=unit) as simulated:
        outcomes = run_cases(simulated.probe, cases)
    assert [(o.id, o.expected, o.seen, o.log[-4:]) for o in outcomes if o.status == "failed"] == []
    assert [o.id for o in outcomes if o.status == "skipped"] == []
    assert len(outcomes) >= 15
