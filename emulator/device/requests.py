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
from starhil.emulator.device.signals import Executed
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.device.telemetry_faults import Hits, TelemetryFaults, with_flaws
from starhil.emulator.simulation.guard import log_internal_error
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import MessageError
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind

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
        self.faults = TelemetryFaults(icd, device.profile.run.seed)
        """Faults in the content of telemetry."""
        self.telemetry_bindings = {row.name: TelemetryBinding(row, icd) for row in icd.telemetry.values()}
        self.telecommand_bindings = {
            row.name: TelecommandBinding(row, icd) for row in icd.telecommands.values()
        }
        self._telemetry_rows = {
            (row.message_class, row.id): row for row in icd.telemetry.values() if not row.only_sent
        }
        self._telecommand_rows = {(row.message_class, row.id): row for row in icd.telecommands.values()}
        serial = icd.link.serial
        self._stamped = serial is not None and any(
            item.role in ("ticks", "time") for item in serial.reply_header
        )
        """Whether replies contain the time."""
        device.signals.rows_due.connect(self._send_unsolicited)

    def handle(self, request: Request, *, console: bool = False) -> Answer:
        """Handle a request from a link; return the replies to send on the same link, in order.

        Telemetry that the `console` requests is not counted: what an OBC has counted still agrees with the device.
        """
        device = self.device
        if device.unresponsive:
            return []
        if request.kind is RequestKind.TELEMETRY:
            row = self._telemetry_rows.get((request.message_class, request.id))
            if not console:
                device.counters = device.counters.with_telemetry()
            snapshot = device.snapshot()
            hits = self.faults.hits(row, snapshot, counted=not console)
            reply = self._answer_telemetry(request, row, snapshot, hits)
            return self._replies(request, row, reply, snapshot, hits)
        row = self._telecommand_rows.get((request.message_class, request.id))
        device.counters = device.counters.with_telecommand()
        outcome = self._execute(request, row)
        if isinstance(outcome, PendingAnswer):

            def acknowledge(code: ErrorCode) -> list[Reply]:
                device.signals.executed.emit(Executed(request, row, code, console))
                return self._acknowledge(request, row, code, device.snapshot())

            return outcome.then(acknowledge)
        code, replies = outcome
        device.signals.executed.emit(Executed(request, row, code, console))
        snapshot = device.snapshot()
        answered = self._answers_with_data(request, replies, snapshot, code) or self._acknowledge(
            request, row, code, snapshot
        )
        for item in replies:
            if item.id is not None:
                packet = replace(item, destination=request.source)
                answered += self._flawed(self.faults.hits(row, snapshot, packet=True), packet, snapshot)
        return answered

    def count_fault(self, fault: LinkFault) -> None:
        """Count input on a link that was not a valid request."""
        if not self.device.unresponsive:
            log.debug("%s: %s", fault.kind.value, fault.detail)
            self.device.counters = self.device.counters.with_fault(fault)

    def count_overrun(self) -> None:
        """Flag the loss of a request that arrived while too many others waited."""
        if not self.device.unresponsive:
            log.debug("a request is lost, because too many wait")
            self.device.counters = self.device.counters.with_overrun()

    def telemetry(self, name: str, snapshot: Snapshot, hits: Hits = ()) -> bytes:
        """Return the data of a telemetry row at one moment, with the faults of the message.

        Raises Refused if it cannot be read then.
        """
        binding = self.telemetry_bindings[name]
        try:
            data = self._content(name, snapshot, hits)
            binding.follow(self.device)
        except Refused:
            raise
        except Exception as error:
            log_internal_error(f"telemetry {name}", error)
            raise Refused(ErrorCode.INTERNAL) from error
        return data

    def _content(self, name: str, snapshot: Snapshot, hits: Hits = ()) -> bytes:
        """Return the data of a telemetry row at one moment, as faults let the device see it, and change it."""
        binding = self.telemetry_bindings[name]
        for hit in hits:
            snapshot = hit.seen(snapshot)
        data = binding.encode(snapshot)
        for hit in hits:
            data = hit.changed(binding.row, data)
        return data

    def _flawed(self, hits: Hits, reply: Reply, snapshot: Snapshot) -> list[Reply]:
        """Return the messages that are sent instead of one that faults affect."""
        return with_flaws(
            hits, reply, lambda name: (self.telemetry_bindings[name].row, self._content(name, snapshot))
        )

    def _acknowledge(
        self, request: Request, row: Row | None, code: ErrorCode, snapshot: Snapshot
    ) -> list[Reply]:
        """Return the answers to a telecommand that has been executed or refused."""
        hits = self.faults.hits(row, snapshot)
        return self._replies(request, row, self._answer(request, snapshot, code), snapshot, hits)

    def _replies(
        self, request: Request, row: Row | None, reply: Reply, snapshot: Snapshot, hits: Hits
    ) -> list[Reply]:
        """Return the answers of a row in order, including its reply or refusal, all of one moment."""
        own = self._flawed(hits, reply, snapshot)
        if row is None or row.answers == ("reply",):
            return own
        replies: list[Reply] = []
        for answer in row.answers:
            if answer == "echo":
                replies.append(Reply.echo(request))
            elif answer == "reply":
                replies += own
            elif reply.kind is not ReplyKind.NACK:
                other = self.device.icd.telemetry[answer.partition(":")[2]]
                as_request = replace(
                    request,
                    kind=RequestKind.TELEMETRY,
                    id=other.id,
                    message_class=other.message_class,
                    data=b"",
                )
                hits = self.faults.hits(other, snapshot)
                replies += self._flawed(
                    hits, self._answer_telemetry(as_request, other, snapshot, hits), snapshot
                )
        return [replace(item, final=item is replies[-1]) for item in replies]

    def _answers_with_data(
        self, request: Request, replies: Sequence[Reply], snapshot: Snapshot, code: ErrorCode
    ) -> list[Reply]:
        """Return answers with data made by an action of a plugin, which are marked by having no ID."""
        data = [reply.data for reply in replies if reply.id is None]
        kind = ReplyKind.ACK if code is ErrorCode.OK else ReplyKind.NACK
        return [
            replace(self._reply(request, snapshot, kind, item, code), final=number == len(data))
            for number, item in enumerate(data, 1)
        ]

    def _answer_telemetry(self, request: Request, row: Row | None, snapshot: Snapshot, hits: Hits) -> Reply:
        if row is None:
            return self._answer(request, snapshot, ErrorCode.INVALID_ID)
        if request.data:
            return self._answer(request, snapshot, ErrorCode.INVALID_LENGTH)
        try:
            data = self.telemetry(row.name, snapshot, hits)
        except Refused as refused:
            return self._answer(request, snapshot, refused.code)
        return self._reply(request, snapshot, ReplyKind.TELEMETRY, data)

    def _answer(self, request: Request, snapshot: Snapshot, code: ErrorCode) -> Reply:
        kind = ReplyKind.ACK if code is ErrorCode.OK else ReplyKind.NACK
        return self._reply(request, snapshot, kind, code=code)

    def _reply(
        self,
        request: Request,
        snapshot: Snapshot,
        kind: ReplyKind,
        data: bytes = b"",
        code: ErrorCode = ErrorCode.OK,
    ) -> Reply:
        reply = Reply(
            kind,
            request.id,
            data,
            code,
            request.source,
            message_class=request.message_class,
            sequence=request.sequence,
            flags=request.flags,
        )
        return self._with_times(reply, snapshot)

    def _with_times(self, reply: Reply, snapshot: Snapshot) -> Reply:
        """Return a reply with uptime and device time since the unit's epoch, if replies of the unit carry them."""
        return (
            replace(reply, uptime_ns=snapshot.uptime_ns, time_ns=snapshot.clock_ns)
            if self._stamped
            else reply
        )

    def _execute(
        self, request: Request, row: Row | None
    ) -> tuple[ErrorCode, Sequence[Reply]] | PendingAnswer[ErrorCode]:
        """Execute a telecommand and record its outcome, at once or when it is done."""
        device = self.device
        if not device.acknowledge.processed:
            device.counters = device.counters.with_overrun()
        begun = device.acknowledge = Acknowledge(request.id, processed=False)

        def end(code: ErrorCode = ErrorCode.OK, index: int = 0) -> None:
            if device.acknowledge is begun:  # no other telecommand and no restart has followed
                device.acknowledge = Acknowledge(request.id, error=code, parameter_index=index)

        if row is None:
            end(ErrorCode.INVALID_ID)
            return ErrorCode.INVALID_ID, []
        try:
            outcome = self.telecommand_bindings[row.name].execute(device, request.data)
        except MessageError as wrong:
            end(wrong.code, wrong.index)
            return wrong.code, []
        except Refused as refused:
            end(refused.code, refused.index)
            return refused.code, [Reply(ReplyKind.NACK, None, refused.data)] if refused.data else []
        except Exception as error:  # noqa: BLE001 (the OBC always gets an answer)
            log_internal_error(f"telecommand {request.id}", error)
            end(ErrorCode.INTERNAL)
            return ErrorCode.INTERNAL, []
        if isinstance(outcome, PendingAnswer):
            codes: list[ErrorCode] = []
            outcome.when_done(codes.append)
            outcome.when_done(end)
            if outcome.accepted:
                return ErrorCode.OK, []
            return (codes[0], []) if codes else outcome
        end()
        return ErrorCode.OK, outcome or []

    def _send_unsolicited(self, rows: Sequence[Row]) -> None:
        device = self.device
        if device.unresponsive or not rows:
            return
        host = int(device.parameters["host_address"])
        snapshot = device.snapshot()
        for row in rows:
            hits = self.faults.hits(row, snapshot)
            try:
                data = self.telemetry(row.name, snapshot, hits)
            except Refused:  # the row cannot be read now, for example while an image is being opened
                continue
            reply = Reply(
                ReplyKind.UNSOLICITED, row.id, data, destination=host, message_class=row.message_class
            )
            for item in self._flawed(hits, self._with_times(reply, snapshot), snapshot):
                device.signals.unsolicited.emit(item)
            if row.action is not None:
                snapshot = device.snapshot()  # after the action that follows the reading of the row
