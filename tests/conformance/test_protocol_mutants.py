"""Conformance finds errors of the protocol code that the device shares with the product's own client."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from starhil.hil_tests.conformance.runner import run_case
from starhil.protocol.errors import ProtocolError
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine, exchanges
from tests.conformance.links import LINKS, write_unit
from tests.conformance.protocol_mutants import MUTANTS, ProtocolMutant
from tests.conformance.simulated import SUITES, SimulatedUnit, outcomes
from tests.planted import Edit, LostAimError, planted
from tests.test_your_unit import written

pytestmark = pytest.mark.long

MECHANISMS = (
    "checks", "framings", "headers", "scalar types", "scaling", "bits", "enumerations", "lengths", "segmentation",
    "PDO mapping", "unsolicited telemetry", "byte stuffing", "formats", "texts",
)  # fmt: skip


def unit_of(name: str, folder: Path) -> str | Path:
    """Return a bundled unit, the unit of the tutorial, or one with another link, little-endian if the name ends in `-le`."""
    if name == "tutorial":
        return folder if folder.exists() else written(folder)
    if not name.startswith("link:"):
        return name
    link, _, order = name.removeprefix("link:").partition("-")
    return write_unit(folder, link, "little" if order == "le" else "big")


def test_each_mechanism_has_at_least_five_mutants() -> None:
    counts = Counter(mutant.mechanism for mutant in MUTANTS)
    assert set(counts) == set(MECHANISMS)
    assert min(counts.values()) >= 5
    assert len({(mutant.mechanism, mutant.name) for mutant in MUTANTS}) == len(MUTANTS) >= 50


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.mechanism}: {mutant.name}")
def test_an_error_of_both_ends_fails_a_case(mutant: ProtocolMutant, tmp_path: Path) -> None:
    folder = unit_of(mutant.unit, tmp_path / "unit")
    with mutant.planted():
        icd, errors, _ = examine(folder)
        assert bool(errors) is not mutant.hidden, errors
        failed = []
        with SimulatedUnit(mutant.link, unit=folder, icd=icd) as simulated:
            cases = {case.id: case for case in SUITES[mutant.link](simulated.judged)}
            for case in mutant.cases:
                outcome = run_case(simulated.probe, cases[f"{mutant.link}.{case}"])
                failed += [outcome] if outcome.status == "failed" else []
    assert [outcome.id for outcome in failed] == [f"{mutant.link}.{case}" for case in mutant.cases]
    assert all(outcome.expected and outcome.seen for outcome in failed)


def messages(unit: Path) -> list[object]:
    """Return an example of each message of a unit."""
    try:
        return [(item.request, item.answers) for item in exchanges(load_unit(unit))]
    except ProtocolError as error:
        return [str(error)]


@pytest.mark.parametrize("streams_by_itself", [False, True])
def test_the_unit_of_the_tutorial_passes_every_case(streams_by_itself: bool, tmp_path: Path) -> None:
    results = list(outcomes("serial", written(tmp_path / "lynx", streams_by_itself)))
    assert [
        (o.id, o.expected, o.seen) for o in results if o.status != "passed" and ".unjudged." not in o.id
    ] == []
    assert len(results) >= 45


def test_every_error_that_changes_a_message_of_the_tutorial_fails_a_case(tmp_path: Path) -> None:
    unit = written(tmp_path / "lynx")
    healthy = messages(unit)
    missed, caught = [], 0
    # those of the tutorial have their cases above
    for mutant in (each for each in MUTANTS if each.unit != "tutorial" and each.link == "serial"):
        with mutant.planted():
            if messages(unit) != healthy:
                caught += 1
                if all(outcome.status != "failed" for outcome in outcomes("serial", unit)):
                    missed.append(mutant.name)
    assert missed == []
    assert caught >= 20


@pytest.mark.parametrize(
    ("link", "order"),
    # little-endian: lengths of two and three bytes, and checks of two and four
    [*((link, "big") for link in LINKS), *((link, "little") for link in ("sum", "dle", "xor16", "fletcher"))],
)
def test_a_unit_on_any_link_passes_every_case(link: str, order: str, tmp_path: Path) -> None:
    folder = write_unit(tmp_path / "unit", link, order)
    results = list(outcomes("serial", folder))
    assert [
        (o.id, o.expected, o.seen, o.log[-4:])
        for o in results
        if o.status != "passed" and ".unjudged." not in o.id
    ] == []
    assert len(results) >= 45


@pytest.mark.parametrize(
    "edit",
    [
        Edit("serial.checks:no_such_function", "a", "b"),
        Edit("no_such_module:crc", "a", "b"),
        Edit("serial.checks:crc", "no such text", "b"),
        Edit("serial.checks:crc", "register", "b"),
        Edit(
            "serial.checks", "from __future__ import annotations\n", "from __future__ import annotations  \n"
        ),
    ],
    ids=["function", "module", "text", "text that occurs several times", "no effect"],
)
def test_a_mutant_whose_aim_is_lost_is_an_error(edit: Edit) -> None:
    with pytest.raises(LostAimError), planted(edit):
        pass
