"""A run on a whole unit stops if nothing answers, and restores the settings of the unit."""

from __future__ import annotations

import re

import pytest

from starhil.configs.units.cubestar.controls import parameter, reset, set_parameter, value_of
from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.case import Case
from starhil.hil_tests.conformance.runner import run_cases
from starhil.hil_tests.conformance.suites import serial_suite
from starhil.hil_tests.judge.definition import read_unit
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.protocol.can.frame import CanFrame
from tests.conformance.links import write_unit
from tests.conformance.mutants_units import bodies
from tests.conformance.simulated import SimulatedUnit
from tests.conformance.test_healthy import SUITES
from tests.protocol.canopen.conftest import simulated_probe

pytestmark = pytest.mark.long

FOUND = {"exposure": 500, "update_rate": 2.0, "limiting_magnitude": 5.5, "min_star_pixels": 3}
"""What a user has set and stored; it is not what the cases need."""
IN_USE = {"exposure": 450}
"""What a user has set since."""


def link_of(unit: SimulatedUnit):
    return unit.probe.port


def mute(unit: SimulatedUnit, monkeypatch, echo: bytes | None = None) -> None:
    """Let the device say nothing any more, or always the same."""

    def send(_item):
        if echo is not None:
            unit.transport.out.append(echo if unit.kind == "serial" else CanFrame(0x05_80_04_01, echo[:8]))

    monkeypatch.setattr(link_of(unit), "send", send)


@pytest.mark.parametrize("link", ["serial", "can"])
@pytest.mark.parametrize(
    ("echo", "message"),
    [
        (None, "nothing answers on /dev/ttyX"),
        (b"$GPGGA,092750.000,5321.6802,N*76\r\n", "no valid answer on /dev/ttyX: "),
    ],
    ids=["mute", "foreign"],
)
def test_a_run_stops_where_no_star_sensor_answers(link, echo, message, monkeypatch):
    with SimulatedUnit(link) as unit:
        if link == "can" and echo is not None:
            echo = b"1234567"  # a row of 8 bytes is what is asked for
        mute(unit, monkeypatch, echo)
        begin = unit.probe.now()
        outcomes = run_cases(unit.probe, SUITES[link], port="/dev/ttyX")
        assert unit.probe.now() - begin < 10.0
    first, *others = outcomes
    assert (first.id, first.status) == (f"{link}.answers", "failed")
    assert first.seen.startswith(message)
    assert first.seen.endswith("check --dialect, --baud and the addresses") == (echo is not None)
    assert [outcome.id for outcome in others] == [case.id for case in SUITES[link]]
    assert {(outcome.status, outcome.seen) for outcome in others} == {("not run", f"not run: {first.seen}")}


@pytest.mark.parametrize(
    ("unit", "change", "fault"),
    [
        ("sagitta", lambda body, _stack: body[:-1] + bytes((body[-1] ^ 1,)), r"check xxh32: computed (.. .. ..) .., received \1 "),
        ("st16", lambda body, stack: body[: -stack.requests.check.size] + b"\0\0", r"check crc u16 1021h: computed .. .., received 00 00"),
        ("st16", lambda body, stack: stack.requests.close(body[:1] + bytes((body[1] ^ 1,)) + body[2 : -stack.requests.check.size], b""), "must be"),
    ],
    ids=["hash", "crc", "address"],
)  # fmt: skip
def test_a_run_names_what_is_wrong_with_every_answer(unit, change, fault):
    with SimulatedUnit("serial", bodies(change), unit=unit) as simulated:
        first, *_ = run_cases(simulated.probe, serial_suite(read_unit(unit)), port="/dev/ttyX")
    assert re.match(rf"no valid answer on /dev/ttyX: malformed \(.*{fault}.*\), \d+ bytes: ", first.seen)
    assert "--dialect" not in first.seen


def test_a_run_stops_where_no_canopen_node_answers():
    probe = simulated_probe()
    probe.node = 99  # nobody has this number
    outcomes = run_cases(probe, CANOPEN_CASES, port="vcan0 at node 9")
    assert (outcomes[0].id, outcomes[0].seen) == ("canopen.answers", "nothing answers on vcan0 at node 9")
    assert {outcome.status for outcome in outcomes[1:]} == {"not run"}


def test_a_run_stops_when_the_unit_falls_silent_within_it(monkeypatch):
    with SimulatedUnit("serial") as unit:
        cases = list(SUITES["serial"])[:30]
        outcomes = run_cases(
            unit.probe,
            cases,
            lambda outcome: mute(unit, monkeypatch) if outcome.id == cases[9].id else None,
        )
    statuses = [outcome.status for outcome in outcomes]
    assert statuses[:10] == ["passed"] * 10
    assert "failed" in statuses[10:14]
    assert statuses.count("not run") >= 15
    assert [o.seen for o in outcomes if o.id == "serial.answers"] == ["nothing answers on the link"]


def set_up(unit: SimulatedUnit) -> None:
    """Put a unit into the state that a user left it in."""
    for name, value in FOUND.items():
        set_parameter(unit.probe, name, value)
    unit.probe.command("save_parameters")
    unit.probe.wait_for("device_status", {"parameters_changed": False}, 2.0)
    set_parameter(unit.probe, "exposure", IN_USE["exposure"])
    unit.probe.command("set_mode", mode="lost_in_space")


def assert_as_found(unit: SimulatedUnit) -> None:
    """Check parameters in use, mode and, by a reset, the stored parameters."""
    assert unit.probe.telemetry("device_status")["mode"] in ("lost_in_space", "tracking")
    assert {name: parameter(unit.probe, name)["value"] for name in FOUND} == FOUND | IN_USE
    reset(unit.probe)
    assert {name: parameter(unit.probe, name)["value"] for name in FOUND} == FOUND


@pytest.mark.parametrize("link", ["serial", "can"])
def test_cases_pass_with_any_settings_and_restore_them(link):
    cases = [
        case for case in SUITES[link] if case.id.split(".")[1] in ("modes", "store", "parameters", "reset")
    ]
    with SimulatedUnit(link) as unit:
        set_up(unit)
        outcomes = run_cases(unit.probe, cases)
        assert [(o.id, o.expected, o.seen) for o in outcomes if o.status != "passed"] == []
        assert_as_found(unit)


@pytest.mark.parametrize("link", ["serial", "can"])
def test_cases_pass_on_a_unit_that_identifies_stars_from_the_start(link):
    areas = ("modes", "store", "reset", "images", "acknowledge")
    cases = [case for case in SUITES[link] if case.id.split(".")[1] in areas]
    with SimulatedUnit(link, parameters={"start_mode": "lost_in_space", "exposure": 120}) as unit:
        outcomes = run_cases(unit.probe, cases)
        assert [(o.id, o.expected, o.seen) for o in outcomes if o.status != "passed"] == []
        unit.probe.command("reset")
        unit.probe.sleep(5.0)
        unit.probe.drain()
        assert unit.probe.telemetry("device_status")["mode"] in ("lost_in_space", "tracking")
        assert value_of(unit.probe, "exposure") == 120


READBACK = """
[[telemetry]]
id = 140
name = "state"
doc = "Two telecommands as set, and another value."
include = ["set_numbers", "uptime_only", "set_mode"]

[[telemetry]]
id = 141
name = "uptime_only"
doc = "Time since start."
fields = [{ name = "uptime", type = "u32", unit = "s", value = "uptime" }]

[[telecommand]]
id = 3
name = "set_mode"
doc = "Set the mode."
action = "set_mode"
fields = [{ name = "mode", type = "u8", argument = "mode", map = { 1 = "standby", 2 = "lost_in_space" } }]

[link.serial]
"""


def test_settings_that_a_row_reports_among_other_values_are_restored(tmp_path):
    file = write_unit(tmp_path, "sum") / "unit.toml"
    text = file.read_text()
    before, _, after = text.partition("[[telemetry]]\nid = 128\n")
    text = before + "[[telemetry]]\n" + after.partition("[[telemetry]]\n")[2]
    file.write_text(text.replace("[link.serial]\n", READBACK))
    cases = [
        case
        for case in serial_suite(read_unit(tmp_path))
        if case.area in ("serial.settings", "serial.commands")
    ]
    with SimulatedUnit("serial", unit=tmp_path) as unit:
        unit.probe.command(
            "set_numbers", a=33, b=-1.5, c=4, d=0.5, e=10.0, f=2.0, g=-3, h=0.5, i=7, flag=True, group=9
        )
        first_state = unit.probe.telemetry("state")
        outcomes = run_cases(unit.probe, cases)
        last_state = unit.probe.telemetry("state")
        mode = unit.device.modes.mode.value
    assert [(o.id, o.expected, o.seen) for o in outcomes if o.status != "passed"] == []
    assert "serial.settings.state.set_numbers" in {o.id for o in outcomes}
    assert {**last_state, "uptime": 0} == {**first_state, "uptime": 0}
    assert mode == "tracking"


def test_an_interrupted_run_leaves_the_unit_as_it_was():
    def interrupted(probe):
        set_parameter(probe, "exposure", 77)
        probe.command("save_parameters")
        raise Interrupted(15)

    with SimulatedUnit("serial") as unit:
        set_up(unit)
        with pytest.raises(Interrupted, match="interrupted by SIGTERM"):
            run_cases(unit.probe, [Case("serial.x.y", "serial.x", "t", "c", interrupted, intrusive=True)])
        assert_as_found(unit)


@pytest.mark.parametrize("name", ["time.set", "time.flag"])
def test_a_case_that_fails_or_is_interrupted_puts_the_clock_back(name, monkeypatch):
    case = next(case for case in SUITES["serial"] if case.id == f"serial.{name}")
    with SimulatedUnit("serial") as unit:
        unit.probe.command("set_unix_time", seconds=1_800_000_000, milliseconds=0)
        command = unit.probe.command

        def interrupted(telecommand, **values):
            command(telecommand, **values)
            if values.get("seconds") == 1_700_000_000:
                raise Interrupted(15)

        monkeypatch.setattr(unit.probe, "command", interrupted)
        with pytest.raises(Interrupted):
            case.run(unit.probe)
        assert 1_800_000_000 <= unit.probe.telemetry("device_status")["clock"] < 1_800_000_060


def test_settings_that_cannot_be_put_back_are_named(monkeypatch):
    with SimulatedUnit("serial") as unit:
        set_up(unit)

        def fall_silent(_probe):
            mute(unit, monkeypatch)

        (outcome,) = run_cases(
            unit.probe, [Case("serial.x.y", "serial.x", "t", "c", fall_silent, intrusive=True)]
        )[1:]
    assert (outcome.id, outcome.status) == ("serial.settings.kept", "failed")
    assert "exposure = 500" in outcome.expected
    assert "limiting_magnitude = 5.5" in outcome.expected


def test_safe_cases_alone_do_not_touch_the_settings():
    with SimulatedUnit("serial") as unit:
        set_up(unit)
        before = unit.probe.telemetry("communication_status")["telecommand_count"]
        run_cases(unit.probe, [case for case in SUITES["serial"] if not case.intrusive][:10])
        assert unit.probe.telemetry("communication_status")["telecommand_count"] == before
