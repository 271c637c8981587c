"""Telemetry without a request: what the definition sends at a rate or after events, and what was subscribed to; no other."""

import re
from dataclasses import replace

import pytest

from starhil.emulator.cli.endurance import run_once
from starhil.emulator.device.subscriptions import Subscriptions
from starhil.emulator.launch.unit_in_memory import UnitUnderTest
from starhil.hil_tests.endurance.life import Life, make_life
from starhil.hil_tests.endurance.obc import Obc
from starhil.hil_tests.endurance.oracle import Oracle
from starhil.hil_tests.judge.definition import read_unit
from tests.test_docs import blocks
from tests.test_your_unit import PAGE, STREAMING, written
from tests.user_units import ATTITUDE, HEAD, PACKETS, STREAM
from tests.user_units import written as user_unit

pytestmark = pytest.mark.long

WAIT = {"do": "wait", "s": 3.0}
VARIANTS = ("as it is", "streaming more", "with each image")


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    """The folders of the tutorial's unit and of its variants."""
    folder = tmp_path_factory.mktemp("units")
    units = {name: written(folder / name.replace(" ", "_")) for name in VARIANTS}
    (more,) = [block.text for block in blocks(PAGE, "toml") if block.heading == STREAMING]
    (units["streaming more"] / "more.toml").write_text(more, encoding="utf-8")
    file = units["with each image"] / "unit.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(
        text.replace("unsolicited = 5.0", 'unsolicited = ["frame"]').replace(
            '["mode"]', '["validity", "start"]'
        ),
        encoding="utf-8",
    )
    return units


def request(unit, name, link="serial", **values):
    row = unit.telecommands.get(name) or unit.telemetry[name]
    data = row.encode(values).hex() if row.kind == "telecommand" else ""
    return {"do": "request", "link": link, "row": [row.message_class, row.id, row.kind], "data": data}


def outcome_of(folder, *steps, start_mode="standby"):
    return run_once(
        Life(str(folder), 1, ("serial",), {"parameters": {"start_mode": start_mode}}, (WAIT, *steps))
    )


@pytest.mark.parametrize(("number", "variant"), list(enumerate(VARIANTS)))
def test_no_life_of_the_unit_of_the_tutorial_ends_in_a_violation(units, number, variant):
    unit = read_unit(units[variant])
    seeds = range(number, 9, len(VARIANTS))
    lives = [make_life(unit, variant, ("serial",), seed, 60) for seed in seeds]  # whatever the folder is
    outcomes = [run_once(replace(life, unit=str(units[variant]))) for life in lives]
    assert [outcome.violation for outcome in outcomes] == [""] * len(lives)
    assert sum(outcome.readings for outcome in outcomes) > 1000


@pytest.mark.parametrize("start_mode", ["standby", "lost_in_space"])
def test_a_mode_is_reported_when_it_changes_and_judged_as_of_then(units, start_mode):
    unit = read_unit(units["as it is"])
    commands = [request(unit, "measure", mode=mode) for mode in ("lost_in_space", "standby")]
    steps = [step for command in commands for step in (command, WAIT)]
    outcome = outcome_of(units["as it is"], *steps, start_mode=start_mode)
    assert outcome.violation == ""
    assert outcome.readings > 45


def test_output_that_a_fault_has_delayed_is_awaited_until_it_has_come(units):
    unit = read_unit(units["as it is"])
    stream = request(unit, "stream", **dict.fromkeys(unit.telecommands["stream"].named, 0x41))
    fault = {"do": "fault", "fault": {"serial": {"delay_s": 1.0, "split": 3}}}
    read = request(unit, "exposure")
    outcome = outcome_of(
        units["as it is"], stream, fault, {"do": "wait", "s": 60.0, "most": 10_000}, {"do": "clear"}, read,
        start_mode="lost_in_space",
    )  # fmt: skip
    assert outcome.violation == ""


def test_output_that_is_held_for_ever_is_a_violation(units, monkeypatch):
    monkeypatch.setattr(UnitUnderTest, "is_late", lambda *_: True)
    monkeypatch.setattr("starhil.hil_tests.endurance.run.LONGEST_DELAY_S", 60.0)
    fault = {"do": "fault", "fault": {"serial": {"delay_s": 1.0}}}
    outcome = outcome_of(units["as it is"], fault, {"do": "clear"})
    assert outcome.violation == "output that faults delayed has not come 60 s after their end"


def test_rows_that_look_like_answers_may_be_subscribed_to(tmp_path):
    folder = user_unit(tmp_path / "unit", STREAM)
    unit = read_unit(folder)
    steps = (request(unit, "stream", row=3), WAIT, request(unit, "status"), WAIT)
    outcome = outcome_of(folder, *steps, start_mode="lost_in_space")
    assert outcome.violation == ""
    assert outcome.readings > 5


def test_lives_of_a_unit_whose_telemetry_cannot_be_requested_end_without_a_violation(tmp_path):
    folder = user_unit(tmp_path / "unit", PACKETS.replace("LENGTH", "u16"))
    unit = read_unit(folder)
    assert not unit.readable
    lives = [make_life(unit, "packets", ("serial",), seed, 40) for seed in range(2)]
    outcomes = [run_once(replace(life, unit=str(folder))) for life in lives]
    assert [outcome.violation for outcome in outcomes] == [""] * len(lives)
    assert sum(outcome.readings for outcome in outcomes) > 1000


TWO_ANSWERS = """
[[telecommand]]
id = 10
name = "measure"
doc = "d"
action = "set_mode"
answer = ["reply", "row:mode"]
fields = [{ name = "mode", type = "u8", argument = "mode", map = { 1 = "standby", 2 = "lost_in_space" } }]
"""


def test_a_telecommand_is_answered_as_often_as_the_definition_says(tmp_path, monkeypatch):
    folder = user_unit(
        tmp_path / "unit", HEAD + TWO_ANSWERS + MODES_ON_TWO_LINKS.replace('unsolicited = ["mode"]\n', "")
    )
    unit = read_unit(folder)
    steps = [request(unit, "measure", link, mode="standby") for link in ("serial", "can")]
    life = Life(str(folder), 1, ("serial", "can"), {"parameters": {"start_mode": "standby"}}, (WAIT, *steps))
    outcome = run_once(life)
    assert outcome.violation == ""
    assert outcome.readings == len(steps)
    for answers, number in ((("reply",), 1), (("reply", "row:mode", "row:mode"), 3)):
        monkeypatch.setattr(Obc, "_expected_answers", lambda *_, answers=answers: answers)
        assert run_once(life).violation == f"serial: measure 01: 2 answers, not {number}"


MODES_ON_TWO_LINKS = """
[[telemetry]]
id = 130
name = "mode"
doc = "d"
unsolicited = ["mode"]
fields = [{ name = "mode", type = "u8", value = "mode", map = { 0 = "boot", 1 = "standby", 2 = "lost_in_space", 3 = "tracking", 9 = "error" } }]

[link.can]
kind = "cubespace"
[link.serial]
framing = { kind = "cubespace", dialect = "c" }
"""


def test_what_is_sent_on_two_links_is_one_change_of_the_unit(tmp_path):
    rows = ATTITUDE.replace("ID", "131").replace("KEYS", 'unsolicited = ["frame"]') + MODES_ON_TWO_LINKS
    folder = user_unit(tmp_path / "unit", HEAD + rows)
    profile = {"parameters": {"start_mode": "lost_in_space"}}
    outcome = run_once(Life(str(folder), 1, ("serial", "can"), profile, (WAIT,)))
    assert outcome.violation == ""
    assert outcome.readings > 4


def scheduled(factor):
    schedule = Subscriptions._schedule
    return lambda self, key, row, rate_hz, due_ns: schedule(self, key, row, factor * rate_hz, due_ns)


def reporting(name):
    """Let each change of the mode be reported by a row."""
    return lambda self, event: [self._icd.telemetry[name]] if event == "mode" else []


WRONG = {
    "too often": ("_schedule", scheduled(1.01), r"serial: attitude 0\.19\d+ s after the previous one, not 0\.2 s"),
    "too rarely": ("_schedule", scheduled(0.5), r"serial: (attitude 0\.4 s after the previous one, not 0\.2 s|no attitude for .*)"),
    "never": ("_schedule", lambda *_: None, r"serial: no attitude for 3 s, although it is sent every 0\.2 s"),
    "a row that is not sent by itself": ("_reporting", reporting("status"), "serial: status without a subscription or an event"),
    "an error that has not occurred": ("_reporting", reporting("fault"), "serial: fault without a subscription or an event"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_stream_that_is_not_that_of_the_definition_is_a_violation(units, monkeypatch, name):
    method, instead, expected = WRONG[name]
    monkeypatch.setattr(Subscriptions, method, instead)
    assert re.fullmatch(expected, outcome_of(units["as it is"]).violation)


def test_a_mode_that_is_not_the_one_commanded_is_a_violation_of_its_report(units, monkeypatch):
    unit = read_unit(units["as it is"])
    monkeypatch.setattr(Oracle, "_take_effect", lambda *_: None)
    outcome = outcome_of(units["as it is"], request(unit, "measure", mode="lost_in_space"))
    assert outcome.violation == "mode.mode: lost_in_space, but only standby is possible"


def test_only_the_rows_of_the_last_subscription_may_come(units):
    unit = read_unit(units["as it is"])
    oracle = Oracle(unit, {}, 1.7e9, (5.0, 25.0))
    command, names = unit.telecommands["stream"], ("status", "exposure")
    found = []
    for row_id in (0x40, 0x43, 0):
        data = command.encode(dict.fromkeys(command.named, row_id))
        oracle.executed(command, unit.request(command, data), "ok", sure=True)
        found.append([oracle.is_subscribed(unit.telemetry[name]) for name in names])
    assert found == [[True, False], [False, True], [False, False]]
