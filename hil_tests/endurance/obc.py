"""The OBC of a life: sends requests on every link, and judges replies and unsolicited messages.

Each request must get exactly the answers that the definition names; the oracle decides whether it must be accepted. On a
link disturbed by a fault, and after a request with an unknown outcome, nothing is judged, and the oracle no longer relies
on what may have changed. Unsolicited messages are read at the end of each step, in order of time, and judged as of then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Final

from starhil.hil_tests.endurance.life import ADDRESSES, Outcome
from starhil.hil_tests.endurance.node import Node
from starhil.hil_tests.endurance.oracle import Oracle
from starhil.hil_tests.endurance.ports import CanopenPort, CanPort, Port, SerialPort, objects_of
from starhil.hil_tests.endurance.streams import Streams
from starhil.hil_tests.endurance.unit import LiveUnit
from starhil.hil_tests.endurance.violation import Violation
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.links import LINKS
from starhil.hil_tests.judge.messages import Answer, Request, Value
from starhil.hil_tests.judge.rows import Row
from starhil.protocol.can.frame import CanFrame

TIME_OUT_S: Final = 0.7
"""Silence after which a unit has dropped an incomplete message."""
TURN_S: Final = 1e-6
"""Simulation time in which what a telecommand does after its answer is done."""


class Obc:
    """The OBC's end of all links of a unit; requests and readings are counted in `outcome`."""

    def __init__(self, definition: Unit, unit: LiveUnit, oracle: Oracle, outcome: Outcome) -> None:
        self._definition = definition
        self._unit = unit
        self._oracle = oracle
        self._outcome = outcome
        serial = definition.serial
        self._fixed_framing = serial is not None and serial.framing.kind == "fixed"
        self._objects = {} if definition.canopen is None else objects_of(definition)
        self._node = None if definition.canopen is None else Node(definition)
        self._ports: dict[str, Port] = {}
        self._streams = Streams(definition)
        self._unasked: list[tuple[float, str, Answer]] = []
        """What came with the answers to requests, to be judged once these have been: it follows from them."""
        self._sent_by: dict[tuple[float, str, bytes], str] = {}
        """First link on which a row was sent without a request, with these data, at this instant."""

    def connect(self) -> None:
        """Make the end of each link, for the address or format in use."""
        for link in self._unit.links:
            name = LINKS[link].address
            in_use = self._oracle.in_use(name)
            if in_use is None:
                parameter = self._definition.device_parameters[name]
                in_use = parameter.default
                if parameter.id:
                    self._oracle.disturbed.add(link)  # until the unit is restored
            self._ports[link] = self._port(link, in_use)
            self._streams.begin(link, self._unit.now_s)

    def _port(self, link: str, address: Value) -> Port:
        deliver, take = partial(self._unit.deliver, link), partial(self._unit.take, link)
        if LINKS[link].bus == "serial":
            return SerialPort(self._definition, deliver, take, str(address))
        if link == "canopen":
            return CanopenPort(self._definition, self._objects, deliver, take, int(address))
        return CanPort(deliver, take, int(address))

    async def pass_time(self, seconds: float, *, most: int | None = None) -> None:
        """Let time pass, and judge the messages that arrive in it."""
        await self._unit.step(seconds, most=most)
        self.hear()
        self._oracle.time_passed(self._unit.now_s)

    async def settle(self, link: str) -> None:
        """Wait until the unit has dropped what is incomplete, and begin a link again."""
        await self._unit.step(TIME_OUT_S)
        self._unit.take(link)
        self._streams.begin(link, self._unit.now_s)
        self.hear()
        self._oracle.time_passed(self._unit.now_s)
        self.connect()

    # --- what comes without a request ---

    def hear(self) -> None:
        """Judge the messages that no request has caused, in order of time."""
        messages: list[tuple[float, str, Answer | CanFrame]] = [*self._unasked]
        self._unasked.clear()
        for link in self._unit.links:
            port = self._ports[link]
            messages += [(at_s, link, event) for at_s, event in port.answers()]
            if isinstance(port, CanopenPort):
                messages += [(at_s, link, frame) for at_s, frame in port.messages()]
        for at_s, link, event in sorted(messages, key=lambda item: item[0]):
            if at_s > self._oracle.now_s:
                self._end_instant()
                self._sent_by.clear()
            if link not in self._oracle.disturbed:
                self._oracle.time_passed(at_s)
                self._judge_unasked(link, event)
        self._end_instant()
        for link in self._unit.links:
            if self._oracle.stuck or link in self._oracle.disturbed:
                self._streams.begin(link, self._unit.now_s)
            elif self._has_unsolicited(link):
                self._streams.passed(link, self._unit.now_s)

    def _has_unsolicited(self, link: str) -> bool:
        port = self._ports[link]
        return (
            port.line.envelope.has_unsolicited if isinstance(port, SerialPort) else isinstance(port, CanPort)
        )

    def _end_instant(self) -> None:
        if self._node is not None:
            self._node.judge_instant(self._oracle)

    def _judge_unasked(self, link: str, event: Answer | CanFrame) -> None:
        port = self._ports[link]
        if self._oracle.stuck:
            raise Violation(f"{link}: output of an unresponsive unit")
        if isinstance(event, CanFrame):
            if self._node is not None and isinstance(port, CanopenPort):
                self._outcome.readings += self._node.judge(event, port.node, self._oracle)
            return
        if event.kind == "burst":
            if not self._oracle.bursts:
                raise Violation(f"{link}: a packet of a file that nobody requested")
            return
        row = self._definition.by_key.get((event.message_class, event.row_id or 0))
        if event.kind != "unsolicited":
            raise Violation(f"{link}: {event} without a request")
        if row is None or row.kind != "telemetry":
            raise Violation(f"{link}: unsolicited {event}")
        host = self._oracle.in_use("host_address")
        if link == "can" and host not in (None, event.other):
            raise Violation(f"{link}: {event} to address {event.other}, not {host!r}")
        subscribed = self._oracle.is_subscribed(row)
        if not subscribed and not self._oracle.may_send(row):
            raise Violation(f"{link}: {row.name} without a subscription or an event")
        self._streams.received(link, row, self._oracle.now_s, subscribed=subscribed)
        sent = (self._oracle.now_s, row.name, event.data)
        if self._sent_by.setdefault(sent, link) == link:  # not read on another link already
            self._outcome.readings += 1
            self._oracle.read_unasked(row, event.data)

    # --- requests ---

    async def request(self, link: str, row: Sequence[Any], data: str = "") -> None:
        """Send a request, data in hexadecimal, and judge the answers."""
        message_class, row_id, kind = row
        request = Request(row_id, bytes.fromhex(data), message_class, telemetry=kind == "telemetry")
        defined_row = self._definition.by_key.get((message_class, row_id))
        if defined_row is not None and defined_row.kind != kind:
            defined_row = None
        if link == "canopen" and not self._in_dictionary(defined_row, request):
            return
        verdict = self._oracle.verdict(defined_row, request)
        try:
            self._ports[link].ask(request)
        except (ValueError, OverflowError):
            return  # the header has no room for such an ID
        self._outcome.requests += 1
        counts = link != "canopen" or not (
            request.telemetry or defined_row is None or self._oracle.is_outside(defined_row, request.data)
        )
        if counts and not self._oracle.stuck:
            self._oracle.counted(request)
        answers = self._answers(link)
        if self._oracle.stuck:
            if answers:
                raise Violation(f"an unresponsive unit answers {answers[0]}")
            await self.settle(link)
        elif link in self._oracle.disturbed:
            await self._unknown_outcome(link, request)
        else:
            await self._judge(link, defined_row, request, verdict, answers, counts=counts)

    def _in_dictionary(self, row: Row | None, request: Request) -> bool:
        """Return whether a request can be made by SDO."""
        if row is None or len(request.data) != (0 if row.is_telemetry else row.size):
            return False
        return (row.kind, row.name) in self._objects

    async def _unknown_outcome(self, link: str, request: Request) -> None:
        """The answer may have been lost: nothing that the request may have changed is known.

        With messages of fixed length, a unit does not even recognise, and count, a request of another length.
        """
        if not request.telemetry or self._fixed_framing:
            self._oracle.forget()
        await self.settle(link)

    def _answers(self, link: str) -> list[Answer]:
        """Return the answers on a link; what else has come is put aside."""
        answers: list[Answer] = []
        for at_s, event in self._ports[link].answers():
            if event.kind not in ("unsolicited", "burst"):
                answers.append(event)
            else:
                self._unasked.append((at_s, link, event))
        return answers

    async def _judge(
        self,
        link: str,
        row: Row | None,
        request: Request,
        verdict: str | None,
        replies: list[Answer],
        *,
        counts: bool,
    ) -> None:
        what = f"{link}: {row.name if row is not None else request.id}"
        for fault in self._faults(link, row, request, verdict, replies):
            raise Violation(f"{f'{what} {request.data.hex()}'.rstrip()}: {fault}")
        expected = self._expected_answers(link, row)
        refused = any(reply.kind == "nack" for reply in replies)
        silent = not refused and (not replies or expected == ("echo",))
        if silent and verdict is None and expected:
            await self._unknown_outcome(link, request)
            return
        if counts and not request.telemetry:
            sure = verdict is not None or not (refused or silent)
            await self._executed(row, request, verdict or ("internal" if refused else "ok"), sure=sure)
        if silent and verdict != "ok":
            await self.settle(link)
            if self._fixed_framing:
                self._oracle.forget()
        for reply in replies:
            if reply.kind == "telemetry" and verdict in (None, "ok"):
                self._read(what, row, request, reply)

    def _faults(
        self, link: str, row: Row | None, request: Request, verdict: str | None, replies: list[Answer]
    ) -> Iterator[str]:
        """Yield what is wrong with the answers to a request."""
        port, expected = self._ports[link], self._expected_answers(link, row)
        line = port.line if isinstance(port, SerialPort) else None
        yield from (str(reply) for reply in replies if reply.kind == "malformed")
        nack = next((reply for reply in replies if reply.kind == "nack"), None)
        if nack is not None:
            if verdict == "ok":
                yield f"refused with {nack.code}, must be accepted"
            elif verdict is not None and not self._is_code(nack.code, verdict, port):
                yield f"refused with {nack.code}, not {self._definition.code(verdict)}"
            if len(replies) != 1:
                yield f"{len(replies)} answers to a refused request"
        elif not replies:
            if expected and verdict == "ok":
                yield "no answer"
            refusable = (
                line is None or line.envelope.can_refuse(request.message_class)
            ) and not self._fixed_framing
            if expected and verdict is not None and refusable:
                yield "no answer, must be refused"
        elif expected != ("echo",) and verdict not in (None, "ok"):
            # in dialects a and b, data and the code of a refusal may both be one byte
            if line is None or line.dialect not in ("a", "b") or row is None or row.size != 1:
                yield "accepted, must be refused"
        elif expected != ("echo",):
            ends, wanted = sum(reply.final for reply in replies), _final_answers(port, expected)
            if ends != wanted:
                yield f"{ends} answers, not {wanted}"

    def _expected_answers(self, link: str, row: Row | None) -> Sequence[str]:
        if row is None:
            return ("reply",)
        return tuple(self._definition.serial_answers(row) if LINKS[link].bus == "serial" else row.answers)

    def _is_code(self, code: int, error: str, port: Port) -> bool:
        """Return whether a refusal has the code of an error; aborts have codes of their own, some lines have none."""
        if isinstance(port, SerialPort) and not port.line.envelope.has_codes:
            return True
        return code != 0 if isinstance(port, CanopenPort) else code == self._definition.code(error)

    async def _executed(self, row: Row | None, request: Request, code: str, *, sure: bool) -> None:
        oracle = self._oracle
        oracle.executed(row, request, code, sure=sure)
        if row is None or code != "ok":
            return
        if row.action == "reset":
            start_s = self._unit.now_s
            await self._unit.step(TURN_S)
            for link in self._unit.links:
                self._unit.take(link)  # of the time before the restart, or of the boot
            self._unasked.clear()
            oracle.restarted(start_s)
            oracle.time_passed(self._unit.now_s)
            self.connect()
        elif any(field.parameter in ADDRESSES for field in row.named.values()) or row.action in _SETTERS:
            self.connect()  # what follows the answer comes in the new format, from the new address
            await self.pass_time(TURN_S)

    def _read(self, what: str, row: Row | None, request: Request, reply: Answer) -> None:
        number = request.id if reply.row_id is None else reply.row_id
        other = self._definition.by_key.get((reply.message_class or request.message_class, number)) or row
        named = set() if row is None else {item.partition(":")[2] or row.name for item in row.answers}
        if other is None or other.kind != "telemetry" or other.name not in named:
            raise Violation(f"{what}: {reply}")
        self._outcome.readings += 1
        self._oracle.read(other, reply.data)

    # --- many requests, parts of requests, and other input ---

    async def burst(self, link: str, rows: Sequence[Sequence[Any]]) -> None:
        """Send telemetry requests without waiting; the answers come in order."""
        if link == "canopen" or self._oracle.stuck or link in self._oracle.disturbed:
            return
        by_key = self._definition.by_key
        known = [by_key[key] for each in rows if (key := (each[0], each[1])) in by_key]  # of another unit
        answerable = [
            row for row in known if self._oracle.verdict(row, self._definition.request(row)) == "ok"
        ]
        self._outcome.requests += len(answerable)
        self._ports[link].ask(*(self._definition.request(row) for row in answerable))
        replies = self._answers(link)
        if len(replies) != len(answerable) or any(reply.kind != "telemetry" for reply in replies):
            raise Violation(f"{link}: {len(replies)} answers to {len(answerable)} requests")
        for row, reply in zip(answerable, replies, strict=True):
            self._oracle.counted(self._definition.request(row))
            if reply.row_id not in (None, row.id) or len(reply.data) != row.size:
                raise Violation(f"{link}: {reply} where {row.name} was next")
            self._oracle.read(row, reply.data)

    async def flood(self, link: str, row: Sequence[Any], count: int, data: str = "") -> None:
        """Send the same request many times, each judged, so that counters of 16 bits wrap."""
        for _ in range(count):
            if self._oracle.stuck or link in self._oracle.disturbed:
                return
            await self.request(link, row, data)
            self.hear()

    async def cut(self, link: str, row: Sequence[Any], share: float) -> None:
        """Send the first part of a request, as a client that disconnects does; on a bus it must not be answered."""
        row_definition = self._definition.by_key.get((row[0], row[1]))
        if link in self._oracle.disturbed or row_definition is None:
            return
        content = b"" if row_definition.is_telemetry else bytes(row_definition.size)
        self._ports[link].cut(self._definition.request(row_definition, content), share)
        if LINKS[link].bus != "serial":
            await self.pass_time(TIME_OUT_S)
            return
        if self._fixed_framing:  # any bytes are a request
            self._oracle.forget()
        await self.settle(link)

    async def junk(self, link: str, data: str = "", frames: Sequence[tuple[int, str]] = ()) -> None:
        """Send input that is not a request for this unit; nothing may answer frames on a bus."""
        if link in self._oracle.disturbed:
            return
        port = self._ports[link]
        if isinstance(port, (CanPort, CanopenPort)):
            for can_id, content in frames:
                port.send_to_others(can_id, bytes.fromhex(content))
            await self.pass_time(TIME_OUT_S)
        else:
            self._unit.deliver(link, bytes.fromhex(data))
            self._oracle.forget()  # some framings find a request in any bytes
            await self.settle(link)

    async def set_state(self, link: str, command: int) -> None:
        """Send an NMT command to the node."""
        port = self._ports[link]
        if isinstance(port, CanopenPort):
            port.set_state(command)

    async def expect_valid(self, row: Row, field: str, recovery_s: float) -> None:
        """Read a row, whose attitude must be valid."""
        link = self._unit.links[0]
        request = self._definition.request(row)
        self._ports[link].ask(request)
        if link != "canopen":
            self._oracle.counted(request)
        replies = [answer for answer in self._answers(link) if answer.kind == "telemetry"]
        if not replies:
            raise Violation(f"{link}: {row.name}: no answer after all faults have ended")
        self._oracle.read(row, replies[-1].data)
        if not self._definition.telemetry[row.name].decode(replies[-1].data)[field]:
            raise Violation(f"{row.name}: no valid attitude {recovery_s:g} s after the last fault has ended")


def _final_answers(port: Port, expected: Sequence[str]) -> int:
    """Return how many answers to an accepted request are final: each, or the last where an answer says whether it is."""
    if isinstance(port, CanopenPort) or (isinstance(port, SerialPort) and port.line.envelope.has_final):
        return 1
    return sum(answer != "echo" for answer in expected)


_SETTERS: Final = frozenset({"set_parameter", "restore_parameters", "default_parameters"})
