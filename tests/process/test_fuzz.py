"""10 000 random byte strings and frames cause no crash and no wrong reply, and are counted."""

from __future__ import annotations

import asyncio
import random

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.protocol.can.frame import CanFrame
from tests.process.reference import (
    ICD,
    UNANSWERED,
    CanOracle,
    answer_to,
    bodies_in,
    frame_request,
    is_dangerous,
    requests_in,
)
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

STRINGS = 10_000
FRAMES = 10_000
BATCH = 40
"""Strings that are sent at once: about 1 KiB, well below what a pty holds."""
MARK = 0x80
"""Request that ends a batch: identification."""


def random_string(rng: random.Random) -> bytes:
    """Make a byte string: plain noise, noise of the bytes that mean something, or a framed or mangled request."""
    kind = rng.randrange(10)
    if kind < 3:
        return rng.randbytes(rng.randrange(1, 40))
    if kind < 5:
        return bytes(rng.choices((0x1F, 0x7F, 0xFF, 0x00, 0x80, 0x02, 0x81), k=rng.randrange(1, 25)))
    identifier = rng.choice((rng.randrange(256), *(row.id for row in ICD.rows)))
    row = ICD.row(identifier)
    size = (
        row.size
        if row is not None and row.kind == "telecommand" and rng.random() < 0.7
        else rng.randrange(12)
    )
    data = b"" if identifier >= 128 and rng.random() < 0.8 else rng.randbytes(size)
    if is_dangerous(identifier, data):
        return random_string(rng)
    request = frame_request(identifier, data)
    if kind < 9:
        return request
    spot = rng.randrange(len(request))
    return request[:spot] + bytes([rng.randrange(256)]) * rng.randrange(3) + request[spot + 1 :]


def harmless_batch(rng: random.Random) -> tuple[bytes, list[tuple[int, bytes]]]:
    """Make random strings whose junk does not happen to change how the device answers; return the requests in them too."""
    while True:
        batch = b"".join(random_string(rng) for _ in range(BATCH)) + frame_request(MARK)
        requests = requests_in(batch)
        if not any(is_dangerous(*request) for request in requests):
            return batch, requests


async def exchange(client: ObcClient, data: bytes, expected: int) -> bytes:
    """Send bytes and gather what comes back until it holds the expected number of replies."""
    link = client.core.link
    received = bytearray()
    arrived = asyncio.Event()

    def take(item: bytes) -> None:
        received.extend(item)
        # an end mark cannot stand in the data: every escape byte there is doubled
        if bytes(received).replace(b"\x1f\x1f", b"").count(b"\x1f\xff") >= expected:
            arrived.set()

    link.on_raw = take
    try:
        link.send(data)
        async with asyncio.timeout(PATIENCE_S):
            await arrived.wait()
    finally:
        link.on_raw = None
    return bytes(received)


def test_random_byte_strings(serial_obc, emulator):
    rng = random.Random(20_260_101)
    serial_obc.command("clear_counters")
    telecommands = telemetry = answered = 0
    for _ in range(STRINGS // BATCH):
        batch, requests = harmless_batch(rng)
        answered_ones = [request for request in requests if request[0] not in UNANSWERED]
        replies = bodies_in(serial_obc.run(exchange(serial_obc, batch, len(answered_ones))))
        assert len(replies) == len(answered_ones)
        for request, reply in zip(answered_ones, replies, strict=True):
            assert answer_to(*request).fits(reply), f"request {request[0]} {request[1].hex()}: {reply.hex()}"
        telecommands += sum(identifier < 128 for identifier, _ in requests)
        telemetry += sum(identifier >= 128 for identifier, _ in requests)
        answered += len(replies)
    status = serial_obc.telemetry("communication_status")
    assert answered > STRINGS // 4
    assert status["telecommand_count"] == telecommands % 65536
    assert status["telemetry_count"] == (telemetry + 1) % 65536
    assert status["uart_protocol_error"]
    assert status["uart_incomplete"]
    assert not status["can_telecommand_error"]
    assert serial_obc.telemetry("identification")["interface_version"] == 1
    serial_obc.command("clear_counters")
    assert not serial_obc.telemetry("communication_status")["uart_protocol_error"]
    assert emulator.running


def random_frame(rng: random.Random) -> CanFrame:
    """Make a frame: anything at all, or one for the device."""
    data = rng.randbytes(rng.randrange(9))
    kind = rng.randrange(10)
    if kind == 0:
        return CanFrame(rng.randrange(0x800), data, extended=False)
    if kind == 1:
        return CanFrame(rng.randrange(1 << 29), extended=True, remote=True)
    if kind < 4:
        frame = CanFrame(rng.randrange(1 << 29), data)
    else:
        number = rng.choice((rng.randrange(256), *(row.id for row in ICD.rows)))
        message_type = rng.choice((1, 1, 1, 4, 4, 4, 7, rng.randrange(32)))
        row = ICD.row(number)
        if message_type == 4 and rng.random() < 0.8:
            data = b""
        elif row is not None and row.size <= 8 and rng.random() < 0.7:
            data = rng.randbytes(row.size)
        frame = CanFrame(message_type << 24 | number << 16 | rng.choice((1, 2, 200)) << 8 | 4, data)
    if frame.id >> 24 == 1 and is_dangerous(frame.id >> 16 & 0xFF, frame.data):
        return random_frame(rng)
    return frame


def segmented(rng: random.Random) -> list[CanFrame]:
    """Make a telecommand of several segments, at times with one lost, doubled or out of order."""
    number = rng.choice([row.id for row in ICD.telecommands.values() if row.size > 8] + [rng.randrange(128)])
    row = ICD.row(number)
    data = rng.randbytes(
        row.size if row is not None and row.size > 8 and rng.random() < 0.7 else rng.randrange(9, 40)
    )
    if is_dangerous(number, data):
        return segmented(rng)
    parts = [data[start : start + 7] for start in range(0, len(data), 7)]
    frames = [
        CanFrame(0x07 << 24 | number << 16 | 1 << 8 | 4, part + bytes([len(parts) - 1 - index]))
        for index, part in enumerate(parts)
    ]
    harm = rng.randrange(6)
    spot = rng.randrange(len(frames))
    if harm == 0:
        del frames[spot]
    elif harm == 1:
        frames.insert(spot, frames[spot])
    elif harm == 2:
        rng.shuffle(frames)
    return frames


class BusWatch:
    """Gathers replies of the device from the bus, segments joined."""

    def __init__(self, mark_source: int) -> None:
        self.replies: list[tuple[int, int, bytes]] = []
        self.done = asyncio.Event()
        self._mark_source = mark_source
        self._open: dict[int, bytes] = {}

    def on_frame(self, frame: CanFrame) -> None:
        """Take a frame from the bus; only replies of the device are of interest."""
        kind, number, source, destination = (
            frame.id >> 24,
            frame.id >> 16 & 0xFF,
            frame.id >> 8 & 0xFF,
            frame.id & 0xFF,
        )
        if not frame.extended or source != 4 or kind not in (2, 3, 5, 6, 8):
            return
        body = frame.data
        if kind == 8:
            gathered = self._open.pop(frame.id, b"") + frame.data[:-1]
            if frame.data[-1]:
                self._open[frame.id] = gathered
                return
            body = gathered
        elif kind == 2:
            assert frame.data == b""
            body = b"\0"
        self.replies.append((number, destination, body))
        if destination == self._mark_source:
            self.done.set()


async def exchange_frames(
    client: ObcClient, frames: list[CanFrame], mark: CanFrame
) -> list[tuple[int, int, bytes]]:
    """Send frames and a marking request; return the replies up to that to the mark."""
    link = client.core.link
    watch = BusWatch(mark.id >> 8 & 0xFF)
    link.on_raw = watch.on_frame
    try:
        for frame in [*frames, mark]:
            link.send(frame)
        async with asyncio.timeout(PATIENCE_S):
            await watch.done.wait()
    finally:
        link.on_raw = None
    return watch.replies


def test_random_frames(can_obc, emulator):
    rng = random.Random(20_260_102)
    oracle = CanOracle()
    mark = CanFrame(0x04800000 | 99 << 8 | 4)
    can_obc.command("clear_counters")
    telecommands = telemetry = sent = answered = 0
    while sent < FRAMES:
        # an empty segment ends what is under way, so that no time-out between batches does
        batch = [CanFrame(identifier) for identifier in oracle.unfinished]
        while len(batch) < BATCH:
            batch += segmented(rng) if rng.random() < 0.03 else [random_frame(rng)]
        expected = []
        for frame in [*batch, mark]:
            request = oracle.take(frame.id, frame.data, extended=frame.extended, remote=frame.remote)
            if request is not None:
                assert not is_dangerous(*request[:2])
                expected.append(answer_to(*request))
        replies = can_obc.run(exchange_frames(can_obc, batch, mark))
        assert [(item.identifier, item.source) for item in expected] == [reply[:2] for reply in replies]
        for item, reply in zip(expected, replies, strict=True):
            assert item.fits(reply[2]), f"request {item.identifier}: {reply[2].hex()}"
        telecommands += sum(item.identifier < 128 for item in expected)
        telemetry += sum(item.identifier >= 128 for item in expected)
        sent += len(batch)
        answered += len(replies)
    status = can_obc.telemetry("communication_status")
    assert answered > FRAMES // 5
    assert status["telecommand_count"] == telecommands % 65536
    assert status["telemetry_count"] == (telemetry + 1) % 65536
    assert status["can_telecommand_error"]
    assert can_obc.telemetry("identification")["interface_version"] == 1
    # no half message is left to time out and set its flag again
    can_obc.run(exchange_frames(can_obc, [CanFrame(identifier) for identifier in oracle.unfinished], mark))
    can_obc.command("clear_counters")
    assert not can_obc.telemetry("communication_status")["can_telecommand_error"]
    assert emulator.running
