"""The OBC of a life: sends requests on every link, and judges what comes back and what comes by itself.

Each request gets exactly the answers that the definition names; the oracle says whether it must be accepted. On a
link that a fault disturbs, and after a request with an unknown outcome, nothing is judged but the oracle forgets.
What comes without a request is heard at the end of each step, in the order of its times, and judged as of then.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from starhil.hil_tests.endurance.node import Node
from starhil.hil_tests.endurance.oracle import Oracle
from starhil.hil_tests.endurance.outcome import Outcome
from starhil.hil_tests.endurance.ports import UNASKED, CanopenPort, CanPort, Port, SerialPort
from starhil.hil_tests.endurance.unit import Unit
from starhil.hil_tests.endurance.violation import Violation, flag
from starhil.hil_tests.errors import BenchError
from starhil.protocol.can_framing import CanFrame, CanId
from starhil.protocol.canopen.device_dictionary import DeviceDictionary, build_dictionary
from starhil.protocol.codec import Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.errors import ProtocolError
from starhil.protocol.link_schema import FixedFraming
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.serial_stack import build_serial_stack, chosen_dialect, serial_answers
from starhil.protocol.values import IcdError

TIME_OUT_S: Final = 0.7
"""Silence after which a unit has dropped an incomplete message."""
TURN_S: Final = 1e-6
"""Simulation time in which what a telecommand does after its answer is done."""


class Obc:
    """The OBC's end of all links of a unit.

    Parameters
    ----------
    icd
        Definition of the unit.
    unit
        The unit.
    oracle
        What the unit may and must do.
    outcome
        Where requests and readings are counted.
    """

    def __init__(self, icd: InterfaceDefinition, unit: Unit, oracle: Oracle, outcome: Outcome) -> None:
        self._icd = icd
        self._unit = unit
        self._oracle = oracle
        self._outcome = outcome
        self._fixed_framing = icd.link.serial is not None and isinstance(
            icd.link.serial.framing, FixedFraming
        )
        self._stack = build_serial_stack(icd) if icd.link.serial is not None else None
        self._dictionary = build_dictionary(icd) if icd.canopen is not None else None
        self._node = None if self._dictionary is None else Node(icd, self._dictionary)
        self._ports: dict[str, Port] = {}

    def connect(self) -> None:
        """Make the end of each link, for the addresses and format in use."""
        unit, values = self._unit, self._oracle.values

        def number(name: str, default: int) -> int:
            known = values.get(name)
            return default if known is None else int(known[0])

        for link in unit.links:
            address = _ADDRESS[link]
            if address in self._icd.parameters and values[address] is None:
                self._oracle.disturbed.add(link)  # until the unit is restored

            def deliver(item: Any, link: str = link) -> None:
                unit.deliver(link, item)

            def take(link: str = link) -> list[tuple[float, Any]]:
                return unit.take(link)

            if self._stack is not None and link == "serial":
                self._ports[link] = SerialPort(self._stack, deliver, take, self._dialect(), self._answered)
            elif link == "can":
                self._ports[link] = CanPort(deliver, take, number("can_address", 4))
            else:
                node = number("canopen_node", 44)
                self._ports[link] = CanopenPort(self._icd, self._objects(), deliver, take, node)

    def _objects(self) -> DeviceDictionary:
        if self._dictionary is None:
            raise BenchError(f"unit {self._icd.name}: has no CANopen")
        return self._dictionary

    def _dialect(self) -> Dialect | None:
        only = chosen_dialect(self._icd, None)
        known = self._oracle.values.get("serial_dialect")
        if only is None or known is None or self._stack is None or len(self._stack.dialects) < 2:
            return only
        return Dialect(str(known[0]))

    async def pass_time(self, seconds: float, *, most: int | None = None) -> None:
        """Let time pass, and judge what comes meanwhile."""
        await self._unit.step(seconds, most=most)
        self.hear()
        self._oracle.time_passed(self._unit.now_s)

    async def settle(self, link: str) -> None:
        """Wait until the unit has dropped what is incomplete, and begin a link again."""
        await self._unit.step(TIME_OUT_S)
        self._unit.take(link)
        self.hear()
        self._oracle.time_passed(self._unit.now_s)
        self.connect()

    # --- what comes without a request ---

    def hear(self) -> None:
        """Judge what has come without a request, in the order of its times."""
        heard: list[tuple[float, str, Reply | LinkFault | CanFrame]] = []
        for link in self._unit.links:
            port = self._ports[link]
            heard += [(at_s, link, event) for at_s, event in port.answers()]
            if isinstance(port, CanopenPort):
                heard += [(at_s, link, frame) for at_s, frame in port.messages()]
        for at_s, link, event in sorted(heard, key=lambda item: item[0]):
            if at_s > self._oracle.now_s:
                self._end_instant()
            if link not in self._oracle.disturbed:
                self._oracle.time_passed(at_s)
                self._judge_unasked(link, event)
        self._end_instant()

    def _end_instant(self) -> None:
        if self._node is not None:
            self._node.judge_instant(self._oracle)

    def _judge_unasked(self, link: str, event: Reply | LinkFault | CanFrame) -> None:
        port = self._ports[link]
        if self._oracle.stuck:
            raise Violation(f"{link}: output of an unresponsive unit")
        if isinstance(event, CanFrame):
            if self._node is not None and isinstance(port, CanopenPort):
                self._outcome.readings += self._node.judge(event, port.node, self._oracle)
            return
        if isinstance(event, LinkFault):
            raise Violation(f"{link}: malformed output: {event.detail}")
        if event.kind is ReplyKind.BURST:
            if not self._oracle.bursts:
                raise Violation(f"{link}: a packet of a file that nobody requested")
            return
        row = self._icd.rows_by_key.get((event.klass, event.id or 0))
        if event.kind not in UNASKED:
            raise Violation(f"{link}: {_text(event)} without a request")
        if row is None or row.kind != "telemetry":
            raise Violation(f"{link}: unsolicited {_text(event)}")
        if event.kind is ReplyKind.UNSOLICITED and not self._oracle.streams:
            raise Violation(f"{link}: {row.name} without a subscription")
        self._outcome.readings += 1
        self._oracle.read(row, event.data)

    # --- requests ---

    async def request(self, link: str, key: Sequence[Any], data: bytes) -> None:
        """Send a request and judge the answers."""
        klass, row_id, kind = key
        row = self._icd.rows_by_key.get((klass, row_id))
        if row is not None and row.kind != kind:
            row = None
        if link == "canopen" and not self._in_dictionary(row, data):
            return
        verdict = self._oracle.verdict(row, kind, data)
        request = Request(RequestKind(kind), row_id, data, klass=klass)
        size = row.size if row is not None and row.kind == "telemetry" else 0
        try:
            self._ports[link].ask(request, size)
        except ProtocolError:
            return  # the header has no room for such an ID
        self._outcome.requests += 1
        if not self._oracle.stuck and (link != "canopen" or kind == "telecommand"):
            self._oracle.counted(kind)
        answers = self._answers(link)
        if self._oracle.stuck:
            if answers:
                raise Violation(f"an unresponsive unit answers {_text(answers[0])}")
            await self.settle(link)
        elif link in self._oracle.disturbed:
            await self._unknown_outcome(link, kind)
        else:
            await self._judge(link, row, request, verdict, answers)

    def _in_dictionary(self, row: Row | None, data: bytes) -> bool:
        """Return whether a request can be made by SDO."""
        if row is None or len(data) != (row.size if row.kind == "telecommand" else 0):
            return False
        try:
            entries = self._objects().entries_of(row)
        except IcdError:
            return False
        return row.kind == "telemetry" or len(entries) == 1

    async def _unknown_outcome(self, link: str, kind: str) -> None:
        """The answer may have been lost: nothing that the request may have changed is known.

        With messages of fixed length, a unit does not even recognise, and count, a request of another length.
        """
        if kind == "telecommand" or self._fixed_framing:
            self._oracle.forget()
        await self.settle(link)

    def _answers(self, link: str) -> list[Reply | LinkFault]:
        """Return the answers on a link; packets of files that follow them are judged apart."""
        found: list[Reply | LinkFault] = []
        for _, event in self._ports[link].answers():
            if isinstance(event, LinkFault) or event.kind not in UNASKED:
                found.append(event)
            elif link not in self._oracle.disturbed:
                self._judge_unasked(link, event)
        return found

    async def _judge(
        self,
        link: str,
        row: Row | None,
        request: Request,
        verdict: ErrorCode | None,
        answers: list[Reply | LinkFault],
    ) -> None:
        what = f"{link}: {row.name if row is not None else request.id}"
        replies = [answer for answer in answers if isinstance(answer, Reply)]
        if len(replies) != len(answers):
            raise Violation(f"{what}: malformed answer: {_text(answers[0])}")
        expected = self._expected_answers(link, row)
        sent = f"{what} {request.data.hex()}".rstrip()
        nack = next((reply for reply in replies if reply.kind is ReplyKind.NACK), None)
        silent = all(reply.kind is ReplyKind.ECHO for reply in replies)
        if nack is not None:
            self._judge_refusal(sent, link, nack, verdict)
            if sum(reply.kind is not ReplyKind.ECHO for reply in replies) != 1:
                raise Violation(f"{sent}: {len(replies)} answers to a refused request")
        elif silent:
            self._judge_silence(sent, verdict, expected, refusable=self._can_refuse(link, request.klass))
            if verdict is None and expected:
                await self._unknown_outcome(link, request.kind.value)
                return
            if verdict is not ErrorCode.OK:
                await self.settle(link)
                if self._fixed_framing:
                    self._oracle.forget()
        elif verdict not in (None, ErrorCode.OK):
            raise Violation(f"{sent}: accepted, must be refused")
        elif sum(reply.final for reply in replies) != 1:
            raise Violation(f"{sent}: {sum(reply.final for reply in replies)} answers")
        if request.kind is RequestKind.TELECOMMAND:
            refused = ErrorCode.INTERNAL if nack is not None else ErrorCode.OK
            unknown = nack is not None and verdict is None
            if link == "canopen" and verdict is ErrorCode.INVALID_PARAMETER:
                # the object dictionary refuses some values before the device has seen a telecommand
                self._oracle.counts["telecommands"] = None
                unknown = True
            await self._executed(row, request, verdict or refused, unknown=unknown)
        for reply in replies:
            if reply.kind is ReplyKind.TELEMETRY:
                self._read(what, row, request, reply)

    def _expected_answers(self, link: str, row: Row | None) -> Sequence[str]:
        if row is None:
            return ("reply",)
        return serial_answers(self._icd, row) if link == "serial" else row.answers

    def _answered(self, request: Request) -> bool:
        row = self._icd.rows_by_key.get((request.klass, request.id))
        return bool(self._expected_answers("serial", row))

    def _judge_refusal(self, sent: str, link: str, nack: Reply, verdict: ErrorCode | None) -> None:
        if verdict is ErrorCode.OK:
            raise Violation(f"{sent}: refused with {int(nack.code)}, must be accepted")
        if verdict is not None and not self._same_code(link, nack, verdict):
            wanted = int(self._icd.error_number(verdict))
            raise Violation(f"{sent}: refused with {int(nack.code)}, not {wanted}")

    def _judge_silence(
        self, sent: str, verdict: ErrorCode | None, expected: Sequence[str], *, refusable: bool
    ) -> None:
        if verdict is ErrorCode.OK and any(answer != "echo" for answer in expected):
            raise Violation(f"{sent}: no answer")
        refused = verdict not in (None, ErrorCode.OK)
        if refused and refusable and expected and not self._fixed_framing:
            raise Violation(f"{sent}: no answer, must be refused")

    async def _executed(self, row: Row | None, request: Request, code: ErrorCode, *, unknown: bool) -> None:
        oracle = self._oracle
        oracle.executed(row, request.id, request.data, code)
        if unknown:
            oracle.forget_last()
        if row is None or code is not ErrorCode.OK:
            return
        if row.action == "reset":
            start_s = self._unit.now_s
            await self._unit.step(TURN_S)
            for link in self._unit.links:
                self._unit.take(link)  # of the time before the restart, or of the boot
            oracle.restarted(start_s)
            oracle.time_passed(self._unit.now_s)
            self.connect()
        elif any(field.parameter in _ADDRESSES for field in row.fields) or row.action in _SETTERS:
            await self.pass_time(TURN_S)
            self.connect()

    def _read(self, what: str, row: Row | None, request: Request, reply: Reply) -> None:
        number = request.id if reply.id is None else reply.id
        other = self._icd.rows_by_key.get((reply.klass or request.klass, number)) or row
        if other is None or other.kind != "telemetry":
            raise Violation(f"{what}: {_text(reply)}")
        self._outcome.readings += 1
        self._oracle.read(other, reply.data)

    def _same_code(self, link: str, nack: Reply, verdict: ErrorCode) -> bool:
        composed = self._stack if link == "serial" else None
        if composed is not None and "status" not in composed.reply_header.roles:
            return True  # a refusal has no code
        if link == "canopen":
            return int(nack.code) != 0  # aborts have codes of their own
        return int(nack.code) == int(self._icd.error_number(verdict))

    def _can_refuse(self, link: str, klass: str) -> bool:
        if link != "serial" or self._stack is None:
            return True
        return bool(self._stack.reply_header.roles_in(klass) & {"status", "ack"})

    # --- many requests, parts of requests, and other input ---

    def burst(self, link: str, keys: Sequence[Sequence[Any]]) -> None:
        """Send telemetry requests without waiting; the answers come in order."""
        if link == "canopen" or self._oracle.stuck or link in self._oracle.disturbed:
            return
        rows = [self._icd.rows_by_key[klass, row_id] for klass, row_id, _ in keys]
        rows = [row for row in rows if self._oracle.verdict(row, "telemetry", b"") is ErrorCode.OK]
        for row in rows:
            self._outcome.requests += 1
            self._ports[link].ask(self._icd.request(row), row.size)
        answers = self._answers(link)
        replies = [item for item in answers if isinstance(item, Reply) and item.kind is ReplyKind.TELEMETRY]
        others = [item for item in answers if not isinstance(item, Reply) or item.kind is not ReplyKind.ECHO]
        if len(replies) != len(rows) or len(others) != len(replies):
            raise Violation(f"{link}: {len(replies)} answers to {len(rows)} requests")
        for _ in rows:
            self._oracle.counted("telemetry")
        for row, reply in zip(rows, replies, strict=True):
            if reply.id not in (None, row.id) or len(reply.data) != row.size:
                raise Violation(f"{link}: {_text(reply)} where {row.name} was next")

    async def flood(self, link: str, key: Sequence[Any], data: bytes, count: int) -> None:
        """Send the same request many times, each judged, so that counters of 16 bits wrap."""
        for _ in range(count):
            if self._oracle.stuck or link in self._oracle.disturbed:
                return
            await self.request(link, key, data)

    async def cut(self, link: str, key: Sequence[Any], share: float) -> None:
        """Send the first part of a request, as a client that goes away, and let another client come."""
        if link in self._oracle.disturbed:
            return
        row = self._icd.rows_by_key[key[0], key[1]]
        data = bytes(row.size) if row.kind == "telecommand" else b""
        self._ports[link].cut(Request(RequestKind(row.kind), row.id, data, klass=row.klass), share)
        if self._fixed_framing:  # any bytes are a request
            self._oracle.forget()
        await self.settle(link)

    async def junk(self, link: str, data: bytes, frames: Sequence[tuple[int, str]]) -> None:
        """Send input that is not a request for this unit; nothing may answer."""
        if link in self._oracle.disturbed:
            return
        if link == "serial":
            self._unit.deliver(link, data)
            self._oracle.forget()  # some framings find a request in any bytes
        for can_id, content in frames:
            if link == "canopen":  # an SDO of another node
                other = 0x580 + (can_id & 0xFF)
                if other != 0x600 + getattr(self._ports[link], "node", 0):
                    self._unit.deliver(link, CanFrame(other, bytes.fromhex(content), extended=False))
                continue
            known = CanId.unpack(can_id)
            if known.destination not in (0, getattr(self._ports[link], "device", 0)):
                self._unit.deliver(link, CanFrame(can_id, bytes.fromhex(content)))
        await self.settle(link)

    def set_state(self, link: str, command: int) -> None:
        """Send an NMT command to the node."""
        port = self._ports[link]
        if isinstance(port, CanopenPort):
            port.set_state(command)

    async def expect_valid(self, row: Row, field: str, recovery_s: float) -> None:
        """Read a row, whose attitude must be valid."""
        link = self._unit.links[0]
        self._ports[link].ask(self._icd.request(row), row.size)
        if link != "canopen":
            self._oracle.counted("telemetry")
        replies = [answer for answer in self._answers(link) if isinstance(answer, Reply) and answer.data]
        if not replies:
            raise Violation(f"{link}: {row.name}: no answer after all faults have ended")
        self._oracle.read(row, replies[-1].data)
        if not flag(row.decode(replies[-1].data)[field]):
            raise Violation(f"{row.name}: no valid attitude {recovery_s:g} s after the last fault has ended")


def _text(answer: Reply | LinkFault) -> str:
    if isinstance(answer, LinkFault):
        return answer.detail
    return f"{answer.kind.value} {answer.klass} {answer.id}, {len(answer.data)} bytes"


_ADDRESS: Final = {"serial": "serial_dialect", "can": "can_address", "canopen": "canopen_node"}
"""Parameter without which the unit cannot be reached on a link."""
_ADDRESSES: Final = frozenset({"can_address", "serial_dialect"})
_SETTERS: Final = frozenset({"set_parameter", "restore_parameters", "default_parameters"})
