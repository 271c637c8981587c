"""The interface definition in the object dictionary: places, types, limits, handlers, bad layouts."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import check_status
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.errors import IcdError
from starhil.protocol.files.bundled import find_unit
from starhil.protocol.icd.canopen_schema import CanopenModel
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine

pytestmark = pytest.mark.lowest("canopen")

ICD = load_unit()


def test_the_subindex_of_every_row_is_its_id():
    entries = DeviceDictionary(load_unit()).entries
    assert {subindex for index, subindex in entries if index == 0x2000} == {0, *(row.id for row in ICD.rows)}


def test_the_subindex_of_every_parameter_is_its_id(bench):
    for parameter in ICD.parameters.values():
        entry = bench.dictionary.find(0x6020, parameter.id)
        assert entry.variable.name == parameter.name
        assert entry.variable.description == parameter.doc
        assert entry.variable.unit == parameter.unit
        assert bench.read(0x6020, parameter.id) == entry.read()


@pytest.mark.parametrize(
    "row", [row for row in ICD.rows if row.kind == "telemetry"], ids=lambda row: row.name
)
def test_telemetry_rows_are_the_same_as_on_other_links(bench, row):
    values = row.example()
    bench.application.rows[row.name] = values
    assert bench.read(0x2000, row.id) == row.encode(values)


@pytest.mark.parametrize(
    "index", [0x6001, 0x6002, 0x6003, 0x6010, 0x6030, 0x6031, 0x6032, 0x6033, 0x6041, 0x6050]
)
def test_fields_of_a_record_are_the_rows_bytes(bench, index):
    name = next(item.telemetry for item in ICD.canopen.object if item.index == index)
    row = ICD.telemetry[name]
    bench.application.rows[name] = row.example()
    data = row.encode(row.example())
    used = [
        slot
        for slot in row.slots
        if any(field.slot.index == slot.index for field in row.named_fields.values())
    ]
    assert bench.number(index) == len(used)
    for subindex, slot in enumerate(used, 1):
        assert bench.read(index, subindex) == data[slot.offset : slot.offset + slot.size]


def test_telecommand_without_data_is_executed_by_writing_1(bench):
    assert bench.write(0x6051, 0, 0, 1) == AbortCode.VALUE_LOW
    assert bench.write(0x6051, 0, 2, 1) == AbortCode.VALUE_HIGH
    assert bench.write(0x6051, 0, 1, 1) == 0
    assert bench.application.commands == [("clear_counters", {})]


def test_telecommand_with_one_value(bench):
    import struct

    assert bench.write(0x6060, 0, struct.pack("<f", 5.0)) == 0
    assert bench.write(0x6060, 0, struct.pack("<f", 150.0)) == AbortCode.VALUE_HIGH
    assert bench.application.commands == [("set_update_rate", {"rate": 5.0})]


def test_mode_is_read_and_commanded_at_one_place(bench):
    bench.application.rows["device_status"] = {"mode": "boot"}
    assert bench.number(0x6000) == 0
    assert bench.write(0x6000, 0, 2, 1) == 0
    assert bench.application.commands == [("set_mode", {"mode": "lost_in_space"})]


def test_float_limits_accept_the_limits_themselves(bench):
    import struct

    for parameter in (item for item in ICD.parameters.values() if item.type == "f32"):
        for limit in (parameter.minimum, parameter.maximum):
            assert bench.write(0x6020, parameter.id, struct.pack("<f", limit)) == 0


@pytest.mark.parametrize(
    ("status", "code"),
    [
        (1, AbortCode.NO_OBJECT),
        (2, AbortCode.LENGTH),
        (3, AbortCode.VALUE_RANGE),
        (5, AbortCode.UNSUPPORTED_ACCESS),
        (6, AbortCode.DEVICE_STATE),
        (7, AbortCode.DEVICE_STATE),
        (8, AbortCode.GENERAL),
    ],
)
def test_published_error_codes_as_abort_codes(status, code):
    with pytest.raises(SdoAbortError) as caught:
        check_status(status, "set_mode")
    assert caught.value.code is code
    assert "set_mode" in str(caught.value)


def test_status_ok_passes():
    check_status(0, "set_mode")


def layout(**changes) -> CanopenModel:
    document = ICD.canopen.model_dump(by_alias=True)
    return CanopenModel.model_validate(document | changes)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"object": [{"index": 0x6000, "name": "x", "telemetry": "no_such_row"}]}, "no_such_row"),
        (
            {"object": [{"index": 0x6000, "name": "x", "value": "rates.no_field"}], "tpdo": [], "rpdo": []},
            "no_field",
        ),
        ({"tpdo": [{"name": "x", "objects": ["6000.nothing"]}]}, "6000.nothing"),
        ({"tpdo": [{"name": "x", "objects": ["2000.health"]}]}, "PDO x: .*cannot be mapped.*2000h:A4h"),
        ({"rpdo": [{"name": "x", "objects": ["6001.mode"]}]}, "PDO x: .*cannot be mapped"),
        ({"tpdo": [{"name": "x", "objects": ["6001.mode"] * 9}]}, "PDO x: .*9 bytes, at most 8"),
        (
            {
                "object": [{"index": 0x6000, "name": n, "telemetry": "rates"} for n in "ab"],
                "tpdo": [],
                "rpdo": [],
            },
            "6000h is used twice",
        ),
        (
            {
                "object": [
                    {"index": 0x6000, "name": "x", "value": "unix_time.seconds", "telecommand": "set_mode"}
                ],
                "tpdo": [],
                "rpdo": [],
            },
            "differ in type",
        ),
        (
            {
                "object": [
                    {
                        "index": 0x6000,
                        "name": "x",
                        "members": [{"name": n, "subindex": 1, "value": "unix_time.seconds"} for n in "ab"],
                    }
                ],
                "tpdo": [],
                "rpdo": [],
            },
            "6000h: a and b are both sub-index 1",
        ),
    ],
)
def test_layouts_that_do_not_fit_the_definition(changes, text):
    from starhil.protocol.errors import ProtocolError

    with pytest.raises(ProtocolError, match=text):
        DeviceDictionary(replace(ICD, canopen=layout(**changes)))


@pytest.mark.parametrize("unit", ["cubestar", "oresat"])
def test_what_can_be_read_of_the_device_is_kept_by_the_device_alone(unit):
    """So the node has only communication parameters to store."""
    application = [entry for entry in DeviceDictionary(load_unit(unit)) if entry.key[0] >= 0x2000]
    kept = {entry.key[1] for entry in application if entry.reader is None and entry.variable.readable}
    assert len(application) > 50
    assert kept == {0}


def test_rows_that_are_no_sub_indices():
    request = {"object": [{"index": 0x6000, "name": "x", "requests": True}], "tpdo": [], "rpdo": []}
    for number in (0, 255):
        row = ICD.telecommands["reset"].model_copy(update={"id": number})
        icd = replace(ICD, canopen=layout(**request), telecommands={"reset": row})
        with pytest.raises(IcdError, match=f"6000h: reset would be sub-index {number}, not 1 to 254"):
            DeviceDictionary(icd)


UNIT_HEAD = '[unit]\nname = "x"\nversion = "1"\ndoc = "x"\n'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "has no CANopen"),
        ("[canopen]\n", "canopen.device_type"),
        ("[canopen]\ndevice_type = 'x'\n", "canopen.device_type"),
    ],
)
def test_layouts_that_cannot_be_read(tmp_path, text, reason):
    path = tmp_path / "unit.toml"
    path.write_text(UNIT_HEAD + text, encoding="ascii")
    with pytest.raises(IcdError, match=reason):
        DeviceDictionary(load_unit(path))


def test_a_check_of_a_unit_finds_what_its_eds_cannot_hold(tmp_path):
    text = (find_unit("oresat") / "oresat.toml").read_text(encoding="utf-8")
    path = tmp_path / "oresat.toml"
    path.write_text(text.replace('name = "make_status_file"', 'name = "update"'), encoding="utf-8")
    _, (error,), _ = examine(path)
    assert re.search(
        r"object (....h), sub-index \d+: has the same name as object \1, sub-index \d+ in EDS: update", error
    )


def test_object_of_two_kinds():
    with pytest.raises(ValueError, match="exactly one of"):
        layout(object=[{"index": 0x6000, "name": "x", "telemetry": "rates", "image": "frame"}])
