"""What peers without trust may take of an event loop: a budget of its time, turns, a limit of connections; and socket options for TCP.

Each server has a `Budget` and accepts connections by `listen`. What a protocol does is limited by a `Gate` for each connection,
what a coroutine does by `Budget.run`. Without a limit on their number, connections could use up all file descriptors of the
process, and links could not be reopened.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import resource
import socket
import time
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator
from typing import Any, Final, TypeVar, cast

log: Final = logging.getLogger("starhil.connections")

Result = TypeVar("Result")

TURN: Final = 4 * 1024
"""Maximum number of bytes that a connection of a server reads per turn of the loop: about 100 CAN frames as text."""

WINDOW: Final = 16 * 1024
"""Size of each buffer of a connection, bytes; buffered bytes delay later ones."""


KEEPALIVE: Final = {socket.TCP_KEEPIDLE: 5, socket.TCP_KEEPINTVL: 2, socket.TCP_KEEPCNT: 3}
"""Probe a connection after 5 s of silence, then every 2 s; it is lost after 3 probes without an
answer."""

UNREAD_LIMIT_MS: Final = 10_000
"""A server that has not acknowledged sent data for this time is lost."""

MAX_CONNECTIONS: Final = 64
"""Maximum number of connections of a server."""

SHARE_OF_DESCRIPTORS: Final = 8
"""A server uses at most one in this many of the file descriptors that the process may open."""


LEAST_TURN: Final = 256
"""Number of bytes that is read from a connection at a time when many send much."""

FREE_SHARE: Final = 0.02
"""Share of the loop that a connection may take without rests: on the hub, 200 frames per second."""

FREE_IN_ALL: Final = 0.3
"""Share of the loop that all connections of a server together may take without rests."""

LEAST_TAKEN_S: Final = 0.001
"""Processor time beyond the free share after which a connection rests, seconds."""

REST: Final = 3.0
"""Length of a rest: this many times what the connection has taken. Connections that rest do so one after another, so that all
those of a server together leave three quarters of the loop to the links."""

ACCEPTING_S: Final = 0.005
"""Shortest time between two connections that a server accepts, seconds: each costs the loop some 0.2 ms."""

REFUSED_S: Final = 1.0
"""Pause after a connection that could not be accepted, seconds: the process has no free file descriptor."""


class Account:
    """Processor time that a peer, or all peers of a server together, have taken of the loop beyond a free share of it.

    Parameters
    ----------
    budget
        That of the server.
    free_share
        Returns the share of the loop that is free at present.
    """

    def __init__(self, budget: Budget, free_share: Callable[[], float]) -> None:
        self._budget = budget
        self._free_share = free_share
        self._taken_s = 0.0
        self._longest_s = 0.0
        self._counted_s = 0.0

    @contextlib.contextmanager
    def taking(self, beside_s: float = 0.0) -> Iterator[None]:
        """Count the time of what is done inside, which must not await; `beside_s` is spent on it elsewhere, seconds."""
        loop = asyncio.get_running_loop()
        begin_s, began_s = loop.time(), time.thread_time()
        try:
            yield
        finally:
            now_s = loop.time()
            self._taken_s = max(self._taken_s - self._free_share() * (now_s - self._counted_s), 0.0)
            self._taken_s += time.thread_time() - began_s + beside_s
            self._longest_s = now_s - begin_s  # longer where other processes have the processor
            self._counted_s = now_s

    def rests_until_s(self) -> float | None:
        """Begin a rest if it is due, behind those that rest already; return its end in time of the loop, seconds."""
        if self._taken_s <= LEAST_TAKEN_S:
            return None
        now_s, taken_s = asyncio.get_running_loop().time(), max(self._taken_s, self._longest_s)
        self._taken_s = 0.0
        self._budget.rested_s = max(self._budget.rested_s, now_s) + REST * taken_s
        return self._budget.rested_s


class _Pause:
    """Awaits what a step of a coroutine has ended with: what the coroutine itself would have passed to the event loop."""

    def __init__(self, awaited: object) -> None:
        self._awaited = awaited

    def __await__(self) -> Generator[object, None, None]:
        yield self._awaited


class Budget:
    """The time of the event loop that the peers of a server may take, the order of their rests, and their turns."""

    def __init__(self) -> None:
        self.accounts = 0
        """Number of connections with an account of their own."""
        self.resting = 0
        """Number of connections from which nothing is read for now."""
        self.rested_s = 0.0
        """Time of the loop at which the last of them has rested, seconds."""
        self.together = Account(self, lambda: FREE_IN_ALL)
        """Account of all peers whose work is done in turns."""
        self._turn = asyncio.Lock()

    @property
    def read_size(self) -> int:
        """Number of bytes to read from a connection at a time: the fewer, the more there are that may send at once."""
        return max(TURN // (1 + max(self.resting, self.accounts // 4)), LEAST_TURN)

    def free_share(self) -> float:
        """Return the share of the loop that a connection may take without rests."""
        return min(FREE_SHARE, FREE_IN_ALL / max(self.accounts, 1))

    async def run(self, work: Coroutine[Any, Any, Result], beside_s: float = 0.0) -> Result:
        """Await a coroutine in turns: each of its steps, up to the next await that waits, is counted, and after it the loop is others'.

        What the coroutine does in tasks of its own is not counted. `beside_s` is spent on the work elsewhere, seconds. An exception
        of what it waits for, such as a cancellation, is raised in it in its next turn.
        """
        error: BaseException | None = None
        with contextlib.closing(work):
            while True:
                try:
                    await self._turn.acquire()
                except asyncio.CancelledError as cancelled:
                    error = cancelled
                    continue
                try:
                    with self.together.taking(beside_s):
                        awaited = work.send(None) if error is None else work.throw(error)
                except StopIteration as end:
                    result: Result = end.value
                    return result
                finally:
                    self._end_turn()
                beside_s, error = 0.0, None
                try:
                    await _Pause(awaited)
                except (Exception, asyncio.CancelledError) as raised:  # noqa: BLE001 (it is for the coroutine)
                    error = raised

    def _end_turn(self) -> None:
        """Give the next peer its turn when the loop has served others, and the peers together have rested."""
        loop, until_s = asyncio.get_running_loop(), self.together.rests_until_s()
        if until_s is None:
            loop.call_soon(self._turn.release)
        else:
            loop.call_at(until_s, self._turn.release)


class ConnectionLimit:
    """Rejects connections of a server that has too many, with `refusal`; the first rejection is logged."""

    def __init__(self, server: str, refusal: bytes = b"") -> None:
        self._server = server
        self._refusal = refusal
        self._logged = False
        descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        unlimited = descriptors == resource.RLIM_INFINITY
        share = MAX_CONNECTIONS if unlimited else descriptors // SHARE_OF_DESCRIPTORS
        self.size = max(1, min(MAX_CONNECTIONS, share))
        """Maximum number; as `backlog` of the server it also limits what asyncio accepts in one turn of the loop."""

    def admits(self, transport: asyncio.BaseTransport, connected: int) -> bool:
        """Return whether there is room besides the connected peers; close the connection if not."""
        if connected < self.size:
            return True
        if not self._logged:
            self._logged = True
            log.warning(
                "%s: %d connections are open, the maximum; further ones are closed, and not logged again",
                self._server,
                self.size,
            )
        stream = cast("asyncio.WriteTransport", transport)
        stream.write(self._refusal)
        stream.close()
        return False


class TurnProtocol(asyncio.BufferedProtocol):
    """A connection that reads at most `read_size` bytes before the loop serves other connections."""

    read_size: int = TURN
    _buffer: bytearray

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002 (asyncio's signature)
        """Return the buffer for the next bytes."""
        self._buffer = bytearray(self.read_size)
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Pass the bytes that were read to `data_received`."""
        self.data_received(bytes(self._buffer[:nbytes]))

    @abstractmethod
    def data_received(self, data: bytes) -> None:
        """Process bytes that were read."""


class Gate(TurnProtocol):
    """Passes what a connection sends to a protocol, in turns and within the budget of its server.

    Parameters
    ----------
    budget
        That of the server.
    make
        Makes the protocol of a connection that is admitted.
    admits
        Whether a new connection is admitted; it closes one that is not.
    """

    _transport: asyncio.Transport

    def __init__(
        self,
        budget: Budget,
        make: Callable[[], asyncio.BaseProtocol],
        admits: Callable[[asyncio.BaseTransport], bool],
    ) -> None:
        self._make = make
        self._admits = admits
        self._budget = budget
        self._account = Account(budget, budget.free_share)
        self._protocol = asyncio.Protocol()  # which ignores everything
        self._rest: asyncio.TimerHandle | None = None
        """Its end, during a rest."""
        self._held = b""
        """What came in a rest; reading is paused then, unless the protocol resumes it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._budget.accounts += 1
        if self._admits(transport):
            self._protocol = cast("asyncio.Protocol", self._make())
            self._protocol.connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._budget.accounts -= 1
        if self._rest is not None:
            self._rest.cancel()
            self._budget.resting -= 1
        self._protocol.connection_lost(exc)

    def eof_received(self) -> bool | None:
        self._pass_held()
        return self._protocol.eof_received()

    def pause_writing(self) -> None:
        self._protocol.pause_writing()

    def resume_writing(self) -> None:
        self._protocol.resume_writing()

    def get_buffer(self, sizehint: int) -> bytearray:
        self.read_size = self._budget.read_size
        return super().get_buffer(sizehint)

    def data_received(self, data: bytes) -> None:
        """Pass on what was read; a connection that takes much of the loop then rests, behind those that rest already."""
        if self._rest is not None:
            self._held += data
            self._transport.pause_reading()
        else:
            self._pass_on(data)

    def _pass_on(self, data: bytes) -> None:
        with self._account.taking():
            self._protocol.data_received(data)
        until_s = self._account.rests_until_s()
        if until_s is not None and self._rest is None and not self._transport.is_closing():
            self._budget.resting += 1
            self._rest = asyncio.get_running_loop().call_at(until_s, self._end_rest)

    def _end_rest(self) -> None:
        self._rest = None
        self._budget.resting -= 1
        if self._held and not self._transport.is_closing():
            self._transport.resume_reading()
            self._pass_held()

    def _pass_held(self) -> None:
        data, self._held = self._held, b""
        if data:
            self._pass_on(data)


class Listener:
    """A TCP server that accepts connections one by one, with a pause: a flood of them takes a small share of the loop."""

    def __init__(
        self, server: asyncio.Server, backlog: int, make: Callable[[], asyncio.BaseProtocol]
    ) -> None:
        self._server = server
        self._make = make
        self.address = server.sockets[0].getsockname()
        """Address of the first socket."""
        self._loop = asyncio.get_running_loop()
        self._pauses: dict[socket.socket, asyncio.TimerHandle | None] = {}
        """Sockets, each with the end of its pause."""
        self._connecting: set[asyncio.Task[Any]] = set()
        for each in server.sockets:
            own = each.dup()
            self._pauses[own] = None
            own.listen(backlog)
            self._end_pause(own)

    def _end_pause(self, listening: socket.socket) -> None:
        self._pauses[listening] = None
        self._loop.add_reader(listening, self._accept, listening)

    def _accept(self, listening: socket.socket) -> None:
        pause_s = ACCEPTING_S
        try:
            connection, _ = listening.accept()
        except (BlockingIOError, ConnectionError):  # it has closed already
            pass
        except OSError as error:
            pause_s = REFUSED_S
            self._loop.call_exception_handler(
                {"message": "a connection cannot be accepted", "exception": error}
            )
        else:
            connection.setblocking(False)  # noqa: FBT003 (the call of the library)
            connecting = self._loop.create_task(self._loop.connect_accepted_socket(self._make, connection))
            self._connecting.add(connecting)
            connecting.add_done_callback(self._connected)
        self._loop.remove_reader(listening)
        self._pauses[listening] = self._loop.call_later(pause_s, self._end_pause, listening)

    def _connected(self, connecting: asyncio.Task[Any]) -> None:
        self._connecting.discard(connecting)
        if not connecting.cancelled():
            connecting.exception()  # it has closed already

    def close(self) -> None:
        """Stop listening; connections stay open."""
        for listening, pause in self._pauses.items():
            if pause is None:
                self._loop.remove_reader(listening)
            else:
                pause.cancel()
            listening.close()
        self._pauses.clear()
        self._server.close()


def stream_protocol(
    serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
) -> Callable[[], asyncio.BaseProtocol]:
    """Return what makes the protocol of connections that a coroutine serves with streams."""
    return lambda: asyncio.StreamReaderProtocol(asyncio.StreamReader(), serve)


async def listen(
    make: Callable[[], asyncio.BaseProtocol], host: str, port: int, backlog: int = MAX_CONNECTIONS
) -> Listener:
    """Listen on TCP; `make` makes the protocol of a connection.

    Raises OSError or UnicodeError if the address is not available.
    """
    server = await asyncio.get_running_loop().create_server(make, host, port, start_serving=False)
    try:
        return Listener(server, backlog, make)
    except OSError:
        server.close()
        raise


def limit_buffers(transport: asyncio.BaseTransport) -> None:
    """Limit the kernel buffers of a connection, which hold megabytes by default, also of a peer that has flooded it and gone."""
    for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, option, WINDOW)


def detect_lost_peer(transport: asyncio.BaseTransport, *, must_read: bool = False) -> None:
    """Close a silent TCP connection within about ten seconds after the other machine has disappeared.

    With `must_read`, a peer that is alive but reads nothing for that long is lost too. Use it for servers,
    but not for clients, which may be halted in a debugger.
    """
    connection = transport.get_extra_info("socket")
    options = KEEPALIVE | {socket.TCP_USER_TIMEOUT: UNREAD_LIMIT_MS} if must_read else KEEPALIVE
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in options.items():
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
