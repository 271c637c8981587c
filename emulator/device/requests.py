"""Requests from all links to the device, and unsolicited telemetry."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

from starhil.emulator.device.bindings import TelecommandBinding, TelemetryBinding
from starhil.emulator.device.counters import Acknowledge
from starhil.emulator.device.device import Device
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.refusal import Refused
from starhil.emulator.guard import log_internal_error
from starhil.protocol.codec import Row
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.values import MessageError

log = logging.getLogger("starhil.device")

Answer: TypeAlias = list[Reply] | PendingAnswer[list[Reply]]
"""Replies to a request; pending if it is answered when it is done."""


class Requests:
    """Executes telecommands and answers telemetry requests for the rows of the interface definition.

    Refusals carry an `ErrorCode`; each link translates it for its bus.
    """

    def __init__(self, device: Device) -> None:
        icd = device.icd
        self.device = device
        self.telemetry_bindings = {row.name: TelemetryBinding(row, icd) for row in icd.telemetry.values()}
        self.telecommand_bindings = {
            row.name: TelecommandBinding(row, icd) for row in icd.telecommands.values()
        }
        self._telemetry_rows = {
            (row.klass, row.id): row for row in icd.telemetry.values() if not row.only_sent
        }
        self._telecommand_rows = {(row.klass, row.id): row for row in icd.telecommands.values()}
        serial = icd.link.serial
        self._stamped = serial is not None and any(
            item.role in ("ticks", "time") for item in serial.reply_header
        )
        """Whether replies contain the time."""
        device.signals.row_due.connect(self._send_unsolicited)

    def handle(self, request: Request, *, console: bool = False) -> Answer:
        """Handle a request from a link; return the replies to send on the same link, in order.

        Telemetry that the `console` requests is not counted: what an OBC has counted still agrees with the device.
        """
        device = self.device
        if device.unresponsive:
            return []
        if request.kind is RequestKind.TELEMETRY:
            row = self._telemetry_rows.get((request.klass, request.id))
            device.counters.telemetry = (device.counters.telemetry + (not console)) & 0xFFFF
            return self._replies(request, row, self._answer_telemetry(request, row))
        row = self._telecommand_rows.get((request.klass, request.id))
        device.counters.telecommands = (device.counters.telecommands + 1) & 0xFFFF
        outcome = self._execute(request, row)
        if isinstance(outcome, PendingAnswer):
            return outcome.then(lambda code: self._replies(request, row, self._answer(request, code)))
        code, replies = outcome
        answered = self._answers_with_data(request, replies) or self._replies(
            request, row, self._answer(request, code)
        )
        following = [replace(item, destination=request.source) for item in replies if item.id is not None]
        return answered + following

    def count_fault(self, fault: LinkFault) -> None:
        """Count input on a link that was not a valid request."""
        if not self.device.unresponsive:
            log.debug("%s: %s", fault.kind.value, fault.detail)
            self.device.counters.count_fault(fault)

    def telemetry(self, name: str) -> bytes:
        """Return the current data of a telemetry row; raises Refused if it cannot be read now."""
        try:
            return self.telemetry_bindings[name].encode(self.device)
        except Refused:
            raise
        except Exception as error:
            log_internal_error(f"telemetry {name}", error)
            raise Refused(ErrorCode.INTERNAL) from error

    def _replies(self, request: Request, row: Row | None, reply: Reply) -> list[Reply]:
        """Return the answers of a row in order, including its reply or refusal."""
        if row is None or row.answers == ("reply",):
            return [reply]
        replies: list[Reply] = []
        for answer in row.answers:
            if answer == "echo":
                replies.append(Reply.echo(request))
            elif answer == "reply":
                replies.append(reply)
            elif reply.kind is not ReplyKind.NACK:
                other = self.device.icd.telemetry[answer.partition(":")[2]]
                as_request = replace(
                    request, kind=RequestKind.TELEMETRY, id=other.id, klass=other.klass, data=b""
                )
                replies.append(self._answer_telemetry(as_request, other))
        return [replace(item, final=item is replies[-1]) for item in replies]

    def _answers_with_data(self, request: Request, replies: Sequence[Reply]) -> list[Reply]:
        """Return answers with data made by an action of a plugin, which are marked by having no ID."""
        data = [reply.data for reply in replies if reply.id is None]
        return [
            replace(self._reply(request, ReplyKind.ACK, item), final=number == len(data))
            for number, item in enumerate(data, 1)
        ]

    def _answer_telemetry(self, request: Request, row: Row | None) -> Reply:
        if row is None:
            return self._answer(request, ErrorCode.INVALID_ID)
        if request.data:
            return self._answer(request, ErrorCode.INVALID_LENGTH)
        try:
            data = self.telemetry(row.name)
        except Refused as refused:
            return self._answer(request, refused.code)
        return self._reply(request, ReplyKind.TELEMETRY, data)

    def _answer(self, request: Request, code: ErrorCode) -> Reply:
        kind = ReplyKind.ACK if code is ErrorCode.OK else ReplyKind.NACK
        return self._reply(request, kind, code=code)

    def _reply(
        self, request: Request, kind: ReplyKind, data: bytes = b"", code: ErrorCode = ErrorCode.OK
    ) -> Reply:
        reply = Reply(
            kind,
            request.id,
            data,
            code,
            request.source,
            klass=request.klass,
            sequence=request.sequence,
            flags=request.flags,
        )
        return self._with_times(reply)

    def _with_times(self, reply: Reply) -> Reply:
        """Return a reply with uptime and device time since the unit's epoch, if replies of the unit carry them."""
        if not self._stamped:
            return reply
        device = self.device
        uptime_ns = device.clock.now_ns() - device.started_ns
        time_ns = device.icd.conventions.reported_ns(device.time.unix_ns())
        return replace(reply, uptime_ns=uptime_ns, time_ns=time_ns)

    def _execute(
        self, request: Request, row: Row | None
    ) -> tuple[ErrorCode, Sequence[Reply]] | PendingAnswer[ErrorCode]:
        """Execute a telecommand and record its outcome, at once or when it is done."""
        device = self.device
        if not device.acknowledge.processed:
            device.counters.overrun()
        acknowledge = device.acknowledge = Acknowledge(request.id, processed=False)
        if row is None:
            acknowledge.end(ErrorCode.INVALID_ID)
            return ErrorCode.INVALID_ID, []
        try:
            outcome = self.telecommand_bindings[row.name].execute(device, request.data)
        except (Refused, MessageError) as refused:
            acknowledge.end(refused.code, refused.index)
            return refused.code, []
        except Exception as error:  # noqa: BLE001 (the OBC always gets an answer)
            log_internal_error(f"telecommand {request.id}", error)
            acknowledge.end(ErrorCode.INTERNAL)
            return ErrorCode.INTERNAL, []
        if isinstance(outcome, PendingAnswer):
            outcome.when_done(acknowledge.end)
            if outcome.accepted:
                return ErrorCode.OK, []
            return (acknowledge.error, []) if outcome.done else outcome
        acknowledge.end()
        return ErrorCode.OK, outcome or []

    def _send_unsolicited(self, row: Row) -> None:
        device = self.device
        if device.unresponsive:
            return
        try:
            data = self.telemetry(row.name)
        except Refused:  # the row cannot be read now, for example while an image is being opened
            return
        host = int(device.parameters["host_address"])
        reply = Reply(ReplyKind.UNSOLICITED, row.id, data, destination=host, klass=row.klass)
        device.signals.unsolicited.emit(self._with_times(reply))
