"""What a CANopen node sends unprompted, decoded by the default mapping of its definition: PDOs, EMCY, heartbeats.

A TPDO carries entries of the object dictionary, each a field of a telemetry row or the same in a narrower type. The
values of the TPDOs of one instant are judged as one row, so that an attitude spread over two of them is compared, and
modes of zero duration are ignored. Lives do not change the mapping.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from starhil.hil_tests.endurance.attitude_judge import Readings
from starhil.hil_tests.endurance.oracle import Oracle
from starhil.hil_tests.endurance.violation import Violation
from starhil.hil_tests.judge import canopen
from starhil.hil_tests.judge.definition import Unit
from starhil.protocol.can.frame import CanFrame

DEVICE_ERROR: Final = 0xFF00
"""Base of the EMCY error codes of the error mode (docs/canopen.md)."""
STATES: Final = frozenset({0x00, 0x04, 0x05, 0x7F})
"""States in a heartbeat: boot-up, stopped, operational, pre-operational."""
TPDO: Final = 0x1800
"""Index of the communication record of the first TPDO."""


class Node:
    """Judges the messages of a node."""

    def __init__(self, unit: Unit) -> None:
        self._unit = unit
        self._tpdos: dict[tuple[int, bool], list[canopen.Entry]] = {}
        """Entries by CAN ID, and whether the node ID is added to it."""
        entries = {entry.name.lower(): entry for entry in canopen.entries(unit, unit.canopen)}
        for number, model in enumerate(unit.canopen.tpdo):
            if model.enabled:
                can_id = canopen.pdo_can_id(0, TPDO + number, model)
                self._tpdos[can_id, model.relative] = [entries[name.lower()] for name in model.objects]
        self._together: Readings = {}

    def judge(self, frame: CanFrame, node: int, oracle: Oracle) -> int:
        """Judge a message sent now; return the number of rows read."""
        entries = self._tpdos.get((frame.id - node, True)) or self._tpdos.get((frame.id, False))
        if entries is not None:
            self._keep(frame, entries)
            return 1
        if frame.id == canopen.EMERGENCY + node and len(frame.data) == 8:
            self._judge_emergency(int.from_bytes(frame.data[:2], "little"), oracle)
        elif (
            frame.id != canopen.HEARTBEAT + node or len(frame.data) != 1 or frame.data[0] & 0x7F not in STATES
        ):
            raise Violation(
                f"canopen: a frame {frame.id:03X}h {frame.data.hex()} that the unit does not define"
            )
        return 0

    def _keep(self, frame: CanFrame, entries: list[canopen.Entry]) -> None:
        if len(frame.data) != sum(entry.size for entry in entries):
            raise Violation(f"TPDO {frame.id:03X}h: {len(frame.data)} bytes")
        offset = 0
        for entry in entries:
            self._together |= read_entry(entry, self._unit, frame.data[offset : offset + entry.size])
            offset += entry.size

    def judge_instant(self, oracle: Oracle) -> None:
        """Judge the TPDOs of the last instant; the last value of each quantity counts."""
        read, self._together = self._together, {}
        oracle.judge("TPDOs", read)
        four = [read.get(f"attitude.{letter}") for letter in "xyzw"]
        if any(item is None for item in four):
            return
        if "attitude.valid" not in read:  # sent only when it changes
            numbers = [item for item in four if item is not None]
            read["attitude.valid"] = (numbers[0][0], any(value != 0.0 for _, value in numbers))
        oracle.judge_attitude("TPDOs", read)

    def _judge_emergency(self, code: int, oracle: Oracle) -> None:
        if code and code - DEVICE_ERROR not in self._unit.device_errors.values():
            raise Violation(f"canopen: EMCY {code:04X}h, which no event has caused")
        if code and "error" not in oracle.modes:
            raise Violation(f"canopen: EMCY {code:04X}h in {', '.join(sorted(oracle.modes))}")


def read_entry(entry: canopen.Entry, unit: Unit, data: bytes) -> Readings:
    """Return the quantities that the data of an entry carry: fields of a row, or one of them in a narrower type."""
    row, slot, packed = entry.row, entry.slot, entry.packed
    if packed is not None:
        row_name, _, name = packed.source.partition(".")
        row = unit.telemetry[row_name]
        slot = row.named[name]
    if row is None or slot is None or (packed is not None and packed.wrap):
        return {}
    if packed is not None and not slot.width:
        raw = int.from_bytes(data, "little", signed=packed.type.startswith("i"))
        narrow = replace(slot, kind="integer", scale=packed.scale)
        return {} if slot.value is None else {slot.value: (narrow, raw * packed.scale)}
    content = bytearray(row.size)
    content[slot.offset : slot.offset + slot.size] = canopen.with_byte_order(slot, data)
    values = row.decode(bytes(content))
    return {
        item.value: (item, values[name])
        for name, item in row.named.items()
        if item.offset == slot.offset and item.value is not None
    }
