"""The master's side of SDO against the slave: every row by the entries of the object dictionary that hold it."""

from __future__ import annotations

import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import download, requests_of, row_transfer
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.errors import IcdError
from starhil.protocol.unit import load_unit
from tests.protocol.canopen.stand_in import StandInApplication

NODE = 0x2C


class NumberedRows(StandInApplication):
    """Telemetry of bytes that differ from row to row and within a row; settings as they were set."""

    def telemetry(self, row):
        if any(field.telecommand for field in row.named_fields.values()):
            return super().telemetry(row)
        return bytes((row.id + number) % 251 for number in range(row.size))


class Node:
    """A slave of a unit, and a master that runs transfers with it."""

    def __init__(self, unit):
        self.icd = load_unit(unit)
        self.dictionary = DeviceDictionary(self.icd)
        self.dictionary.application = self.application = NumberedRows(self.icd)
        self.slave = CanopenSlave(self.dictionary, NODE)
        self.slave.start(0.0)

    def run(self, transfer):
        request = next(transfer)
        while True:
            (answer,) = self.slave.receive(CanFrame(0x600 + NODE, request, extended=False), 0.0)
            try:
                request = transfer.send(answer.data)
            except StopIteration as done:
                return done.value


@pytest.mark.parametrize("unit", ["oresat", "cubestar"])
def test_every_row_is_read_and_executed_by_the_entries_that_hold_it(unit):
    node = Node(unit)
    for row in node.icd.telemetry.values():
        assert node.run(row_transfer(node.dictionary, row)) == node.application.telemetry(row), row.name
    for row in node.icd.telecommands.values():
        lowest = {field.name: field.physical_limits[0] for field in row.fields if field.minimum is not None}
        data = row.encode({**row.example(), **lowest})
        assert node.run(row_transfer(node.dictionary, row, data)) == b""
        assert node.application.commands[-1] == (row.name, dict(row.decode(data)))


def test_an_abort_ends_a_transfer_with_its_code():
    node = Node("oresat")
    with pytest.raises(SdoAbortError) as abort:
        node.run(download(0x4000, 0, b"\x4d"))
    assert abort.value.code == AbortCode.VALUE_RANGE
    with pytest.raises(SdoAbortError) as abort:
        node.run(download(0x5FFF, 0, bytes(20)))
    assert abort.value.code == AbortCode.NO_OBJECT


def test_the_requests_of_a_download_are_known_before_it_is_sent():
    assert [data.hex() for data in requests_of(download(0x4000, 0, b"\x04"))] == ["2f00400004000000"]
    assert [data.hex() for data in requests_of(download(0x2000, 1, bytes(range(9))))] == [
        "2100200109000000",
        "0000010203040506",
        "1b07080000000000",
    ]


def test_a_row_outside_the_dictionary_is_named():
    icd = load_unit("oresat")
    row = load_unit("cubestar").telemetry["health"]
    with pytest.raises(IcdError, match="unit oresat: no entry of its object dictionary holds health"):
        row_transfer(DeviceDictionary(icd), row)
