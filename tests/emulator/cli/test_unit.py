"""`starhil unit`: list, create, check and describe units; a unit with errors does not start."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from starhil.emulator.cli.bench import group as bench
from starhil.emulator.cli.conformance import CaseOptions
from starhil.emulator.cli.options import BenchOptions
from starhil.emulator.cli.unit import group
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.run import Run
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess
from starhil.hil_tests.rig.rig import LinkOptions
from starhil.hil_tests.session import SessionRequest, run_session
from starhil.protocol.errors import ProtocolError
from starhil.protocol.files.bundled import bundled_units, find


def unit(*words: str):
    """Run a command of the group."""
    return CliRunner().invoke(group, words)


def test_a_new_unit_has_no_errors_and_shows_its_exchanges(tmp_path):
    folder = tmp_path / "mine"
    assert unit("new", str(folder)).exit_code == 0
    assert 'name = "mine"' in (folder / "unit.toml").read_text(encoding="utf-8")
    checked = unit("check", str(folder))
    assert checked.exit_code == 0
    assert (
        "telecommand set_mode, ID 0x02, 1 B, on serial\n    mode = lost_in_space\n  > C0 10 01 02 01 DE 14 C0\n"
        in checked.stdout
    )
    assert checked.stdout.endswith(f"{folder}: no errors\n")


def test_a_definition_is_not_overwritten(tmp_path):
    unit("new", str(tmp_path))
    assert isinstance(unit("new", str(tmp_path)).exception, EmulatorError)


def test_all_errors_are_printed_and_the_status_is_1(tmp_path):
    unit("new", str(tmp_path))
    file = tmp_path / "unit.toml"
    text = (
        file.read_text(encoding="utf-8").replace("attitude.w", "atitude.w").replace("set_clock", "set_clok")
    )
    file.write_text(text, encoding="utf-8")
    checked = unit("check", str(tmp_path), "--json")
    assert checked.exit_code == 1
    clock, attitude = json.loads(checked.stdout)["errors"]
    assert (
        clock
        == f"{file}: telecommand set_time: no action named 'set_clok'; did you mean set_clock, set_mode?"
    )
    assert attitude.startswith(
        f"{file}: telemetry attitude: field q_w: no quantity named 'atitude.w'; did you mean"
    )


def test_a_profile_with_a_wrong_unit_starts_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "starhil.emulator.run.run.make_pipeline", lambda *_, **__: pytest.fail("the pipeline was started")
    )
    unit("new", str(tmp_path / "mine"))
    profile = tmp_path / "profile.toml"
    profile.write_text('extends = "cubestar"\nunit = "mine"\n', encoding="utf-8")
    file = tmp_path / "mine" / "unit.toml"
    file.write_text(file.read_text(encoding="utf-8").replace("attitude.w", "w"), encoding="utf-8")
    with pytest.raises(ProtocolError, match="no quantity named 'w'"):
        Run([load_profile(str(profile))])
    file.write_text(file.read_text(encoding="utf-8").replace(', value = "w"', ""), encoding="utf-8")
    with pytest.raises(EmulatorError, match="field q_w: no `value`"):
        Run([load_profile(str(profile))])


def test_bundled_units_are_listed_and_described():
    listed = json.loads(unit("list", "--json").stdout)
    assert [item["unit"] for item in listed] == bundled_units()
    table = unit("list").stdout
    assert re.search(
        r"^cubestar \(default\)  serial \(cubespace\), CAN \(cubespace\), CANopen  \d+ telecommands  ",
        table,
        re.MULTILINE,
    )
    assert re.search(r"^nos3 .*  \d+ telecommands?  +\d+ telemetry rows?  ", table, re.MULTILINE)
    text = unit("describe", "cubestar").stdout
    assert re.search(
        r"160 telemetry precise_attitude: 56 B, ours\n +0 time_of_exposure: f64 s <- frame\.time\n", text
    )
    rows = json.loads(unit("describe", "cubestar", "--json").stdout)["rows"]
    assert next(row for row in rows if row["name"] == "set_mode")["action"] == "set_mode"


def test_an_unknown_unit_is_answered_with_similar_names():
    assert "did you mean cubestar" in str(unit("describe", "cubstar").exception)


def test_a_profile_names_its_unit_by_name_or_by_a_folder_beside_it(tmp_path):
    profile, mine = tmp_path / "profile.toml", tmp_path / "mine"
    shutil.copytree(find("unit", "sagitta"), mine)
    for unit_, source in (("sagitta", "sagitta"), ("mine", str(mine)), (str(mine), str(mine))):
        profile.write_text(f'extends = "cubestar"\nunit = "{unit_}"\n', encoding="utf-8")
        assert load_profile(str(profile)).unit_source == source


def test_a_bench_of_another_unit_than_the_profile_is_rejected():
    process = EmulatorProcess(["none"])
    process.ready = {"unit": "/my%20units/one"}
    process.check_unit("/my units/one")
    with pytest.raises(BenchError, match="the profile's unit is /my units/one: add --unit"):
        process.check_unit(None)
    process.ready = {"unit": "cubestar"}
    process.check_unit(None)


@pytest.mark.parametrize(
    ("unit_", "links", "message"),
    [
        ("sagitta", {"serial": {"port": "off"}}, "can.channel: unit sagitta has none of the links"),
        ("nos3", {"canopen": {"node": 5}}, "canopen.node: unit nos3 has no CANopen"),
        ("oresat", {"can": {"channel": "off"}}, "serial.port: unit .* has none of the links"),
        ("sagitta", {"serial": {"dialect": "b"}}, "links.serial.dialect: unit sagitta has no reply dialects"),
        (
            "cubestar-gen2",
            {"serial": {"dialect": "a"}},
            "links.serial.dialect: unit cubestar-gen2 has only dialect c",
        ),
    ],
)
def test_a_unit_without_the_links_that_are_asked_for_starts_nothing(monkeypatch, unit_, links, message):
    monkeypatch.setattr(
        "starhil.emulator.run.run.make_pipeline", lambda *_, **__: pytest.fail("the pipeline was started")
    )
    with pytest.raises(EmulatorError, match=message):
        Run([Profile.model_validate({"unit": unit_, "links": links})])


@pytest.mark.parametrize(
    ("name", "options", "links"),
    [
        ("cubestar", {}, ("auto", "auto", None)),
        ("cubestar", {"canopen": 44}, ("auto", "auto", 44)),
        ("cubestar", {"serial": "off"}, (None, "auto", None)),
        ("cubestar", {"can": "off"}, ("auto", None, None)),
        ("cubestar", {"can": "auto"}, (None, "auto", None)),
        ("sagitta", {}, ("auto", None, None)),
        ("cubestar-gen2", {}, ("auto", "auto", None)),
        ("oresat", {}, (None, "auto", 0x2C)),
        ("oresat", {"can": "auto"}, (None, "auto", 0x2C)),
    ],
)
def test_a_conformance_run_takes_the_links_that_the_unit_has(name, options, links):
    node = {"canopen": options.pop("canopen")} if "canopen" in options else {}
    bench = BenchOptions(unit=name, start=True, **options)
    request = CaseOptions(**node).request(bench, (), list_only=False)
    assert (request.serial, request.can, request.canopen_node) == links


@pytest.mark.parametrize("options", [{"serial": "off"}, {"can": "off"}, {"serial": "off", "can": "off"}])
def test_no_command_takes_off_for_the_name_of_a_port(options):
    with pytest.raises(BenchError, match="no link: use --serial DEV"):
        CaseOptions().request(BenchOptions(**options), (), list_only=False)
    request = SessionRequest(Path("first_light"), LinkOptions(**options))
    with pytest.raises(BenchError, match="no link: use --serial DEV"):
        run_session(request)


def test_the_load_of_the_links_is_refused_for_a_unit_without_its_rows():
    done = CliRunner().invoke(bench, ["bus", "--unit", "sagitta"])
    assert isinstance(done.exception, BenchError)
    assert "unit sagitta lacks the CubeStar rows that are used to load the links (identification, " in str(
        done.exception
    )


def test_a_link_that_the_unit_lacks_is_left_out_with_a_warning(monkeypatch, caplog):
    monkeypatch.setattr("starhil.emulator.run.run.make_pipeline", lambda *_, **__: None)
    Run([Profile.model_validate({"unit": "sagitta", "links": {"can": {"channel": "vcan0"}}})])
    assert "links.can.channel: unit sagitta has no such link" in caplog.text


def test_bindings_lists_quantities_actions_with_arguments_and_parameters():
    lines = unit("bindings").stdout.splitlines()
    assert 'value = "attitude.valid"  Whether the attitude of the last frame is valid.' in lines
    action = next(number for number, line in enumerate(lines) if line.startswith('action = "set_hole_map"'))
    assert [line.split('"')[1] for line in lines[action + 1 : action + 3]] == ["section", "map"]
    assert any(line.startswith('parameter = "exposure"  ms: ') for line in lines)
    listed = json.loads(unit("bindings", "--json").stdout)
    assert len(listed["quantities"]) == sum(line.startswith("value = ") for line in lines)
    assert {item["name"] for item in listed["actions"]} >= {"set_clock", "set_hole_map"}
