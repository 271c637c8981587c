"""The EDS: parsed by independent readers, and consistent with the node."""

from __future__ import annotations

import configparser
import io
import subprocess
import sys
import warnings
from pathlib import Path

import canopen
import dcf
import pytest
from canopen.objectdictionary import ODVariable, datatypes

from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.unit import load_unit

pytestmark = pytest.mark.lowest("canopen")


@pytest.fixture(scope="module")
def eds(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("eds") / "star-sensor.eds"
    path.write_text(build_eds(DeviceDictionary(load_unit())), encoding="ascii")
    return path


@pytest.fixture(scope="module")
def od(eds):
    return canopen.import_od(str(eds), 0x2C)


def variables(od):
    for index in sorted(od.indices):
        item = od.indices[index]
        if isinstance(item, ODVariable):
            yield item
        else:
            yield from (item.subindices[subindex] for subindex in sorted(item.subindices))


def test_dcfchk_accepts_the_eds(eds):
    program = Path(sys.executable).with_name("dcfchk")
    result = subprocess.run([program, "-n", "44", "-p", eds], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


def test_lely_sees_the_default_mappings(eds):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        device = dcf.Device.from_dcf(str(eds), {"NODEID": 0x2C})
    assert [tpdo.cob_id for tpdo in device.tpdo.values()][:5] == [
        0x400001AC, 0x400002AC, 0x400003AC, 0x400004AC, 0xC0000000,
    ]  # fmt: skip
    assert [item.name for item in device.tpdo[2].mapping.values()] == [
        "sequence",
        "flags",
        "time_of_exposure",
    ]
    assert [item.name for item in device.rpdo[1].mapping.values()] == ["Mode"]


def test_same_dictionary_gives_the_same_text(eds):
    assert build_eds(DeviceDictionary(load_unit())) == eds.read_text(encoding="ascii")


def test_data_sheet_and_dictionary_have_the_same_objects(od):
    listed = {(item.index, item.subindex) for item in variables(od) if item.index >= 0x1000}
    assert listed == set(DeviceDictionary(load_unit()).entries)


def test_the_eds_describes_the_served_dictionary(bench, od):
    """Each object's type, access, default and length, as an SDO client sees them after power-on."""
    for item in variables(od):
        if item.index < 0x1000 or item.index in {0x2000, 0x6040, 0x6043} or item.access_type == "wo":
            continue
        if item.index == 0x1003 and item.subindex:
            continue
        data = bench.read(item.index, item.subindex)
        packer = ODVariable.STRUCT_TYPES.get(item.data_type)
        if packer is not None:
            assert len(data) == packer.size, item
        if item.default is not None and item.data_type in datatypes.INTEGER_TYPES:
            assert item.decode_raw(data) == item.default, item
        elif item.data_type == datatypes.VISIBLE_STRING:
            assert data.decode("ascii") == item.default
        elif item.data_type == datatypes.REAL32 and getattr(item, "default_raw", None):
            assert data[::-1].hex().upper() == item.default_raw[2:], item


def test_limits_come_from_the_interface_definition(od):
    exposure = od["Parameters"]["exposure"]
    assert (exposure.min, exposure.max, exposure.default, exposure.data_type) == (
        1,
        5000,
        100,
        datatypes.UNSIGNED16,
    )


def test_device_information(od):
    information = od.device_information
    assert information.product_name == "CubeStar-like star sensor"
    assert (information.nr_of_RXPDO, information.nr_of_TXPDO, information.LSS_supported) == (4, 8, True)
    assert 125_000 in information.allowed_baudrates


def test_lists_cover_every_object_once(eds):
    parser = configparser.RawConfigParser(inline_comment_prefixes=(";",))
    parser.read_string(eds.read_text(encoding="ascii"))
    listed = []
    for section in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        count = parser.getint(section, "SupportedObjects")
        listed += [int(parser.get(section, str(number)), 0) for number in range(1, count + 1)]
    assert sorted(listed) == sorted({index for index, _ in DeviceDictionary(load_unit()).entries})


def test_data_sheet_is_served_by_the_node(bench, eds):
    assert bench.read(0x1021) == eds.read_bytes()
    assert bench.read(0x1022) == b"\0"
    with io.StringIO(bench.read(0x1021).decode("ascii")) as file:
        file.name = "served.eds"
        assert 0x6011 in canopen.import_od(file, 0x2C)
