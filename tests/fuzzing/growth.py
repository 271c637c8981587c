"""The target of growth: messages on every channel that look valid and become longer; their work per byte must not.

The work is the number of calls, of Python and of C, in all threads: deterministic, unlike time. `tools/fuzz.py --growth`
measures the time as well, because a call of C may also take longer.
"""

from __future__ import annotations

import asyncio
import copy
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

from starhil.emulator.cli.fmu.process import PACKET, _unpacked
from starhil.emulator.console.reported_runs import ReportedRuns
from starhil.emulator.truth.feed import LiveFeed, _Datagrams
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.simulator_42 import Format42
from starhil.protocol.can.cubespace import CanDeviceReceiver
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.can.socketcand import format_send
from starhil.protocol.errors import OneLineError
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.connections import TURN, Budget
from starhil.protocol.transports.hub import CanHub, _Client
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from tests.fuzzing.control import ASKED, REQUESTS, _Loop, console_of, viewer_of
from tests.fuzzing.edits import _spots
from tests.fuzzing.target import Run, target
from tests.fuzzing.wire import (
    BLOCK_42,
    CANOPEN_IDENTIFIERS,
    CANOPEN_SEEDS,
    FEED,
    REQUEST_FRAMES,
    UNITS,
    frames_of,
    rows_of,
)
from tests.protocol.canopen.conftest import Bench as CanopenBench

SMALL, LARGE = 4_000, 32_000
"""Sizes of a message that are compared, bytes."""

GROWTH = 2.0
"""Largest growth of the work per byte, from the small to the large message; quadratic work would grow by 8."""

FIXED_S = 1e-3
"""Processor time that a message may need whatever its size, seconds."""

FIXED_WORK = 10_000
"""Calls that a message may need whatever its size."""

HOLDS = {"kind": "slew", "segments": [{"do": "hold", "seconds": 1.0}, {"do": "slew", "to": {"ra_deg": 1.0, "dec_deg": 2.0}, "max_rate_deg_s": 1.0}]}  # fmt: skip
GROWING = [
    *(request for request in REQUESTS if request["do"] not in ("quit", "step")),
    {"do": "set_truth", "truth": HOLDS},
    {"do": "set_truth", "truth": {"kind": "file", "path": "slew.csv"}},
    {"do": "fault", "optical": {"planets": [{"ra_deg": 1.0, "dec_deg": 2.0, "magnitude": 3.0}], "obstructions": [{"polygon_px": [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]}]}},
    {"do": "fault", "device": {"error": "sensor", "reset": "command", "upset": {"parameter": "exposure_ms", "bit": 1}}},
]  # fmt: skip
REPORTS = [
    {"run": "1", "event": "begin", "kind": "session", "title": "t", "unit": "u", "planned": 1},
    {"run": "1", "event": "result", "result": {"status": "passed", "name": "n", "log": ["a", "b"]}},
]


WORST = [
    bytes(numbers) for numbers in ((0, 9, 3, 3), (0, 9, 3, 6), (0, 10, 1, 4), (0, 11, 1, 4), (4, 0, 1, 0))
]
"""Empty segments, wrong segments, unknown keys of a truth and of a sky, and a datagram of many messages."""


@dataclass(frozen=True)
class Channel:
    """A channel: good messages, and a function that processes one of them, grown."""

    messages: list[bytes]
    process: Callable[[bytes], object]
    is_json: bool = False

    def grown(self, message: bytes, spot: int, shape: int, size: int) -> bytes:
        """Return a message of about a size; a document grows at a spot, other bytes from a spot on."""
        if self.is_json:
            return grown_document(json.loads(message), spot, shape, size)
        spot %= len(message)
        match shape % 4:
            case 0:
                return message * (size // len(message))
            case 1:
                return message[:spot] + message[spot : spot + 8] * (size // 8) + message[spot:]
            case 2:
                return message[: spot + 1] * (size // (spot + 1))
            case _:
                return message[:spot] + message[spot : spot + 1] * size + message[spot:]


def grown_document(document: Any, spot: int, shape: int, size: int) -> bytes:
    """Return JSON of a document in which one value has grown: by items, keys, length or depth."""
    document = copy.deepcopy(document)
    spots = list(_spots(document))
    holder, key = spots[spot % len(spots)]
    value = holder[key]
    each = json.dumps(value)
    match shape % 7:
        case 0:
            holder[key] = [value] * (size // (len(each) + 2))
        case 1:
            holder[key] = {f"key{number:05}": value for number in range(size // (len(each) + 14))}
        case 2:
            holder[key] = f"{value}" + "a" * size
        case 3:
            holder[key] = [{}] * (size // 4)
        case 4 if isinstance(value, dict):
            value |= {f"key{number:05}": number for number in range(size // 17)}
        case 5 if isinstance(value, list):
            holder[key] = value * (size // (len(each) + 1))
        case 6 if isinstance(value, (list, dict)):
            rows = [value] if isinstance(value, dict) else value
            wrong = [{**row, "kez": 1} if isinstance(row, dict) else "x" for row in rows]
            holder[key] = wrong * max(1, size // len(json.dumps(wrong)))
        case _:
            holder[key] = ["ab " * (size // 3)]
    return json.dumps(document).encode()


class _Transport:
    """The connection of a client of the hub that reads at once."""

    def get_extra_info(self, _name: str) -> Any:
        """Return a socket without options."""
        return self

    def setsockopt(self, *_option: object) -> None:
        """Take an option."""

    def set_write_buffer_limits(self, high: int) -> None:
        """Take a limit."""

    def is_closing(self) -> bool:
        """It stays open."""
        return False

    def get_write_buffer_size(self) -> int:
        """Nothing waits."""
        return 0

    def write(self, data: bytes) -> None:
        """Take data."""


def _hub(loop: asyncio.AbstractEventLoop) -> Channel:
    hub = CanHub()
    clients = [_Client(hub) for _ in range(3)]

    async def process(data: bytes) -> None:
        for start in range(0, len(data), TURN):
            clients[0].data_received(data[start : start + TURN])

    async def join() -> None:
        for client in clients:
            client.connection_made(cast("asyncio.BaseTransport", _Transport()))
            client.data_received(b"< open vcan0 >< rawmode >< echo >")

    loop.run_until_complete(join())
    messages = [*map(format_send, REQUEST_FRAMES[:3]), b"< open vcan0 >", b"< echo >"]
    return Channel(messages, lambda data: loop.run_until_complete(process(data)))


def _serial(unit: str) -> Channel:
    stack = SerialStack(load_unit(unit))

    def process(data: bytes) -> None:
        receiver = stack.device()
        for start in range(0, len(data), 16):  # as a line brings them
            receiver.feed(data[start : start + 16], 0.0)

    return Channel([stack.encode_request(request) for request in rows_of(unit)[0][:4]], process)


def _can() -> Channel:
    def process(data: bytes) -> None:
        receiver = CanDeviceReceiver(4, max_size=80)
        for number, start in enumerate(range(0, len(data), 8)):
            frame = REQUEST_FRAMES[number % len(REQUEST_FRAMES)]
            receiver.feed(CanFrame(frame.id, data[start : start + 8]), 0.0)
        for start in range(0, len(data), 8):
            receiver.feed(CanFrame(0x07 << 24 | 3 << 16 | 1 << 8 | 4, data[start : start + 8]), 0.0)

    return Channel([b"\0\1\2\3\4\5\6\7", b"\0\0\0\0\0\0\0\x09"], process)


def _canopen(unit: str) -> Channel:
    bench = CanopenBench(unit=unit).power_on()

    def process(data: bytes) -> None:
        for frame in frames_of(data, CANOPEN_IDENTIFIERS, extended=False):
            bench.slave.receive(frame, bench.now)
            bench.slave.take_events()

    return Channel(
        [bytes.fromhex(text + "0" * (len(text.replace(" ", "")) % 2)) for text in CANOPEN_SEEDS], process
    )


def _feed(form: Any, messages: list[bytes]) -> Channel:
    feed = LiveFeed(LiveTruth(Attitude.identity(), message_format=form), lambda: 1.0)
    datagrams = _Datagrams(feed, Budget())

    def process(data: bytes) -> None:
        datagrams.add(data)
        while datagrams.waiting:
            datagrams.process_line()

    return Channel(messages, process)


def _whole(form: Format42) -> Channel:
    return Channel(
        [BLOCK_42], lambda data: LiveTruth(Attitude.identity(), message_format=form).receive(data, 1.0)
    )


def _fmu() -> Channel:
    def process(data: bytes) -> None:
        for start in range(0, len(data), PACKET.size):
            _unpacked(data[start : start + PACKET.size].ljust(PACKET.size, b"\0"))

    return Channel([bytes(8) + b"text", b"\x1f" * 32], process)


def channels() -> dict[str, Channel]:
    """Return every channel by name."""
    run_ = _Loop()
    run_.loop.set_default_executor(ThreadPoolExecutor(2, initializer=partial(sys.setprofile, _count)))
    console, runs = console_of(run_), ReportedRuns()
    viewer = viewer_of(console)

    def documents(requests: list[Any]) -> list[bytes]:
        return [json.dumps(request).encode() for request in requests]

    def ask(data: bytes) -> None:
        run_.call(console.answer(viewer, json.loads(data)))
        viewer._texts.clear()  # as a page that reads at once

    return {
        "control": Channel(
            documents(GROWING), lambda data: run_.call(run_.control.answer(data)), is_json=True
        ),
        "console": Channel(documents(ASKED), ask, is_json=True),
        "reports": Channel(documents(REPORTS), lambda data: runs.report(json.loads(data)), is_json=True),
        "hub": _hub(run_.loop),
        "feed": _feed(None, [json.dumps(FEED).encode() + b"\n", b"{}\n"]),
        "feed-document": Channel(documents([FEED]), _feed(None, []).process, is_json=True),
        "feed-42": _whole(Format42()),
        "fmu": _fmu(),
        "can": _can(),
        **{f"serial-{unit}": _serial(unit) for unit in UNITS if load_unit(unit).link.serial is not None},
        **{f"canopen-{unit}": _canopen(unit) for unit in UNITS if load_unit(unit).canopen is not None},
    }


_calls = 0


def _count(*_event: object) -> None:
    global _calls
    _calls += 1


def processed(channel: Channel, message: bytes) -> None:
    """Process a message, which may be rejected; nothing is logged."""
    logging.disable(logging.CRITICAL)
    try:
        channel.process(message)
    except (OneLineError, UnicodeDecodeError):
        return
    finally:
        logging.disable(logging.NOTSET)


def work(channel: Channel, message: bytes) -> int:
    """Return the number of calls in which a message is processed."""
    begin = _calls
    sys.setprofile(_count)
    try:
        processed(channel, message)
    finally:
        sys.setprofile(None)
    return _calls - begin


def seconds(channel: Channel, message: bytes) -> float:
    """Return the processor time in which a message is processed, the shortest of three."""
    taken = []
    for _ in range(3):
        begin = time.process_time()
        processed(channel, message)
        taken.append(time.process_time() - begin)
    return min(taken)


def pairs(channel: Channel) -> Iterator[tuple[str, bytes, bytes]]:
    """Yield name, small and large message of every growth of the first spots of every good message."""
    for number, message in enumerate(channel.messages):
        spots = len(list(_spots(json.loads(message)))) if channel.is_json else min(len(message), 4)
        for spot in range(spots):
            for shape in range(7 if channel.is_json else 4):
                small, large = (channel.grown(message, spot, shape, size) for size in (SMALL, LARGE))
                yield f"{number}.{spot}.{shape}", small, large


@target(
    "growth", lambda: [*WORST, *(bytes([channel, 0, 1, shape]) for channel in range(10) for shape in (0, 3))]
)
def _growth(_folder: Path) -> Run:
    all_channels = list(channels().values())

    def run(data: bytes) -> None:
        numbers = [*data[:4], *bytes(4 - len(data[:4]))]
        channel = all_channels[numbers[0] % len(all_channels)]
        message = channel.messages[numbers[1] % len(channel.messages)]
        small, large = (channel.grown(message, *numbers[2:], size) for size in (SMALL, LARGE))
        processed(channel, small)  # what is computed once
        few, many = work(channel, small), work(channel, large)
        allowed = GROWTH * few * max(1.0, len(large) / len(small)) + FIXED_WORK
        assert many <= allowed, (
            f"{few} calls for {len(small)} bytes, but {many} for {len(large)}: {small[:200]!r}"
        )

    return run
