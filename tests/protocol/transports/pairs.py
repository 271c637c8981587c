"""Two connected ends of each kind of serial port and CAN bus that this machine has."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.can import CanTransport, kernel_can_is_up, open_can
from starhil.protocol.transports.hub import CanHub
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial

HAS_VCAN = kernel_can_is_up("vcan0")

SERIAL_KINDS = ["pty and tty", "listen and socket"]

FRAMES = [
    CanFrame(0x08AA0401, bytes(range(8))),
    CanFrame(0x123, b"\x1f", extended=False),
    CanFrame(0x123, b"\x1f"),
    CanFrame(0, b"", extended=False),
    CanFrame(0x1FFFFFFF, b""),
]

CAN_KINDS = [
    "hub",
    "virtual",
    "udp_multicast",
    "slcan",
    pytest.param(
        "socketcan", marks=[pytest.mark.socketcan, pytest.mark.skipif(not HAS_VCAN, reason="no vcan0 here")]
    ),
]


class SerialPair:
    """Two connected ends and what each has received."""

    def __init__(self, one: SerialTransport, two: SerialTransport) -> None:
        self.one, self.two = one, two
        self.got_one, self.got_two = bytearray(), bytearray()
        self.errors: list[ProtocolError] = []

    async def start(self, transport: SerialTransport, got: bytearray) -> None:
        await transport.start(got.extend, self.errors.append)


@contextlib.asynccontextmanager
async def serial_pair(kind: str, tmp_path: Path, baud: int = 921600) -> AsyncIterator[SerialPair]:
    link = tmp_path / "tty"
    specs = {
        "pty and tty": ("pty", str(link)),
        "listen and socket": ("listen://127.0.0.1:0", None),
    }[kind]
    one = open_serial(specs[0], baud, symlink=link if specs[1] else None)
    pair = SerialPair(one, one)
    await pair.start(one, pair.got_one)
    one.publish()
    pair.two = open_serial(specs[1] or one.description, baud)
    await pair.start(pair.two, pair.got_two)
    try:
        yield pair
    finally:
        await pair.two.close()
        await pair.one.close()


class CanPair:
    """Two transports on one bus and what each has received."""

    def __init__(self, one: CanTransport, two: CanTransport) -> None:
        self.one, self.two = one, two
        self.got_one: list[CanFrame] = []
        self.got_two: list[CanFrame] = []
        self.errors: list[ProtocolError] = []

    async def start(self) -> None:
        await self.one.start(self.got_one.append, self.errors.append)
        await self.two.start(self.got_two.append, self.errors.append)


@contextlib.asynccontextmanager
async def crossed_ptys() -> AsyncIterator[tuple[str, str]]:
    """Two tty paths with a cable between them."""
    loop = asyncio.get_running_loop()
    masters, slaves = zip(os.openpty(), os.openpty(), strict=True)
    for source, sink in (masters, masters[::-1]):
        loop.add_reader(source, lambda source=source, sink=sink: os.write(sink, os.read(source, 4096)))
    for slave in slaves:
        tty.setraw(slave)
    try:
        yield os.ttyname(slaves[0]), os.ttyname(slaves[1])
    finally:
        for master in masters:
            loop.remove_reader(master)
        for end in (*masters, *slaves):
            os.close(end)


@contextlib.asynccontextmanager
async def can_pair(kind: str) -> AsyncIterator[CanPair]:
    async with contextlib.AsyncExitStack() as stack:
        specs = {
            "virtual": "virtual:pair",
            "udp_multicast": "udp_multicast:239.74.163.9",
            "socketcan": "vcan0",
        }
        if kind == "hub":
            hub = CanHub(port=0)
            await hub.start()
            stack.push_async_callback(hub.close)
            one = two = f"socketcand:127.0.0.1:{hub.port}/vcan0"
        elif kind == "slcan":
            paths = await stack.enter_async_context(crossed_ptys())
            one, two = (f"slcan:{path}" for path in paths)
        else:
            one = two = specs[kind]
        pair = CanPair(open_can(one), open_can(two))
        await pair.start()
        stack.push_async_callback(pair.one.close)
        stack.push_async_callback(pair.two.close)
        yield pair
