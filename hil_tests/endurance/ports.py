"""The OBC's end of each link of a unit in memory: requests out, answers in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from starhil.protocol.can_framing import CanFrame, CanHostReceiver, encode_request_frames
from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.cob import SDO_RECEIVE, SDO_TRANSMIT
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import ERROR_OF_ABORT, row_transfer
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial_interface import Dialect, SerialStack

HOST: Final = 1
"""CAN address of the OBC."""

Deliver = Callable[[Any], None]
Take = Callable[[], Sequence[Any]]


class Port(Protocol):
    """An OBC on one link."""

    def ask(self, request: Request, reply_size: int, now_s: float) -> None:
        """Send a request."""
        ...

    def answers(self, now_s: float) -> list[Reply | LinkFault]:
        """Return what has arrived."""
        ...

    def reset(self) -> None:
        """Forget what is incomplete."""
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
        self.dialect = dialect
        self._expected: list[tuple[Request, int]] = []
        self.reset()

    def reset(self) -> None:
        """Forget what is incomplete."""
        self._receiver = self._stack.host(self.dialect)
        self._expected.clear()

    def ask(self, request: Request, reply_size: int, now_s: float) -> None:  # noqa: ARG002 (the same for all)
        """Send a request."""
        if self._answered(request):
            self._expected.append((request, reply_size))
            if len(self._expected) == 1:
                self._receiver.expect(request, reply_size)
        self._deliver(self._stack.encode_request(request))

    def answers(self, now_s: float) -> list[Reply | LinkFault]:
        """Return what has arrived."""
        found: list[Reply | LinkFault] = []
        for chunk in self._take():
            # byte by byte, because each reply determines what is expected next
            for byte in chunk:
                for event in self._receiver.feed(bytes((byte,)), now_s):
                    found.append(event)
                    self._expect_next(event)
        return found

    def _expect_next(self, event: Reply | LinkFault) -> None:
        if not isinstance(event, Reply) or event.kind in _UNASKED or not event.final:
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
        self.reset()

    def reset(self) -> None:
        """Forget what is incomplete."""
        self._receiver = CanHostReceiver(HOST, self.device)

    def ask(self, request: Request, reply_size: int, now_s: float) -> None:  # noqa: ARG002 (the same for all)
        """Send a request."""
        for frame in encode_request_frames(request, HOST, self.device):
            self._deliver(frame)

    def answers(self, now_s: float) -> list[Reply | LinkFault]:
        """Return what has arrived."""
        return [event for frame in self._take() for event in self._receiver.feed(frame, now_s)]


class CanopenPort:
    """A CANopen master that executes each request by SDO transfers."""

    def __init__(
        self, icd: InterfaceDefinition, dictionary: DeviceDictionary, deliver: Deliver, take: Take, node: int
    ) -> None:
        self._icd = icd
        self._dictionary = dictionary
        self._deliver, self._take = deliver, take
        self.node = node
        self._answers: list[Reply | LinkFault] = []

    def reset(self) -> None:
        """Forget what is incomplete."""
        self._answers.clear()

    def ask(self, request: Request, reply_size: int, now_s: float) -> None:  # noqa: ARG002 (the same for all)
        """Run the transfers of a request to their end; the node answers each at once."""
        row = self._icd.rows_by_key[request.klass, request.id]
        transfer = row_transfer(self._dictionary, row, request.data)
        self._take()
        try:
            data = next(transfer)
            while (response := self._exchange(data)) is not None:
                data = transfer.send(response)
        except StopIteration as done:
            kind = ReplyKind.ACK if row.kind == "telecommand" else ReplyKind.TELEMETRY
            self._answers.append(Reply(kind, request.id, done.value, klass=request.klass))
        except SdoAbortError as abort:
            code = self._icd.error_number(ERROR_OF_ABORT.get(abort.code, ErrorCode.INTERNAL))
            self._answers.append(Reply(ReplyKind.NACK, request.id, code=code, klass=request.klass))

    def _exchange(self, data: bytes) -> bytes | None:
        self._deliver(CanFrame(SDO_RECEIVE + self.node, data, extended=False))
        responses = [
            frame for frame in self._take() if not frame.extended and frame.id == SDO_TRANSMIT + self.node
        ]
        return responses[0].data.ljust(8, b"\0") if responses else None

    def answers(self, now_s: float) -> list[Reply | LinkFault]:  # noqa: ARG002 (the same for all)
        """Return the answers to the requests since the last call."""
        found, self._answers = self._answers, []
        return found


_UNASKED: Final = frozenset({ReplyKind.UNSOLICITED, ReplyKind.EVENT, ReplyKind.BURST})
