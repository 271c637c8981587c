"""The OBC's end of each link of a unit in memory: requests out, answers in, each with the time at which it was sent.

Requests are encoded and answers decoded by the judge, not by the product's codecs, so that errors of a codec are found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from starhil.hil_tests.judge import can, canopen
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Answer, Request
from starhil.hil_tests.judge.serial import SerialLine
from starhil.protocol.can.frame import CanFrame

HOST: Final = 1
"""CAN address of the OBC."""
TimedAnswer = tuple[float, Answer]
Deliver = Callable[[Any], None]
Take = Callable[[], Sequence[tuple[float, Any]]]


class SerialPort:
    """An OBC on a serial line; `dialect` is that of the answers, of a unit that has several."""

    def __init__(self, unit: Unit, deliver: Deliver, take: Take, dialect: str | None) -> None:
        self._deliver, self._take = deliver, take
        self.line = SerialLine(unit, dialect)
        # any row may be subscribed to, and the oracle judges whether it was
        self.line.streamed = {(row.message_class, row.id) for row in unit.telemetry.values()}

    def ask(self, *requests: Request) -> None:
        """Send requests in one piece."""
        self._deliver(b"".join(self.line.post(request) for request in requests))

    def cut(self, request: Request, share: float) -> None:
        """Send the first bytes of a request."""
        data = self.line.encode(request)
        self._deliver(data[: max(1, int(share * len(data)))])

    def answers(self) -> list[TimedAnswer]:
        """Return what has arrived."""
        return [(at_s, answer) for at_s, chunk in self._take() for answer in self.line.feed(chunk)]


class CanPort:
    """An OBC on a CAN bus with the CubeSpace layout of CAN IDs."""

    def __init__(self, deliver: Deliver, take: Take, device: int) -> None:
        self._deliver, self._take = deliver, take
        self.device = device

    def _frames(self, request: Request) -> list[CanFrame]:
        return [CanFrame(can_id, data) for can_id, data in can.frames_of(request, HOST, self.device)]

    def ask(self, *requests: Request) -> None:
        """Send requests without a pause."""
        for request in requests:
            for frame in self._frames(request):
                self._deliver(frame)

    def cut(self, request: Request, share: float) -> None:
        """Send the first frames of a request, none if it has only one."""
        frames = self._frames(request)
        for frame in frames[: int(share * len(frames))]:
            self._deliver(frame)

    def send_to_others(self, can_id: int, data: bytes) -> None:
        """Send a frame, unless it is for the unit or for all units."""
        if can_id & 0xFF not in (0, self.device):
            self._deliver(CanFrame(can_id, data))

    def answers(self) -> list[TimedAnswer]:
        """Return what has arrived; a frame of another source, or an answer to another OBC, is malformed."""

        def is_unasked(frame: CanFrame) -> bool:
            return frame.id >> 24 in can.UNSOLICITED and frame.id >> 8 & 0xFF == self.device

        taken = list(self._take())
        solicited = iter([item for item in taken if not is_unasked(item[1])])
        timed_answers = []
        for at_s, frame in solicited:
            if frame.id & 0xFFFF == self.device << 8 | HOST:
                answer = can.read_answer(frame, lambda: next(solicited, (0.0, None))[1])
            else:
                answer = Answer("malformed", data=frame.id.to_bytes(4, "big") + frame.data)
            timed_answers.append((at_s, answer))
        for instant in dict.fromkeys(at_s for at_s, _ in taken):
            frames = [frame for at_s, frame in taken if at_s == instant and is_unasked(frame)]
            timed_answers += [(instant, answer) for answer in can.unsolicited(frames)]
        return timed_answers


Objects = dict[tuple[str, str], list[canopen.Entry]]
"""The entries through which each row is read or executed, by kind and name of the row."""


class CanopenPort:
    """A CANopen master that executes each request by SDO transfers; `node` is the node ID of the unit."""

    def __init__(self, unit: Unit, objects: Objects, deliver: Deliver, take: Take, node: int) -> None:
        self._unit, self._objects = unit, objects
        self._deliver, self._take = deliver, take
        self.node = node
        self._answers: list[TimedAnswer] = []
        self._others: list[tuple[float, CanFrame]] = []
        self._at_s = 0.0

    def ask(self, *requests: Request) -> None:
        """Run the transfers of requests to their end; the node answers each at once."""
        for request in requests:
            row = self._unit.row(request)
            if row is None:
                raise ValueError(f"{request}: no such row")
            try:
                entries = self._objects[row.kind, row.name]
                if row.is_telemetry:
                    answer = Answer("telemetry", data=canopen.row_data(row, entries, self._read))
                else:
                    data = canopen.written(entries[0], row, request.data)
                    canopen.download(self._exchange, entries[0].index, entries[0].subindex, data)
                    answer = Answer("ack")
            except canopen.AbortedError as abort:
                answer = Answer("nack", abort.code)
            except canopen.BadResponseError as error:
                if error.seen is None:
                    continue
                answer = Answer("malformed", data=error.seen)
            self._answers.append((self._at_s, answer))

    def cut(self, request: Request, share: float) -> None:
        """Send nothing: the next transfer of a client aborts an incomplete one."""

    def send_to_others(self, can_id: int, data: bytes) -> None:
        """Send an SDO request or response of another node, one of 256 by the CAN ID given."""
        sdo = canopen.SDO_RESPONSE + (can_id & 0xFF)
        if sdo != canopen.SDO_REQUEST + self.node:
            self._deliver(CanFrame(sdo, data, extended=False))

    def _read(self, entry: canopen.Entry) -> bytes:
        data = canopen.upload(self._exchange, entry.index, entry.subindex)
        if entry.size and len(data) != entry.size:
            raise canopen.BadResponseError(f"{entry.size} bytes of {entry.name}h", data)
        return data

    def _exchange(self, request: bytes) -> bytes | None:
        """Send a request; return the response, several as one that is too long, None for none."""
        data = request.ljust(canopen.SDO_SIZE, b"\0")
        self._deliver(CanFrame(canopen.SDO_REQUEST + self.node, data, extended=False))
        responses = self._sort()
        return b"".join(responses) if responses else None

    def _sort(self) -> list[bytes]:
        """Return the data of the SDO responses that have arrived, and keep all other frames."""
        responses = []
        for at_s, frame in self._take():
            if not frame.extended and frame.id == canopen.SDO_RESPONSE + self.node:
                self._at_s = at_s
                responses.append(frame.data)
            else:
                self._others.append((at_s, frame))
        return responses

    def answers(self) -> list[TimedAnswer]:
        """Return the answers to the requests since the last call."""
        timed_answers, self._answers = self._answers, []
        return timed_answers

    def messages(self) -> list[tuple[float, CanFrame]]:
        """Return what the node has sent apart from SDO since the last call: PDOs, EMCY, heartbeats."""
        self._sort()
        messages, self._others = self._others, []
        return messages

    def set_state(self, command: int) -> None:
        """Send an NMT command to the node."""
        self._deliver(CanFrame(canopen.NMT, bytes((command, self.node)), extended=False))


Port = SerialPort | CanPort | CanopenPort


def objects_of(unit: Unit) -> Objects:
    """Return the entries of the rows that SDO reaches: one for a whole row, or one for each place of telemetry."""
    layout = unit.canopen
    records = [placed.index for placed in layout.object if placed.requests]
    if records:
        return {(row.kind, row.name): [canopen.whole_row(records[0], row.id, row)] for row in unit.rows}
    every = list(canopen.entries(unit, layout))
    objects: Objects = {}
    for row in unit.rows:
        held = {slot.offset: item for item, slot in reversed(canopen.slots(row, every))}
        setters = [item for item in every if item.command is row]
        if row.is_telemetry and held.keys() >= {place.offset for place in canopen.places(row)} and held:
            objects[row.kind, row.name] = list(held.values())
        elif setters and (setters[0].part is None or len(canopen.places(row)) == 1):
            objects[row.kind, row.name] = setters[:1]
    return objects
