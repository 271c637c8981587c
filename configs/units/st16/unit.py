"""Replies of the ST-16 whose data depend on the request: EDAC memory, and the result by address or in parts.

Layout of the result: `sinclair_stt_result_operational` and `_selftest` in hsfl/cosmos-core, libraries/device/sinclair_lib.h;
that of a matching structure, the order of its quaternion, and that of an analog frame also in tables 45 and 46 of the copy of the
vendor's document (doclecture.net/1-35920.html). Numbers that the emulator does not model are zeros.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from starhil.protocol.messages import ErrorCode, FaultKind
from starhil.protocol.plugin import action, quantity

VALID = 0x01 | 0x02 | 0x04 | 0x08 | 0x10 | 0x40
"""Return code for a full and consistent solution from two good images."""
FAILED = 0x10
"""Return code if full processing found no attitude."""
NOT_FOUND = -1
"""Return code of a step without a solution, and the number of a star that was not identified (ours)."""

PARTS = (
    (0x00, 4), (0x04, 4), (0x08, 32), (0x28, 24), (0x40, 8), (0x48, 56), (0x80, 172),
    (0x130, 2 * 392), (0x440, 104), (0x4A8, 2 * 416), (0x7E8, 2 * 176),
)  # fmt: skip
"""Offset and size of the part of the result selected by each bit of a combination, lowest bit first."""
SELF_TEST_BIT = 11
"""Bit of a combination that selects the result of the self-test, which then stands in the place of the other."""
PEAKS, BEST = 30, 10
"""Peaks of an image, and stars of the other structures."""
EDAC_SIZE = 512
ANALOG_ADDRESS = 0x04
LENGTH_ADDRESS = 0x4C
COUNTER_ADDRESS = 0x50
"""Framing errors, runts, oversize messages, bad CRCs, FIFO overflows, u32 each: which are counted, and when, is in 1-35919; the
address is ours."""
FAULTS = (FaultKind.UART_PROTOCOL, FaultKind.UART_SHORT, FaultKind.UART_OVERLONG, FaultKind.UART_CHECK)
"""Faults of the first four counters; the FIFO never overflows."""
ANALOG = {
    "mcu_current": 0.1, "bus_voltage": 5.0, "core_voltage": 1.2, "mcu_voltage": 3.3, "io_voltage": 3.3, "mcu_temperature": 20.0,
    "supervisor_voltage": 3.3, "detector_voltage": 3.3,
}  # fmt: skip
"""Analog values, A, V and °C, in the order of the memory, with their defaults (ours); numbers of `[health]` replace them."""
MAX_MESSAGE_SIZE = 256
"""Bytes of the result in one message: as many as the short form can ask for."""
ON, TEST = 0x01, 0x10
"""Bits of a GO code."""
IDLE, PROCESSING = 0, 1
"""States of a sequence (ours)."""


@dataclass
class Sequence:
    """The state of a tracker since its start."""

    started_ns: int
    """Start of the device, after which all is as at first."""
    code: int = 0
    """The last GO code; 0: idle."""
    frames: int = 0
    """Measurements published before the sequence began."""
    memory: bytearray = field(default_factory=lambda: bytearray(EDAC_SIZE))
    """EDAC memory as it was written."""

    def begin(self, code: int, frames: int) -> None:
        """Execute a GO code."""
        self.code, self.frames = code, frames


_sequences: WeakKeyDictionary[Any, Sequence] = WeakKeyDictionary()


def sequence_of(device: Any) -> Sequence:
    """Return the state of a tracker, a new one after a restart of the device."""
    found = _sequences.get(device)
    if found is None or found.started_ns != device.started_ns:
        found = _sequences[device] = Sequence(device.started_ns)
    return found


def reader(snapshot: Any) -> Callable[..., float]:
    """Return a function that reads quantities of this moment by name, or a default if one has no value."""
    # Imported here because reading the definition must not require the emulator.
    from starhil.emulator.device.quantities import getter_of

    def value(name: str, default: float = 0.0) -> float:
        found = getter_of(name)(snapshot)
        return float(found) if isinstance(found, (int, float)) else default

    return value


def refused(
    argument: str | None = None, data: bytes = b"", code: ErrorCode = ErrorCode.INVALID_PARAMETER
) -> Exception:
    """Return the exception that refuses a request."""
    from starhil.emulator.device.refusal import Refused

    return Refused(code, argument, data)


# --- the result ---


def first(stars: Any, count: int, empty: Any, of: Callable[[Any], Any]) -> list[Any]:
    """Return something of each of the first stars, filled up to a count."""
    return [of(star) for star in stars[:count]] + [empty] * (count - len(stars[:count]))


def epoch_s(snapshot: Any) -> float:
    """Return the middle of the exposure on the count of TIME, seconds since start; 0 before the first."""
    return (
        0.0
        if snapshot.frame is None
        else (snapshot.frame.mid_ns - snapshot.now_ns + snapshot.uptime_ns) / 1e9
    )


def hardware(value: Callable[..., float]) -> bytes:
    """Return the hardware telemetry."""
    celsius = round(10.0 * value("health.detector_temperature", value("temperature.detector")))
    return bytes(12) + struct.pack("<h", celsius) + bytes(42)


def result(snapshot: Any) -> bytes:
    """Return the result of the last measurement; both images are the one that the emulator takes."""
    value = reader(snapshot)
    valid, epoch = bool(value("attitude.valid")), epoch_s(snapshot)
    quaternion = [value(f"attitude.{axis}") for axis in "wxyz"]
    stars, code, count = snapshot.stars, 0 if valid else NOT_FOUND, int(value("stars.matched"))
    head = struct.pack(
        "<II4d3dd",
        int(value("frame.counter")),
        VALID if valid else FAILED,
        *quaternion,
        *(value(f"rate.{axis}") for axis in "xyz"),
        epoch,
    )
    spots = [
        number
        for spot in first(
            stars, PEAKS, (0, 0, 0), lambda star: (round(star.x), round(star.y), round(star.snr))
        )
        for number in spot
    ]
    image = struct.pack("<IiiI2d90i", 1, code, 0, min(len(stars), PEAKS), 0.0, epoch, *spots)
    mapping = first(stars, BEST, NOT_FOUND, lambda star: star.hip)
    rate = struct.pack("<Ii10i7d", 1, code, *mapping, *bytes(7))
    places = [
        number for place in first(stars, BEST, (0.0, 0.0), lambda star: (star.x, star.y)) for number in place
    ]
    vectors = [
        number for vector in first(stars, BEST, (0.0,) * 3, lambda star: star.vector) for number in vector
    ]
    centroids = struct.pack("<IiiI50d", 1, code, count, 0, *places, *vectors)
    matching = struct.pack(
        "<IiII2diiiId10i4d6d",
        1, code, 0, 0, 0.0, value("attitude.confidence"), 0, 0, count, 0, 0.0, *mapping, *quaternion, *bytes(6),
    )  # fmt: skip
    statistics = struct.pack("<HH", *2 * (snapshot.constants.image_size[1],)) + bytes(168)
    return b"".join(
        (head, hardware(value), statistics, bytes(4), image * 2, rate, centroids * 2, matching * 2)
    )


def self_test(snapshot: Any) -> bytes:
    """Return the result of the self-test: analog values at each step, and two tests, which have found no error."""
    frame, value = analog(snapshot), reader(snapshot)
    return b"".join((frame * 10, bytes(8), frame, hardware(value), frame, bytes(172), frame))


def whole_result(state: Sequence, snapshot: Any) -> bytes:
    """Return the result that the last GO code asked for."""
    return self_test(snapshot) if state.code & TEST else result(snapshot)


# --- EDAC memory ---


def analog(snapshot: Any) -> bytes:
    """Return an analog frame."""
    value = reader(snapshot)
    defaults = ANALOG | {"mcu_temperature": value("temperature.detector")}
    return struct.pack("<8f", *(value(f"health.{name}", default) for name, default in defaults.items()))


def edac(state: Sequence, snapshot: Any) -> bytes:
    """Return EDAC memory: what was written, and over it what the unit keeps there."""
    memory = bytearray(state.memory)
    done = state.code & ON and snapshot.frames > state.frames
    counters = [snapshot.counters.faults.get(kind, 0) for kind in FAULTS] + [0]
    for address, data in (
        (ANALOG_ADDRESS, analog(snapshot)),
        (LENGTH_ADDRESS, struct.pack("<I", len(whole_result(state, snapshot)) if done else 0)),
        (COUNTER_ADDRESS, struct.pack("<5I", *counters)),
    ):
        memory[address : address + len(data)] = data
    return bytes(memory)


def part_of(memory: bytes | bytearray, address: int, count: int) -> bytes:
    """Return bytes of a memory; refuse those beyond its end."""
    if address + count > len(memory):
        raise refused("address")
    return bytes(memory[address : address + count])


def count_of(arguments: Mapping[str, Any]) -> int:
    """Return the count of a short or long form; 0 in the short form is 256 (1-35917)."""
    high = arguments.get("count_high")
    return (arguments["count"] or 256) if high is None else arguments["count"] | high << 8


def written(device: Any, address: int, data: bytes) -> None:
    """Write EDAC memory."""
    part_of(sequence_of(device).memory, address, len(data))
    sequence_of(device).memory[address : address + len(data)] = data


def read(memory: bytes, arguments: Mapping[str, Any]) -> list[bytes]:
    """Return address and bytes of a memory, in as many messages as needed."""
    address, data = arguments["address"], part_of(memory, arguments["address"], count_of(arguments))
    starts = range(0, max(len(data), 1), MAX_MESSAGE_SIZE)
    return [struct.pack("<H", address + start) + data[start : start + MAX_MESSAGE_SIZE] for start in starts]


# --- commands ---


@action("init")
def init(device: Any, _arguments: Mapping[str, Any]) -> None:
    """Return to idle."""
    sequence_of(device).begin(0, 0)


@action("read_file")
def read_file(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with the number of a file, in the form in which it was sent, and its four bytes."""
    number: bytes = arguments["file"]
    memory = edac(sequence_of(device), device.snapshot())
    return [number + part_of(memory, 4 * int.from_bytes(number, "little"), 4)]


@action("write_file")
def write_file(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Write a file, and answer with the command."""
    data: bytes = arguments["file_data"]
    written(device, 4 * int.from_bytes(data[:-4], "little"), data[-4:])
    return [data]


@action("read_edac")
def read_edac(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with an address and the memory there, all of one moment (1-35916); 512 bytes are one message."""
    memory, count = edac(sequence_of(device), device.snapshot()), count_of(arguments)
    return [struct.pack("<H", arguments["address"]) + part_of(memory, arguments["address"], count)]


@action("write_edac")
def write_edac(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Write memory, and answer with the command."""
    written(device, arguments["address"], arguments["data"])
    return [struct.pack("<H", arguments["address"]) + arguments["data"]]


@action("go")
def go(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Begin or end a sequence, and answer with the code."""
    sequence_of(device).begin(arguments["code"], device.snapshot().frames)
    return [bytes((arguments["code"],))]


@action("read_result")
def read_result(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with an offset and the bytes of the result there."""
    return read(whole_result(sequence_of(device), device.snapshot()), arguments)


@action("dark_window")
def dark_window(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Answer with the command if the window is inside the image."""
    columns, rows = device.snapshot().constants.image_size
    for start, count, size in (("row", "rows", rows), ("column", "columns", columns)):
        if arguments[start] + arguments[count] > size:
            raise refused(count)
    window = [arguments[name] for name in ("row", "column", "rows", "columns")]
    return [struct.pack("<BB4H", 0, arguments["image"], *window) + arguments["dark"]]


@action("combination")
def combination(device: Any, arguments: Mapping[str, Any]) -> list[bytes]:
    """Execute a GO code and answer with the parts of the result that the bits select, in a row."""
    state, snapshot = sequence_of(device), device.snapshot()
    parts, code = arguments["parts_low"] | arguments["parts_high"] << 16, arguments["code"]
    tested = bool(parts >> SELF_TEST_BIT & 1)
    state.begin(code, 0)
    why = (
        "functional processor is off" if not code & ON
        else "no result yet" if snapshot.frame is None
        else "self-test and operational parts are not in one result" if tested != bool(code & TEST)
        else ""
    )  # fmt: skip
    if why:
        raise refused(
            data=bytes((PROCESSING if code & ON else IDLE,)) + why.encode("ascii"), code=ErrorCode.SEQUENCE
        )
    memory = whole_result(state, snapshot)
    chosen = [part for bit, part in enumerate(PARTS) if parts >> bit & 1]
    stream = memory if tested else b"".join(part_of(memory, *part) for part in chosen)
    starts = range(0, max(len(stream), 1), MAX_MESSAGE_SIZE)
    return [struct.pack("<H", start) + stream[start : start + MAX_MESSAGE_SIZE] for start in starts]


@quantity("time.low", unit="us", doc="Lower 32 bits of the count of microseconds since start.")
def time_low(snapshot: Any) -> int:
    """Return bits 0 to 31 of TIME, whose lowest bit is always 0 (1-35918)."""
    return int(snapshot.uptime_ns // 1000 & 0xFFFFFFFE)


@quantity("time.high", doc="Upper 16 bits of the count of microseconds since start.")
def time_high(snapshot: Any) -> int:
    """Return bits 32 to 47 of TIME."""
    return int(snapshot.uptime_ns // 1000 >> 32 & 0xFFFF)
