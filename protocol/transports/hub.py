"""A CAN bus over TCP for machines without kernel CAN: an asyncio server of the socketcand text protocol.

Each client opens a bus by name and receives every frame that other clients send on this bus; frames of one
sender stay in order. Up to `BACKLOG_LIMIT` bytes wait for a client that reads slowly or not at all. Senders
take turns in that queue. When it is full, frames of the sender with the most waiting bytes are dropped for
that client and counted, so a flood delays and loses only its own frames. A malformed command has no effect; the first
one in what is read at once is answered by an error.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TextIO, cast

from starhil.protocol.can.frame import CanFrame, format_candump
from starhil.protocol.can.socketcand import CommandSplitter, format_frame, parse_send
from starhil.protocol.errors import ProtocolError, reason
from starhil.protocol.transports.connections import (
    WINDOW,
    Budget,
    ConnectionLimit,
    Gate,
    Listener,
    detect_lost_peer,
    limit_buffers,
    listen,
)

_LOGGER: Final = logging.getLogger("starhil.hub")

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 29536
DEFAULT_BUS: Final = "vcan0"

BACKLOG_LIMIT: Final = 256 * 1024
"""Maximum number of bytes that wait for a slow client: about 4500 frames, half a second at 1 Mbit/s.

A kernel CAN socket holds fewer than 300 frames by default. Waiting frames are stale when read, and delay
later ones.
"""

SETTLE_S: Final = 1.0
"""Longest time that frames are withheld from a client that has just entered raw mode.

python-can's client rejects the answer to `< rawmode >` if a frame follows it in the same read. Anything that
the client sends shows that it has read the answer, and ends the wait.
"""


@dataclass(slots=True)
class HubStatistics:
    """Counters since the start."""

    frames: int = 0
    """Frames received from clients."""
    delivered: int = 0
    """Frames delivered to clients."""
    dropped: int = 0
    """Frames dropped because a client did not read."""
    errors: int = 0
    """Malformed or unknown commands."""


class FairQueue:
    """Queue of lines for one receiver, in which senders take turns, one line each.

    Lines of one sender stay in order. When the queue is full, the sender with the most waiting bytes loses its
    oldest lines, at most some bytes more than are added: to choose it again for each line took most of the time of
    a flood. `limit` is the maximum number of waiting bytes.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lines: dict[Hashable, deque[bytes]] = {}
        self._sizes: dict[Hashable, int] = {}
        self.size = 0
        """Number of waiting bytes."""

    def put(self, sender: Hashable, lines: Sequence[bytes]) -> int:
        """Add lines of a sender; return how many lines were dropped, of any sender."""
        if not lines:
            return 0
        added = sum(map(len, lines))
        self._lines.setdefault(sender, deque()).extend(lines)
        self._sizes[sender] = self._sizes.get(sender, 0) + added
        self.size += added
        dropped = 0
        while self.size > self._limit:
            longest = max(self._sizes, key=lambda each: self._sizes[each])
            lines_of_longest, least = self._lines[longest], self._sizes[longest] - added
            while self.size > self._limit and lines_of_longest and self._sizes[longest] >= least:
                self._note_removed(longest, lines_of_longest.popleft())
                dropped += 1
        return dropped

    def take(self, size: int) -> list[bytes]:
        """Remove and return the next lines: at least `size` bytes, or everything."""
        taken: list[bytes] = []
        rest = size
        while self._lines and rest > 0:
            for sender in tuple(self._lines):
                line = self._lines[sender].popleft()
                self._note_removed(sender, line)
                taken.append(line)
                rest -= len(line)
        return taken

    def _note_removed(self, sender: Hashable, line: bytes) -> None:
        self.size -= len(line)
        self._sizes[sender] -= len(line)
        if not self._lines[sender]:
            del self._lines[sender], self._sizes[sender]


class _Client(asyncio.Protocol):
    _transport: asyncio.Transport

    def __init__(self, hub: CanHub) -> None:
        self._hub = hub
        self._splitter = CommandSplitter()
        self._waiting = FairQueue(BACKLOG_LIMIT)
        self._full = False
        self._settle: asyncio.TimerHandle | None = None
        self._error_answered = False
        """Whether a malformed command in what was read last has been answered."""
        self.bus: str | None = None
        self.raw = False
        self.remote = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        detect_lost_peer(transport)
        limit_buffers(transport)
        self._transport.set_write_buffer_limits(high=WINDOW)
        self._transport.write(b"< hi >")
        self._hub.clients.append(self)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (asyncio's signature)
        if self._settle is not None:
            self._settle.cancel()
        self._hub.clients.remove(self)

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False
        self._write_waiting()

    def data_received(self, data: bytes) -> None:
        self._end_settling()
        self._error_answered = False
        frames: list[CanFrame] = []
        for command in self._splitter.feed(data):
            if self.bus is not None and command is not None and command.startswith(b"send "):
                try:
                    frames.append(parse_send(command))
                except ProtocolError as error:
                    self._answer_error(str(error))
            else:
                if frames:
                    self._hub.distribute(self, frames)
                    frames = []
                self._execute(command)
        if frames:
            self._hub.distribute(self, frames)

    def close(self) -> None:
        """Drop the connection and its queue."""
        self._transport.abort()

    def deliver(self, sender: _Client, lines: list[bytes]) -> int:
        """Send frames of another client as soon as there is room; return how many were dropped."""
        if self._transport.is_closing():
            return len(lines)
        if self._waiting.size or self._full or self._settle is not None:
            return self._waiting.put(sender, lines)
        self._transport.write(b"".join(lines))
        return 0

    @property
    def backlog(self) -> int:
        """Number of bytes that wait for this client."""
        return self._waiting.size + self._transport.get_write_buffer_size()

    def _write_waiting(self) -> None:
        while self._waiting.size and not self._full and not self._transport.is_closing():
            self._transport.write(b"".join(self._waiting.take(WINDOW)))

    def _answer(self, text: str) -> None:
        if self.backlog <= BACKLOG_LIMIT and not self._transport.is_closing():
            self._transport.write(f"< {text} >".encode())

    def _answer_error(self, text: str) -> None:
        """Answer a malformed command, unless another one in the same read has been: answers must not be a multiple of the input."""
        self._hub.statistics.errors += 1
        if not self._error_answered:
            self._error_answered = True
            self._answer(f"error {text}")

    def _execute(self, command: bytes | None) -> None:
        match command.split() if command is not None else []:
            case [b"open", name] if self.bus is None and name.isascii():
                self.bus = name.decode()
                self._answer("ok")
            case [b"rawmode"] if self.bus is not None:
                self._answer("ok")
                if not (self.raw or self.remote):
                    self._settle = asyncio.get_running_loop().call_later(SETTLE_S, self._end_settling)
                self.raw = True
            case [b"remote"] if self.bus is not None:
                self.remote = True
                self._answer("ok")
            case [b"echo"]:
                self._answer("echo")
            case [b"open", _]:
                self._answer_error("a bus is open already")
            case [b"rawmode"] | [b"remote"] | [b"send", *_]:
                self._answer_error("no bus is open; send open NAME first")
            case []:
                self._answer_error("malformed command")
            case _:
                self._answer_error("unknown command")

    def _end_settling(self) -> None:
        if self._settle is not None:
            self._settle.cancel()
            self._settle = None
            self._write_waiting()


class CanHub:
    """The server: after `await start()`, clients may connect to `host:port` until `await close()`.

    With port 0, `start` chooses a free one. `log` is a candump log of all frames, opened by `opener`, and `now` the clock for
    timestamps (s since 1970).
    """

    def __init__(
        self,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        *,
        log: Path | None = None,
        opener: Callable[[str, int], int] | None = None,
        now: Callable[[], float] = time.time,
    ) -> None:
        self.host: Final = host
        self.port = port
        self.statistics: Final = HubStatistics()
        self.limit: Final = ConnectionLimit("CAN hub", b"< error too many clients >")
        self._log_path = log
        self._opener = opener
        self._log: TextIO | None = None
        self._now = now
        self._listener: Listener | None = None
        self._budget = Budget()
        self.clients: Final[list[_Client]] = []

    async def start(self) -> None:
        """Listen. Raises ProtocolError if the address or the log is not available."""

        def admits(transport: asyncio.BaseTransport) -> bool:
            return self.limit.admits(transport, len(self.clients))

        try:
            self._listener = await listen(
                lambda: Gate(self._budget, lambda: _Client(self), admits),
                self.host,
                self.port,
                self.limit.size,
            )
        except (OSError, UnicodeError) as error:
            remedy = "--host" if isinstance(error, UnicodeError | socket.gaierror) else "--port"
            raise ProtocolError(
                f"CAN hub: cannot listen at {self.host}:{self.port}: {reason(error)}; choose another {remedy}"
            ) from None
        self.port = self._listener.address[1]
        if self._log_path is not None:
            try:
                self._log = open(  # noqa: SIM115 (a path has no opener; closed with the hub)
                    self._log_path, "w", encoding="ascii", buffering=1, opener=self._opener
                )  # a batch is written at once
            except OSError as error:
                await self.close()
                raise ProtocolError(f"CAN hub: cannot write {self._log_path}: {error.strerror}") from None

    async def close(self) -> None:
        """Stop listening and drop all clients."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for client in tuple(self.clients):
            client.close()
        while self.clients:
            await asyncio.sleep(0)
        if self._log is not None:
            self._log.close()
            self._log = None

    def distribute(self, sender: _Client, frames: list[CanFrame]) -> None:
        """Deliver frames to every other client of the sender's bus."""
        seconds = self._now()
        stamp = f"{seconds:.6f}".encode()
        lines = [(format_frame(frame, stamp), frame.remote) for frame in frames]
        self.statistics.frames += len(lines)
        all_lines = [line for line, _ in lines]
        data_lines = [line for line, remote in lines if not remote]
        for client in self.clients:
            if client is sender or not client.raw or client.bus != sender.bus:
                continue
            wanted = all_lines if client.remote else data_lines
            dropped = client.deliver(sender, wanted)
            self.statistics.delivered += len(wanted) - dropped
            self.statistics.dropped += dropped
        if self._log is not None:
            bus = sender.bus or DEFAULT_BUS
            text = "".join(format_candump(replace(frame, timestamp=seconds), bus) + "\n" for frame in frames)
            try:
                self._log.write(text)
            except OSError as error:
                _LOGGER.warning(
                    "CAN hub: log %s ends here: %s; the bus continues", self._log_path, reason(error)
                )
                with contextlib.suppress(OSError):  # its buffer cannot be written either
                    self._log.close()
                self._log = None
