"""The OBC's end of each link of a unit in memory: requests out, answers in, each with the time at which it was sent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from starhil.protocol.can_framing import CanFrame, CanHostReceiver, encode_request_frames
from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.cob import SDO_RECEIVE, SDO_TRANSMIT
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import ERROR_OF_ABORT, row_transfer
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.serial_stack import SerialStack

HOST: Final = 1
"""CAN address of the OBC."""
UNASKED: Final = frozenset({ReplyKind.UNSOLICITED, ReplyKind.EVENT, ReplyKind.BURST})
"""Messages that come without a request, or after the answer to one."""

Heard = tuple[float, Reply | LinkFault]
Deliver = Callable[[Any], None]
Take = Callable[[], Sequence[tuple[float, Any]]]


class Port(Protocol):
    """An OBC on one link."""

    def ask(self, request: Request, reply_size: int) -> None:
        """Send a request."""
        ...

    def cut(self, request: Request, share: float) -> None:
        """Send the first part of a request, as a client that goes away."""
        ...

    def answers(self) -> list[Heard]:
        """Return what has arrived."""
        ...


class SerialPort:
    """An OBC on a serial line; `answered` returns whether the unit answers a request there."""

    def __init__(
        self,
        stack: SerialStack,
        deliver: Deliver,
        take: Take,
        dialect: Dialect | None,
        answered: Callable[[Request], bool],
    ) -> None:
        self._stack = stack
        self._answered = answered
        self._deliver, self._take = deliver, take
        self._expected: list[tuple[Request, int]] = []
        self._receiver = stack.host(dialect)

    def ask(self, request: Request, reply_size: int) -> None:
        """Send a request."""
        if self._answered(request):
            self._expected.append((request, reply_size))
            if len(self._expected) == 1:
                self._receiver.expect(request, reply_size)
        self._deliver(self._stack.encode_request(request))

    def cut(self, request: Request, share: float) -> None:
        """Send the first bytes of a request."""
        data = self._stack.encode_request(request)
        self._deliver(data[: max(1, int(share * len(data)))])

    def answers(self) -> list[Heard]:
        """Return what has arrived."""
        found: list[Heard] = []
        for at_s, chunk in self._take():
            # byte by byte, because each reply determines what is expected next
            for byte in chunk:
                for event in self._receiver.feed(bytes((byte,)), at_s):
                    found.append((at_s, event))
                    self._expect_next(event)
        return found

    def _expect_next(self, event: Reply | LinkFault) -> None:
        if not isinstance(event, Reply) or event.kind in UNASKED or not event.final:
            return
        if self._expected:
            self._expected.pop(0)
        if self._expected:
            self._receiver.expect(*self._expected[0])


class CanPort:
    """An OBC on a CAN bus with the CubeSpace layout of CAN IDs."""

    def __init__(self, deliver: Deliver, take: Take, device: int) -> None:
        self._deliver, self._take = deliver, take
        self.device = device
        self._receiver = CanHostReceiver(HOST, device)

    def ask(self, request: Request, reply_size: int) -> None:  # noqa: ARG002 (the same for all)
        """Send a request."""
        for frame in encode_request_frames(request, HOST, self.device):
            self._deliver(frame)

    def cut(self, request: Request, share: float) -> None:
        """Send the first frames of a request, none if it has only one."""
        frames = encode_request_frames(request, HOST, self.device)
        for frame in frames[: int(share * len(frames))]:
            self._deliver(frame)

    def answers(self) -> list[Heard]:
        """Return what has arrived."""
        return [(at_s, event) for at_s, frame in self._take() for event in self._receiver.feed(frame, at_s)]


class CanopenPort:
    """A CANopen master that executes each request by SDO transfers.

    Attributes
    ----------
    node
        Node ID of the unit.
    """

    def __init__(
        self, icd: InterfaceDefinition, dictionary: DeviceDictionary, deliver: Deliver, take: Take, node: int
    ) -> None:
        self._icd = icd
        self._dictionary = dictionary
        self._deliver, self._take = deliver, take
        self.node = node
        self._answers: list[Heard] = []
        self._others: list[tuple[float, CanFrame]] = []
        self._at_s = 0.0

    def ask(self, request: Request, reply_size: int) -> None:  # noqa: ARG002 (the same for all)
        """Run the transfers of a request to their end; the node answers each at once."""
        row = self._icd.rows_by_key[request.klass, request.id]
        transfer = row_transfer(self._dictionary, row, request.data)
        try:
            data = next(transfer)
            while (response := self._exchange(data)) is not None:
                data = transfer.send(response)
        except StopIteration as done:
            kind = ReplyKind.ACK if row.kind == "telecommand" else ReplyKind.TELEMETRY
            self._answers.append((self._at_s, Reply(kind, request.id, done.value, klass=request.klass)))
        except SdoAbortError as abort:
            code = self._icd.error_number(ERROR_OF_ABORT.get(abort.code, ErrorCode.INTERNAL))
            self._answers.append(
                (self._at_s, Reply(ReplyKind.NACK, request.id, code=code, klass=request.klass))
            )

    def cut(self, request: Request, share: float) -> None:
        """Send nothing: the next transfer of a client aborts an incomplete one."""

    def _exchange(self, data: bytes) -> bytes | None:
        self._deliver(CanFrame(SDO_RECEIVE + self.node, data, extended=False))
        responses = self._sort()
        return responses[0].ljust(8, b"\0") if responses else None

    def _sort(self) -> list[bytes]:
        """Return the data of the SDO responses that have arrived, and keep all other frames."""
        responses = []
        for at_s, frame in self._take():
            if not frame.extended and frame.id == SDO_TRANSMIT + self.node:
                self._at_s = at_s
                responses.append(frame.data)
            else:
                self._others.append((at_s, frame))
        return responses

    def answers(self) -> list[Heard]:
        """Return the answers to the requests since the last call."""
        found, self._answers = self._answers, []
        return found

    def messages(self) -> list[tuple[float, CanFrame]]:
        """Return what the node has sent apart from SDO since the last call: PDOs, EMCY, heartbeats."""
        self._sort()
        found, self._others = self._others, []
        return found

    def set_state(self, command: int) -> None:
        """Send an NMT command to the node."""
        self._deliver(CanFrame(0x000, bytes((command, self.node)), extended=False))
