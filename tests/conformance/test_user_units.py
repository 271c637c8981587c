"""Units as users write them: each healthy one passes, each wrong one fails, and what is not judged is listed."""

from __future__ import annotations

from pathlib import Path

import pytest

from starhil.hil_tests.attitude import from_radec_roll
from starhil.hil_tests.conformance.canopen_suite import canopen_suite
from starhil.hil_tests.conformance.runner import run_case, run_cases
from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.files.bundled import UNITS_FOLDER
from tests.conformance.simulated import SimulatedUnit
from tests.user_units import ON_CAN, STREAM, packets, written

pytestmark = pytest.mark.long

SUITES = {"serial": serial_suite, "can": can_suite}
TRUTH = from_radec_roll(83.8, -1.2, 0.0)


def outcomes_of(unit: Path, served: Path | None = None, case: str | None = None, link: str = "serial"):
    """Run all cases, or one, on a simulated unit whose truth is known; return the outcomes by ID without the link."""
    cases = SUITES[link](read_unit(unit))
    with SimulatedUnit(link, unit=unit, served=served) as simulated:
        simulated.probe.truth = lambda: TRUTH
        if case is None:
            outcomes = run_cases(simulated.probe, cases)
        else:
            chosen = [item for item in cases if item.id == f"{link}.{case}"]
            outcomes = [run_case(simulated.probe, item) for item in chosen]
    return {outcome.id.removeprefix(f"{link}."): outcome for outcome in outcomes}


def bad(outcomes) -> list[tuple[str, str, str]]:
    return [(o.id, o.expected, o.seen) for o in outcomes.values() if o.status in ("failed", "not run")]


UNITS = {
    "stream": STREAM,
    "packets": packets(),
    "packets with a length of one byte": packets("u8"),
    "packets, and one row that is read": packets().replace("request = false\n", "", 1).replace(
        "offset = -1", "offset = 1"
    ),
    "a telecommand that two rows answer": STREAM.replace('action = "nothing"\n', 'action = "nothing"\nanswer = ["reply", "row:status", "row:attitude"]\n'),
    "a telecommand that a row answers": STREAM.replace('action = "nothing"\n', 'action = "nothing"\nanswer = ["row:status"]\n'),
    "a row at a rate among rows that are read": STREAM.replace('name = "attitude"\n', 'name = "attitude"\nunsolicited = 5.0\n'),
    "a constant that is negative": STREAM.replace("request_header = [", 'request_header = [{ type = "i8", const = -1 }, '),
}  # fmt: skip


@pytest.mark.parametrize("name", UNITS)
def test_a_healthy_unit_passes(tmp_path: Path, name: str) -> None:
    outcomes = outcomes_of(written(tmp_path / "unit", UNITS[name]))
    assert bad(outcomes) == []
    assert outcomes["attitude.attitude"].status == "passed"


def test_a_row_that_comes_with_each_frame_on_can_is_judged(tmp_path: Path) -> None:
    unit = written(tmp_path / "unit", ON_CAN)
    outcomes = outcomes_of(unit, link="can")
    assert bad(outcomes) == []
    passed = {name for name, outcome in outcomes.items() if outcome.status == "passed"}
    assert passed >= {
        "attitude.attitude",
        "unsolicited.attitude",
        "commands.ping",
        "clocks.status.telecommands",
    }
    negated = ON_CAN.replace('"f64", value = "attitude.x"', '"f64", scale = -1, value = "attitude.x"')
    wrong = outcomes_of(unit, written(tmp_path / "served", negated), "attitude.attitude", "can")
    assert wrong["attitude.attitude"].status == "failed"


def test_where_answers_name_no_row_one_that_follows_is_not_judged(tmp_path: Path) -> None:
    outcomes = outcomes_of(written(tmp_path / "unit", ON_CAN))  # dialect b
    assert bad(outcomes) == []
    assert outcomes["commands.ping"].seen == "on this link an answer does not name its row, such as status"


def test_a_telecommand_that_another_row_answers_fails(tmp_path: Path) -> None:
    text = STREAM.replace('action = "nothing"\n', 'action = "nothing"\nanswer = ["reply", "row:status"]\n')
    unit = written(tmp_path / "unit", text)
    for number, answer in enumerate(('["reply", "row:attitude"]', '["reply"]', '["row:status"]')):
        served = written(tmp_path / f"served_{number}", text.replace('["reply", "row:status"]', answer))
        assert outcomes_of(unit, served, "commands.ping")["commands.ping"].status == "failed", answer


def test_a_message_is_no_longer_than_its_length_can_state(tmp_path: Path) -> None:
    unit = written(tmp_path / "unit", STREAM)
    outcome = outcomes_of(unit, case="framing.overlong")["framing.overlong"]
    assert outcome.status == "passed"
    assert any("EB 90 FF 02" in line for line in outcome.log)


def test_of_packets_only_what_is_sent_is_judged_and_the_rest_is_listed(tmp_path: Path) -> None:
    outcomes = outcomes_of(written(tmp_path / "unit", packets()))
    skipped = {name: outcome.seen for name, outcome in outcomes.items() if outcome.status == "skipped"}
    assert list(skipped) == ["unjudged.request", "unjudged.requests"]
    assert skipped["unjudged.request"].startswith("verification.last (request.last); ")
    assert skipped["unjudged.requests"].startswith("no request reads a row")


def test_a_wrong_attitude_in_packets_fails(tmp_path: Path) -> None:
    unit = written(tmp_path / "unit", packets())
    negated = packets().replace('"f64", value = "attitude.x"', '"f64", scale = -1, value = "attitude.x"')
    assert (
        outcomes_of(unit, written(tmp_path / "served", negated), "attitude.attitude")[
            "attitude.attitude"
        ].status
        == "failed"
    )


def test_a_row_that_goes_on_after_the_end_of_its_subscription_fails(tmp_path: Path) -> None:
    unit = written(tmp_path / "unit", STREAM)
    served = written(
        tmp_path / "served", STREAM.replace('name = "status"\n', 'name = "status"\nunsolicited = 5.0\n')
    )
    outcome = outcomes_of(unit, served, "subscriptions.stream")["subscriptions.stream"]
    assert (outcome.status, outcome.expected) == ("failed", "messages after the end of the subscription 0")


SWAPPED = {
    "uptime": ("clocks.status", "u32"),
    "clock": ("clocks.status", "f64"),
    "asked": ("clocks.status", "u16"),
    "commanded": ("clocks.status.telecommands", "u16"),
    "frames": ("clocks.status.frames", "u32"),
    "frame_time": ("clocks.status.frames", "f64"),
}


@pytest.mark.parametrize("field", SWAPPED)
def test_a_time_or_count_in_the_other_byte_order_fails(tmp_path: Path, field: str) -> None:
    case, kind = SWAPPED[field]
    start = f'{{ name = "{field}", type = "{kind}"'
    assert start in STREAM
    unit = written(tmp_path / "unit", STREAM)
    served = written(tmp_path / "served", STREAM.replace(start, f'{start}, order = "little"'))
    assert outcomes_of(unit, case=case)[case].status == "passed"
    outcome = outcomes_of(unit, served, case)[case]
    assert outcome.status == "failed"
    assert outcome.expected.startswith(f"status.{field}")


def test_a_time_in_another_unit_fails(tmp_path: Path) -> None:
    unit = written(tmp_path / "unit", STREAM)
    served = written(
        tmp_path / "served", STREAM.replace('unit = "ms", value = "uptime"', 'unit = "us", value = "uptime"')
    )
    assert outcomes_of(unit, served, "clocks.status")["clocks.status"].status == "failed"


PLUGIN = """
from starhil.protocol.plugin import quantity


@quantity("maker.x")
def x(snapshot):
    return 0.5
"""


def test_an_attitude_of_the_plugin_is_listed_as_not_judged(tmp_path: Path) -> None:
    text = STREAM.replace('doc = "A user\'s unit."', 'doc = "d"\nplugin = "unit.py"').replace(
        'value = "attitude.x"', 'value = "maker.x"'
    )
    unit = written(tmp_path / "unit", text)
    (unit / "unit.py").write_text(PLUGIN, encoding="utf-8")
    cases = [item for item in serial_suite(read_unit(unit)) if item.area == "serial.unjudged"]
    seen = {outcome.id: outcome for outcome in outcomes_of(unit, case="unjudged.plugin").values()}
    outcome = seen["serial.unjudged.plugin"]
    assert outcome.status == "skipped"
    assert "attitude.x (maker.x)" in outcome.seen
    assert "serial.unjudged.attitude" in {
        item.id for item in cases
    }  # w, y, z and valid, which alone state no attitude


def test_a_time_in_another_unit_on_canopen_fails(tmp_path: Path) -> None:
    text = (UNITS_FOLDER / "oresat" / "oresat.toml").read_text(encoding="utf-8")
    field = 'name = "uptime", type = "u32", unit = "s"'
    assert field in text
    served = written(tmp_path / "served", text.replace(field, field.replace('unit = "s"', 'unit = "ms"')))
    (case,) = [item for item in canopen_suite(read_unit("oresat")) if item.id == "canopen.clocks.system"]
    statuses = []
    for folder in (None, served):
        with SimulatedUnit("canopen", unit="oresat", served=folder) as simulated:
            statuses.append(run_case(simulated.probe, case).status)
    assert statuses == ["passed", "failed"]
