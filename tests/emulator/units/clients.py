"""A device of any unit behind its link, and what clients written from the units' tables need: independent of our codec."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import numpy as np

from starhil.emulator.links.can import CanLink
from starhil.emulator.links.canopen import CanopenLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.truth.source import RateTruth
from starhil.protocol.can.frame import CanFrame
from tests.emulator.conftest import Bench
from tests.emulator.wire import Wire

RA_DEG, DEC_DEG = 83.8, -1.2
"""Where the emulated unit looks, with celestial north up in the image."""


class Emulated:
    """A unit on the stepped clock, which sees the truth, and its serial line or CAN bus."""

    def __init__(self, unit: str) -> None:
        self.bench = Bench(unit=unit).start()
        self.wire = Wire()

    def serial(self) -> Emulated:
        self.link = SerialLink(self.bench.requests, self.wire)
        return self

    def can(self) -> Emulated:
        self.link = CanLink(self.bench.requests, self.wire)
        return self

    def canopen(self) -> Emulated:
        self.link = CanopenLink(self.bench.requests, self.wire)
        return self

    def step(self, seconds: float) -> list:
        """Let time pass; return what the device sent."""
        self.wire.take()
        self.bench.step(seconds)
        return self.wire.take()

    def ask(self, data: bytes) -> bytes:
        """Send bytes; return the bytes of the answer."""
        self.wire.take()
        self.wire.arrive(data)
        return b"".join(self.wire.take())

    def ask_can(self, frame_id: int, data: bytes = b"", *, extended: bool = True) -> list[CanFrame]:
        """Send a CAN frame; return the frames of the answer."""
        self.wire.take()
        self.wire.arrive(CanFrame(frame_id, data, extended=extended))
        return self.wire.take()

    def turn(self, rate_deg_s: tuple[float, float, float]) -> None:
        """Turn at a constant body rate from now on, and let some frames pass."""
        device = self.bench.device
        now_s = self.bench.clock.now_ns() / 1e9
        attitude = device.surroundings.truth.state(now_s).attitude
        device.surroundings.truth = RateTruth(attitude, np.radians(rate_deg_s), now_s)
        self.step(4.0)

    def cover(self) -> None:
        """Cover the lens: no star is seen from now on."""
        self.bench.pipeline.fail = "too_few_stars"


def with_unit(unit: str, link: str, scenario: Callable[[Emulated], None]) -> None:
    """Run a scenario with a unit whose link is open and whose first frames are solved."""

    async def run() -> None:
        emulated = getattr(Emulated(unit), link)()
        await emulated.link.start()
        emulated.step(3.0)
        scenario(emulated)

    asyncio.run(run())


def true_matrix() -> np.ndarray:
    """Return the rotation from ICRS to the sensor: image right, image down, boresight, with north up."""
    ra, dec = math.radians(RA_DEG), math.radians(DEC_DEG)
    boresight = [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
    north = [-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)]
    east = [-math.sin(ra), math.cos(ra), 0.0]
    return np.array([np.negative(east), np.negative(north), boresight])


def attitude_matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Return a textbook's A(q), (w² - v·v) I + 2 v vᵀ - 2 w [v×], which takes vectors from ICRS to the sensor."""
    v = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) - 2 * w * cross


def arcseconds_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle of the rotation between two matrices."""
    sine = np.linalg.norm(first - second) / (2 * math.sqrt(2))
    return math.degrees(2 * math.asin(min(sine, 1.0))) * 3600


# --- SLIP (RFC 1055), XXH32 of its specification, CRC of X-25 bit by bit ---


def slip(body: bytes) -> bytes:
    """Frame a body byte by byte."""
    out = bytearray([0xC0])
    for byte in body:
        out += {0xC0: b"\xdb\xdc", 0xDB: b"\xdb\xdd"}.get(byte, bytes([byte]))
    return bytes(out) + b"\xc0"


def unslip(stream: bytes) -> list[bytes]:
    """Return the bodies in a stream."""
    bodies, body, escaped = [], bytearray(), False
    for byte in stream:
        if escaped:
            body.append({0xDC: 0xC0, 0xDD: 0xDB}[byte])
            escaped = False
        elif byte == 0xDB:
            escaped = True
        elif byte == 0xC0:
            if body:
                bodies.append(bytes(body))
            body.clear()
        else:
            body.append(byte)
    assert not body, "the stream ends within a message"
    return bodies


P1, P2, P3, P4, P5 = 2654435761, 2246822519, 3266489917, 668265263, 374761393
MASK = 0xFFFFFFFF


def _rotate(value: int, bits: int) -> int:
    return (value << bits | value >> (32 - bits)) & MASK


def xxh32(data: bytes, seed: int) -> int:
    """Return XXH32 as its specification computes it."""
    position = 0
    if len(data) >= 16:
        lanes = [(seed + P1 + P2) & MASK, (seed + P2) & MASK, seed, (seed - P1) & MASK]
        while position + 16 <= len(data):
            for lane in range(4):
                word = int.from_bytes(data[position : position + 4], "little")
                lanes[lane] = _rotate((lanes[lane] + word * P2) & MASK, 13) * P1 & MASK
                position += 4
        total = sum(_rotate(lane, turn) for lane, turn in zip(lanes, (1, 7, 12, 18), strict=True))
    else:
        total = seed + P5
    total = (total + len(data)) & MASK
    while position + 4 <= len(data):
        word = int.from_bytes(data[position : position + 4], "little")
        total = _rotate((total + word * P3) & MASK, 17) * P4 & MASK
        position += 4
    for byte in data[position:]:
        total = _rotate((total + byte * P5) & MASK, 11) * P1 & MASK
    total = (total ^ total >> 15) * P2 & MASK
    total = (total ^ total >> 13) * P3 & MASK
    return total ^ total >> 16


def crc16(data: bytes) -> int:
    """Return the CRC with polynomial 8408 (reflected) and initial value FFFF."""
    register = 0xFFFF
    for byte in data:
        for bit in range(8):
            register = register >> 1 ^ (0x8408 if (register ^ byte >> bit) & 1 else 0)
    return register
