"""The one way into the device: requests from every link, and the telemetry that it sends unsolicited."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.counters import Acknowledge
from starhil.emulator.device.device import Device
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.scheduler import Event
from starhil.emulator.device.telecommands import ANSWERED_WHEN_DONE, TELECOMMANDS
from starhil.emulator.device.telemetry import TELEMETRY
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import call_guarded, log_internal_error
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.values import MessageError

log = logging.getLogger("starhil.device")


class Requests:
    """Executes telecommands and answers telemetry requests for the rows of the interface definition.

    Parameters
    ----------
    device
        The device that the requests act on.

    Attributes
    ----------
    unsolicited_receivers
        Called with each unsolicited telemetry message; one per link.

    Raises
    ------
    EmulatorError
        The interface definition has a row without a handler.
    """

    def __init__(self, device: Device) -> None:
        missing = missing_handlers(device.icd)
        if missing:
            raise EmulatorError(
                f"interface definition {device.icd.name}: the device has no handler for {missing[0]}"
            )
        self.device = device
        self.unsolicited_receivers: list[Callable[[Reply], None]] = []
        self._next_unsolicited: Event | None = None
        device.on_start.append(self._schedule_unsolicited)
        device.parameters.observe(self._parameters_changed)

    def handle(self, request: Request, later: Callable[[Reply], None] | None = None) -> list[Reply] | None:
        """Handle a request from a link; return the replies to send on the same link, in order.

        Parameters
        ----------
        request
            The request as received.
        later
            Called with the answer to a telecommand that is answered only once it is done; `handle` then returns None.
        """
        device = self.device
        if device.unresponsive:
            return []
        if request.kind is RequestKind.TELEMETRY:
            device.counters.telemetry = (device.counters.telemetry + 1) & 0xFFFF
            return [self._answer_telemetry(request)]
        device.counters.telecommands = (device.counters.telecommands + 1) & 0xFFFF
        code, replies = self._execute(request)
        if code is not None:
            return [_answer(request, code), *replies]
        if later is not None:
            device.acknowledge.on_end = lambda code: later(_answer(request, code))
        return None

    def count_fault(self, fault: LinkFault) -> None:
        """Count input on a link that was not a valid request."""
        if not self.device.unresponsive:
            log.debug("%s: %s", fault.kind.value, fault.detail)
            self.device.counters.count_fault(fault)

    def telemetry(self, name: str) -> bytes:
        """Return the present data of a telemetry row.

        Raises
        ------
        Refused
            The row cannot be read now.
        """
        try:
            return self.device.icd.telemetry[name].encode(TELEMETRY[name](self.device), saturate=True)
        except Refused:
            raise
        except Exception as error:
            log_internal_error(f"telemetry {name}", error)
            raise Refused(ErrorCode.INTERNAL) from error

    def _answer_telemetry(self, request: Request) -> Reply:
        row = self.device.icd.telemetry_by_id.get(request.id)
        if row is None:
            return _answer(request, ErrorCode.INVALID_ID)
        if request.data:
            return _answer(request, ErrorCode.INVALID_LENGTH)
        try:
            data = self.telemetry(row.name)
        except Refused as refused:
            return _answer(request, refused.code)
        return Reply(ReplyKind.TELEMETRY, request.id, data, destination=request.source)

    def _execute(self, request: Request) -> tuple[ErrorCode | None, list[Reply]]:
        """Execute a telecommand and record its outcome; the code is None while the outcome is open."""
        device = self.device
        if not device.acknowledge.processed:
            device.counters.overrun()
        acknowledge = device.acknowledge = Acknowledge(request.id, processed=False)
        row = device.icd.telecommands_by_id.get(request.id)
        if row is None:
            acknowledge.end(ErrorCode.INVALID_ID)
            return ErrorCode.INVALID_ID, []
        try:
            replies = TELECOMMANDS[row.name](device, row.decode(request.data), acknowledge)
        except (Refused, MessageError) as refused:
            acknowledge.end(refused.code, refused.index)
            return refused.code, []
        except Exception as error:  # noqa: BLE001 (the OBC gets an answer whatever happens)
            log_internal_error(f"telecommand {request.id}", error)
            acknowledge.end(ErrorCode.INTERNAL)
            return ErrorCode.INTERNAL, []
        if replies is not None:
            acknowledge.end()
            return ErrorCode.OK, [replace(reply, destination=request.source) for reply in replies]
        if row.name not in ANSWERED_WHEN_DONE:
            return ErrorCode.OK, []
        return acknowledge.error if acknowledge.processed else None, []

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if names & {"unsolicited_rate", "unsolicited_selection"}:
            self._schedule_unsolicited()

    def _schedule_unsolicited(self) -> None:
        if self._next_unsolicited is not None:
            self._next_unsolicited.cancel()
            self._next_unsolicited = None
        device = self.device
        if float(device.parameters["unsolicited_rate"]) > 0.0:
            self._next_unsolicited = device.scheduler.at(device.clock.now_ns(), self._send_unsolicited)

    def _send_unsolicited(self, due_ns: int) -> None:
        device, parameters = self.device, self.device.parameters
        period_ns = max(1, round(NANOSECONDS / float(parameters["unsolicited_rate"])))
        missed = max(0, (device.clock.now_ns() - due_ns) // period_ns)
        self._next_unsolicited = device.scheduler.at(
            due_ns + (missed + 1) * period_ns, self._send_unsolicited
        )
        row = device.icd.telemetry_by_id.get(int(parameters["unsolicited_selection"]))
        if row is None or device.unresponsive:
            return
        try:
            data = self.telemetry(row.name)
        except Refused:  # the row cannot be read now, for example while an image is being opened
            return
        reply = Reply(ReplyKind.UNSOLICITED, row.id, data, destination=int(parameters["host_address"]))
        for receiver in self.unsolicited_receivers:
            call_guarded("unsolicited telemetry", receiver, reply)


def _answer(request: Request, code: ErrorCode) -> Reply:
    kind = ReplyKind.ACK if code is ErrorCode.OK else ReplyKind.NACK
    return Reply(kind, request.id, code=code, destination=request.source)


def missing_handlers(icd: InterfaceDefinition) -> list[str]:
    """Return the names of the rows of a definition that the device has no handler for."""
    return sorted((set(icd.telemetry) - set(TELEMETRY)) | (set(icd.telecommands) - set(TELECOMMANDS)))
