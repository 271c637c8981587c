"""The sockets of a live feed, UDP or TCP as server or client of the simulator, and lock-step with it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any, Final, Literal

from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.simulation.guard import until_cancelled
from starhil.emulator.truth.feed_rates import SHORTEST_S, FeedError
from starhil.emulator.truth.json_lines import read_lines
from starhil.emulator.truth.live import RESTART_S, LiveTruth
from starhil.protocol.errors import reason
from starhil.protocol.transports.connections import (
    Budget,
    ConnectionLimit,
    Listener,
    limit_buffers,
    listen,
    stream_protocol,
)

log = logging.getLogger("starhil.truth")

RETRY_S: Final = 0.5
"""Pause between attempts to connect to a simulator, seconds."""

Socket = Literal["udp", "listen", "connect"]

Step = Callable[[float], Awaitable[None]]
"""Advances simulation time by a number of seconds; returns when all events within the step are done."""


class LockStep:
    """Advances the simulation clock with the messages of a live feed: each to its time, and is then answered.

    The first message is the current truth. Each later message is the truth at the end of the step that it causes, so
    that exposures within the step are between two messages. The simulator waits for the answer: both have the same
    time, and the same messages give the same bytes.
    """

    def __init__(self, truth: LiveTruth, now_s: Callable[[], float], step: Step) -> None:
        self._truth = truth
        truth.timeline = "run"
        self._now_s = now_s
        self._step = step
        self._last_t: float | None = None
        self._lock = asyncio.Lock()

    async def receive(self, data: bytes) -> str:
        """Process one message; return the fault of a rejected message, otherwise an empty text."""
        async with self._lock:
            try:
                return await self._apply_message(data)
            except (FeedError, EmulatorError) as fault:
                self._truth.reject(str(fault))
                return str(fault)

    async def _apply_message(self, data: bytes) -> str:
        message = self._truth.format.decode(data)
        if message.t is None:
            raise FeedError("t is missing; lock-step needs the sender's time")
        last, now = self._last_t, self._now_s()
        if last is not None and last - message.t > RESTART_S:
            self._truth.begin_timeline()
            last = None
        step_s = 0.0 if last is None else message.t - last
        if last is not None and abs(step_s) < SHORTEST_S:
            return ""  # a simulator may repeat its first message
        if step_s < 0.0:
            raise FeedError(f"t = {message.t} is not later than in the previous message")
        self._last_t = message.t
        accepted = self._truth.accept(replace(message, t=now + step_s), now)
        if step_s > 0.0:
            await self._step(step_s)
        return "" if accepted else self._truth.last_fault


MAX_LINES: Final = 32
"""Most lines of a datagram."""

MAX_WAITING: Final = 200
"""Most lines of datagrams that wait while others are processed."""

TURN_S: Final = 0.0001
"""Processor time after which a turn receives no further datagrams, and again after which it processes no further lines, seconds."""

LONGEST_DATAGRAM: Final = 65536


class _Datagrams:
    """Passes each line of each datagram to the feed, within the budget of its server; what comes too fast is dropped, the oldest first.

    During a rest nothing is received, and the kernel drops what does not fit its buffer.
    """

    def __init__(self, feed: LiveFeed, budget: Budget) -> None:
        self._feed = feed
        self._account = budget.together
        self._waiting: deque[list[bytes]] = deque()
        """Lines of each datagram that has not been processed, the next one last."""
        self.waiting = 0
        """Number of these lines."""
        self._socket: socket.socket | None = None
        self._rest: asyncio.TimerHandle | None = None

    async def listen(self, host: str, port: int) -> tuple[Any, ...]:
        """Receive datagrams; return the address."""
        loop = asyncio.get_running_loop()
        (family, kind, protocol, _, address), *_ = await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        source = socket.socket(family, kind, protocol)
        try:
            source.settimeout(0.0)
            source.bind(address)
        except OSError:
            source.close()
            raise
        self._socket = source
        loop.add_reader(source, self._turn, source)
        own: tuple[Any, ...] = source.getsockname()
        return own

    def close(self) -> None:
        """Receive nothing more."""
        if self._rest is not None:
            self._rest.cancel()
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _turn(self, source: socket.socket) -> None:
        """Receive what has come, and process lines until none waits or it takes long; then rest, if that is due."""
        loop, begin_s = asyncio.get_running_loop(), time.thread_time()
        with self._account.taking():
            with contextlib.suppress(OSError):  # nothing more is there
                while time.thread_time() < begin_s + TURN_S:
                    self.add(source.recv(LONGEST_DATAGRAM))
            while self.waiting:
                self.process_line()
                if time.thread_time() >= begin_s + 2.0 * TURN_S:
                    break
        until_s = self._account.rests_until_s()
        if until_s is None and self.waiting:
            until_s = loop.time()
        if until_s is not None:
            loop.remove_reader(source)
            self._rest = loop.call_at(until_s, self._end_rest, source)

    def _end_rest(self, source: socket.socket) -> None:
        asyncio.get_running_loop().add_reader(source, self._turn, source)
        self._turn(source)

    def add(self, data: bytes) -> None:
        """Add the lines of a datagram; if too many wait, the oldest datagrams are dropped."""
        lines = data.split(b"\n", MAX_LINES)
        if any(line.strip() for line in lines[MAX_LINES:]):
            self._feed.truth.reject(f"datagram of more than {MAX_LINES} lines")
        self._waiting.append(lines[MAX_LINES - 1 :: -1])
        self.waiting += len(self._waiting[-1])
        while self.waiting > MAX_WAITING:
            self.waiting -= len(self._waiting.popleft())
            self._feed.truth.reject("messages come too fast; the oldest are dropped")

    def process_line(self) -> None:
        line = self._waiting[0].pop()
        self.waiting -= 1
        if not self._waiting[0]:
            self._waiting.popleft()
        if line.strip():
            self._feed.receive(line)


class LiveFeed:
    """The socket between a dynamics simulator and a `LiveTruth`.

    `step` advances the simulation clock, for lock-step; None if time passes by itself.
    """

    def __init__(
        self,
        truth: LiveTruth,
        now_s: Callable[[], float],
        step: Step | None = None,
        on_message: Callable[[bytes], None] | None = None,
    ) -> None:
        self.truth = truth
        self._on_message = on_message
        self._now_s = now_s
        self._lock_step = None if step is None else LockStep(truth, now_s, step)
        self._datagrams: _Datagrams | None = None
        self._server: Listener | None = None
        self._budget = Budget()
        self._client: asyncio.Task[None] | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._limit = ConnectionLimit("truth feed")

    async def start(self, kind: Socket, host: str, port: int) -> str:
        """Listen, or start connecting; return the address as `udp:HOST:PORT` or `tcp:HOST:PORT`."""
        if kind == "connect":
            self._client = asyncio.create_task(self._keep_connected(host, port))
            return f"tcp:{host}:{port}"
        protocol = "udp" if kind == "udp" else "tcp"
        what = f"truth feed {protocol}:{host}:{port}: cannot listen"
        with explained(what, "choose another port, or 0", errors=(OSError, ValueError)):
            if kind == "udp":
                self._datagrams = _Datagrams(self, self._budget)
                address = await self._datagrams.listen(host, port)
            else:
                serve = until_cancelled(self._serve_connection)
                self._server = await listen(stream_protocol(serve), host, port, self._limit.size)
                address = self._server.address
        return f"{protocol}:{address[0]}:{address[1]}"

    def receive(self, data: bytes) -> None:
        if len(data) > self.truth.format.max_size:
            self.truth.reject(self._too_long())
            return
        self._message_received(data)
        self.truth.receive(data, self._now_s())

    def _too_long(self) -> str:
        return f"message longer than {self.truth.format.max_size} bytes"

    async def process(self, data: bytes) -> str:
        """Process one message; return the fault of a message rejected in lock-step."""
        if self._lock_step is None:
            self.receive(data)
            return ""
        self._message_received(data)
        return await asyncio.create_task(self._lock_step.receive(data))  # its step is not the sender's work

    def _message_received(self, data: bytes) -> None:
        if self._on_message is not None:
            self._on_message(data)

    async def _keep_connected(self, host: str, port: int) -> None:
        """Connect to a simulator that listens, and reconnect after a loss."""
        reported = False
        while True:
            try:
                reader, writer = await asyncio.open_connection(host, port)
            except (OSError, ValueError) as error:
                if not reported:  # once, not at every attempt
                    log.warning(
                        "truth feed tcp:%s:%d: no connection (%s); still trying; the simulator must listen there",
                        host,
                        port,
                        reason(error),
                    )
                reported = True
            else:
                reported = False
                await self._serve_connection(reader, writer)
            await asyncio.sleep(RETRY_S)

    async def _serve_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._limit.admits(writer.transport, len(self._writers)):
            return
        self._writers.add(writer)
        limit_buffers(writer.transport)
        try:
            await self._budget.run(self._answer_messages(reader, writer))
        except ConnectionError:
            self.truth.reject("connection broken")
        finally:
            self._writers.discard(writer)
            writer.close()

    async def _answer_messages(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Process the messages of a connection, and answer each if the sender expects this."""
        message_format = self.truth.format
        async for data in read_lines(reader, message_format.max_size, message_format.end):
            if data is None:
                self.truth.reject(self._too_long())
                continue
            fault = await self.process(data)
            if self._lock_step is not None or message_format.always_answers:
                writer.write(message_format.answer(self._now_s(), fault))
                await writer.drain()

    def close(self) -> None:
        """Stop listening and connecting."""
        if self._datagrams is not None:
            self._datagrams.close()
            self._datagrams = None
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._client is not None:
            self._client.cancel()
            self._client = None
        for writer in list(self._writers):
            writer.transport.abort()
