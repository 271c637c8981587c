"""Runs a life on a unit and lets the oracle judge it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

from starhil.hil_tests.endurance.life import MOST_EVENTS, Life, Step
from starhil.hil_tests.endurance.oracle import RECOVERY_S, Oracle
from starhil.hil_tests.endurance.ports import CanopenPort, CanPort, Port, SerialPort
from starhil.hil_tests.endurance.truth import Motion
from starhil.hil_tests.endurance.violation import Violation, flag
from starhil.hil_tests.errors import BenchError
from starhil.protocol.can_framing import CanFrame, CanId
from starhil.protocol.canopen.device_dictionary import DeviceDictionary, build_dictionary
from starhil.protocol.codec import Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.link_schema import FixedFraming
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.serial_stack import build_serial_stack, chosen_dialect, serial_answers
from starhil.protocol.values import IcdError

TIME_OUT_S: Final = 0.7
"""Silence after which a unit has dropped an incomplete message."""
TURN_S: Final = 1e-6
"""Simulation time in which what a telecommand does after its answer is done."""
QUEUE_LIMIT: Final = 5000
ORION: Final = {"kind": "fixed", "attitude": {"ra_deg": 83.8, "dec_deg": -1.2, "roll_deg": 0.0}}


class Unit(Protocol):
    """A unit with its power and surroundings, in simulated time."""

    links: tuple[str, ...]
    """Names of the open links."""

    @property
    def now_s(self) -> float:
        """Simulation time since power was switched on, seconds."""
        ...

    async def power_on(self) -> None:
        """Switch the unit on."""
        ...

    async def power_off(self, *, factory: bool = False) -> None:
        """Switch the unit off; `factory` deletes its stored state."""
        ...

    async def step(self, seconds: float, *, most: int | None = None) -> None:
        """Let time pass, or less, after about `most` events."""
        ...

    def deliver(self, link: str, item: bytes | CanFrame) -> None:
        """Pass bytes or a frame to the unit."""
        ...

    def take(self, link: str) -> list[Any]:
        """Return what the unit has sent."""
        ...

    async def set_truth(self, truth: Mapping[str, Any]) -> None:
        """Replace the truth."""
        ...

    def fault(self, fault: Mapping[str, Any]) -> None:
        """Inject faults."""
        ...

    def clear_faults(self) -> None:
        """End all faults."""
        ...

    def end_pipeline(self) -> bool:
        """End the image pipeline unexpectedly; return whether this is possible."""
        ...

    def set_disk(self, *, full: bool) -> None:
        """Set whether files can be written."""
        ...

    def set_peer(self, link: str, *, reads: bool) -> None:
        """Set whether the peer of a link reads."""
        ...

    def internal_errors(self) -> list[str]:
        """Return the internal errors since the last call."""
        ...

    def open_descriptors(self) -> int:
        """Return the number of open file descriptors."""
        ...

    def queued_events(self) -> int:
        """Return the number of queued events."""
        ...


@dataclass
class Outcome:
    """What a life has shown.

    Attributes
    ----------
    violation
        What the unit did and must never do; empty if nothing.
    step
        Number of the last step.
    device_s
        Simulation time lived, seconds.
    requests, readings, attitudes
        Requests sent, rows read, and valid attitudes compared with the truth.
    """

    violation: str = ""
    step: int = -1
    device_s: float = 0.0
    requests: int = 0
    readings: int = 0
    attitudes: int = 0


class LifeRun:
    """Executes the steps of a life.

    Parameters
    ----------
    life
        The life.
    icd
        Definition of the unit.
    unit
        The unit.
    sigma_arcsec
        Largest standard deviations that the unit may leave unstated.
    """

    def __init__(
        self, life: Life, icd: InterfaceDefinition, unit: Unit, sigma_arcsec: tuple[float, float]
    ) -> None:
        self._life = life
        self._icd = icd
        self._unit = unit
        parameters = dict(life.profile.get("parameters", {}))
        start_unix_s = life.profile.get("run", {}).get("start_unix_s", 1_767_225_600.0)
        self._oracle = Oracle(icd, parameters, start_unix_s, sigma_arcsec)
        self._fixed_framing = icd.link.serial is not None and isinstance(
            icd.link.serial.framing, FixedFraming
        )
        self._stack = build_serial_stack(icd) if icd.link.serial is not None else None
        self._dictionary = build_dictionary(icd) if icd.canopen is not None else None
        self._ports: dict[str, Port] = {}
        self._not_read: set[str] = set()
        """Links whose peer does not read."""
        self._lived_s = 0.0
        self._descriptors = 0
        self.outcome = Outcome()
        self._actions: dict[str, Callable[[Step], Any]] = {
            "wait": self._wait,
            "request": self._request,
            "burst": self._burst,
            "junk": self._junk,
            "truth": self._truth,
            "fault": self._fault,
            "clear": self._clear,
            "power": self._power,
            "end_pipeline": self._end_pipeline,
            "disk": self._disk,
            "peer": self._peer,
            "recover": self._recover,
        }

    async def run(self) -> Outcome:
        """Execute all steps, or those up to the first violation."""
        try:
            await self._unit.power_on()
            self._powered(factory=True)
            self._descriptors = self._unit.open_descriptors()
            for step in self._life.steps:
                self.outcome.step += 1
                await self._actions[step["do"]](step)
                self._check_inside()
        except Violation as violation:
            self.outcome.violation = str(violation)
        finally:
            self.outcome.attitudes = self._oracle.attitudes.count
            self.outcome.device_s = self._lived_s + self._unit.now_s
            self._unit.set_disk(full=False)
            await self._unit.power_off()
        return self.outcome

    def _check_inside(self) -> None:
        errors = self._unit.internal_errors()
        if errors:
            raise Violation(f"internal error: {errors[0]}")
        if self._unit.queued_events() > QUEUE_LIMIT:
            raise Violation(f"{self._unit.queued_events()} events are queued")
        if self._unit.open_descriptors() > self._descriptors + 4:
            raise Violation(
                f"{self._unit.open_descriptors()} descriptors are open, {self._descriptors} at the start"
            )

    # --- time and power ---

    async def _pass_time(self, seconds: float) -> None:
        await self._unit.step(seconds)
        self._oracle.time_passed(self._unit.now_s)

    async def _wait(self, step: Step) -> None:
        await self._unit.step(step["s"], most=MOST_EVENTS)
        self._oracle.time_passed(self._unit.now_s)
        for name in self._unit.links:
            self._discard(name)

    def _discard(self, link: str) -> None:
        """Judge what came without a request."""
        for event in self._ports[link].answers(self._unit.now_s):
            self._unasked(link, event)

    async def _power(self, step: Step) -> None:
        self._lived_s += self._unit.now_s
        await self._unit.power_off(factory=step["factory"])
        await self._unit.power_on()
        self._powered(factory=step["factory"])

    def _powered(self, *, factory: bool) -> None:
        self._oracle.powered(factory=factory, motion=Motion.of(ORION, 0.0))
        self._oracle.disturbed |= self._not_read
        self._connect()

    def _connect(self) -> None:
        """Make the OBC's end of each link, for the addresses and format in use."""
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

            def take(link: str = link) -> list[Any]:
                return unit.take(link)

            if self._stack is not None and link == "serial":
                self._ports[link] = SerialPort(self._stack, deliver, take, self._dialect(), self._answered)
            elif link == "can":
                self._ports[link] = CanPort(deliver, take, number("can_address", 4))
            else:
                self._ports[link] = CanopenPort(
                    self._icd, self._objects(), deliver, take, number("canopen_node", 44)
                )

    def _objects(self) -> DeviceDictionary:
        if self._dictionary is None:
            raise BenchError(f"unit {self._icd.name}: has no CANopen")
        return self._dictionary

    def _dialect(self) -> Dialect | None:
        only = chosen_dialect(self._icd, None)
        known = self._oracle.values.get("serial_dialect")
        if only is None or known is None or getattr(self._stack, "dialect", None) is not None:
            return only
        return Dialect(str(known[0]))

    # --- requests ---

    async def _request(self, step: Step) -> None:
        klass, row_id, kind = step["row"]
        link, data = step["link"], bytes.fromhex(step.get("data", ""))
        row = self._icd.rows_by_key.get((klass, row_id))
        if row is not None and row.kind != kind:
            row = None
        if link == "canopen" and not self._in_dictionary(row, data):
            return
        self._discard(link)
        verdict = self._oracle.verdict(row, kind, data)
        request = Request(RequestKind(kind), row_id, data, klass=klass)
        size = row.size if row is not None and row.kind == "telemetry" else 0
        try:
            self._ports[link].ask(request, size, self._unit.now_s)
        except ProtocolError:
            return  # the header has no room for such an ID
        self.outcome.requests += 1
        if not self._oracle.stuck and (link != "canopen" or kind == "telecommand"):
            self._oracle.counted(kind)
        answers = self._answers(link)
        if self._oracle.stuck:
            if answers:
                raise Violation(f"an unresponsive unit answers {_text(answers[0])}")
            await self._settle(link)
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
        """The answer may have been lost: nothing that the request may have changed is known."""
        if kind == "telecommand":
            self._oracle.forget()
        await self._settle(link)

    async def _settle(self, link: str) -> None:
        await self._pass_time(TIME_OUT_S)
        self._unit.take(link)
        self._connect()

    def _answers(self, link: str) -> list[Reply | LinkFault]:
        """Return the answers on a link; unsolicited messages are judged apart."""
        found: list[Reply | LinkFault] = []
        for event in self._ports[link].answers(self._unit.now_s):
            if isinstance(event, LinkFault) or event.kind not in _UNASKED:
                found.append(event)
            else:
                self._unasked(link, event)
        return found

    def _unasked(self, link: str, event: Reply | LinkFault) -> None:
        if link in self._oracle.disturbed:
            return
        if isinstance(event, LinkFault):
            raise Violation(f"{link}: malformed output: {event.detail}")
        if event.kind is ReplyKind.BURST:
            if not self._oracle.bursts:
                raise Violation(f"{link}: a packet of a file that nobody requested")
            return
        if event.kind not in _UNASKED:
            raise Violation(f"{link}: {_text(event)} without a request")
        row = self._icd.rows_by_key.get((event.klass, event.id or 0))
        if row is None or row.kind != "telemetry" or len(event.data) != row.size:
            raise Violation(f"{link}: unsolicited {_text(event)}")

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
                await self._settle(link)
                if self._fixed_framing:
                    self._oracle.forget()
        elif verdict not in (None, ErrorCode.OK):
            raise Violation(f"{sent}: accepted, must be refused")
        elif sum(reply.final for reply in replies) != 1:
            raise Violation(f"{sent}: {sum(reply.final for reply in replies)} answers")
        if request.kind is RequestKind.TELECOMMAND:
            refused = ErrorCode.INTERNAL if nack is not None else ErrorCode.OK
            await self._executed(
                row, request, verdict or refused, unknown=nack is not None and verdict is None
            )
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
            await self._pass_time(TURN_S)
            oracle.restarted()
            oracle.started_at(self._unit.now_s - TURN_S)
            self._connect()
        elif any(field.parameter in _ADDRESSES for field in row.fields) or row.action in _SETTERS:
            await self._pass_time(TURN_S)
            self._connect()

    def _read(self, what: str, row: Row | None, request: Request, reply: Reply) -> None:
        number = request.id if reply.id is None else reply.id
        other = self._icd.rows_by_key.get((reply.klass or request.klass, number)) or row
        if other is None or other.kind != "telemetry":
            raise Violation(f"{what}: {_text(reply)}")
        self.outcome.readings += 1
        self._oracle.read(other, reply.data)

    def _same_code(self, link: str, nack: Reply, verdict: ErrorCode) -> bool:
        composed = self._stack if link == "serial" and isinstance(self._stack, ComposedStack) else None
        if composed is not None and "status" not in composed.reply_header.roles:
            return True  # a refusal has no code
        if link == "canopen":
            return int(nack.code) != 0  # aborts have codes of their own
        return int(nack.code) == int(self._icd.error_number(verdict))

    def _can_refuse(self, link: str, klass: str) -> bool:
        if link != "serial" or not isinstance(self._stack, ComposedStack):
            return True
        return bool(self._stack.reply_header.roles_in(klass) & {"status", "ack"})

    async def _burst(self, step: Step) -> None:
        link = step["link"]
        if link == "canopen" or self._oracle.stuck or link in self._oracle.disturbed:
            return
        self._discard(link)
        rows = [self._icd.rows_by_key[klass, row_id] for klass, row_id, _ in step["rows"]]
        rows = [row for row in rows if self._oracle.verdict(row, "telemetry", b"") is ErrorCode.OK]
        answers: list[Reply | LinkFault] = []
        for row in rows:
            self.outcome.requests += 1
            self._ports[link].ask(self._icd.request(row), row.size, self._unit.now_s)
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

    async def _junk(self, step: Step) -> None:
        link = step["link"]
        if link in self._oracle.disturbed:
            return
        self._discard(link)
        if link == "serial":
            self._unit.deliver(link, bytes.fromhex(step["data"]))
            self._oracle.forget()  # some framings find a request in any bytes
        else:
            for can_id, data in step["frames"]:
                if link == "canopen":  # an SDO of another node
                    other = 0x580 + (can_id & 0xFF)
                    if other != 0x600 + getattr(self._ports[link], "node", 0):
                        self._unit.deliver(link, CanFrame(other, bytes.fromhex(data), extended=False))
                    continue
                known = CanId.unpack(can_id)
                if known.destination != 0 and known.destination != getattr(self._ports[link], "device", 0):
                    self._unit.deliver(link, CanFrame(can_id, bytes.fromhex(data)))
        await self._settle(link)

    # --- surroundings ---

    async def _truth(self, step: Step) -> None:
        await self._unit.set_truth(step["truth"])
        self._oracle.moved(Motion.of(step["truth"], self._unit.now_s))

    async def _fault(self, step: Step) -> None:
        fault = step["fault"]
        self._unit.fault(fault)
        oracle = self._oracle
        if "optical" in fault:
            oracle.covered(fully=fault["optical"].get("blocked_share") == 1.0)
        for link in self._unit.links:
            if link in fault or (link == "canopen" and "can" in fault):
                oracle.disturbed.add(link)
        device = fault.get("device", {})
        oracle.stuck = bool(device.get("stuck", False)) if device else oracle.stuck
        if "reset" in device:
            oracle.restarted()
            self._connect()
        if "error" in device:
            oracle.failed()

    async def _clear(self, _step: Step) -> None:
        self._unit.clear_faults()
        oracle = self._oracle
        oracle.covered(fully=False)
        oracle.stuck = False
        if oracle.disturbed:
            await self._pass_time(10.0)  # delayed output arrives
            for link in self._unit.links:
                self._unit.take(link)
            oracle.disturbed = set(self._not_read)
            self._connect()

    async def _end_pipeline(self, _step: Step) -> None:
        if self._unit.end_pipeline():
            self._oracle.failed()

    async def _disk(self, step: Step) -> None:
        self._unit.set_disk(full=step["full"])
        self._oracle.disk_full = step["full"]

    async def _peer(self, step: Step) -> None:
        link, reads = step["link"], step["reads"]
        self._unit.set_peer(link, reads=reads)
        self._not_read = self._not_read - {link} if reads else self._not_read | {link}
        if not reads:
            self._oracle.disturbed.add(link)

    async def _recover(self, _step: Step) -> None:
        """End all faults and restore the unit; its attitude must become valid."""
        for link in self._unit.links:
            await self._peer({"link": link, "reads": True})
        await self._disk({"full": False})
        await self._clear({})
        await self._power({"factory": True})
        await self._truth({"truth": ORION})
        await self._pass_time(RECOVERY_S / 3.0)
        self._connect()
        for row in self._icd.telecommands.values():
            if row.action == "set_mode":
                fields = [field for field in row.named_fields.values() if field.argument == "mode"]
                data = row.encode({fields[0].name: "lost_in_space"})
                link = self._unit.links[0]
                await self._request({"link": link, "row": [row.klass, row.id, row.kind], "data": data.hex()})
                break
        await self._pass_time(RECOVERY_S)
        for row in self._icd.telemetry.values():
            valid = [field for field in row.named_fields.values() if field.value == "attitude.valid"]
            if valid:
                await self._expect_valid(row, valid[0].name)
                break

    async def _expect_valid(self, row: Row, field: str) -> None:
        link = self._unit.links[0]
        self._discard(link)
        self._ports[link].ask(self._icd.request(row), row.size, self._unit.now_s)
        if link != "canopen":
            self._oracle.counted("telemetry")
        replies = [answer for answer in self._answers(link) if isinstance(answer, Reply) and answer.data]
        if not replies:
            raise Violation(f"{link}: {row.name}: no answer after all faults have ended")
        self._oracle.read(row, replies[-1].data)
        if not flag(row.decode(replies[-1].data)[field]):
            raise Violation(f"{row.name}: no valid attitude {RECOVERY_S:g} s after the last fault has ended")


def _text(answer: Reply | LinkFault) -> str:
    if isinstance(answer, LinkFault):
        return answer.detail
    return f"{answer.kind.value} {answer.klass} {answer.id}, {len(answer.data)} bytes"


_UNASKED: Final = frozenset({ReplyKind.UNSOLICITED, ReplyKind.EVENT, ReplyKind.BURST})
_ADDRESS: Final = {"serial": "serial_dialect", "can": "can_address", "canopen": "canopen_node"}
"""Parameter without which the unit cannot be reached on a link."""
_ADDRESSES: Final = frozenset({"can_address", "serial_dialect"})
_SETTERS: Final = frozenset({"set_parameter", "restore_parameters", "default_parameters"})
