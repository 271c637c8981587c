"""Requests from all links to the device, and unsolicited telemetry."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from starhil.emulator.device.bindings import TelecommandBinding, TelemetryBinding
from starhil.emulator.device.counters import Acknowledge
from starhil.emulator.device.device import Device
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.subscriptions import Subscription
from starhil.emulator.guard import call_guarded, log_internal_error
from starhil.protocol.codec import Row
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.values import MessageError

log = logging.getLogger("starhil.device")

BY_PARAMETERS = "parameters"
"""Origin of the subscription made by the parameters unsolicited_selection and unsolicited_rate."""


class Requests:
    """Executes telecommands and answers telemetry requests for the rows of the interface definition.

    Refusals carry an `ErrorCode`; each link translates it for its bus.

    Parameters
    ----------
    device
        The device that executes the requests.

    Attributes
    ----------
    unsolicited_receivers
        Called with each unsolicited telemetry message; one per link.
    """

    def __init__(self, device: Device) -> None:
        icd = device.icd
        self.device = device
        self.unsolicited_receivers: list[Callable[[Reply], None]] = []
        self.telemetry_bindings = {row.name: TelemetryBinding(row, icd) for row in icd.telemetry.values()}
        self.telecommand_bindings = {
            row.name: TelecommandBinding(row, icd) for row in icd.telecommands.values()
        }
        self._telemetry_rows = {(row.klass, row.id): row for row in icd.telemetry.values()}
        self._telecommand_rows = {(row.klass, row.id): row for row in icd.telecommands.values()}
        serial = icd.link.serial
        self._stamped = serial is not None and any(
            item.role in ("ticks", "time") for item in serial.reply_header
        )
        """Whether replies contain the time."""
        device.subscriptions.send = self._send_unsolicited
        device.on_start.append(self._restart_subscriptions)
        device.on_frame.append(lambda _measurement: device.subscriptions.frame_published())
        device.parameters.observe(self._parameters_changed)

    def handle(self, request: Request, later: Callable[[Reply], None] | None = None) -> list[Reply] | None:
        """Handle a request from a link; return the replies to send on the same link, in order.

        Parameters
        ----------
        request
            The request as received.
        later
            Called with the answer to a telecommand that is answered when it is done; `handle` then returns
            None.
        """
        device = self.device
        if device.unresponsive:
            return []
        if request.kind is RequestKind.TELEMETRY:
            row = self._telemetry_rows.get((request.klass, request.id))
            device.counters.telemetry = (device.counters.telemetry + 1) & 0xFFFF
            return self._replies(request, row, self._answer_telemetry(request, row))
        row = self._telecommand_rows.get((request.klass, request.id))
        device.counters.telecommands = (device.counters.telecommands + 1) & 0xFFFF
        code, replies = self._execute(request, row)
        if code is not None:
            answered = self._answers_with_data(request, replies) or self._replies(
                request, row, self._answer(request, code)
            )
            following = [replace(item, destination=request.source) for item in replies if item.id is not None]
            return answered + following
        if later is not None:
            device.acknowledge.on_end = partial(self._answer_later, request, row, later)
        return None

    def _answer_later(
        self, request: Request, row: Row | None, later: Callable[[Reply], None], code: ErrorCode
    ) -> None:
        for reply in self._replies(request, row, self._answer(request, code)):
            later(reply)

    def count_fault(self, fault: LinkFault) -> None:
        """Count input on a link that was not a valid request."""
        if not self.device.unresponsive:
            log.debug("%s: %s", fault.kind.value, fault.detail)
            self.device.counters.count_fault(fault)

    def telemetry(self, name: str) -> bytes:
        """Return the current data of a telemetry row.

        Raises
        ------
        Refused
            The row cannot be read now.
        """
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
        uptime_ns, time_ns = self._times()
        return Reply(
            kind,
            request.id,
            data,
            code,
            request.source,
            klass=request.klass,
            sequence=request.sequence,
            flags=request.flags,
            uptime_ns=uptime_ns,
            time_ns=time_ns,
        )

    def _times(self) -> tuple[int, int]:
        """Return uptime and device time since the unit's epoch, ns; 0 if replies do not carry it."""
        if not self._stamped:
            return 0, 0
        device = self.device
        uptime_ns = device.clock.now_ns() - device.started_ns
        return uptime_ns, device.icd.conventions.reported_ns(device.time.unix_ns())

    def _execute(self, request: Request, row: Row | None) -> tuple[ErrorCode | None, Sequence[Reply]]:
        """Execute a telecommand and record its outcome; the code is None while the outcome is pending."""
        device = self.device
        if not device.acknowledge.processed:
            device.counters.overrun()
        acknowledge = device.acknowledge = Acknowledge(request.id, processed=False)
        if row is None:
            acknowledge.end(ErrorCode.INVALID_ID)
            return ErrorCode.INVALID_ID, []
        binding = self.telecommand_bindings[row.name]
        try:
            replies = binding.execute(device, request.data, acknowledge)
        except (Refused, MessageError) as refused:
            acknowledge.end(refused.code, refused.index)
            return refused.code, []
        except Exception as error:  # noqa: BLE001 (the OBC always gets an answer)
            log_internal_error(f"telecommand {request.id}", error)
            acknowledge.end(ErrorCode.INTERNAL)
            return ErrorCode.INTERNAL, []
        if not acknowledge.continues:
            acknowledge.end()
            return ErrorCode.OK, replies
        if not binding.answered_when_done:
            return ErrorCode.OK, []
        return acknowledge.error if acknowledge.processed else None, []

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if names & {"unsolicited_rate", "unsolicited_selection"}:
            self._subscribe_by_parameters()

    def _restart_subscriptions(self) -> None:
        self.device.subscriptions.clear()
        self._subscribe_by_parameters()

    def _subscribe_by_parameters(self) -> None:
        device = self.device
        rate_hz = float(device.parameters["unsolicited_rate"])
        row = device.icd.telemetry_row(int(device.parameters["unsolicited_selection"]))
        wanted = [Subscription(row, rate_hz)] if row is not None and rate_hz > 0.0 else []
        device.subscriptions.replace(BY_PARAMETERS, wanted)

    def _send_unsolicited(self, row: Row) -> None:
        device = self.device
        if device.unresponsive:
            return
        try:
            data = self.telemetry(row.name)
        except Refused:  # the row cannot be read now, for example while an image is being opened
            return
        uptime_ns, time_ns = self._times()
        reply = Reply(
            ReplyKind.UNSOLICITED,
            row.id,
            data,
            destination=int(device.parameters["host_address"]),
            klass=row.klass,
            uptime_ns=uptime_ns,
            time_ns=time_ns,
        )
        for receiver in self.unsolicited_receivers:
            call_guarded("unsolicited telemetry", receiver, reply)
