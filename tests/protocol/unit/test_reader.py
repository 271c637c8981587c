"""The interface definition: loaded as a whole, refused by name, and its codecs against bytes worked out by hand."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.errors import IcdError
from starhil.protocol.files.bundled import find_unit
from starhil.protocol.icd import FieldError, UnknownNameError
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.values import LengthError, MessageError, Value, to_f32
from starhil.protocol.messages import ErrorCode
from starhil.protocol.unit import load_unit

pytestmark = pytest.mark.lowest("pydantic")

ICD = load_unit()
ROWS = list(ICD.rows)

# identifier -> bytes of data, as public flight software has them
PUBLISHED_SIZES = {
    128: 8, 129: 6, 140: 6, 144: 6, 187: 6, 188: 6, 189: 6, 202: 53, 211: 54, 212: 6, 213: 6, 214: 6,
    229: 6, 230: 6, 231: 6, 233: 2, 240: 4, 242: 5, 247: 16, 254: 16, 192: 128, 193: 3,
    1: 1, 2: 6, 37: 53, 80: 2, 64: 3, 65: 2, 112: 8, 119: 2, 120: 16, 127: 16,
}  # fmt: skip


@pytest.mark.parametrize(("identifier", "size"), PUBLISHED_SIZES.items())
def test_published_rows_have_their_published_sizes(identifier: int, size: int) -> None:
    row = ICD.row(identifier)
    assert row is not None
    assert row.size == size


def test_the_escape_byte_is_not_an_id() -> None:
    assert ICD.row(0x1F) is None


def test_own_rows_are_marked_and_published_rows_name_their_source() -> None:
    for row in ROWS:
        assert row.doc
        assert (row.provenance == "ours") == (row.source == ""), row.name
        for field in row.named_fields.values():
            assert field.doc, f"{row.name}.{field.name}"


# -- bytes worked out by hand from the public layouts ------------------------------------------------------------------

GOLDEN = [
    ("identification",
     {"node_type": 8, "interface_version": 1, "firmware_major": 2, "firmware_minor": 3, "runtime_s": 0x0405, "runtime_ms": 0x0607},
     "08 01 02 03 05 04 07 06"),
    ("boot_status",
     {"reset_cause": "watchdog", "boot_cause": "command", "boot_count": 0x1234, "program_index": 1, "firmware_major": 2, "firmware_minor": 3},
     "22 34 12 01 02 03"),
    ("unix_time", {"seconds": 0x12345678, "milliseconds": 999}, "78 56 34 12 E7 03"),
    ("communication_status",
     {"telecommand_count": 1, "telemetry_count": 2, "uart_protocol_error": True, "can_telecommand_error": True},
     "01 00 02 00 22 00"),
    ("acknowledge", {"last_telecommand": 37, "processed": True, "error": "invalid_parameter", "parameter_index": 3}, "25 01 03 03"),
    ("quaternion", {"q_x": 0.5, "q_y": -0.5, "q_z": 1.0}, "88 13 78 EC 10 27"),
    ("rates", {"rate_x": 0.3, "rate_y": -0.0001, "rate_z": -3.2768}, "B8 0B FF FF 00 80"),
    ("star_performance_2",
     {"capture_ok": True, "attitude_ok": True, "communication_error": True, "sample_period": 1000, "confidence_1": 100},
     "89 E8 03 64 00 00"),
    ("star_1_raw", {"star_1_catalogue": 27989, "star_1_x": -468.0, "star_1_y": 0.02}, "55 6D 98 A4 01 00"),
    ("image_status", {"percent": 50, "status": "waiting_frame"}, "32 02"),
    ("image_frame_info", {"frame": 0x1FFF, "checksum": 0x1F}, "FF 1F 1F"),
    ("reset", {}, "5A"),
    ("set_unix_time", {"seconds": 1, "milliseconds": 2}, "01 00 00 00 02 00"),
    ("load_file_block", {"file_type": "bmp", "offset": 20480, "length": 20480}, "04 00 00 50 00 00 00 50"),
    ("save_image", {"camera": "star", "image_size": "size_64"}, "02 04"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "values", "expected"), GOLDEN, ids=[name for name, _, _ in GOLDEN])
def test_bytes_worked_out_by_hand(name: str, values: dict[str, Value], expected: str) -> None:
    row = (ICD.telemetry if name in ICD.telemetry else ICD.telecommands)[name]
    data = bytes.fromhex(expected)
    assert row.encode(values) == data
    decoded = row.decode(data)
    for key, value in values.items():
        assert decoded[key] == pytest.approx(value) if isinstance(value, float) else decoded[key] == value


def test_star_configuration_offsets_are_the_published_ones() -> None:
    offsets = {
        "mounting_alpha": 0, "mounting_beta": 2, "mounting_gamma": 4, "exposure": 6, "analog_gain": 8,
        "detection_threshold": 10, "star_threshold": 11, "max_stars_matched": 12, "detection_timeout": 13,
        "max_star_pixels": 15, "min_star_pixels": 16, "error_margin": 17, "delay_time": 18, "centroid_x": 20,
        "centroid_y": 24, "focal_length": 28, "k1": 32, "k2": 36, "p1": 40, "p2": 44, "window_width": 48,
        "tracking_margin": 49, "validation_margin": 50, "tracking_enable": 51, "prediction_enable": 51, "search_width": 52,
    }  # fmt: skip
    row = ICD.telecommands["set_star_config"]
    assert {name: field.offset for name, field in row.named_fields.items()} == offsets
    assert [field.name for field in ICD.telemetry["star_config"].fields] == [
        field.name for field in row.fields
    ]


def test_search_width_is_sent_times_five() -> None:
    row = ICD.telecommands["set_star_config"]
    data = row.encode({**_defaults_of_star_config(), "search_width": 10.0})
    assert data[52] == 50


def test_combined_telemetry_is_its_parts_one_after_another() -> None:
    parts = [
        "star_performance_1", "star_performance_2", "star_magnitudes", "star_1_raw", "star_2_raw", "star_3_raw",
        "star_timing", "rates", "quaternion",
    ]  # fmt: skip
    values: dict[str, Value] = {
        "stars_detected": 9,
        "sample_period": 777,
        "magnitude_2": 3.5,
        "star_3_x": 11.0,
        "rate_z": 0.1,
        "q_y": 0.25,
    }
    pieces = []
    for name in parts:
        row = ICD.telemetry[name]
        pieces.append(row.encode({key: value for key, value in values.items() if key in row.named_fields}))
    assert ICD.telemetry["star_tracker"].encode(values) == b"".join(pieces)


def test_precise_attitude_by_an_independent_reader() -> None:
    values: dict[str, Value] = {
        "time_of_exposure": 1.79e9 + 0.125, "frame_counter": 7, "q_x": 0.1, "q_y": -0.2, "q_z": 0.3, "q_w": 0.9, "valid": True,
        "tracking": True, "reason": "ok", "mode": "tracking", "stars_detected": 40, "stars_matched": 31, "uncertainty_cross": 6.5,
        "uncertainty_roll": 30.0, "rate_x": 0.3, "rate_y": 0.0, "rate_z": -0.1, "latency": 123.4,
    }  # fmt: skip
    read = struct.unpack("<dI4f6B2f3fH", ICD.telemetry["precise_attitude"].encode(values))
    assert read[:2] == (1.79e9 + 0.125, 7)
    assert read[2:6] == pytest.approx((0.1, -0.2, 0.3, 0.9))
    assert read[6:12] == (0b1001, 0, 3, 40, 31, 0)
    assert read[12:] == pytest.approx((6.5, 30.0, 0.3, 0.0, -0.1, 1234))


# -- every row, there and back -----------------------------------------------------------------------------------------


def _values_of(field: Field) -> st.SearchStrategy[Value]:
    """Values that a field can carry exactly."""
    match field.kind:
        case "flag":
            return st.booleans() if field.const is None else st.just(bool(field.const))
        case "enum":
            assert field.enum is not None
            return st.sampled_from(sorted(field.enum.values))
        case "bytes":
            return st.binary(min_size=field.size, max_size=field.size)
        case "float":
            low, high = field.physical_limits
            if field.slot.type == "f32":
                finite = st.floats(width=32, allow_nan=False, allow_infinity=False)
                return finite.map(lambda value: to_f32(min(max(value, low), high)))
            return st.floats(max(low, -1e300), min(high, 1e300))
        case _:
            low_raw, high_raw = field.raw_limits
            return st.integers(low_raw, high_raw).map(field.to_physical)


def _row_values() -> st.SearchStrategy[tuple[Row, dict[str, Value]]]:
    return st.sampled_from(ROWS).flatmap(
        lambda row: st.tuples(
            st.just(row), st.fixed_dictionaries({name: _values_of(f) for name, f in row.named_fields.items()})
        )
    )


@pytest.mark.long
@settings(max_examples=100, deadline=None, derandomize=True)
@given(_row_values())
def test_every_row_decodes_the_values_it_encoded(case: tuple[Row, dict[str, Value]]) -> None:
    row, values = case
    data = row.encode(values)
    assert len(data) == row.size
    assert row.decode(data, check=True) == values


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.sampled_from(ROWS), st.data())
def test_any_bytes_of_the_right_length_decode_and_never_raise_but_for_limits(
    row: Row, data: st.DataObject
) -> None:
    raw = data.draw(st.binary(min_size=row.size, max_size=row.size))
    decoded = row.decode(raw, check=False)
    assert decoded.keys() == row.named_fields.keys()
    refusal = _refusal(row, raw)
    if refusal is not None:
        assert str(refusal).startswith(f"{row.name}.{list(row.named_fields)[refusal.index]}: ")


def _refusal(row: Row, raw: bytes) -> FieldError | None:
    try:
        row.decode(raw, check=True)
    except FieldError as error:
        return error
    return None


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.id}-{row.name}")
def test_every_row_has_an_example_that_it_accepts(row: Row) -> None:
    assert row.decode(row.encode(row.example()), check=True).keys() == row.named_fields.keys()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.id}-{row.name}")
@pytest.mark.parametrize("extra", [-1, 1])
def test_a_wrong_length_is_refused_with_the_published_code(row: Row, extra: int) -> None:
    size = row.size + extra
    if size < 0:
        return
    with pytest.raises(LengthError, match=row.name) as caught:
        row.decode(bytes(size))
    assert caught.value.code is ErrorCode.INVALID_LENGTH


# -- what is refused ---------------------------------------------------------------------------------------------------


def _defaults_of_star_config() -> dict[str, Value]:
    row = ICD.telecommands["set_star_config"]
    return {
        name: ICD.parameters[field.parameter].default
        for name, field in row.named_fields.items()
        if field.parameter
    }


def test_defaults_of_the_parameters_make_a_valid_star_configuration() -> None:
    row = ICD.telecommands["set_star_config"]
    values = row.decode(row.encode(_defaults_of_star_config()))
    for name, field in row.named_fields.items():
        assert field.parameter is not None
        parameter = ICD.parameters[field.parameter]
        assert parameter.check(values[name]) == pytest.approx(parameter.default), name


REFUSED: list[tuple[str, dict[str, Value], str]] = [
    ("reset", {"magic": 0x5B}, "reset.magic: 91 is outside 90 to 90"),
    ("set_unix_time", {"seconds": 1, "milliseconds": 1000}, "milliseconds: 1000 is outside 0 to 999 ms"),
    ("set_unix_time", {"seconds": -1}, "seconds: -1 is outside"),
    ("set_unix_time", {"seconds": 1.5}, "not a whole number"),
    ("set_unix_time", {}, "set_unix_time.seconds: missing value"),
    ("set_mode", {"mode": "error"}, "not one of standby"),
    ("set_mode", {"mode": "stanby"}, r"'stanby' is not one of standby \(1\).*; did you mean standby\?$"),
    ("set_mode", {"mode": 9}, "not one of standby"),
    ("set_mode", {"mood": "standby"}, "set_mode.mood: no such field"),
    ("set_update_rate", {"rate": 0.0}, "rate: 0.0 is outside 0.01 to 100 Hz"),
    ("set_update_rate", {"rate": "fast"}, "is not a number"),
    ("set_update_rate", {"rate": True}, "is not a number"),
    ("set_hole_map_3", {"map": b"short"}, "5 bytes, must be 16"),
    ("set_hole_map_3", {"map": "text of 16 chars"}, "is not bytes"),
    ("start_burst", {"ignore_hole_map": 2}, "not a flag"),
]


@pytest.mark.parametrize(("name", "values", "text"), REFUSED)
def test_values_against_the_definition_are_rejected_by_row_and_field(
    name: str, values: dict[str, Value], text: str
) -> None:
    with pytest.raises(FieldError, match=text) as caught:
        ICD.telecommands[name].encode(values)
    assert caught.value.code is ErrorCode.INVALID_PARAMETER


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_telecommand_with_a_non_finite_number_is_rejected(value: float) -> None:
    data = struct.pack("<Bd", 1, value)
    with pytest.raises(FieldError, match=r"set_parameter\.value"):
        ICD.telecommands["set_parameter"].decode(data)
    with pytest.raises(FieldError):
        ICD.telecommands["set_update_rate"].decode(struct.pack("<f", value))


def test_single_precision_limits_hold_after_rounding() -> None:
    row = ICD.telecommands["set_update_rate"]
    assert row.decode(row.encode({"rate": 0.01})) == {"rate": to_f32(0.01)}
    assert ICD.parameters["update_rate"].check(to_f32(0.01)) == to_f32(0.01)


def test_bad_values_can_be_sent_on_purpose() -> None:
    assert ICD.telecommands["reset"].encode({"magic": 0}, check=False) == b"\x00"
    assert ICD.telecommands["set_mode"].encode({"mode": 77}, check=False) == b"\x4d"
    with pytest.raises(FieldError):
        ICD.telecommands["reset"].encode({"magic": 256}, check=False)


def test_a_field_that_wraps_keeps_its_lowest_bits() -> None:
    row = ICD.telemetry["identification"]
    assert row.decode(row.encode({"runtime_s": 65536 + 7}, saturate=True))["runtime_s"] == 7
    uptime = ICD.telemetry["device_status"]
    after_50_days = 50 * 86400.0
    wrapped = uptime.decode(uptime.encode({"uptime": after_50_days}, saturate=True))["uptime"]
    assert wrapped == pytest.approx(after_50_days - 2**32 / 1000.0)
    with pytest.raises(FieldError):
        row.encode({"runtime_s": 65536})


def test_a_row_names_the_fields_that_it_would_clip() -> None:
    row = ICD.telemetry["rates"]
    x, y = row.named_fields["rate_x"], row.named_fields["rate_y"]
    assert not x.clips(3.27674)
    assert not y.clips(-3.27684)
    assert x.clips(3.2768)
    assert y.clips(-3.2769)
    assert not ICD.telemetry["identification"].named_fields["runtime_s"].clips(70000)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ('type = "i16", wrap = true', "only unsigned integers wrap"),
        ('type = "f32", wrap = true', "only unsigned integers wrap"),
        ('type = "u16", max = 7, wrap = true', "a field that wraps has no min and max"),
    ],
)
def test_wrapping_is_for_unsigned_counters(tmp_path: Path, field: str, message: str) -> None:
    text = """[unit]
name = "x"
version = "1"
doc = "x"

[[telemetry]]
id = 200
name = "row"
doc = "x"
provenance = "ours"
size = SIZE
fields = [{ name = "n", FIELD }]
"""
    size = "4" if "f32" in field else "2"
    (tmp_path / "a.toml").write_text(text.replace("FIELD", field).replace("SIZE", size))
    with pytest.raises(IcdError, match=message):
        load_unit(tmp_path)


def test_telemetry_saturates_as_the_unit_does() -> None:
    rates = ICD.telemetry["rates"]
    with pytest.raises(FieldError):
        rates.encode({"rate_x": 5.0})
    assert rates.decode(rates.encode({"rate_x": 5.0, "rate_y": -1e9, "rate_z": math.inf}, saturate=True)) == {
        "rate_x": 3.2767,
        "rate_y": -3.2768,
        "rate_z": 3.2767,
    }
    assert ICD.telemetry["star_performance_1"].encode({"stars_detected": 300}, saturate=True)[0] == 255


def test_unknown_numbers_of_enumerations_stay_numbers_in_telemetry() -> None:
    assert ICD.telemetry["image_status"].decode(b"\x05\x63")["status"] == 0x63


def test_unknown_names_offer_near_ones() -> None:
    with pytest.raises(UnknownNameError, match="did you mean quaternion") as caught:
        ICD.telemetry["quaternio"]
    assert str(caught.value).startswith("no telemetry row named 'quaternio'")
    with pytest.raises(UnknownNameError, match="icd list --unit UNIT"):
        ICD.parameters["zzz"]


# -- parameters --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "given_value", "expected"),
    [
        ("exposure", 200.0, 200),
        ("tracking_enable", 1.0, True),
        ("tracking_enable", False, False),
        ("serial_dialect", "c", "c"),
        ("serial_dialect", 2.0, "c"),
        ("update_rate", 10, 10.0),
    ],
)
def test_parameters_take_numbers_as_the_wire_carries_them(
    name: str, given_value: Value, expected: Value
) -> None:
    checked = ICD.parameters[name].check(given_value)
    assert checked == expected
    assert type(checked) is type(expected)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("exposure", 0), ("exposure", 5001), ("exposure", 1.5), ("exposure", math.nan), ("exposure", "long"), ("exposure", True),
        ("tracking_enable", 2), ("tracking_enable", math.nan), ("serial_dialect", "d"), ("serial_dialect", 3.0), ("update_rate", math.nan),
        ("update_rate", 100.001), ("can_address", 255),
    ],
)  # fmt: skip
def test_parameters_reject_values_outside_their_limits_with_a_reason(name: str, value: Value) -> None:
    with pytest.raises(MessageError, match=f"^{name}: ") as caught:
        ICD.parameters[name].check(value)
    assert caught.value.code is ErrorCode.INVALID_PARAMETER


@pytest.mark.parametrize("parameter", ICD.parameters.values(), ids=lambda parameter: parameter.name)
def test_every_default_survives_the_wire(parameter: object) -> None:
    parameter = ICD.parameters[parameter.name]  # type: ignore[attr-defined]
    wire = struct.unpack("<d", struct.pack("<d", parameter.to_number(parameter.default)))[0]
    assert parameter.check(wire) == parameter.default


# -- bad definitions ---------------------------------------------------------------------------------------------------

HEAD = '[unit]\nname = "x"\nversion = "1"\ndoc = "d"\nfirst_telemetry_id = 128\n'


CUBESPACE_CAN = '[link.can]\nkind = "cubespace"\n'
CUBESPACE_SERIAL = '[link.serial]\nframing = { kind = "cubespace" }\n'
CANOPEN = """[canopen]
device_type = 0
device_name = "n"
vendor_name = "v"
vendor_id = 0
product_code = 0
revision = 0
bit_rates = [1000000]
"""


def _row(
    extra: str = "",
    *,
    kind: str = "telemetry",
    identifier: int = 200,
    name: str = "row",
    size: int = 1,
    fields: str | None = None,
) -> str:
    fields = '[{ name = "a", type = "u8" }]' if fields is None else fields
    return f'[[{kind}]]\nid = {identifier}\nname = "{name}"\ndoc = "d"\nprovenance = "ours"\nsize = {size}\nfields = {fields}\n{extra}\n'


BAD_DEFINITIONS = [
    ("another lowest telemetry ID than that of CubeSpace's CAN", HEAD.replace("128", "64") + CUBESPACE_CAN,
     r"unit\.first_telemetry_id: 64, but link\.can is of CubeSpace, whose telemetry begins at 128; set it to 128"),
    ("another lowest telemetry ID than that of CubeSpace's framing", HEAD.replace("128", "64") + CUBESPACE_SERIAL,
     r"unit\.first_telemetry_id: 64, but link\.serial is of CubeSpace, whose telemetry begins at 128; set it to 128"),
    ("telemetry ID that CubeSpace's CAN has for telecommands",
     HEAD.replace("first_telemetry_id = 128", "") + CUBESPACE_CAN + _row(identifier=5), r"ID 5 is not a telemetry ID \(128 and up\)"),
    ("unknown key", HEAD + _row('colour = "red"'), r"row\.colour"),
    ("unknown key of a field", HEAD + _row(fields='[{ name = "a", type = "u8", units = "m" }]'), r"row\.fields\.a\.units"),
    ("wrong type", HEAD + _row(fields='[{ name = "a", type = "u48" }]'), r"row\.fields\.a\.type"),
    ("wrong size", HEAD + _row(size=2), "row: size is 2 but the fields add up to 1"),
    ("double id", HEAD + _row() + _row(name="other"), "other: ID 200 is already used by row"),
    ("double name", HEAD + _row() + _row(identifier=201), "row: name used twice"),
    ("double field", HEAD + _row(size=2, fields='[{ name = "a", type = "u8" }, { name = "a", type = "u8" }]'), "field a: name used twice"),
    ("telemetry below 128", HEAD + _row(identifier=5), "is not a telemetry ID"),
    ("telecommand above 127", HEAD + _row(kind="telecommand"), "is not a telecommand ID"),
    ("unknown enumeration", HEAD + _row(fields='[{ name = "a", type = "enum8", enum = "e" }]'), "no enumeration named 'e'"),
    ("enumeration not named", HEAD + _row(fields='[{ name = "a", type = "enum8" }]'), "needs `enum`"),
    ("unknown parameter", HEAD + _row(fields='[{ name = "a", type = "u8", parameter = "p" }]'), "no parameter named 'p'"),
    ("enumeration of a number", HEAD + _row(fields='[{ name = "a", type = "u8", enum = "mode" }]'), "`enum` needs type enum8, not u8"),
    ("scaled flag", HEAD + _row(fields='[{ type = "bits8", bits = [{ name = "b", scale = 2.0 }, { width = 7 }] }]'), "scale and offset need a number of at least 2 bits"),
    ("limit beyond bits", HEAD + _row(fields='[{ type = "bits8", bits = [{ name = "b", width = 3, max = 9 }, { width = 5 }] }]'), "max 9 does not fit 3 bits"),
    ("unsolicited telecommand", HEAD + _row(kind="telecommand", identifier=3) + "unsolicited = 1.0", "only telemetry is sent unsolicited"),
    ("unknown event", HEAD + _row() + 'unsolicited = ["reboot"]', r"row\.unsolicited"),
    ("bits too few", HEAD + _row(fields='[{ name = "a", type = "bits8", bits = [{ name = "b" }] }]'), "the bits add up to 1, must be 8"),
    ("limits that do not fit", HEAD + _row(fields='[{ name = "a", type = "u8", max = 300 }]'), "max 300 does not fit"),
    ("min above max", HEAD + _row(fields='[{ name = "a", type = "u8", min = 3, max = 2 }]'), "min 3 is above max 2"),
    ("unknown include", HEAD + '[[telemetry]]\nid = 200\nname = "r"\ndoc = ""\nprovenance = "ours"\nsize = 0\ninclude = ["x"]', "no row named 'x'"),
    ("bytes without size", HEAD + _row(fields='[{ name = "a", type = "bytes" }]'), "needs a size"),
    ("unit unlike the parameter's", HEAD + _row(fields='[{ name = "a", type = "u8", unit = "s", parameter = "exposure" }]'), "they must agree"),
    ("default outside", HEAD + '[[parameter]]\nid = 1\nname = "window_width"\ndefault = 2\n', "default: window_width: 2 is outside"),
    ("parameter limits", HEAD + '[[parameter]]\nid = 1\nname = "window_width"\nmax = 1000\n', "do not fit type u8"),
    ("enum numbers", HEAD + '[[enum]]\nname = "e"\ndoc = "d"\nvalues = { a = 1, b = 1 }\n', "two names have the same number"),
    ("repeat with other keys", HEAD + _row(fields='[{ type = "u8", repeat = { count = 2, fields = ["u8 a"] } }]'), "`repeat` allows no other keys but `doc`"),
    ("repeat in repeat", HEAD + _row(fields='[{ repeat = { count = 2, fields = [{ name = "a", type = "u8", count = 2 }] } }]'), "a repeated group cannot contain `repeat` or `count`"),
    ("text with other keys", HEAD + _row(fields='[{ text = "u8 a", doc = "d" }]'), "field 'u8 a': `text` allows no other keys"),
    ("no type", HEAD + _row(fields='[{ name = "a" }]'), "field a: needs `type`, or `repeat`"),
    ("bits of a number", HEAD + _row(fields='[{ name = "a", type = "u8", bits = [{ name = "b" }] }]'), "only types bits8, bits16 and bits32 have bits"),
    ("size of a number", HEAD + _row(fields='[{ name = "a", type = "u8", size = 1 }]'), "type u8 has a fixed size; remove `size`"),
    ("map and enum", HEAD + _row(fields='[{ name = "a", type = "enum8", enum = "mode", map = { 1 = "x" } }]'), "has both `map` and `enum`"),
    ("no bits", HEAD + _row(fields='[{ name = "a", type = "bits8" }]'), "type bits8 needs `bits` and takes no count"),
    ("bits too narrow", HEAD + _row(fields='[{ type = "bits8", bits = [{ name = "b", map = { 2 = "x" } }, { width = 7 }] }]'), "enumeration map does not fit 1 bits"),
    ("negative number of bits", HEAD + _row(fields='[{ type = "bits8", bits = [{ name = "b", map = { -1 = "x" } }, { width = 7 }] }]'), "enumeration map does not fit 1 bits"),
    ("map beyond the type", HEAD + _row(fields='[{ name = "a", type = "u8", map = { 300 = "x" } }]'), "field a: enumeration map does not fit type u8"),
    ("map of a float", HEAD + _row(size=4, fields='[{ name = "a", type = "f32", map = { 1 = "x" } }]'), "field a: enumeration map does not fit type f32"),
    ("map of a string", HEAD + _row(fields='[{ name = "a", type = "text", size = 1, map = { 1 = "x" } }]'), "field a: enumeration map does not fit type text"),
    ("enumeration beyond the type", HEAD + '[[enum]]\nname = "e"\ndoc = "d"\nvalues = { a = 300 }\n' + _row(fields='[{ name = "a", type = "enum8", enum = "e" }]'), "field a: enumeration e does not fit type enum8"),
    ("scaled enumeration", HEAD + _row(fields='[{ name = "a", type = "u8", scale = 2.0, map = { 1 = "x" } }]'), "field a: scale and offset need a number of at least 2 bits"),
    ("unknown class of a header field", HEAD + '[link.serial]\nframing = { kind = "slip" }\nrequest_header = [{ role = "id", type = "u8" }, { default = 1, type = "u8", classes = ["b", "a", "c", "d"] }]\n', "request_header: no class named 'b'"),
    ("constant too wide", HEAD + _row(fields='[{ type = "bits8", bits = [{ name = "b", const = 2 }, { width = 7 }] }]'), "const 2 does not fit 1 bits"),
    ("scale 0", HEAD + _row(fields='[{ name = "a", type = "u8", scale = 0.0 }]'), "field a: scale 0 is smaller than 1e-100"),
    ("scale that is no number", HEAD + _row(fields='[{ name = "a", type = "u8", scale = nan }]'), "scale: .*finite"),
    ("scale that is too small", HEAD + _row(fields='[{ name = "a", type = "u8", scale = 1e-320 }]'), "scale 9.99989e-321 is smaller"),
    ("infinite limit", HEAD + _row(fields='[{ name = "a", type = "u8", max = inf }]'), "max: .*finite"),
    ("limit that is too large", HEAD + _row(fields='[{ name = "a", type = "u8", min = -1e300 }]'), "min: a number is at most 1e.100"),
    ("constant that is too large", HEAD + _row(fields='[{ name = "a", type = "u8", const = 1000000000000000000000000000000 }]'), "const"),
    ("offset that is no number", HEAD + _row(fields='[{ name = "a", type = "u8", offset = -nan }]'), "offset: .*finite"),
    ("default that is too large", HEAD + _row(fields='[{ name = "a", type = "u8", default = 1e300 }]'), "default: a number is at most"),
    ("empty list in a map", HEAD + _row(fields='[{ name = "a", type = "u8", map = { 1 = [] } }]'), "map: 1: no value, or a duplicate one"),
    ("value twice in a map", HEAD + _row(fields='[{ name = "a", type = "u8", map = { 1 = ["x", "y"], 2 = "y" } }]'), "map: 2: no value, or a duplicate one"),
    ("default not in the map", HEAD + _row(fields='[{ name = "a", type = "u8", map = { 1 = "x" }, default = "y" }]'), "default 'y' is not in enumeration map"),
    ("double enumeration", HEAD + 2 * '[[enum]]\nname = "e"\ndoc = "d"\nvalues = { a = 1 }\n', "enum e: defined twice"),
    ("double parameter", HEAD + '[[parameter]]\nid = 1\nname = "exposure"\n[[parameter]]\nid = 2\nname = "exposure"\n', "parameter exposure: defined twice"),
    ("double parameter id", HEAD + '[[parameter]]\nid = 1\nname = "exposure"\n[[parameter]]\nid = 1\nname = "analog_gain"\n', "ID 1 is already used by exposure"),
    ("unit of a parameter", HEAD + '[[parameter]]\nid = 1\nname = "exposure"\nunit = "s"\n', "unit 's', but in the device it is 'ms'"),
    ("limits of a parameter", HEAD + '[[parameter]]\nid = 1\nname = "exposure"\nmin = 9\nmax = 8\n', "needs min and max, with min not above max"),
    ("too many rows", HEAD + _row("last_id = 4294967295"), "last_id 4294967295 makes 4294967096 rows; a unit has at most 65536"),
    ("too many rows of several", HEAD + "".join(_row("last_id = 65535", kind="telecommand", identifier=0, name=name) for name in "ab"), "telecommand b: last_id 65535 makes 65536 rows"),
    ("name of a unit that is too long", HEAD.replace('name = "x"', f'name = "{"u" * 20000}"'), "unit.name: .*at most 100 characters"),
    ("last id", HEAD + _row("last_id = 199"), "last_id 199 is below ID 200"),
    ("argument without action", HEAD + _row(kind="telecommand", identifier=1, fields='[{ name = "a", type = "u8", argument = "mode" }]'), "argument mode: the row has no `action`"),
    ("unknown fixed argument", HEAD + _row('action = "reset"\narguments = { mood = 1 }', kind="telecommand", identifier=1), "action reset has no argument 'mood'"),
    ("member of two kinds", HEAD + CANOPEN + '[[canopen.object]]\nindex = 0x2000\nname = "o"\nmembers = [{ name = "m", parameter = "exposure", domain = "ro" }]\n', "needs value and/or telecommand, or parameter, or domain"),
    ("type of no telecommand", HEAD + CANOPEN + '[[canopen.object]]\nindex = 0x2000\nname = "o"\nparameters = true\ntype = "u8"\n', "`type` is only for a telecommand"),
    ("no head", _row(), r"no \[unit\]"),
    ("no TOML", "[[[", "not valid TOML"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [(text, message) for _, text, message in BAD_DEFINITIONS],
    ids=[name for name, _, _ in BAD_DEFINITIONS],
)
def test_a_bad_definition_is_rejected_by_file_and_row(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(IcdError, match=message) as caught:
        load_unit(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "const", "other"),
    [
        ('{ name = "a", type = "u8", const = 3 }', 3, 1),
        ('{ name = "a", type = "u8", map = { 1 = "one", 3 = "three" }, const = 3 }', "three", "one"),
        ('{ type = "bits8", bits = [{ name = "a", width = 3, const = 3 }, { width = 5 }] }', 3, 1),
        ('{ type = "bits8", bits = [{ name = "a", const = 1 }, { width = 7 }] }', True, False),
        ('{ type = "bits8", bits = [{ name = "a", width = 2, map = { 1 = "one", 3 = "three" }, const = 3 }, { width = 6 }] }', "three", "one"),
    ],
)  # fmt: skip
def test_a_constant_of_any_kind_is_required_in_a_telecommand(tmp_path, field, const, other) -> None:
    file = tmp_path / "unit.toml"
    file.write_text(HEAD + _row('action = "nothing"', kind="telecommand", identifier=1, fields=f"[{field}]"))
    row = load_unit(file).telecommands["row"]
    assert row.decode(row.encode()) == {"a": const}
    with pytest.raises(FieldError, match=r"row\.a: .* is outside"):
        row.encode({"a": other})
    with pytest.raises(FieldError, match=r"row\.a: .* is outside"):
        row.decode(row.encode({"a": other}, check=False))


def test_a_missing_or_empty_definition_is_reported(tmp_path: Path) -> None:
    with pytest.raises(IcdError, match="not found"):
        load_unit(tmp_path / "none.toml")
    with pytest.raises(IcdError, match=r"no \.toml file"):
        load_unit(tmp_path)


def test_the_definition_may_be_a_folder_or_one_file(tmp_path: Path) -> None:
    files = [
        file for file in sorted(find_unit("cubestar").glob("*.toml")) if not file.stem.endswith("_cases")
    ]
    text = "".join(file.read_text() for file in files)
    file = tmp_path / "all.toml"
    file.write_text(text)
    assert [(row.id, row.name, row.size) for row in load_unit(file).rows] == [
        (row.id, row.name, row.size) for row in ROWS
    ]


def test_an_error_of_rows_that_one_entry_expands_to_is_reported_once(tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(HEAD + _row("last_id = 60000") + _row(identifier=255, name="other"))
    with pytest.raises(IcdError) as caught:
        load_unit(file)
    assert [problem.partition("telemetry ")[2] for problem in caught.value.problems] == [
        "row_57: ID 256 is above 255",
        "other: ID 255 is already used by row_56",
    ]
