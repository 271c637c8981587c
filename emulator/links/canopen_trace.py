"""CANopen frames decoded for people: objects by index and name with their values, PDOs by their default mapping."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Final

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.cob import (
    EMERGENCY,
    ERROR_CONTROL,
    LSS_MASTER,
    LSS_SLAVE,
    NMT,
    SDO_RECEIVE,
    SDO_TRANSMIT,
    TIME,
)
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.dictionary import type_size
from starhil.protocol.canopen.emergency import MESSAGE
from starhil.protocol.canopen.pdo_mapping import MAPPING_ENTRY, Direction
from starhil.protocol.errors import ProtocolError

STATES: Final = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
COMMANDS: Final = {
    1: "start",
    2: "stop",
    128: "pre-operational",
    129: "reset node",
    130: "reset communication",
}
PDOS: Final = {
    0x180 + 0x80 * number: (direction, number // 2)
    for number, direction in enumerate((Direction.TRANSMIT, Direction.RECEIVE) * 4)
}
"""Function codes of the predefined PDOs → direction and number, 0 for the first."""

SHOWN_BYTES: Final = 16
"""Number of bytes of a long value that are shown."""

SDO_LENGTH: Final = 8


@dataclass
class _Transfer:
    """An SDO transfer in segments."""

    index: int
    subindex: int
    data: bytearray = field(default_factory=bytearray)


class CanopenDecoder:
    """Decodes the 11-bit frames of a bus, in order."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self._dictionary = dictionary
        dictionary.load_defaults(1)
        self._transfers: dict[int, _Transfer] = {}
        """Transfers by node."""

    def line(self, frame: CanFrame) -> tuple[str, str]:
        node, function = frame.id & 0x7F, frame.id & 0x780
        if frame.id in (LSS_SLAVE, LSS_MASTER):
            return "canopen", "LSS reply" if frame.id == LSS_SLAVE else "LSS request"
        if frame.id == NMT and len(frame.data) == 2:
            command, whom = frame.data
            return "canopen", f"NMT {COMMANDS.get(command, command)}, node {whom or 'all'}"
        if frame.id in (EMERGENCY, TIME):
            return "canopen", "SYNC" if frame.id == EMERGENCY else "TIME"
        if function in (SDO_RECEIVE, SDO_TRANSMIT) and len(frame.data) == SDO_LENGTH:
            decode = self._request if function == SDO_RECEIVE else self._answer
            kind, text = decode(node, frame.data)
            return kind, f"node {node} {text}"
        if function in PDOS:
            return "canopen", f"node {node} {self._pdo(function, frame.data)}"
        if function == ERROR_CONTROL and len(frame.data) == 1:
            return "canopen", f"node {node} heartbeat: {STATES.get(frame.data[0] & 0x7F, frame.data[0])}"
        if function == EMERGENCY and len(frame.data) == SDO_LENGTH:
            emergency = MESSAGE.parse(frame.data)
            return "fault", f"node {node} EMCY {emergency.code:04X}h, register {emergency.register:02X}h"
        return "canopen", f"COB-ID {frame.id:03X}"

    def _request(self, node: int, data: bytes) -> tuple[str, str]:
        """Return kind and text of an SDO request, by the client's command specifier."""
        index, subindex = struct.unpack_from("<HB", data, 1)
        name = self._name(index, subindex)
        match data[0] >> 5:
            case 1 if data[0] & 0x02:
                return "telecommand", f"write {name} = {self._value(index, subindex, _expedited(data))}"
            case 1:
                self._transfers[node] = _Transfer(index, subindex)
                return "telecommand", f"write {name} in segments"
            case 0:
                return self._segment(node, data, "telecommand", "write")
            case 2:
                self._transfers[node] = _Transfer(index, subindex)
                return "telemetry", f"read {name}"
            case 3:
                return "part", "SDO: next segment"
            case 4:
                return "nack", f"SDO abort by the client: {_abort(data)}"
            case _:
                return "part", "SDO block transfer"

    def _answer(self, node: int, data: bytes) -> tuple[str, str]:
        """Return kind and text of an SDO answer, by the server's command specifier."""
        index, subindex = struct.unpack_from("<HB", data, 1)
        name = self._name(index, subindex)
        match data[0] >> 5:
            case 3:
                return "ack", f"written {name}"
            case 2 if data[0] & 0x02:
                return "reply", f"{name} = {self._value(index, subindex, _expedited(data))}"
            case 2:
                return "part", f"{name} follows in segments"
            case 0:
                return self._segment(node, data, "reply", "")
            case 1:
                return "part", "SDO: segment received"
            case 4:
                return "nack", f"{name} refused: {_abort(data)}"
            case _:
                return "part", "SDO block transfer"

    def _segment(self, node: int, data: bytes, kind: str, verb: str) -> tuple[str, str]:
        """Join a segment; the last one is the value."""
        transfer = self._transfers.get(node)
        if transfer is None:
            return "part", "SDO segment"
        transfer.data += data[1 : SDO_LENGTH - (data[0] >> 1 & 0x07)]
        if not data[0] & 0x01:
            return "part", "SDO segment"
        del self._transfers[node]
        name = self._name(transfer.index, transfer.subindex)
        value = self._value(transfer.index, transfer.subindex, bytes(transfer.data))
        return kind, f"{verb} {name} = {value}".strip()

    def _name(self, index: int, subindex: int) -> str:
        """Return index, sub-index and name of an object."""
        where = f"{index:04X}h" + (f":{subindex:02X}h" if subindex else "")
        try:
            name = self._dictionary.find(index, subindex).variable.qualname
        except SdoAbortError:
            return where
        return f"{where} {name}"

    def _value(self, index: int, subindex: int, data: bytes) -> str:
        try:
            variable = self._dictionary.find(index, subindex).variable
            size = type_size(variable.data_type)
            value = variable.decode_raw(data if size is None else data[:size])
        except (ProtocolError, ValueError, struct.error):
            return data.hex(" ").upper()
        if isinstance(value, bytes):
            return value[:SHOWN_BYTES].hex(" ").upper() + (" …" if len(value) > SHOWN_BYTES else "")
        named = variable.value_descriptions.get(value) if isinstance(value, int) else None
        text = named or (f"{value:.6g}" if isinstance(value, float) else str(value))
        return f"{text} {variable.unit}".strip()

    def _pdo(self, function: int, data: bytes) -> str:
        """Return the objects of a PDO, which are those of its default mapping."""
        direction, number = PDOS[function]
        title = f"{'T' if direction is Direction.TRANSMIT else 'R'}PDO {number + 1}"
        mapping, offset, objects = direction.mapping(number), 0, []
        try:
            count = self._dictionary.find(mapping, 0).number()
            for slot in range(1, count + 1):
                entry = MAPPING_ENTRY.parse(self._dictionary.find(mapping, slot).number().to_bytes(4, "big"))
                size = entry.bits // 8
                part = data[offset : offset + size]
                offset += size
                if len(part) == size:
                    variable = self._dictionary.find(entry.index, entry.subindex).variable
                    objects.append(f"{variable.name}={self._value(entry.index, entry.subindex, part)}")
        except SdoAbortError:
            return title
        return f"{title} {' '.join(objects)}".strip()


def _expedited(data: bytes) -> bytes:
    """Return the value in an expedited request or answer."""
    return data[4 : SDO_LENGTH - (data[0] >> 2 & 0x03)] if data[0] & 0x01 else data[4:]


def _abort(data: bytes) -> str:
    (code,) = struct.unpack_from("<I", data, 4)
    return str(SdoAbortError(code))
