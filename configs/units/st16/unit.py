"""Replies of the ST-16 whose data depend on the request: memory, and the result structure by address or in parts.

Layout of the result: `sinclair_stt_result_operational` in hsfl/cosmos-core, libraries/device/sinclair_lib.h.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

from starhil.protocol.messages import ErrorCode
from starhil.protocol.plugin import action

VALID = 0x01 | 0x02 | 0x04 | 0x08 | 0x10 | 0x40
"""Return code for a full and consistent solution from two good images."""
FAILED = 0x10
"""Return code if full processing found no attitude."""

PARTS = ((0x00, 4), (0x04, 4), (0x08, 32), (0x28, 24), (0x40, 8), (0x48, 56), (0x80, 172))
"""Offset and size of the part selected by each bit of a combination, lowest bit first."""
RESULT_SIZE = 0x80 + 172
ANALOG_ADDRESS = 0x04
LENGTH_ADDRESS = 0x4C
EDAC_SIZE = 0x50
ANALOG = {
    "mcu_current": 0.1, "bus_voltage": 5.0, "core_voltage": 1.2, "mcu_voltage": 3.3, "io_voltage": 3.3, "mcu_temperature": 20.0,
    "supervisor_voltage": 3.3, "detector_voltage": 3.3,
}  # fmt: skip
"""Analog values, A, V and °C, in the order of the memory, with their defaults (ours); numbers of `[health]` replace them."""
MAX_MESSAGE_SIZE = 256
"""Bytes of the result in one message (ours)."""


def reader(device: Any) -> Callable[..., float]:
    """Return a function that reads quantities of the device at this moment by name, or a default if one has no value."""
    # Imported here because reading the definition must not require the emulator.
    from starhil.emulator.device.quantities import getter_of

    shot = device.snapshot()

    def value(name: str, default: float = 0.0) -> float:
        found = getter_of(name)(shot)
        return float(found) if isinstance(found, (int, float)) else default

    return value


def result(device: Any) -> bytes:
    """Return the result structure of the last measurement."""
    value = reader(device)
    head = struct.pack(
        "<II4d3dd",
        int(value("frame.counter")),
        VALID if value("attitude.valid") else FAILED,
        *(value(f"attitude.{axis}") for axis in "xyzw"),
        *(value(f"rate.{axis}") for axis in "xyz"),
        value("frame.time"),
    )
    temperature = round(10.0 * value("health.detector_temperature", value("temperature.detector")))
    hardware = bytes(12) + struct.pack("<h", temperature) + bytes(42)
    return head + hardware + bytes(172)


def edac(device: Any) -> bytes:
    """Return the memory that can be read: analog values, and the length of the result."""
    value = reader(device)
    defaults = ANALOG | {"mcu_temperature": value("temperature.detector")}
    analog = struct.pack("<8f", *(value(f"health.{name}", default) for name, default in defaults.items()))
    memory = bytearray(EDAC_SIZE)
    memory[ANALOG_ADDRESS : ANALOG_ADDRESS + len(analog)] = analog
    memory[LENGTH_ADDRESS:] = struct.pack("<I", RESULT_SIZE)
    return bytes(memory)


def memory_reply(memory: bytes, address: int, count: int) -> bytes:
    """Return the data of a reply: an address and the bytes there."""
    from starhil.emulator.device.refusal import Refused

    if address + count > len(memory):
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="address")
    return struct.pack("<H", address) + memory[address : address + count]


@action("read_edac")
def read_edac(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with an address and the memory there."""
    return [memory_reply(edac(device), arguments["address"], arguments["count"])]


@action("go")
def go(_device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with the command."""
    return [bytes((arguments["command"],))]


@action("read_result")
def read_result(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with an offset and the bytes of the result there, in as many messages as needed."""
    start, end = arguments["address"], arguments["address"] + arguments["count"]
    memory = result(device)
    starts = range(start, max(end, start + 1), MAX_MESSAGE_SIZE)
    return [memory_reply(memory, offset, min(MAX_MESSAGE_SIZE, end - offset)) for offset in starts]


@action("combination")
def combination(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with the parts of the result that the bits select, one message each."""
    wanted = arguments["parts_low"] | arguments["parts_high"] << 16
    memory = result(device)
    replies = [memory_reply(memory, *part) for bit, part in enumerate(PARTS) if wanted >> bit & 1]
    return replies or [memory_reply(memory, 0, 0)]
