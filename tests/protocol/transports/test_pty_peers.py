"""A pseudo-terminal as a wire: what nobody reads is lost, and who opens it hears what is sent from then on."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from starhil.protocol.transports import pty
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial
from tests.waiting import turns, until

pytestmark = pytest.mark.long

MESSAGE = bytes(range(100))
REQUEST = b"request"


@contextlib.asynccontextmanager
async def opened(
    *, baud: int = 921600, paced: bool = False
) -> AsyncIterator[tuple[SerialTransport, bytearray]]:
    line = open_serial("pty", baud, paced=paced)
    heard = bytearray()
    await line.start(heard.extend)
    try:
        yield line, heard
    finally:
        await line.close()


@contextlib.contextmanager
def peer(line: SerialTransport) -> Iterator[int]:
    fd = os.open(line.description, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


def unread(fd: int) -> bytes:
    """What waits for a peer now."""
    data = b""
    with contextlib.suppress(BlockingIOError):
        while piece := os.read(fd, 65536):
            data += piece
    return data


async def next_bytes(fd: int, count: int) -> bytes:
    data = bytearray()

    def read() -> bool:
        data.extend(unread(fd))
        return len(data) >= count

    await until(read)
    return bytes(data)


def test_bytes_sent_while_the_line_is_closed_are_lost() -> None:
    async def main() -> None:
        async with opened() as (line, _):
            for _ in range(1000):
                assert not line.send(MESSAGE)
            assert line.statistics.dropped == 1000 * len(MESSAGE)
            with peer(line) as fd:
                assert line.send(MESSAGE)
                assert await next_bytes(fd, len(MESSAGE)) == MESSAGE

    asyncio.run(main())


def fill(line: SerialTransport) -> None:
    """Send until the pseudo-terminal and the queue before it take no more."""
    while line.send(MESSAGE):
        pass


@pytest.mark.parametrize("watched", [True, False], ids=["inotify", "no inotify"])
def test_unread_bytes_are_not_passed_to_the_next_peer(watched: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not watched:
        monkeypatch.setattr(pty, "_watch", lambda _: -1)

    async def main() -> None:
        async with opened() as (line, heard):
            with peer(line) as fd:
                fill(line)
                os.write(fd, REQUEST)
                await until(lambda: bytes(heard) == REQUEST)
            await until(lambda: line._backlog == 0)  # type: ignore[attr-defined]
            with peer(line) as fd:
                assert line.send(MESSAGE)
                assert await next_bytes(fd, len(MESSAGE)) == MESSAGE
                assert unread(fd) == b""

    asyncio.run(main())


def test_a_peer_that_connects_before_the_loop_sees_the_last_one_leave_gets_only_its_own_answer() -> None:
    async def main() -> None:
        line = open_serial("pty", paced=False)
        await line.start(lambda _: line.send(MESSAGE))
        with peer(line):
            fill(line)
            await asyncio.sleep(0)
        with peer(line) as fd:
            for count in (1, 2):  # between the two answers there is nothing else
                os.write(fd, REQUEST)
                await until(lambda count=count: line.statistics.received == count * len(REQUEST))
                assert await next_bytes(fd, len(MESSAGE)) == MESSAGE
            assert unread(fd) == b""
        await line.close()

    asyncio.run(main())


def test_a_peer_does_not_receive_messages_queued_before_it_connected() -> None:
    async def main() -> None:
        async with opened(baud=9600, paced=True) as (line, _):
            with peer(line) as fd:
                for _ in range(100):
                    line.send(bytes(50))
                await next_bytes(fd, 10)
            with peer(line) as fd:
                await turns()
                assert line.send(MESSAGE)
                assert await next_bytes(fd, len(MESSAGE)) == MESSAGE

    asyncio.run(main())


def test_a_second_program_that_opens_the_port_takes_no_bytes_from_the_peer() -> None:
    async def main() -> None:
        async with opened() as (line, _):
            with peer(line) as fd:
                assert line.send(MESSAGE)
                for _ in range(3):
                    with peer(line):
                        pass
                    await turns()
                assert line.send(MESSAGE)
                assert await next_bytes(fd, 2 * len(MESSAGE)) == 2 * MESSAGE

    asyncio.run(main())


def test_a_request_from_a_program_that_closes_at_once_is_received() -> None:
    async def main() -> None:
        async with opened() as (line, heard):
            Path(line.description).write_bytes(REQUEST)
            await until(lambda: bytes(heard) == REQUEST)

    asyncio.run(main())


def test_no_descriptor_stays_open_after_close() -> None:
    async def main() -> None:
        before = len(list(Path("/proc/self/fd").iterdir()))
        async with opened() as (line, _):
            with peer(line):
                line.send(MESSAGE)
        assert len(list(Path("/proc/self/fd").iterdir())) == before

    asyncio.run(main())


def test_a_peer_that_writes_all_the_time_is_read_once_per_turn_of_the_loop() -> None:
    """Each of its writes wakes the transport; more and more reads per turn left no time for anything else."""
    reads, count = 0, 500

    async def main() -> None:
        port = open_serial("auto", paced=False)
        peer = -1

        def write_again(_data: bytes) -> None:
            nonlocal reads
            reads += 1
            os.write(peer, b"x")

        await port.start(write_again)
        peer = os.open(port.description, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(peer, b"x")
            for _ in range(count):
                await asyncio.sleep(0)
        finally:
            await port.close()
            os.close(peer)

    asyncio.run(main())
    assert count / 2 < reads <= count + 1
