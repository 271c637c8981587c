"""Session scripts: what is read, and the one-line message for each error."""

from __future__ import annotations

from pathlib import Path

import pytest

from starhil.hil_tests.attitude import from_radec_roll
from starhil.hil_tests.errors import ScriptError
from starhil.hil_tests.session.expect import Variable
from starhil.hil_tests.session.script import load_script
from starhil.hil_tests.session.session_run import find_script
from starhil.hil_tests.session.steps import Command, Read, Sample, Send
from starhil.protocol.files.bundled import bundled, bundled_units
from starhil.protocol.unit import load_unit
from tests.user_units import STREAM, written

ICD = load_unit()


@pytest.fixture
def load(tmp_path):
    def _load(text: str):
        path = tmp_path / "trial.toml"
        path.write_text(text, encoding="utf-8")
        return load_script(path, ICD)

    return _load


def refusal(load, text: str) -> str:
    with pytest.raises(ScriptError) as caught:
        load(text)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("trial.toml") or "trial.toml:" in message
    return message


FULL = """
title = "All parts"
doc = "Why."
[defaults]
timeout_s = 0.5
retries = 1
keep_going = true
link = "both"
[emulator]
profile = "demo"
set = ["truth.ra_deg=83.8"]
seed = 3
[truth]
ra_deg = 83.8
dec_deg = -1.2
roll_deg = 30
[[step]]
read = "identification"
expect = { interface_version = 1, runtime_s = { max = 60 }, node_type = { one_of = [1, 0x53] } }
capture = { before = "runtime_s" }
[[step]]
name = "set the clock"
command = "set_unix_time"
with = { seconds = "$now_s", milliseconds = "$now_ms" }
[[step]]
read = "precise_attitude"
expect = { valid = true, mode = "tracking", rate_x = { value = 0.3, within = 0.01 } }
attitude = { within_arcsec = 30 }
within_s = 20
link = "can"
[[step]]
sample = { telemetry = "precise_attitude", every_s = 0.2, for_s = 1, file = "slew.csv", at_least = 0.9 }
[[step]]
send = "1F 7F 80 1F FF"
answer = "1F 7F .. .. 1F FF"
[[step]]
wait_s = 0.5
"""


def test_a_full_script_is_read_unchanged(load):
    script = load(FULL)
    defaults = script.defaults
    assert (script.title, defaults.timeout_s, defaults.retries, defaults.keep_going, defaults.link) == (
        "All parts", 0.5, 1, True, "both",
    )  # fmt: skip
    assert (script.emulator.profile, script.emulator.settings, script.emulator.seed) == (
        "demo", ["truth.ra_deg=83.8"], 3,
    )  # fmt: skip
    assert script.truth.attitude == from_radec_roll(83.8, -1.2, 30.0)
    read, clock, attitude, sample, send, wait = script.steps
    assert isinstance(read, Read)
    assert read.row.id == 128
    assert read.capture == {"before": "runtime_s"}
    assert isinstance(clock, Command)
    assert clock.values["seconds"] == Variable("now_s")
    assert clock.name == "set the clock"
    assert (attitude.link, attitude.within_s, attitude.attitude.within_arcsec) == ("can", 20.0, 30.0)
    assert isinstance(sample, Sample)
    assert (sample.file, sample.at_least, sample.every_s) == ("slew.csv", 0.9, 0.2)
    assert isinstance(send, Send)
    assert send.link == "serial"
    assert wait.name == "wait 0.5 s"


def test_every_error_of_a_script_is_reported_with_its_place(load):
    with pytest.raises(ScriptError) as caught:
        load(
            "[defaults]\ntimeout = 3\n"
            "[[step]]\nread = 'quaternoin'\ncapture = { first = 'q_x' }\n"
            "[[step]]\nread = 'rates'\nexpect = { rat_x = 1, rate_y = '$first' }\nwithin = 3\n"
            "[[step]]\ncommand = 'set_mode'\nwith = { mode = 'tracing' }"
        )
    lines = caught.value.args
    assert [line.split(": ")[1] for line in lines] == [
        "defaults.timeout",
        "step 1",
        "step 2",
        "step 2",
        "step 3",
    ]
    for line, word in zip(lines, ("timeout_s", "quaternion", "within_s", "rate_x", "tracking"), strict=True):
        assert word in line


def test_an_image_of_a_unit_without_such_images_is_rejected(tmp_path):
    path = tmp_path / "script.toml"
    path.write_text("[[step]]\ndownload_image = 'i.png'\n")
    with pytest.raises(ScriptError, match="step 1: unit st200 has no telecommand save_image: only images of"):
        load_script(path, load_unit("st200"))


def test_every_wrong_field_of_a_step_is_reported(load):
    with pytest.raises(ScriptError) as caught:
        load(
            "[[step]]\nread = 'rates'\nexpect = { rat_x = 1, rate_y = 'fast' }\ncapture = { first = 'rate_zz' }"
        )
    lines = caught.value.args
    assert len(lines) == 3
    for word in ("'rat_x'", "'rate_y' is a number", "'rate_zz'"):
        assert any(word in line for line in lines)


def test_a_captured_value_may_be_used_by_later_steps_only(load):
    script = load(
        "[[step]]\nread = 'boot_status'\ncapture = { boots = 'boot_count' }\n"
        "[[step]]\nread = 'boot_status'\nexpect = { boot_count = { value = '$boots', plus = 1 } }"
    )
    assert script.steps[1].expect["boot_count"].equals == Variable("boots")


def test_bytes_are_written_in_hexadecimal_and_compared_as_bytes(load):
    zeros, ones = bytes(16), b"\xff" * 16
    conditions = (
        f"value = '{zeros.hex()}', one_of = ['{zeros.hex(' ').upper()}', '$map'], not = '{ones.hex()}'"
    )
    script = load(
        "[[step]]\nread = 'hole_map_1'\ncapture = { map = 'map' }\n"
        f"[[step]]\nread = 'hole_map_1'\nexpect = {{ map = {{ {conditions} }} }}"
    )
    conditions = script.steps[1].expect["map"]
    assert (conditions.equals, conditions.one_of, conditions.differs_from) == (
        zeros,
        [zeros, Variable("map")],
        ones,
    )
    assert conditions.mismatch("map", zeros, {"map": ones}) is None
    assert conditions.mismatch("map", ones, {"map": ones}) is not None


@pytest.mark.parametrize("wanted", ["true", "'true'", "{ not = false }", "{ one_of = [true] }"])
def test_a_flag_that_a_map_defines_is_true_or_false(wanted, tmp_path):
    unit = load_unit("sagitta")
    path = tmp_path / "script.toml"
    path.write_text(f"[[step]]\nread = 'solution'\nexpect = {{ valid = {wanted} }}")
    conditions = load_script(path, unit).steps[0].expect["valid"]
    row = unit.telemetry["solution"]
    seen = [row.decode(row.encode({"valid": valid}))["valid"] for valid in (True, False)]
    assert conditions.mismatch("valid", seen[0], {}) is None
    assert conditions.mismatch("valid", seen[1], {}).startswith("valid is false, expected")
    path.write_text("[[step]]\nread = 'solution'\nexpect = { valid = 'yes' }")
    with pytest.raises(ScriptError, match="'valid' is true or false, not 'yes'"):
        load_script(path, unit)


def test_values_that_a_correct_obc_never_sends_are_allowed_where_a_refusal_is_expected(load):
    script = load("[[step]]\ncommand = 'set_mode'\nwith = { mode = 77 }\nrefused = 'invalid_parameter'")
    assert script.steps[0].refused == "invalid_parameter"


@pytest.mark.parametrize(
    ("unit", "answer", "message"),
    [
        ("cubestar", "{ a = '00', b = '01' }", r"answer: .* of unit cubestar \(a, b, c\), not for a, b$"),
        ("cubestar", "{ a = '0', b = '01', c = '02' }", r"answer: not bytes .*: '0'"),
        ("cubestar", "['0']", r"answer: not bytes .*: '0'"),
        ("cubestar", "[0]", r"answer: must be a text, or a list of texts"),
        ("sagitta", "{ a = '00' }", r"answer: .* of unit sagitta \(none\), not for a$"),
    ],
)
def test_an_answer_that_no_dialect_of_the_unit_has_is_reported(unit, answer, message, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(f"[[step]]\nsend = '00'\nanswer = {answer}")
    with pytest.raises(ScriptError, match=message):
        load_script(path, load_unit(unit))


@pytest.mark.parametrize("unit", ["sagitta", "cubestar"])
def test_a_name_that_a_unit_lacks_is_reported_with_the_unit_as_it_may_be_the_wrong_one(unit, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(f"[[step]]\nread = '{'solution' if unit == 'cubestar' else 'rates'}'")
    with pytest.raises(ScriptError, match=f"step 1: read: unit {unit}: no telemetry row named"):
        load_script(path, load_unit(unit))


def test_a_refusal_is_named_by_the_errors_of_the_unit(tmp_path):
    path = tmp_path / "trial.toml"
    errors = "\n[errors]\nok = 0\nother = 9\n"
    for name, known, unknown in (("default", "invalid_id", "other"), ("its_own", "other", "invalid_id")):
        unit = load_unit(written(tmp_path / name, STREAM + (errors if name == "its_own" else "")))
        path.write_text(f"[[step]]\ncommand = 'ping'\nrefused = '{known}'")
        assert load_script(path, unit).steps[0].refused == known
        path.write_text(f"[[step]]\ncommand = 'ping'\nrefused = '{unknown}'")
        with pytest.raises(ScriptError, match=rf"refused: '{unknown}' is not one of ok \(0\), {known} "):
            load_script(path, unit)


def test_a_missing_file_is_rejected_with_near_names(tmp_path):
    with pytest.raises(ScriptError, match="first_light"):
        find_script(Path("first_lite"))
    with pytest.raises(ScriptError, match="cannot be read"):
        load_script(tmp_path / "none.toml", ICD)


@pytest.mark.parametrize("path", bundled("session").values(), ids=lambda path: path.stem)
def test_the_included_scripts_are_valid(path):
    unit = path.stem.partition("_")[0]
    script = load_script(path, load_unit(unit) if unit in bundled_units() else ICD)
    assert script.steps
    assert script.doc
