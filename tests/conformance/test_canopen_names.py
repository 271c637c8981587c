"""Objects that conformance cases of CANopen choose from the EDS of a node."""

from __future__ import annotations

import pytest
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_names import Names
from starhil.hil_tests.conformance.canopen_probe import CanopenProbe

pytestmark = pytest.mark.long

MODE, EXPOSURE = 0x6000, 0x6020


class Node(CanopenProbe):
    """A node with a mode and an exposure time; in a mode that only the node enters, the mode cannot be set to it."""

    def __init__(self, *, booting: bool) -> None:
        self.od = ObjectDictionary()
        self.mode = 0 if booting else 1
        for index, name, kind in (
            (MODE, "mode", datatypes.UNSIGNED8),
            (EXPOSURE, "exposure", datatypes.UNSIGNED16),
        ):
            item = ODVariable(name, index)
            item.data_type, item.access_type, item.pdo_mappable = kind, "rw", True
            self.od.add_object(item)

    def read(self, index: int, subindex: int = 0) -> bytes:
        assert subindex == 0
        return bytes([self.mode]) if index == MODE else b"\x64\x00"

    def write(self, index: int, subindex: int, value: int | bytes, size: int = 4) -> int:
        assert (value, subindex, size) == (self.read(index), 0, 4)
        return 0x06090030 if index == MODE and self.mode == 0 else 0


@pytest.mark.parametrize(
    ("booting", "entry", "value"), [(True, "0x60200010", "6400"), (False, "0x60000008", "01")]
)
def test_the_object_of_a_tpdo_does_not_change_at_the_end_of_booting(
    booting: bool, entry: str, value: str
) -> None:
    names = Names(Node(booting=booting))
    assert (names["constant"], names["value"]) == (entry, value)
