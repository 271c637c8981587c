"""Asynchronous OBC client; rows and fields have their names in the interface definition."""

from __future__ import annotations

import asyncio
import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from typing import Any, Final

from starhil.hil_tests.client.links import HostLink
from starhil.hil_tests.client.transactions import Ack, Reading, Transaction
from starhil.hil_tests.errors import BadReplyError, BenchError, NackError, NoReplyError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.definition import Names
from starhil.protocol.icd.values import Value
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request, RequestKind

DEFAULT_TIMEOUT_S: Final = 1.0
"""Time-out in current public flight software."""
UNSOLICITED_KEPT: Final = 1000
"""Longest queue of unsolicited readings of a row; the oldest are dropped."""
HISTORY_LENGTH: Final = 10_000
"""Number of transactions, faults and stray replies that a client keeps."""
SETTLE_S: Final = 0.05
"""Pause after a time-out, in which a late reply is discarded."""


class AsyncObcClient:
    """An OBC on one link to one device, with one request at a time.

    `timeout_s` and `retries` (after a time-out, or a row of another length) are defaults; with no retries, the bench sees
    every lost reply.
    """

    def __init__(
        self,
        link: HostLink[Any],
        icd: InterfaceDefinition,
        *,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = 0,
    ) -> None:
        self.link = link
        self.icd = icd
        self.timeout_s = timeout_s
        self.retries = retries
        self.transactions: deque[Transaction] = deque(maxlen=HISTORY_LENGTH)
        self.faults: deque[LinkFault] = deque(maxlen=HISTORY_LENGTH)
        self.stray_replies: deque[Reply] = deque(maxlen=HISTORY_LENGTH)
        self.unsolicited: defaultdict[str, asyncio.Queue[Reading]] = defaultdict(
            lambda: asyncio.Queue(UNSOLICITED_KEPT)
        )
        self.unsolicited_dropped = 0
        self.bursts: asyncio.Queue[bytes] = asyncio.Queue()
        self._understood = False
        """Whether a reply was one of the dialect of the link, so that what is none is not of another dialect."""
        self._turn = asyncio.Lock()
        self._pending: tuple[Request, asyncio.Future[tuple[Reply, float]]] | None = None
        link.on_reply = self._on_reply
        link.on_fault = self.faults.append

    async def start(self) -> None:
        """Open the link."""
        await self.link.start()

    async def close(self) -> None:
        """Close the link."""
        await self.link.close()

    # --- by name ---

    async def read(self, name: str, *, timeout_s: float | None = None, retries: int | None = None) -> Reading:
        """Read a telemetry row.

        Raises NackError, NoReplyError, BadReplyError, LinkLostError; BenchError for a row that is only sent.
        """
        row = self.icd.telemetry[name]
        if row.only_sent:
            raise BenchError(
                f"{row.name}: is only sent, and no request reads it; wait for it as unsolicited telemetry"
            )
        request = self.icd.request(row)
        reply, latency = await self.transact(request, row.name, timeout_s=timeout_s, retries=retries)
        return self._reading(reply, latency)

    async def telemetry(
        self, name: str, *, timeout_s: float | None = None, retries: int | None = None
    ) -> dict[str, Value]:
        """Read a telemetry row and return its physical values by field."""
        return dict((await self.read(name, timeout_s=timeout_s, retries=retries)).values)

    async def command(
        self,
        /,
        name: str,
        values: Mapping[str, Value] | None = None,
        *,
        timeout_s: float | None = None,
        retries: int | None = None,
        checked: bool = True,
        **fields: Value,
    ) -> Ack:
        """Send a telecommand and wait for its acknowledge; fields as a mapping, by keyword, or both.

        A telecommand that the link does not answer, such as `reset` on the serial line of CubeStar, counts as accepted.

        With `checked` false, values outside the limits of the interface definition are sent too, for the device to refuse.

        Raises FieldError: a value violates the definition; nothing is sent. Raises NackError: the device
        refused the telecommand; has the error code.
        """
        data = self.icd.telecommands[name].encode({**(values or {}), **fields}, check=checked)
        return await self.command_raw(name, data, timeout_s=timeout_s, retries=retries)

    async def command_raw(
        self, name: str, data: bytes, *, timeout_s: float | None = None, retries: int | None = None
    ) -> Ack:
        """Send a telecommand with its data as bytes, which may be invalid."""
        row = self.icd.telecommands[name]
        request = self.icd.request(row, data)
        if not self.link.answers(row):
            self.link.request(request)
            return Ack(row.name, 0.0, answered=False)
        _reply, latency = await self.transact(request, row.name, timeout_s=timeout_s, retries=retries)
        return Ack(row.name, latency)

    async def set_parameter(
        self,
        name: str,
        value: Value,
        *,
        timeout_s: float | None = None,
        retries: int | None = None,
        checked: bool = True,
    ) -> Ack:
        """Set a parameter by name, in its unit; `checked` as in `command`."""
        parameter = self.icd.parameters[name]
        number = parameter.to_number(value) if checked or isinstance(value, str) else float(value)
        return await self.command(
            "set_parameter",
            {"parameter": parameter.id, "value": number},
            timeout_s=timeout_s,
            retries=retries,
            checked=checked,
        )

    async def read_parameter(self, name: str) -> Reading:
        """Select a parameter by name and read its value, limits and default."""
        parameter = self.icd.parameters[name]
        await self.command("select_parameter", parameter=parameter.id)
        reading = await self.read("parameter")
        if reading["parameter"] != parameter.id:
            raise BadReplyError(
                f"parameter {name}: the device reports number {reading['parameter']!r}, not {parameter.id}"
            )
        return reading

    async def get_parameter(self, name: str) -> Value:
        """Return the value of a parameter in its type."""
        reading = await self.read_parameter(name)
        try:
            return self.icd.parameters[name].check(reading["value"])
        except ProtocolError as error:
            raise BadReplyError(f"parameter {name}: {error}") from None

    async def wait_for(
        self, name: str, condition: Callable[[Reading], bool], *, within_s: float, every_s: float = 0.1
    ) -> Reading:
        """Read a row until the condition holds.

        Raises BenchError: the condition did not hold in time.
        """
        deadline = time.monotonic() + within_s
        while True:
            reading = await self.read(name)
            if condition(reading):
                return reading
            if time.monotonic() >= deadline:
                raise BenchError(
                    f"{name}: the condition did not hold within {within_s:g} s; last values {dict(reading.values)}"
                )
            await asyncio.sleep(every_s)

    async def wait_unsolicited(
        self, name: str, *, timeout_s: float | None = None, since_s: float = -math.inf
    ) -> Reading:
        """Return the next unsolicited telemetry of a row, which may have arrived before the call.

        Messages received before `since_s` (on `time.monotonic`) are dropped.
        """
        row_name = self.icd.telemetry[name].name
        queue = self.unsolicited[row_name]
        limit = self.timeout_s if timeout_s is None else timeout_s
        try:
            async with asyncio.timeout(limit):
                while True:
                    reading = await queue.get()
                    if reading.received_s >= since_s:
                        return reading
        except TimeoutError:
            raise NoReplyError(f"unsolicited {row_name}", limit) from None

    # --- by row ID ---

    async def transact(
        self,
        request: Request,
        name: str,
        *,
        timeout_s: float | None = None,
        retries: int | None = None,
    ) -> tuple[Reply, float]:
        """Send a request and return its reply and latency.

        The row ID need not be in the definition. Raises BadReplyError: the first reply is one of another dialect.
        """
        limit = self.timeout_s if timeout_s is None else timeout_s
        attempts = 1 + (self.retries if retries is None else retries)
        async with self._turn:
            for left in reversed(range(attempts)):
                answer = await self._attempt(request, limit)
                whole = answer is not None and not self._is_incomplete(answer[0])
                self._understood = self._understood or whole
                dialect = None if self._understood else self.link.dialect_of_reply(request)
                if answer is not None and dialect is None and (whole or not left):
                    return self._checked_reply(name, *answer)
                self.transactions.append(Transaction(name, "no_reply", float("inf")))
                if dialect is not None:
                    remedy = "choose it with --dialect, in pytest --starhil-dialect"
                    raise BadReplyError(f"{name}: the unit replies in dialect {dialect}; {remedy}")
        self.link.check()
        raise NoReplyError(name, limit, attempts)

    async def _attempt(self, request: Request, limit: float) -> tuple[Reply, float] | None:
        future: asyncio.Future[tuple[Reply, float]] = asyncio.get_running_loop().create_future()
        self._pending = (request, future)
        begin = time.perf_counter()
        try:
            self.link.request(request)
            async with asyncio.timeout(limit):
                reply, end = await future
            return reply, end - begin
        except TimeoutError:
            await asyncio.sleep(SETTLE_S)
            self.link.reset_receiver()
            return None
        finally:
            self._pending = None

    def _is_incomplete(self, reply: Reply) -> bool:
        """Return whether a row has another length than in the definition, as after its first segment on CAN was lost.

        Segments count down, so that the next one looks like the first of a shorter message.
        """
        row = self._row_of(reply)
        return row is not None and reply.kind is ReplyKind.TELEMETRY and len(reply.data) != row.size

    def _checked_reply(self, name: str, reply: Reply, latency: float) -> tuple[Reply, float]:
        if reply.kind is not ReplyKind.NACK:
            self.transactions.append(Transaction(name, "ok", latency))
            return reply, latency
        code_name = self.icd.error_name(int(reply.code))
        self.transactions.append(Transaction(name, code_name, latency))
        raise NackError(name, int(reply.code), code_name)

    def _on_reply(self, reply: Reply) -> None:
        now = time.perf_counter()
        if reply.kind is ReplyKind.BURST:
            self.bursts.put_nowait(reply.data)
            return
        if reply.kind is ReplyKind.UNSOLICITED:
            self._on_unsolicited(reply)
            return
        if self._pending is not None:
            request, future = self._pending
            if self._answers(request, reply) and not future.done():
                future.set_result((reply, now))
                return
        row = self._row_of(reply)
        if (
            row is not None
            and reply.kind is ReplyKind.TELEMETRY
            and (row.unsolicited is not None or self.icd.selects_unsolicited)
            and not self.link.marks_unsolicited(reply.message_class)
        ):
            self._on_unsolicited(reply)
        else:
            self.stray_replies.append(reply)

    def _answers(self, request: Request, reply: Reply) -> bool:
        """Return whether a reply answers a request; a telecommand may be answered with a telemetry row."""
        if reply.id is None or (reply.id, reply.message_class) == (request.id, request.message_class):
            return reply.kind in _ANSWERS[request.kind]
        row, answer = self.icd.row(request.id, request.message_class), self._row_of(reply)
        return row is not None and answer is not None and f"row:{answer.name}" in row.answers

    def _on_unsolicited(self, reply: Reply) -> None:
        row = self._row_of(reply)
        if row is None or row.kind != "telemetry" or len(reply.data) != row.size:
            self.stray_replies.append(reply)
        else:
            queue = self.unsolicited[row.name]
            if queue.full():
                queue.get_nowait()
                self.unsolicited_dropped += 1
            queue.put_nowait(self._reading(reply, 0.0))

    def _row_of(self, reply: Reply) -> Row | None:
        return None if reply.id is None else self.icd.row(reply.id, reply.message_class)

    def _reading(self, reply: Reply, latency: float) -> Reading:
        row = self._row_of(reply)
        if row is None:
            raise BadReplyError("a reply without a row ID")
        try:
            values = row.decode(reply.data)
        except ProtocolError as error:
            raise BadReplyError(str(error)) from None
        return Reading(
            row.name,
            Names(f"field of {row.name}", values.items(), few=True),
            latency,
            time.time(),
            time.monotonic(),
        )


_ANSWERS: Final = {
    RequestKind.TELECOMMAND: (ReplyKind.ACK, ReplyKind.NACK),
    RequestKind.TELEMETRY: (ReplyKind.TELEMETRY, ReplyKind.NACK),
}
