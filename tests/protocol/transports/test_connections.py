"""Queues whose senders take turns, and a CAN hub on which a flood delays and loses its own frames only."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import time
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.can.socketcand import format_send
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.connections import ACCEPTING_S, TURN, WINDOW, Budget, Gate, listen
from starhil.protocol.transports.hub import BACKLOG_LIMIT, CanHub, FairQueue
from tests.waiting import PATIENCE_S, turns, until

pytestmark = pytest.mark.long

FLOOD = CanFrame(0x123, bytes(8), extended=False)
REQUEST = CanFrame(0x200, b"\x01", extended=False)
REPLY = CanFrame(0x201, b"\x02", extended=False)


def test_senders_take_turns_and_each_keeps_its_order() -> None:
    queue = FairQueue(100)
    assert queue.put("flood", [b"f1", b"f2", b"f3", b"f4"]) == 0
    assert queue.put("other", [b"o1", b"o2"]) == 0
    assert queue.take(4) == [b"f1", b"o1"]
    assert queue.take(100) == [b"f2", b"o2", b"f3", b"f4"]
    assert queue.take(100) == []
    assert queue.size == 0


def test_the_sender_that_has_most_waiting_loses_its_oldest() -> None:
    queue = FairQueue(8)
    assert queue.put("flood", [b"f1", b"f2", b"f3", b"f4"]) == 0
    assert queue.put("other", [b"o1", b"o2"]) == 2
    assert queue.take(100) == [b"f3", b"o1", b"f4", b"o2"]


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 3), st.lists(st.binary(min_size=1, max_size=9), max_size=5), st.integers(0, 20)
        )
    )
)
def test_every_item_is_delivered_or_counted_as_dropped(steps: list[tuple[int, list[bytes], int]]) -> None:
    queue, put, taken, dropped = FairQueue(30), 0, 0, 0
    for sender, lines, size in steps:
        put += len(lines)
        dropped += queue.put(sender, lines)
        assert queue.size <= 30
        taken += len(queue.take(size))
    taken += len(queue.take(31))
    assert (put, queue.size) == (taken + dropped, 0)


class Busy(asyncio.Protocol):
    """A protocol that takes processor time for whatever it gets, and stops and resumes reading as one with a queue does."""

    def __init__(self, busy_s: float) -> None:
        self.busy_s = busy_s
        self.spent_s = 0.0
        self.got = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        self.got += data
        begin_s = time.thread_time()
        while time.thread_time() - begin_s < self.busy_s:
            pass
        self.spent_s += self.busy_s
        self.transport.pause_reading()
        asyncio.get_running_loop().call_later(0.001, self.transport.resume_reading)

    def eof_received(self) -> bool:
        self.got += b"end"
        return False


async def gated(protocol: Busy, data: bytes, seconds: float) -> float:
    """Send data to a protocol through a gate until it has ended or for some time; return the time that it has spent, seconds."""
    budget = Budget()
    listener = await listen(
        lambda: Gate(budget, lambda: protocol, lambda _transport: True), "127.0.0.1", 0, 8
    )
    _, writer = await asyncio.open_connection(*listener.address)
    writer.write(data)
    writer.write_eof()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while not protocol.got.endswith(b"end"):
                await asyncio.sleep(0.01)
    spent_s = protocol.spent_s
    protocol.transport.abort()
    writer.transport.abort()
    listener.close()
    await until(lambda: (budget.accounts, budget.resting) == (0, 0))
    return spent_s


def test_a_connection_takes_a_quarter_of_the_loop_though_its_protocol_resumes_reading() -> None:
    spent_s = asyncio.run(gated(Busy(0.005), bytes(4 << 20), 1.0))
    assert 0.01 < spent_s < 0.4


def test_what_comes_in_a_rest_is_passed_on_in_order_and_the_end_after_it() -> None:
    data = random.Random(1).randbytes(60_000)
    protocol = Busy(0.0015)
    asyncio.run(gated(protocol, data, PATIENCE_S))
    assert protocol.got == data + b"end"


def test_of_work_in_turns_one_step_is_done_in_a_turn_of_the_loop_and_together_it_takes_a_part() -> None:
    each_s, steps, turn = 0.002, [], 0

    async def work() -> None:
        for _ in range(5):
            steps.append((turn, asyncio.get_running_loop().time()))
            begin_s = time.thread_time()
            while time.thread_time() - begin_s < each_s:
                pass
            await asyncio.sleep(0)

    async def count() -> None:
        nonlocal turn
        while True:
            turn += 1
            await asyncio.sleep(0)

    async def main() -> None:
        budget, counting = Budget(), asyncio.create_task(count())
        await asyncio.gather(*(budget.run(work()) for _ in range(10)))
        counting.cancel()

    asyncio.run(main())
    assert len({turn for turn, _ in steps}) == len(steps) == 50
    assert len(steps) * each_s < 0.4 * (steps[-1][1] - steps[0][1] + each_s)


def test_work_in_turns_ends_as_it_would_by_itself() -> None:
    ends = []

    async def work(what: object) -> object:
        try:
            if isinstance(what, Exception):
                raise what
            if what == "late":
                async with asyncio.timeout(0.01):
                    await asyncio.Event().wait()
            if what == "never":
                await asyncio.Event().wait()
            return await asyncio.sleep(0.001, what)
        finally:
            ends.append(what)

    async def main() -> None:
        budget = Budget()
        assert await budget.run(work(3)) == 3
        with pytest.raises(KeyError):
            await budget.run(work(KeyError()))
        with pytest.raises(TimeoutError):
            await budget.run(work("late"))
        waiting = [asyncio.create_task(budget.run(work("never"))) for _ in range(3)]
        await asyncio.sleep(0.01)
        for task in waiting:
            task.cancel()
        assert all(
            isinstance(end, asyncio.CancelledError)
            for end in await asyncio.gather(*waiting, return_exceptions=True)
        )
        assert await budget.run(work(4)) == 4

    asyncio.run(main())
    assert [str(end) for end in ends] == ["3", "", "late", "never", "never", "never", "4"]


def test_a_server_accepts_connections_with_pauses() -> None:
    """A peer that only opened and closed connections held up replies on the bus by 0.2 s."""
    accepted: list[float] = []

    async def main() -> None:
        class Accepted(asyncio.Protocol):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:  # noqa: ARG002
                accepted.append(time.monotonic())

        begin = time.monotonic()
        listener = await listen(Accepted, "127.0.0.1", 0, 64)
        peers = [socket.create_connection(listener.address) for _ in range(30)]
        await until(lambda: len(accepted) == len(peers))
        for peer in peers:
            peer.close()
        listener.close()

        # not from one to the next, each of which may have been held up since it was accepted
        assert accepted[-1] - begin >= (len(peers) - 1) * ACCEPTING_S

    asyncio.run(main())


async def join(hub: CanHub) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A client in raw mode that sends raw text and reads only on request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", hub.port)
    await reader.readuntil(b">")
    for command in (b"< open vcan0 >", b"< remote >", b"< rawmode >"):
        writer.write(command)
        await reader.readuntil(b">")
    return reader, writer


def test_a_flood_takes_the_place_of_no_other_clients_frame() -> None:
    async def main() -> None:
        hub = CanHub(port=0)
        await hub.start()
        reader, writer = await join(hub)
        reader._transport.pause_reading()  # type: ignore[attr-defined]
        (_, flood), (_, other) = await join(hub), await join(hub)
        while not hub.statistics.dropped:
            flood.write(format_send(FLOOD) * 1000)
            await flood.drain()
            await asyncio.sleep(0)
        other.write(format_send(REQUEST))
        before = hub.statistics.frames
        await until(lambda: hub.statistics.frames > before)
        await turns()
        reader._transport.resume_reading()  # type: ignore[attr-defined]
        async with asyncio.timeout(PATIENCE_S):
            while b" 200 " not in await reader.readuntil(b">"):
                pass
        writer.close()
        await hub.close()

    asyncio.run(main())


def test_many_clients_that_flood_a_bus_are_not_all_read_in_the_same_turn_of_the_loop() -> None:
    """16 of them, on a bus of their own, held up replies on another bus by half a second, 50 for as long as they sent."""
    sizes = [0]

    class Counted(CanHub):
        def distribute(self, sender: Any, frames: list[CanFrame]) -> None:
            sizes[-1] += len(frames)
            super().distribute(sender, frames)

    async def scenario() -> None:
        hub = Counted(port=0)
        await hub.start()
        floods = []
        for _ in range(16):
            reader, flood = await asyncio.open_connection("127.0.0.1", hub.port)
            flood.write(b"< open vcan0 >")
            await reader.readuntil(b"ok >")
            flood.write(format_send(FLOOD) * 2000)
            floods.append(flood)
        # time is that of the processor, so that no other process makes the connections' share of it look smaller
        loop = asyncio.get_running_loop()
        offset_s = loop.time() - time.thread_time()
        loop.time = lambda: offset_s + time.thread_time()
        while hub.statistics.frames < 20_000:
            sizes.append(0)
            await asyncio.sleep(0)
        for flood in floods:
            flood.transport.abort()
        await hub.close()

    asyncio.run(asyncio.wait_for(scenario(), PATIENCE_S))
    in_a_turn = TURN // len(format_send(FLOOD)) + 1
    busy = sorted(size for size in sizes if size)
    assert busy[len(busy) // 2] <= 0.75 * in_a_turn


def test_a_request_is_answered_before_most_of_a_flood_that_came_first() -> None:
    """The flooding client never reads; whoever answers works off what has reached it, not all that waits."""

    async def main() -> None:
        hub = CanHub(port=0)
        await hub.start()
        spec = f"socketcand:127.0.0.1:{hub.port}/vcan0"
        device, bench = open_can(spec), open_can(spec)
        handled = 0
        handled_at: list[int] = []

        def handle(frame: CanFrame) -> None:
            nonlocal handled
            handled += 1
            if frame == REQUEST:
                handled_at.append(handled)
                device.send(REPLY)
            else:
                for _ in range(3):
                    device.send(FLOOD)

        heard: list[CanFrame] = []
        await device.start(handle)
        await bench.start(lambda frame: heard.append(frame) if frame.id == REPLY.id else None)
        device._writer.transport.pause_reading()  # type: ignore[attr-defined]
        _, flood = await join(hub)
        while not hub.statistics.dropped:
            flood.write(format_send(FLOOD) * 1000)
            await flood.drain()
            await asyncio.sleep(0)
        bench.send(REQUEST)
        await bench.drain()
        await turns()
        device._writer.transport.resume_reading()  # type: ignore[attr-defined]
        async with asyncio.timeout(PATIENCE_S):
            while not heard:  # on a busy machine the device's own flood can push its reply out
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(3.0):
                        await until(lambda: bool(heard))
                bench.send(REQUEST)
        text = len("< frame 123 1700000000.250000 0000000000000000 >")
        assert handled_at[0] * text < BACKLOG_LIMIT
        for transport in (bench, device):
            await transport.close()
        await hub.close()

    asyncio.run(main())


def test_a_client_stops_reading_while_the_hub_does_not_accept_its_frames() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"< hi >")
        for _ in range(3):
            await reader.readuntil(b">")
            writer.write(b"< ok >")
        reader._transport.pause_reading()  # type: ignore[attr-defined]
        while True:
            writer.write(b"< frame 123 1.000000 00 >" * 1000)
            await writer.drain()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        device = open_can(f"socketcand:127.0.0.1:{server.sockets[0].getsockname()[1]}/vcan0")
        await device.start(lambda _: [device.send(FLOOD) for _ in range(10)])
        received = -1
        async with asyncio.timeout(PATIENCE_S):
            while device.statistics.received != received:
                received = device.statistics.received
                await turns(200)  # in which the server would have sent more
        assert device._writer.transport.get_write_buffer_size() < 10 * WINDOW  # type: ignore[attr-defined]
        await device.close()
        server.close()

    asyncio.run(main())
