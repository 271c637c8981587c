"""Bundled units pass the cases that their definitions yield."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from starhil.emulator.truth.source import FixedTruth
from starhil.hil_tests.attitude import conjugate
from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES, canopen_suite
from starhil.hil_tests.conformance.case import Case
from starhil.hil_tests.conformance.conformance_run import POINTING
from starhil.hil_tests.conformance.runner import run_case, run_cases
from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import read_unit
from starid.attitude import Attitude
from tests.conformance.mutant_seams import Damage
from tests.conformance.mutants_oresat import DAMAGES, DEFINITION_MUTANTS, DefinitionMutant
from tests.conformance.mutants_units import UnitMutant, gen2, mutants
from tests.conformance.simulated import SUITES, SimulatedUnit, healthy_outcomes
from tests.conformance.test_mutants import MUTANTS

pytestmark = pytest.mark.long

GEN2 = "cubestar-gen2"
UNITS = ("sagitta", "nos3", "st16", "st200", GEN2)


@cache
def cases_of(unit: str, link: str) -> dict[str, Case[Any]]:
    """Return the cases of a unit on a link by ID."""
    return {case.id: case for case in SUITES[link](read_unit(unit))}


ON_CAN = cases_of(GEN2, "can")
MUTANTS_ON_CAN = [
    *(
        (item.name, item.caught_by, item.damage)
        for item in MUTANTS
        if item.caught_by in ON_CAN and ".telemetry." not in item.caught_by
    ),
    *((item.name, item.caught_by, item.damage) for item in gen2("can")),
]
"""Those of the CAN link of a CubeStar whose case the definition yields, and those of the rows."""


@pytest.mark.parametrize(("unit", "link"), [*((unit, "serial") for unit in UNITS), (GEN2, "can")])
def test_a_bundled_unit_passes_every_case_of_its_definition(unit: str, link: str) -> None:
    outcomes = healthy_outcomes(link, unit)
    assert [(o.id, o.expected, o.seen, o.log[-4:]) for o in outcomes if o.status == "failed"] == []
    assert [o.id for o in outcomes if o.status == "skipped" and ".unjudged." not in o.id] == []
    assert len(outcomes) >= 15


@pytest.mark.parametrize(
    ("link", "unit"),
    [
        *(("serial", unit) for unit in ("sagitta", "nos3", "st200", "cubestar")),
        ("can", "cubestar"),
        ("canopen", "oresat"),
    ],
)
@pytest.mark.parametrize("names", ["true", "conjugated"])
def test_an_attitude_is_compared_with_the_truth_as_the_unit_reports_it(
    link: str, unit: str, names: str
) -> None:
    cases = [case for name, case in cases_of(unit, link).items() if name.startswith(f"{link}.attitude.")]

    def point(simulated: SimulatedUnit) -> None:
        simulated.device.surroundings.truth = FixedTruth(Attitude.from_quaternion(POINTING))

    with SimulatedUnit(link, point, unit=unit) as simulated:
        simulated.probe.truth = lambda: POINTING if names == "true" else conjugate(POINTING)
        outcomes = run_cases(simulated.probe, cases)
    assert {o.status for o in outcomes} == {"passed" if names == "true" else "failed"}, outcomes


@pytest.mark.parametrize("mutant", list(mutants()), ids=lambda mutant: f"{mutant.unit}: {mutant.name}")
def test_a_mutant_of_a_unit_is_caught_by_its_case(mutant: UnitMutant) -> None:
    case = cases_of(mutant.unit, "serial")[mutant.caught_by]
    with SimulatedUnit("serial", mutant.damage, unit=mutant.unit) as simulated:
        outcome = run_case(simulated.probe, case)
    assert outcome.status == "failed", f"{mutant.caught_by} passed on a {mutant.unit} where {mutant.name}"
    assert outcome.expected
    assert outcome.seen


@pytest.mark.parametrize(
    ("caught_by", "damage"), [item[1:] for item in MUTANTS_ON_CAN], ids=[item[0] for item in MUTANTS_ON_CAN]
)
def test_a_mutant_of_a_unit_on_can_is_caught_by_its_case(caught_by: str, damage: Damage) -> None:
    with SimulatedUnit("can", damage, unit=GEN2) as simulated:
        outcome = run_case(simulated.probe, ON_CAN[caught_by])
    assert outcome.status == "failed", f"{caught_by} passed"
    assert outcome.expected
    assert outcome.seen


def test_a_unit_on_canopen_passes_every_case_that_its_dictionary_has() -> None:
    outcomes = healthy_outcomes("canopen", "oresat")
    assert [(o.id, o.expected, o.seen, o.log[-4:]) for o in outcomes if o.status == "failed"] == []
    assert {o.id: o.seen for o in outcomes if o.status == "skipped" and ".unjudged." not in o.id} == {
        "canopen.design.attitude": "the EDS has no object named sequence"
    }
    assert len(outcomes) >= 175


def test_the_rows_of_a_unit_with_three_links_pass_on_canopen_too() -> None:
    cases = [case for case in cases_of("cubestar", "canopen").values() if case not in CANOPEN_CASES]
    with SimulatedUnit("canopen") as simulated:
        outcomes = run_cases(simulated.probe, cases)
    assert [(o.id, o.expected, o.seen, o.log[-4:]) for o in outcomes if o.status == "failed"] == []
    assert len(outcomes) >= 35


def caught_on_canopen(simulated: SimulatedUnit, case: str) -> None:
    with simulated:
        outcome = run_case(simulated.probe, cases_of("oresat", "canopen")[f"canopen.{case}"])
    assert outcome.status == "failed", f"{case} passed"
    assert outcome.expected
    assert outcome.seen


@pytest.mark.parametrize("mutant", DEFINITION_MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_of_a_canopen_definition_is_caught_by_its_case(mutant: DefinitionMutant, tmp_path) -> None:
    served = mutant.write(tmp_path)
    caught_on_canopen(SimulatedUnit("canopen", unit="oresat", served=served), mutant.caught_by)


@pytest.mark.parametrize("name", DAMAGES)
def test_a_mutant_of_a_unit_on_canopen_is_caught_by_its_case(name: str) -> None:
    case, damage = DAMAGES[name]
    caught_on_canopen(SimulatedUnit("canopen", damage, unit="oresat"), case)


def test_a_unit_without_cases_for_a_link_is_named() -> None:
    with pytest.raises(BenchError, match="unit oresat: has no serial link"):
        serial_suite(read_unit("oresat"))
    with pytest.raises(BenchError, match="unit sagitta: has no CAN link"):
        can_suite(read_unit("sagitta"))
    with pytest.raises(BenchError, match="unit sagitta: has no CANopen link"):
        canopen_suite(read_unit("sagitta"))
