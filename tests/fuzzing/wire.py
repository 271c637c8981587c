"""Targets on the wire: serial lines, CAN, CANopen, the device behind them, and lines of text on a bus."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.truth.feed_message import JsonFormat
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.simulator_42 import Format42
from starhil.hil_tests.client.raw_traffic import parse_frame as parse_cansend
from starhil.hil_tests.client.raw_traffic import pattern
from starhil.hil_tests.rig.emulator_process import parse_ready_line
from starhil.protocol.can.cubespace import (
    CanDeviceReceiver,
    CanHostReceiver,
    encode_reply_frames,
    encode_request_frames,
)
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.can.socketcand import (
    CommandSplitter,
    format_frame,
    format_send,
    parse_frame,
    parse_send,
)
from starhil.protocol.canopen.storage import FileStorage
from starhil.protocol.errors import ProtocolError
from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.image_transfer import parse_burst_packet
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.emulator.conftest import Bench
from tests.fuzzing.target import DOCUMENTED, NESTED, TARGETS, Run, Target, chunks, target
from tests.protocol.canopen.conftest import Bench as CanopenBench

UNITS = tuple(bundled_units())


def rows_of(unit: str) -> tuple[list[Request], list[Reply]]:
    """Return a good request and a good reply of each row."""
    icd = load_unit(unit)
    requests, replies = [], []
    for row in icd.rows:
        is_command = row.kind == "telecommand"
        requests.append(icd.request(row, row.encode(row.example()) if is_command else b""))
        kind = ReplyKind.ACK if is_command else ReplyKind.TELEMETRY
        data = b"" if is_command else row.encode()
        if len(data) < 200:
            replies.append(Reply(kind, row.id, data, message_class=row.message_class))
    return requests, replies


def examined(unit: str, events: Any) -> int:
    """Decode the data of each message as its row says; return how many messages there were."""
    icd, count = load_unit(unit), 0
    for event in events:
        if isinstance(event, LinkFault):
            continue
        count += 1
        row = icd.row(event.id or 0, event.message_class)
        if row is not None:
            try:
                row.decode(event.data)
            except ProtocolError:
                continue
    return count


def serial_seeds(unit: str, *, device: bool) -> list[bytes]:
    """Good messages, each as one chunk."""
    stack = SerialStack(load_unit(unit))
    requests, replies = rows_of(unit)
    messages = map(stack.encode_request, requests) if device else map(stack.encode_reply, replies)
    return [bytes([31]) + message for message in messages if message]


def serial_device(unit: str, _folder: Path) -> Run:
    """The device's end of a serial line; afterwards it reads a good request."""
    stack = SerialStack(load_unit(unit))
    good = rows_of(unit)[0][-1]

    def run(data: bytes) -> None:
        receiver, now = stack.device(), 0.0
        for chunk in chunks(data):
            now += 0.001
            examined(unit, receiver.feed(chunk, now))
        receiver.flush(now + 10.0)
        assert not receiver.busy
        assert examined(unit, receiver.feed(stack.encode_request(good), now + 20.0)) >= 1

    return run


def serial_host(unit: str, _folder: Path) -> Run:
    """The OBC's end of a serial line, which expects the reply to the row that the first byte selects."""
    icd = load_unit(unit)
    stack = SerialStack(icd)
    rows = list(icd.rows)

    def run(data: bytes) -> None:
        receiver, now = stack.host(), 0.0
        row = rows[(data[0] if data else 0) % len(rows)]
        receiver.overhear(icd.request(row))
        for chunk in chunks(data):
            now += 0.001
            examined(unit, receiver.feed(chunk, now))
        receiver.flush(now + 10.0)
        assert not receiver.busy

    return run


for _unit in UNITS:
    if load_unit(_unit).link.serial is not None:
        TARGETS[f"serial-device-{_unit}"] = Target(
            partial(serial_device, _unit), partial(serial_seeds, _unit, device=True)
        )
        TARGETS[f"serial-host-{_unit}"] = Target(
            partial(serial_host, _unit), partial(serial_seeds, _unit, device=False)
        )


def frames_of(data: bytes, identifiers: list[int], *, extended: bool) -> Iterator[CanFrame]:
    """Read frames, ten bytes each: identifier by number, one bit of it flipped or flags, eight data bytes."""
    for start in range(0, len(data), 10):
        part = data[start : start + 10]
        identifier = identifiers[part[0] % len(identifiers)]
        flags = part[1] if len(part) > 1 else 0
        if flags >= 224:
            yield CanFrame(identifier, b"", extended=extended != (flags % 2 == 1), remote=flags % 4 > 1)
            continue
        if flags >= 192:
            identifier ^= 1 << flags % (29 if extended else 11)
        yield CanFrame(identifier, part[2 : 10 - (flags % 9 if 128 <= flags < 192 else 0)], extended=extended)


CUBESTAR_REQUESTS, CUBESTAR_REPLIES = rows_of("cubestar")
REQUEST_FRAMES = [frame for item in CUBESTAR_REQUESTS for frame in encode_request_frames(item, 1, 4)]
REPLY_FRAMES = [
    frame
    for item in CUBESTAR_REPLIES
    for kind in (item.kind, ReplyKind.UNSOLICITED)
    for frame in encode_reply_frames(Reply(kind, item.id, item.data, destination=1), 4)
]


def numbered(frames: list[CanFrame]) -> tuple[list[int], list[bytes]]:
    """Return the identifiers (at most 256), and frames as `frames_of` reads them."""
    identifiers = sorted({frame.id for frame in frames})[:256]
    known = [frame for frame in frames if frame.id in identifiers]
    return identifiers, [
        bytes([identifiers.index(frame.id), 128 + 8 - len(frame.data)]) + frame.data.ljust(8, b"\0")
        for frame in known
    ]


def in_runs(pieces: list[bytes]) -> list[bytes]:
    """Join five frames to a seed."""
    return [b"".join(pieces[start : start + 5]) for start in range(0, len(pieces), 5)]


@target("can-device", lambda: in_runs(numbered(REQUEST_FRAMES)[1]))
def _can_device(_folder: Path) -> Run:
    identifiers = numbered(REQUEST_FRAMES)[0]

    def run(data: bytes) -> None:
        receiver = CanDeviceReceiver(4, max_size=80)
        for number, frame in enumerate(frames_of(data, identifiers, extended=True)):
            for event in receiver.feed(frame, number * 0.001):
                assert isinstance(event, LinkFault) or len(event.data) <= 80
        receiver.flush(1e3)
        assert not receiver.busy

    return run


@target("can-host", lambda: in_runs(numbered(REPLY_FRAMES)[1]))
def _can_host(_folder: Path) -> Run:
    identifiers = numbered(REPLY_FRAMES)[0]

    def run(data: bytes) -> None:
        receiver = CanHostReceiver(1, 4, max_size=300)
        for number, frame in enumerate(frames_of(data, identifiers, extended=True)):
            examined("cubestar", receiver.feed(frame, number * 0.001))
        receiver.flush(1e3)
        assert not receiver.busy

    return run


# --- the device behind the links ---


def request_seeds(unit: str) -> list[bytes]:
    """Each row with good data."""
    return [
        bytes([number, len(item.data)]) + item.data
        for number, item in enumerate(rows_of(unit)[0])
        if max(number, len(item.data)) < 256
    ]


def requests_of(unit: str, _folder: Path) -> Run:
    """A device that is on, and is sent rows with any data while time passes."""
    icd = load_unit(unit)
    rows = list(icd.rows)

    def run(data: bytes) -> None:
        bench, at = Bench(unit=unit).start(), 0
        while at < len(data):
            row, size = rows[data[at] % len(rows)], data[at + 1] if at + 1 < len(data) else 0
            request = icd.request(row, data[at + 2 : at + 2 + size])
            answer = bench.requests.handle(request)
            if isinstance(answer, PendingAnswer):
                answer.when_done(bench.later.extend)
            else:
                bench.later.extend(answer)
            bench.step(0.01 * (size % 50))
            at += 2 + size
        assert all(isinstance(reply, Reply) for reply in bench.later)

    return run


for _unit in UNITS:
    if not load_unit(_unit).canopen_only:
        TARGETS[f"device-{_unit}"] = Target(partial(requests_of, _unit), partial(request_seeds, _unit))

NODE = 0x2C
CANOPEN_IDENTIFIERS = [
    0x600 + NODE, 0x7E5, 0x000, 0x080, 0x100, 0x080 + NODE, 0x180 + NODE, 0x200 + NODE, 0x300 + NODE, 0x400 + NODE,
    0x500 + NODE, 0x580 + NODE, 0x700 + NODE, 0x601, 0x705, 0x7E4,
]  # fmt: skip
CANOPEN_SEEDS = [
    "0080 4000100000000000", "0080 2310100173617665", "0080 2b17100064000000", "0080 a020600004000000 0080 a300000000000000",
    "0080 c020600014000000 0080 0141424344454647", "0080 2100200008000000 0080 0001020304050607", "0086 0100 0286 012c",
    "0180 0401000000000000 0180 5e00000000000000", "0180 5100000000000000 0180 4600000000000000", "0380 0", "0480 001122334455",
    "0780 0102030405060708", "0280 812c", "0c84 05", "0080 2314100180000000", "0080 2f00180005000000 0080 2300180100000080",
]  # fmt: skip


def canopen_slave(unit: str, folder: Path) -> Run:
    """A CANopen slave with stored parameters, sent any frames; it survives and answers with frames."""
    bench = CanopenBench(unit=unit, storage=FileStorage(folder / "parameters.json")).power_on()
    bench.show(bytes(300))

    def run(data: bytes) -> None:
        bench.now += 1e4
        for frame in frames_of(data, CANOPEN_IDENTIFIERS, extended=False):
            bench.now += 0.001
            answers = bench.slave.receive(frame, bench.now)
            deadline = bench.slave.next_deadline()
            if deadline is not None and deadline <= bench.now:
                answers = [*answers, *bench.slave.tick(bench.now)]
            assert len(answers) <= 200
            bench.slave.take_events()

    return run


for _unit in UNITS:
    if load_unit(_unit).canopen is not None:
        TARGETS[f"canopen-{_unit}"] = Target(
            partial(canopen_slave, _unit),
            lambda: [bytes.fromhex(text + "0" * (len(text.replace(" ", "")) % 2)) for text in CANOPEN_SEEDS],
        )


# --- lines of text on a bus ---


@target(
    "socketcand",
    lambda: [*map(format_send, REQUEST_FRAMES[:40]), *(format_frame(f, b"1.5") for f in REPLY_FRAMES[:40])],
)
def _socketcand(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        splitter = CommandSplitter()
        for chunk in chunks(data):
            for command in splitter.feed(chunk):
                for parse in (parse_send, parse_frame):
                    try:
                        parse(command or b"")
                    except ProtocolError:
                        continue

    return run


@target(
    "cansend",
    lambda: [b"07360104#0001020304050601", b"123#R", b"1F 7F .. FF", b"123#00.."],
)
def _cansend(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        for parse in (parse_cansend, pattern, parse_ready_line):
            try:
                parse(data.decode("latin-1"))
            except DOCUMENTED:
                continue

    return run


@target("burst", lambda: [bytes(22), b"\x00\x04" + bytes(20)])
def _burst(_folder: Path) -> Run:
    return parse_burst_packet


FEED = {
    "t": 12.25, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.3, 0.0], "position_m": [7e6, 0.0, 0.0],
    "velocity_m_s": [0.0, 7e3, 0.0], "unix_s": 1.7e9,
}  # fmt: skip
BLOCK_42 = b"""TIME 2026-326-10:11:12.500000000
SC[0].qn = 0.0 0.0 0.0 1.0
SC[0].B[0].wn = 0.0 0.001 0.0
SC[0].PosR = 0.0 0.0 0.0
SC[0].VelR = 0.0 0.0 0.0
Orb[0].PosN = 7.0e6 0.0 0.0
Orb[0].VelN = 0.0 7.5e3 0.0
[ENDMSG]
"""


@target("feed", lambda: [json.dumps(FEED).encode(), NESTED, BLOCK_42])
def _feed(_folder: Path) -> Run:
    def run(data: bytes) -> None:
        for form in (JsonFormat(), JsonFormat("attitude", "wxyz"), Format42()):
            try:
                message = form.decode(data)
            except FeedError:
                continue
            assert np.isfinite(message.attitude.quaternion_xyzw).all()

    return run
