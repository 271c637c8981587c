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


ANGLES = "ra_deg = 1\ndec_deg = 2\nroll_deg = 3\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[step]]\nread = 'quaternoin'", ["step 1", "quaternoin", "did you mean quaternion"]),
        (
            "[[step]]\ncommand = 'set_mod'\nwith = { mode = 'standby' }",
            ["step 1", "set_mod", "did you mean set_mode?"],
        ),
        ("[[step]]\nread = 'reset'", ["'reset' is a telecommand: use command"]),
        ("[[step]]\ncommand = 'identification'", ["'identification' is telemetry: use read"]),
        (
            "[[step]]\nwait_s = 1\n[[step]]\nread = 'rates'\nexpect = { rat_x = 1 }",
            ["step 2", "rat_x", "did you mean rate_x"],
        ),
        ("[[step]]\ncommand = 'set_mode'\nwith = { mod = 'standby' }", ["'mod'", "did you mean mode"]),
        ("[[step]]\ncommand = 'set_mode'\nwith = { mode = 'tracing' }", ["tracing", "tracking"]),
        ("[[step]]\ncommand = 'set_mode'", ["step 1: with: row 'set_mode' needs the field 'mode'"]),
        ("[[step]]\nread = 'rates'\nexpct = { rate_x = 1 }", ["expct: unknown key", "did you mean expect"]),
        ("[[step]]\nreed = 'rates'", ["exactly one action", "'reed'", "did you mean read"]),
        ("[[step]]\nread = 'rates'\nwait_s = 1", ["has read and wait_s"]),
        ("[[step]]\nname = 'x'", ["has none"]),
        ("title = 'empty'", ["not a session script: has no steps, each under [[step]]; its keys are title"]),
        ("[[stepp]]\nwait_s = 1", ["has no steps, each under [[step]]; did you mean stepp?"]),
        (
            "[[step]]\nread = 'parameter'\nexpect = { value = { vale = 1 } }",  # a field with the name of a condition
            ["expect.value.vale: unknown key; did you mean value"],
        ),
        ("stepp = 1\n[[step]]\nwait_s = 1", ["stepp: unknown key", "did you mean step?"]),
        ("[step]\nwait_s = 1", ["[[step]]"]),
        ("[[step]]\nwait_s = -1", ["at least 0"]),
        ("[[step]]\nwait_s = 'long'", ["wait_s: must be a number"]),
        ("[[step]]\nset_parameter = 'exposur'\nvalue = 1", ["exposur", "did you mean exposure"]),
        ("[[step]]\nset_parameter = 'exposure'\nvalue = 1e9", ["exposure", "outside"]),
        (
            "[[step]]\nread = 'precise_attitude'\nexpect = { mode = 'trackin' }",
            ["trackin", "did you mean tracking"],
        ),
        ("[[step]]\nread = 'precise_attitude'\nexpect = { valid = 1 }", ["'valid' is true or false"]),
        ("[[step]]\nread = 'precise_attitude'\nexpect = { valid = 'true' }", ["'valid' is true or false"]),
        ("[[step]]\nread = 'rates'\nexpect = { rate_x = 'fast' }", ["'rate_x' is a number"]),
        (
            "[[step]]\nread = 'rates'\nexpect = { rate_x = { vale = 1 } }",
            ["expect.rate_x.vale: unknown key", "did you mean value"],
        ),
        ("[[step]]\nread = 'rates'\nexpect = { rate_x = {} }", ["is empty"]),
        ("[[step]]\nread = 'rates'\nexpect = { rate_x = { within = 1 } }", ["need 'value'"]),
        ("[[step]]\nread = 'rates'\nexpect = { rate_x = '$befor' }", ["nothing was captured as '$befor'"]),
        ("[[step]]\nwait_s = 1\nexpect = { rate_x = 1 }", ["needs a step that reads telemetry"]),
        ("[[step]]\nread = 'rates'\nattitude = { within_arcsec = 3 }", ["row with a quaternion"]),
        ("[[step]]\nread = 'quaternion'\nattitude = { within_arcsec = 3 }", ["no truth to compare with"]),
        ("[truth]\nra_deg = 1\n[[step]]\nwait_s = 1", ["truth", "'dec_deg'", "missing"]),
        ("[truth]\nra_deg = 1\ndec_deg = 91\nroll_deg = 0\n[[step]]\nwait_s = 1", ["-90 and 90"]),
        ("[truth]\nquaternion_xyzw = [1, 1, 1, 1]\n[[step]]\nwait_s = 1", ["length is 2"]),
        ("[[step]]\nread = 'rates'\nrefused = 'invalid_idd'", ["invalid_idd", "did you mean invalid_id"]),
        ("[[step]]\ndownload_image = '../x.png'", ["plain file name"]),
        ("[[step]]\ndownload_image = '..'", ["plain file name"]),
        ("[truth]\nfile = '../victim.txt'\n[[step]]\nwait_s = 1", ["truth.file: ", "plain file name"]),
        ("[truth]\nfile = '/etc/victim'\n[[step]]\nwait_s = 1", ["truth.file: ", "plain file name"]),
        ("[[step]]\nwait_s = 1e300", ["step 1", "wait_s: must be at most 1e+06"]),
        ("[defaults]\ntimeout_s = 1e300\n[[step]]\nwait_s = 1", ["timeout_s: must be at most 1e+06"]),
        (
            '[emulator]\nprofile = "a\\u0000b"\n[[step]]\nwait_s = 1',
            ["emulator.profile: has the character NUL"],
        ),
        ('[truth]\nfile = "a\\u0000b"\n[[step]]\nwait_s = 1', ["truth.file: ", "has the character NUL"]),
        ("[[step]]\ndownload_image = 'x.png'\nsize = 'size_100'", ["size_100", "size_1024"]),
        (
            "[[step]]\nsend = 'set_mode'",
            ["send.0: takes raw data, and 'set_mode' is a telecommand: use command"],
        ),
        (
            "[[step]]\nsend = 'identification'",
            ["send.0: takes raw data, and 'identification' is telemetry: use read"],
        ),
        ("[[step]]\nsend = 'zz'", ["send.0: must be bytes in hexadecimal"]),
        ("[[step]]\nsend = ['1F', '123#00']", ["not both"]),
        ("[[step]]\nsend = '123#001'", ["not a CAN frame"]),
        ("[[step]]\nread = 'rates'\nlink = 'i2c'", ["i2c", "can"]),
        ("[[step]]\nrestart = 'gently'", ["gently", "kill"]),
        ("[[step]]\nsample = 'rates'\nevery_s = 1\nfor_s = 1\nat_least = 2", ["at_least: must be at most 1"]),
        ("[[step]\n", ["not valid TOML"]),
        ("[[step]]\nread = 3", ["read: must be a text"]),
        ("[[step]]\nread = 'rates'\nexpect = 3", ["expect: must be a table"]),
        ("[[step]]\nsend = 3", ["send: must be a list"]),
        ("[[step]]\ncommand = 'set_mode'\nwith_hex = 'zz'", ["with_hex: must be bytes in hexadecimal"]),
        ("step = 3", ["'step' must be an array of tables"]),
        ("[emulator]\nseed = 'x'\n[[step]]\nwait_s = 1", ["emulator.seed: must be a whole number"]),
        (
            "[truth]\nquaternion_xyzw = [1, 'x']\n[[step]]\nwait_s = 1",
            ["truth.quaternion_xyzw.1: must be a number"],
        ),
        (
            "[truth]\nquaternion_xyzw = [1, 0]\n[[step]]\nwait_s = 1",
            ["truth.quaternion_xyzw: must have at least 4 items, not 2"],
        ),
        ("[[step]]\ncommand = 'xyzzy'", ["no telecommand named 'xyzzy'; `starhil icd list` lists all"]),
        ("[[step]]\nread = 'xyzzy'", ["no telemetry row named 'xyzzy'; `starhil icd list` lists all"]),
        ("[[step]]\nset_parameter = 'xyzzy'\nvalue = 1", ["'xyzzy'", "`starhil icd list` lists all"]),
        ("[[step]]\nread = 'rates'\nexpect = { xyzzy = 1 }", ["'xyzzy'; known: rate_x, rate_y"]),
        ("[[step]]\nread = 'precise_attitude'\nexpect = { mode = 'xyzzy' }", ["; one of: boot, standby,"]),
        (
            "[[step]]\nread = 'image_frame'\nexpect = { data = 'hello' }",
            ["step 1", "'data' is 128 bytes in hexadecimal, not 'hello'"],
        ),
        (
            "[[step]]\nread = 'hole_map_1'\nexpect = { map = { not = '00 11' } }",
            ["'map' is 16 bytes in hexadecimal, not '00 11'"],
        ),
        (
            "[[step]]\nread = 'hole_map_1'\nexpect = { map = { one_of = ['" + "00" * 16 + "', 5] } }",
            ["'map' is 16 bytes in hexadecimal, not '5'"],
        ),
        ("[[step]]\nread = 'hole_map_1'\nexpect = { map = true }", ["'map' is 16 bytes", "not 'true'"]),
        (
            "[[step]]\nread = 'hole_map_1'\nexpect = { map = { min = 1 } }",
            ["'map' is bytes, and 'min' is for"],
        ),
        (
            "[[step]]\ncommand = 'set_mode'\nwith = { mode = 'standby' }\nwith_hex = '00'",
            ["give the parameters as a table 'with' or as bytes 'with_hex', not both"],
        ),
        (
            "[[step]]\nset_parameter = 'exposure'\nvalue = 'long'\nrefused = 'invalid_parameter'",
            ["'value' must be a number if a refusal is expected"],
        ),
        (
            f"[truth]\nfile = 't.csv'\n{ANGLES}[[step]]\nwait_s = 1",
            ["truth", "give an attitude or a file, not both"],
        ),
        ("[[step]]\nset_parameter = 'exposure'", ["value: missing"]),
        (
            "[[step]]\nread = 'rates'\nexpect = { rate_x = [1, 2] }",
            ["must be a number, true, false or a text, not [1, 2]"],
        ),
        (
            f"[truth]\n{ANGLES}[[step]]\nread = 'quaternion'\nattitude = {{}}",
            ["needs a tolerance: within_arcsec"],
        ),
    ],
)
def test_an_error_is_reported_with_file_step_name_and_near_matches(load, text, words):
    message = refusal(load, text)
    for word in words:
        assert word in message


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


def test_every_wrong_field_of_a_step_is_reported(load):
    with pytest.raises(ScriptError) as caught:
        load(
            "[[step]]\nread = 'rates'\nexpect = { rat_x = 1, rate_y = 'fast' }\ncapture = { first = 'rate_zz' }"
        )
    lines = caught.value.args
    assert len(lines) == 3
    for word in ("'rat_x'", "'rate_y' is a number", "'rate_zz'"):
        assert any(word in line for line in lines)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (  # a value that is known only when the step runs hides nothing
            "command = 'set_parameter'\nwith = { parameter = '$now_s' }",
            ["with: row 'set_parameter' needs the field 'value', which is missing"],
        ),
        (
            "command = 'set_parameter'\nwith = { parameter = '$now_s', valu = 5 }",
            ["'set_parameter' has no field 'valu'; did you mean value", "needs the field 'value'"],
        ),
        (
            "command = 'set_unix_time'\nwith = { seconds = 'x', milliseconds = 100000 }",
            ["with: set_unix_time.seconds: 'x' is not a number", "milliseconds: 100000 is outside"],
        ),
        (
            "command = 'set_mode'\nwith = { mode = '$mod' }\ntimeout_s = 'x'\nexpect = { a = 1 }\nrefusd = 'busy'",
            ["with.mode: nothing was captured", "timeout_s: must be a number", "'expect' needs a step", "refusd: "],
        ),
        (
            "read = 'rates'\nwithin_s = 'x'\nexpect = { rat_x = 1, rate_y = { mn = 1 } }\ncapture = { a = 'rate_q' }",
            ["within_s: must be a number", "mn: unknown key", "capture: row 'rates' has no field 'rate_q'"],
        ),
        ("sample = { telemetry = 'rates', every_s = -1, fr_s = 3 }", ["every_s: ", "for_s: ", "fr_s: "]),
        ("sample = 'ratse'\nevery_s = 1\nfor_s = 1\nfle = 'x'", ["no telemetry row named 'ratse'", "fle: "]),
        ("set_parameter = 'exposure'\nvalu = 5\nlink = 'cn'", ["value: missing", "valu: ", "link: "]),
    ],
)  # fmt: skip
def test_a_step_with_several_errors_reports_each_once(load, step, message):
    with pytest.raises(ScriptError) as caught:
        load(f"[[step]]\n{step}")
    assert len(caught.value.args) == len(message)
    for text in message:
        assert any(text in problem for problem in caught.value.args)


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
