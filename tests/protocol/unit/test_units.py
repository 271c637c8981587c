"""Definitions of other units: byte order, groups, maps, classes, bindings, and errors in definitions."""

from pathlib import Path

import pytest

from starhil.protocol.errors import IcdError
from starhil.protocol.files.bundled import SKELETON, bundled_units
from starhil.protocol.icd import FieldError
from starhil.protocol.icd.device_model import device_model
from starhil.protocol.plugin import quantity
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine, exchanges
from starhil.protocol.units_of_measure import factor

HEAD = '[unit]\nname = "x"\nversion = "1"\ndoc = "d"\n'
BIG = HEAD + '[conventions]\nbyte_order = "big"\n'


def telemetry(fields: str, name: str = "row", number: int = 1, more: str = "") -> str:
    """Text of a telemetry row."""
    return f'[[telemetry]]\nid = {number}\nname = "{name}"\ndoc = "d"\nprovenance = "ours"\n{more}\nfields = [{fields}]\n'


def telecommand(fields: str, action: str = "nothing", number: int = 9, more: str = "") -> str:
    """Text of a telecommand row."""
    return (
        f'[[telecommand]]\nid = {number}\nname = "command"\ndoc = "d"\nprovenance = "ours"\naction = "{action}"\n'
        f"{more}\nfields = [{fields}]\n"
    )


@pytest.fixture
def unit(tmp_path: Path):
    """Load a definition from its text."""

    def load(text: str):
        file = tmp_path / "unit.toml"
        file.write_text(text, encoding="utf-8")
        return load_unit(tmp_path)

    return load


CODED = [
    ("big-endian integer", BIG, '{ name = "a", type = "u32" }', {"a": 0x01020304}, "01 02 03 04"),
    ("big-endian float", BIG, '{ name = "a", type = "f32" }', {"a": 1.0}, "3F 80 00 00"),
    ("big-endian double", BIG, '{ name = "a", type = "f64" }', {"a": 1.0}, "3F F0 00 00 00 00 00 00"),
    ("one field in the other order", BIG, '{ name = "a", type = "u16" }, { name = "b", type = "u16", order = "little" }', {"a": 1, "b": 1}, "00 01 01 00"),
    ("bits, big-endian", BIG, '{ type = "bits16", bits = [{ name = "a", width = 4 }, { width = 11 }, { name = "b" }] }', {"a": 5, "b": True}, "80 05"),
    ("negative scale", HEAD, '{ name = "a", type = "i16", scale = -0.01 }', {"a": 1.5}, "6A FF"),
    ("negative scale at its limit", HEAD, '{ name = "a", type = "i8", scale = -1, min = -100, max = 50 }', {"a": 50}, "CE"),
    ("interleaved group", HEAD, '{ repeat = { count = 2, fields = [{ name = "x", type = "u8" }, { name = "y", type = "u16" }] } }',
     {"x_1": 1, "y_1": 2, "x_2": 3, "y_2": 4}, "01 02 00 03 04 00"),
    ("constant", HEAD, '{ name = "a", type = "u16", const = 0xBEEF }', {"a": 0xBEEF}, "EF BE"),
    ("map", HEAD, '{ name = "a", type = "u8", map = { "7" = "on", "0x10" = "off" } }', {"a": "off"}, "10"),
    ("fields in a text", HEAD, '"i16 mag{0,1}_{x,y} uT 0.01", "u8 -", "u8 css{8..10}"',
     {"mag0_x": 0.01, "mag0_y": 0.02, "mag1_x": 0.03, "mag1_y": 0.04, "css8": 5, "css9": 6, "css10": 7}, "01 00 02 00 03 00 04 00 00 05 06 07"),
    ("bits in a text", HEAD, '"bits a:4 b{0..2} - c:2", "bytes d 2", "text e 3"',
     {"a": 5, "b0": True, "b1": False, "b2": True, "c": 3, "d": b"12", "e": "xy"}, "55 03 31 32 78 79 00"),
    ("group of texts from 0 on", HEAD, '{ repeat = { count = 2, first = 0, fields = ["u8 {x,y}"] } }',
     {"x_0": 1, "y_0": 2, "x_1": 3, "y_1": 4}, "01 02 03 04"),
    ("filler", HEAD, '{ name = "a", type = "u8" }, { type = "u32" }, { name = "b", type = "u8" }', {"a": 1, "b": 2}, "01 00 00 00 00 02"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("head", "fields", "values", "wire"), [case[1:] for case in CODED], ids=[case[0] for case in CODED]
)
def test_fields_have_the_bytes_of_their_definition(unit, head, fields, values, wire):
    row = unit(head + telemetry(fields)).telemetry["row"]
    assert row.encode(values) == bytes.fromhex(wire)
    assert row.decode(bytes.fromhex(wire)) == pytest.approx(values)


def test_a_negative_scale_saturates_at_the_right_end(unit):
    row = unit(HEAD + telemetry('{ name = "a", type = "i8", scale = -0.5 }')).telemetry["row"]
    assert row.encode({"a": 1000.0}, saturate=True) == b"\x80"
    assert row.encode({"a": -1000.0}, saturate=True) == b"\x7f"
    assert row.named_fields["a"].clips(64.5)
    assert not row.named_fields["a"].clips(64.2)


def test_a_telecommand_with_another_constant_is_rejected(unit):
    row = unit(HEAD + telecommand('{ name = "magic", type = "u16", const = 0xBEEF }')).telecommands["command"]
    assert row.encode() == b"\xef\xbe"
    with pytest.raises(FieldError, match=r"command\.magic"):
        row.decode(b"\xee\xbe")


CLASSES = """
[[class]]
name = "get"
kind = "telemetry"
code = 1
[[class]]
name = "watch"
kind = "telemetry"
code = 2
"""


def test_rows_of_two_classes_may_have_one_id(unit):
    a, b = '{ name = "a", type = "u8" }', '{ name = "b", type = "u16" }'
    icd = unit(
        HEAD + CLASSES + telemetry(a, "one", 5, 'class = "get"') + telemetry(b, "two", 5, 'class = "watch"')
    )
    assert icd.row(5, "get").name == "one"
    assert icd.telemetry_row(5).name == "one"
    assert icd.telemetry_row(5, "watch").name == "two"
    assert icd.request(icd.telemetry["two"]).message_class == "watch"


def test_a_flag_of_a_map_may_have_a_default(unit):
    row = unit(
        HEAD
        + telemetry('{ name = "a", type = "u8", map = { 3 = true, 5 = false }, default = false }', "one", 5)
    ).telemetry["one"]
    assert row.encode() == b"\5"
    assert row.decode(b"\3") == {"a": True}


def test_a_parameter_defaults_to_the_device_s(unit):
    icd = unit(HEAD + '[[parameter]]\nid = 7\nname = "exposure"\nmax = 1000\ndefault = 200\n')
    exposure = icd.parameters["exposure"]
    assert (exposure.id, exposure.unit, exposure.minimum, exposure.maximum, exposure.default) == (
        7,
        "ms",
        1,
        1000,
        200,
    )
    assert list(icd.parameters) == ["exposure"]
    assert icd.device_parameters["exposure"] is exposure
    assert set(icd.device_parameters) == set(device_model().parameters)


INVALID = [
    ("a field that sets no parameter", telecommand('{ name = "exposure", type = "u16", unit = "ms" }', "set_parameters"), "command: field exposure: sets nothing; bind it to a parameter"),
    ("unknown quantity", telemetry('{ name = "a", type = "f32", value = "atitude.w" }'), "row: field a: no quantity named 'atitude.w'; did you mean attitude.w"),
    ("number beyond the last", telemetry('{ name = "a", type = "f32", unit = "px", value = "stars[99].x" }'), r"no quantity named 'stars\[99\].x'"),
    ("no number", telemetry('{ name = "a", type = "f32", unit = "px", value = "stars[n].x" }'), r"\[n\] is only allowed with count, repeat or last_id"),
    ("unit of measure", telemetry('{ name = "a", type = "f32", unit = "m", value = "rate.x" }'), "unit 'm', but quantity rate.x is in 'rad/s'; use one of 'rad/s', 'deg/s'"),
    ("names without numbers", telemetry('{ name = "a", type = "u8", value = "mode" }'), "quantity mode has named values: boot, standby.*assign numbers"),
    ("name without a number", telemetry('{ name = "a", type = "u8", value = "mode", map = { "0" = "standby" } }'), "quantity mode has no number for boot, lost_in_space, tracking, error"),
    ("float in bytes", telemetry('{ name = "a", type = "bytes", size = 4, value = "attitude.w" }'), "of type float, which a field of kind bytes cannot hold"),
    ("two sources", telemetry('{ name = "a", type = "f32", value = "attitude.w", const = 1 }'), "has value and const; keep one"),
    ("value without a name", telemetry('{ type = "f32", value = "attitude.w" }'), "needs a name"),
    ("value in a telecommand", telecommand('{ name = "a", type = "f32", value = "attitude.w" }'), "`value` is for telemetry"),
    ("argument in telemetry", telemetry('{ name = "a", type = "u8", argument = "mode" }'), "`argument` is for telecommands"),
    ("unknown action", telecommand("", "reboot"), "command: no action named 'reboot'"),
    ("unknown argument", telecommand('{ name = "a", type = "u32", unit = "s", argument = "second" }', "set_clock"), "action set_clock has no argument 'second'; did you mean seconds"),
    ("missing argument", telecommand("", "set_mode"), "action set_mode needs the argument mode"),
    ("member of an argument", telecommand('{ name = "a", type = "u8", argument = "mode", map = { "1" = "trackin" } }', "set_mode"), "'trackin' is not a value of argument mode; did you mean tracking"),
    ("member of an argument unlike any", telecommand('{ name = "a", type = "u8", argument = "mode", map = { "1" = "acquire" } }', "set_mode"), "'acquire' is not a value of argument mode; known: .*lost_in_space, standby, tracking"),
    ("unknown answer", telecommand("", more='answer = ["ack"]'), "unit.toml: telecommand command: answer 'ack': must be echo, reply or row:NAME"),
    ("field of a group without type", telemetry('{ repeat = { count = 2, fields = [{ name = "x" }] } }'), "telemetry row: field x: needs `type`"),
    ("answer with no such row", telecommand("", more='answer = ["row:stat"]') + telemetry('{ name = "a", type = "u8" }', "status"), "telecommand command: answer 'row:stat': no telemetry row named 'stat'; did you mean status"),
    ("unknown answer of telemetry", telemetry("", more='answer = ["ecko"]'), "telemetry row: answer 'ecko': must be echo, reply or row:NAME"),
    ("echo on a line that has none", '[link.serial]\nframing = { kind = "cubespace" }\n' + telecommand("", more='answer = ["echo", "reply"]'), "telecommand command: answer 'echo': link.serial with framing cubespace has no echoes"),
    ("echo on CAN", '[link.can]\nkind = "cubespace"\n' + telemetry("", more='answer = ["echo", "reply"]').replace("id = 1\n", "id = 200\n"), "telemetry row: answer 'echo': link.can has no echoes"),
    ("unknown key", telemetry('{ name = "a", type = "u8", scal = 2 }'), r"row\.fields\.a\.scal: unknown key; did you mean scale"),
    ("unknown key of a check", '[link.serial]\nframing = { kind = "slip" }\ncheck = { kind = "sum", colour = 1 }\n' + telemetry(""), r"link\.serial\.check\.colour: unknown key"),
    ("unknown key of a framing", '[link.serial]\nframing = { kind = "fixed", colour = 1 }\n' + telemetry(""), r"link\.serial\.framing\.colour: unknown key"),
    ("unknown key of a convention", '[conventions]\nquaternions = "attitude"\n', r"conventions\.quaternions: unknown key; did you mean quaternion"),
    ("left-handed axes", '[conventions]\naxes = ["+x", "-y", "+z"]\n', "is not a right-handed frame"),
    ("unknown epoch", '[conventions]\nepoch = "y2k"\n', "'y2k' is not one of unix, gps, j2000, midnight"),
    ("error that is never sent", "[errors]\ncrc = 4\n", "errors.crc: never sent"),
    ("unknown error", "[errors]\nbad_id = 1\n", "errors.bad_id: no such error; did you mean invalid_id"),
    ("unknown class", CLASSES + telemetry("", more='class = "gets"'), "no class named 'gets'; did you mean get"),
    ("class left out", CLASSES + telemetry(""), "needs `class`, one of get, watch"),
    ("class of the other kind", CLASSES + telecommand("", more='class = "get"'), "class get is for telemetry, not for telecommand"),
    ("code twice", CLASSES.replace("code = 2", "code = 1"), "class watch: code 1 is already used by get"),
    ("id twice", telemetry("", "one") + telemetry("", "two"), "two: ID 1 is already used by one"),
    ("id that the link cannot carry", telemetry("", number=256), "ID 256 is above 255"),
    ("unknown parameter", '[[parameter]]\nid = 1\nname = "exposur"\n', "the device has no parameter with this name; did you mean exposure"),
    ("map that is no number", telemetry('{ name = "a", type = "u8", map = { one = "on" } }'), "'one' is not a number on the wire"),
    ("text without a name", telemetry('"u16"'), "row: field 'u16': needs a type and a name"),
    ("type in a text", telemetry('"u17 a"'), "row: field 'u17 a': type: must be one of 'u8'"),
    ("scale in a text", telemetry('"u16 a s 1,5"'), "field 'u16 a s 1,5': scale: '1,5' is not a number"),
    ("too much in a text", telemetry('"bytes a 5 s"'), "field 'bytes a 5 s': only size may follow the name"),
    ("bits across bytes in a text", telemetry('"bits a:5 b:4"'), "field 'bits a:5 b:4': b: 4 bits do not fit into the remaining 3 bits of the byte"),
    ("no end of fields in a text", telemetry('"u8 a{0..9999999999}"'), "must be 1 to 256 fields"),
    ("readback of another name", telecommand("", more="readback = 1"), "command: the name of a telecommand with a readback must begin with set_"),
    ("readback of telemetry", telemetry("", more="readback = 1"), "row: only telecommands have a readback"),
    ("no provenance", telemetry("").replace('provenance = "ours"', ""), "row: needs `provenance`, here or in \\[unit\\]"),
    ("no plugin", 'plugin = "unit.py"\n', "no such plugin"),
    ("short data without a plugin", telecommand('"u16 a"', more="min_size = 1"), "command: `min_size` needs a telecommand with an action of the unit's plugin"),
    ("short data of telemetry", telemetry('"u16 a"', more="min_size = 1"), "row: `min_size` needs a telecommand"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"), [case[1:] for case in INVALID], ids=[case[0] for case in INVALID]
)
def test_an_error_is_named_with_file_row_field_and_remedy(tmp_path, text, message):
    file = tmp_path / "unit.toml"
    file.write_text(HEAD + text, encoding="utf-8")
    with pytest.raises(IcdError, match=message) as caught:
        load_unit(tmp_path)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_all_errors_are_listed(tmp_path):
    wrong = '{ name = "a", type = "f32", value = "atitude.w" }'
    (tmp_path / "a.toml").write_text(
        HEAD + telemetry(wrong, "one") + telecommand("", "reboot"), encoding="utf-8"
    )
    (tmp_path / "b.toml").write_text(telemetry(wrong, "two", 2), encoding="utf-8")
    problems = examine(tmp_path)[1]
    assert len(problems) == 3
    assert [text for text in problems if "b.toml: telemetry two: field a" in text]
    with pytest.raises(IcdError) as caught:
        load_unit(tmp_path)
    assert list(caught.value.args) == problems


def test_unbound_rows_cannot_be_emulated(unit, tmp_path):
    icd = unit(
        HEAD + telemetry('{ name = "a", type = "u8" }') + telecommand("").replace('action = "nothing"\n', "")
    )
    assert icd.telemetry["row"].size == 1  # but exported and spoken by a client
    command, row = examine(tmp_path)[1]
    (file,) = tmp_path.glob("*.toml")
    assert command.startswith(f"{file}: telecommand command: no `action`")
    assert row.startswith(f"{file}: telemetry row: field a: no `value`")


def test_a_row_may_send_zeros_on_purpose(unit, tmp_path):
    icd = unit(
        HEAD + telemetry('"u8 {a,b}", { name = "c", type = "u8", const = 7 }', more='unbound = "zeros"')
    )
    assert examine(tmp_path)[1] == []
    assert icd.telemetry["row"].encode() == b"\0\0\7"


def test_a_readback_reports_the_fields_of_its_telecommand(unit):
    head = HEAD + 'provenance = "confirmed"\nsource = "s"\n'
    text = telecommand('"u8 a", "f32 b deg"', more="readback = 8").replace("command", "set_thing")
    icd = unit(head + text.replace("[[teleset_thing]]", "[[telecommand]]").replace('provenance = "ours"', ""))
    row = icd.telemetry["thing"]
    assert (row.id, row.provenance, row.source) == (8, "confirmed", "s")
    assert {name: field.telecommand for name, field in row.named_fields.items()} == dict.fromkeys(
        "ab", "set_thing"
    )


GENERATION_2 = {
    "telecommand": "1:1 2:8 5:0 7:0 40:4 42:5 43:2 46:13 47:12 48:12 49:33 50:13 51:1 52:1 54:12 55:6 56:20 57:1 58:3 59:62 60:64 61:42 "
    "62:98 63:24 64:4 65:104 66:24 67:40 68:64 69:8 70:20 71:2 72:1 73:277 74:16 76:12 77:1 78:258 79:2 80:141 99:1 111:120 112:17 "
    "114:6 115:11 116:2 117:23 120:20 122:1",
    "telemetry": "128:8 129:70 131:8 133:8 134:6 135:32 136:22 137:3 138:4 139:16 140:21 149:4 150:5 153:82 154:194 155:13 156:12 157:12 "
    "158:8 159:36 160:28 161:13 162:1 163:1 164:107 165:34 166:18 167:30 168:44 169:49 170:33 171:57 172:115 173:71 174:85 175:41 "
    "176:21 177:21 178:33 179:21 180:21 181:12 182:6 183:20 184:1 185:3 186:62 187:64 188:13 189:42 190:98 191:24 192:4 193:104 "
    "194:24 195:40 196:64 197:8 198:20 199:2 200:1 201:277 202:16 203:19 204:33 205:25 206:15 207:57 208:81 209:33 210:71 211:36 "
    "212:52 213:134 214:26 215:12 216:40 217:20 218:32 219:258 220:4 221:1 225:44 226:53 227:10 228:17 229:1 230:24 231:14 232:15 "
    "233:2 234:19 235:41 236:38 237:10 238:72 239:120 240:65 241:141 242:105 243:26 244:64",
}
"""Identifiers and bytes of all rows in the public driver: COMMAND_SPECS, ADDITIONAL_COMMAND_SPECS and TELEMETRY_SPECS."""


def test_generation_2_has_every_row_of_its_public_source():
    icd = load_unit("cubestar-gen2")
    for kind, rows in GENERATION_2.items():
        public = {(int(row), int(size)) for row, size in (item.split(":") for item in rows.split())}
        assert {(row.id, row.size) for row in icd.rows if row.kind == kind} == public


PLACES = {
    ("set_simulated_sensors", "str1_measured_2_z"): (1192, 16), ("set_simulated_sensors", "gnss_new"): (2206, 1),
    ("set_mounting", "str0_alpha"): (592, 16), ("set_mounting", "ext_gyr1_axis3"): (824, 8),
    ("set_estimator_configuration", "triad_2"): (312, 4), ("event_log_transfer", "ext_sensor1"): (156, 1),
    ("auriga_raw", "rate_1_1"): (1304, 32), ("auriga_health", "last_error_1"): (640, 8), ("pst3s_raw", "saa_mode_1"): (1028, 4),
    ("hil", "fmc_stage"): (852, 4), ("controller", "mtq0_dipole"): (688, 16), ("models", "orbit_source"): (676, 2),
    ("nss_wheel_raw", "rwl2_high_command_error"): (409, 1), ("litef_raw", "axis2_no_go_1"): (287, 1),
    ("port_diagnostics", "sensor_serial_error_3"): (155, 1), ("node_states", "str0"): (56, 4), ("file_information", "owner_program"): (832, 8),
}  # fmt: skip
"""Bit offset and bits of some fields there, one from each part of the longest rows."""


@pytest.mark.parametrize(("row", "name"), PLACES)
def test_fields_of_generation_2_are_where_the_public_driver_reads_them(row, name):
    icd = load_unit("cubestar-gen2")
    field = (icd.telemetry if row in icd.telemetry else icd.telecommands)[row].named_fields[name]
    assert (8 * field.offset + field.shift, field.width or 8 * field.size) == PLACES[row, name]


def test_units_of_measure_are_converted_within_a_kind():
    assert factor("s", "us") == 1e6
    assert factor("rad/s", "deg/s") == pytest.approx(57.29577951308232)
    assert factor("arcsec", "rad") == pytest.approx(4.84813681109536e-6)
    assert factor("px", "px") == 1.0
    assert factor("s", "deg") is None


def test_a_plugin_that_fails_is_reported_in_one_line(tmp_path):
    (tmp_path / "unit.toml").write_text(HEAD + 'plugin = "unit.py"\n', encoding="utf-8")
    (tmp_path / "unit.py").write_text("1 / 0\n", encoding="utf-8")
    with pytest.raises(IcdError, match=r"the plugin fails in unit\.py: ZeroDivisionError"):
        load_unit(tmp_path)


def test_a_quantity_outside_of_a_plugin_is_rejected():
    with pytest.raises(IcdError, match="only while its unit is being loaded"):
        quantity("a")(len)


def test_the_skeleton_can_be_emulated(tmp_path):
    (tmp_path / "unit.toml").write_text(SKELETON.read_text(encoding="utf-8"), encoding="utf-8")
    assert examine(tmp_path)[1] == []
    examples = list(exchanges(load_unit(tmp_path)))
    assert {item.row.name for item in examples} == {
        "set_time",
        "set_mode",
        "set_exposure",
        "attitude",
        "status",
        "stars",
    }
    assert examples[0].request[0].startswith("C0 10 01 01")


@pytest.mark.parametrize("name", [name for name in bundled_units() if name != "cubestar"])
def test_every_row_of_a_foreign_unit_names_its_public_source(name):
    rows = list(load_unit(name).rows)
    assert {row.provenance for row in rows} <= {"confirmed", "copy", "ours"}
    assert all(row.source for row in rows if row.provenance == "confirmed")
    assert all(row.source.startswith("doclecture.net/1-359") for row in rows if row.provenance == "copy")
    assert not any(row.source for row in rows if row.provenance == "ours")


@pytest.mark.parametrize("name", bundled_units())
def test_every_shipped_unit_can_be_emulated(name):
    assert examine(name)[1] == []
    assert all(item.request for item in exchanges(load_unit(name)))
