"""Conformance of any unit on a serial line or CAN, derived from its definition."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final, TypeVar

from starhil.hil_tests.conformance.case import Case, CaseSkipped, check, check_equal
from starhil.hil_tests.conformance.row_cases import bad_values
from starhil.hil_tests.conformance.unit_probe import SerialUnitProbe, UnitProbe
from starhil.protocol.codec import Field, Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.envelope import HeaderField
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.link_schema import DelimitedFraming, EscapedFraming, FixedFraming, SlipFraming
from starhil.protocol.messages import DEFAULT_MAX_SIZE, ErrorCode, Request
from starhil.protocol.serial_stack import build_serial_stack
from starhil.protocol.values import Value

FLOOD: Final = 50
ATTITUDE_S: Final = 20.0
CLOCK_S: Final = 1_700_000_000
SECOND_NS: Final = 1_000_000_000
QUATERNION: Final = ("attitude.x", "attitude.y", "attitude.z", "attitude.w")

Run = Callable[[UnitProbe], None]
ProbeType = TypeVar("ProbeType")


def unit_cases(icd: InterfaceDefinition) -> list[Case[Any]]:
    """Return the cases for a unit with a serial link or CAN."""
    stack = build_serial_stack(icd)
    cases: list[Case[Any]] = [*_framing(icd)]
    if isinstance(stack, ComposedStack):
        cases += [*_check(stack), *_header(stack)]
    fixed = icd.link.serial is not None and isinstance(icd.link.serial.framing, FixedFraming)
    cases += unit_row_cases(icd, stack, lengths=not fixed, clause="[link.serial]")
    return [*cases, *_echoes(icd), *_clock(icd, stack), *_recovery()]


def unit_row_cases(
    icd: InterfaceDefinition, stack: object = None, *, lengths: bool = True, clause: str
) -> list[Case[UnitProbe]]:
    """Yield the cases for the rows of a unit on any link; `stack` is its serial link, if any."""
    return [
        *_identifiers(icd, stack, clause),
        *_rows(icd),
        *(_lengths(icd) if lengths else ()),
        *_limits(icd),
        *_settings(icd),
        *_subscriptions(icd),
        _case("recovery", "flood", "a flood of requests is answered completely and in order", _flood, clause),
    ]


def _case(
    area: str,
    name: str,
    title: str,
    run: Callable[[ProbeType], None],
    clause: str = "[link.serial]",
    *,
    intrusive: bool = False,
) -> Case[ProbeType]:
    return Case(f"{area}.{name}", area, title, clause, run, intrusive)


def clause_of_row(row: Row) -> str:
    """Return the source of a row."""
    return f"{row.kind} {row.name} ({row.provenance}{': ' + row.source if row.source else ''})"


def marks(icd: InterfaceDefinition) -> bytes:
    """Return the bytes that are special in the framing."""
    link = icd.link.serial
    match link.framing if link is not None else None:
        case SlipFraming() as framing:
            return bytes((framing.end, framing.escape, *framing.escaped))
        case EscapedFraming() as framing:
            return bytes((framing.escape, framing.start, framing.end))
        case DelimitedFraming() as framing:
            return bytes((*framing.start, *framing.end))
        case None:
            return b""
        case framing:
            start, end = getattr(framing, "start", []), getattr(framing, "end", [])
            return bytes((*start, *end)) or b"\x1f\x7f\xff"


# --- framing ---


def _framing(icd: InterfaceDefinition) -> Iterator[Case[SerialUnitProbe]]:
    used = marks(icd)
    plain = bytes(byte for byte in range(0x20, 0x60) if byte not in used)

    def asked(probe: SerialUnitProbe, times: int = 1) -> bytes:
        request = probe.request(probe.lively)
        probe.expecting(*[request] * times)
        return probe.stack.encode_request(request) * times

    def answered(probe: SerialUnitProbe, times: int = 1) -> None:
        for _ in range(times):
            probe.expect_telemetry(probe.lively)
        probe.expect_silence("no more was requested")

    def one(probe: SerialUnitProbe) -> None:
        probe.send(asked(probe))
        answered(probe)

    def two(probe: SerialUnitProbe) -> None:
        probe.send(asked(probe, 2))
        answered(probe, 2)

    def bytewise(probe: SerialUnitProbe) -> None:
        for byte in asked(probe):
            probe.send(bytes((byte,)))
            probe.sleep(0.005)
        answered(probe)

    def junk(probe: SerialUnitProbe) -> None:
        probe.send(plain[:9])
        probe.sleep_past_timeout()
        probe.drain()
        one(probe)

    def half(probe: SerialUnitProbe) -> None:
        whole = asked(probe)
        probe.send(whole[: len(whole) // 2])
        probe.sleep_past_timeout()
        probe.send(whole[len(whole) // 2 :])
        probe.expect_silence("the message has timed out")
        probe.sleep_past_timeout()
        probe.expect_alive()

    def overlong(probe: SerialUnitProbe) -> None:
        size = getattr(probe.stack, "max_size", DEFAULT_MAX_SIZE)
        request = replace(probe.request(probe.lively), data=plain[:1] * (size + 64))
        probe.send(probe.stack.encode_request(request))
        probe.expect_silence("the message was too long")
        probe.sleep_past_timeout()
        probe.expect_alive()

    def form(probe: SerialUnitProbe) -> None:
        sent = asked(probe)
        probe.send(sent)
        reply = probe.expect_telemetry(probe.lively)
        probe.sleep(probe.times.quiet_s)
        echo = sent if "echo" in probe.lively.answers else b""
        whole = echo + probe.stack.encode_reply(reply, probe.style)
        slip = icd.link.serial is not None and isinstance(icd.link.serial.framing, SlipFraming)
        end = used[:1] if slip else b""  # which may be omitted before a frame
        check_equal(probe.raw.strip(end), whole.strip(end), "bytes")

    yield _case("framing", "one", "a request is answered once", one)
    yield _case("framing", "reply-form", "a reply is one frame without extra bytes", form)
    yield _case("framing", "two-at-once", "two requests sent together are both answered", two)
    yield _case("framing", "byte-by-byte", "a request may be sent byte by byte", bytewise)
    yield _case("framing", "junk", "bytes that are not a message are ignored", junk)
    yield _case("framing", "half", "an incomplete message is dropped after a time-out", half)
    yield _case("framing", "overlong", "a message that is too long is dropped", overlong)


# --- check ---


def _check(stack: ComposedStack) -> Iterator[Case[SerialUnitProbe]]:
    size = stack.check.size
    if not size:
        return

    def silent(probe: SerialUnitProbe, bodies: Iterator[bytes]) -> None:
        for body in bodies:
            probe.send(stack.framing.encode(body))
        probe.expect_silence("the check is wrong")
        probe.expect_alive()

    def body_of(probe: SerialUnitProbe) -> bytes:
        return stack.request_body(probe.request(probe.lively))

    def flipped(body: bytes, bits: range) -> Iterator[bytes]:
        for bit in bits:
            damaged = bytearray(body)
            damaged[bit // 8] ^= 1 << bit % 8
            yield bytes(damaged)

    def wrong(probe: SerialUnitProbe) -> None:
        body = body_of(probe)
        silent(probe, flipped(body, range(8 * (len(body) - size), 8 * len(body))))

    def damaged(probe: SerialUnitProbe) -> None:
        body = body_of(probe)
        silent(probe, flipped(body, range(8 * (len(body) - size))))

    def swapped(probe: SerialUnitProbe) -> None:
        body = body_of(probe)
        silent(probe, iter([body[:-size] + body[-size:][::-1]]))

    def missing(probe: SerialUnitProbe) -> None:
        silent(probe, iter([body_of(probe)[:-size]]))

    yield _case("check", "wrong", "a message with a bit of the check flipped is not answered", wrong)
    yield _case("check", "damaged", "a message with a bit flipped is not answered", damaged)
    yield _case("check", "missing", "a message without the check is not answered", missing)
    if size > 1:
        yield _case("check", "swapped", "a check with its bytes in the other order is not accepted", swapped)


# --- header ---


def _header(stack: ComposedStack) -> Iterator[Case[SerialUnitProbe]]:
    for field in stack.request_header.fields:
        if field.role == "address":
            own = field.default
            values = [own ^ 1, own ^ 1 << 8 * field.size - 1, 0 if own else 1]
            yield _silent_header(stack, "address", field, values, "another address")
        elif field.role == "class":
            codes = {item.code for item in stack.classes.classes}
            values = [code for code in range(256) if code not in codes][:8]
            yield _silent_header(stack, "class", field, values, "a class that the unit does not have")
        elif field.role is None and field.const is not None:
            yield _silent_header(stack, "constant", field, [field.const ^ 1], "another constant")


def _silent_header(
    stack: ComposedStack, name: str, field: HeaderField, values: list[int], what: str
) -> Case[SerialUnitProbe]:
    def run(probe: SerialUnitProbe) -> None:
        klass = probe.lively.klass
        header = stack.request_body(probe.request(probe.lively))[: stack.request_header.size(klass)]
        before = [item for item in stack.request_header.fields if item.in_class(klass)]
        start = sum(item.size for item in before[: before.index(field)])
        for value in values:
            changed = header[:start] + field.to_bytes(value) + header[start + field.size :]
            probe.send(stack.framing.encode(stack.close(changed, b"")))
        probe.expect_silence(what)
        probe.expect_alive()

    return _case("header", name, f"a message with {what} is not answered", run)


# --- row IDs ---


def _identifiers(icd: InterfaceDefinition, stack: object, clause: str) -> Iterator[Case[UnitProbe]]:
    for klass in [item.name for item in icd.classes if item.code is not None] or [""]:
        title = f"unknown IDs{f' of class {klass}' if klass else ''} are refused"
        run = _unknown(icd, stack, klass)
        yield _case("identifiers", klass or "unknown", title, run, clause, intrusive=True)


def _unknown(icd: InterfaceDefinition, stack: object, klass: str) -> Run:
    rows = [row for row in icd.rows if not klass or row.klass == klass]
    known = {row.id for row in rows}
    top = 255
    if isinstance(stack, ComposedStack):
        bits = [bit for field in stack.request_header.fields for bit in field.bits if bit.role == "id"]
        top = bits[0].mask if bits else top
    near = {row_id + step for row_id in known for step in (-1, 1)} | {0, top}
    kinds = {item.name: item.kind for item in icd.classes}

    def run(probe: UnitProbe) -> None:
        for row_id in sorted(number for number in near - known if 0 <= number <= top):
            request = Request(kinds.get(klass, icd.kind_of_id(row_id)), row_id, klass=klass)
            probe.expect_refusal(request, ErrorCode.INVALID_ID)

    return run


# --- telemetry ---


def _rows(icd: InterfaceDefinition) -> Iterator[Case[UnitProbe]]:
    for row in icd.telemetry.values():
        title = f"{row.name} has {row.size} bytes and values within their limits"
        yield _case("telemetry", row.name, title, _read_twice(row), clause_of_row(row))
        bound = {field.value: name for name, field in row.named_fields.items() if field.value}
        if "attitude.valid" in bound and all(name in bound for name in QUATERNION):
            title = f"{row.name} has a quaternion of length 1 if it is valid"
            yield _case("attitude", row.name, title, _unit_length(row, bound), clause_of_row(row))


def _read_twice(row: Row) -> Run:
    def run(probe: UnitProbe) -> None:
        for _ in range(2):
            probe.values(row)

    return run


def is_valid(value: Value) -> bool:
    """Return whether a field reports a valid attitude: a flag or a number."""
    return str(value).lower() in ("true", "1")


def _unit_length(row: Row, bound: dict[str, str]) -> Run:
    step = max(abs(row.named_fields[bound[name]].scale) for name in QUATERNION)
    tolerance = 1e-5 + (2.0 * step if step < 1.0 else 0.0)

    def run(probe: UnitProbe) -> None:
        end = probe.now() + ATTITUDE_S
        while not is_valid((seen := probe.values(row))[bound["attitude.valid"]]):
            if probe.now() > end:
                raise CaseSkipped(f"no attitude was valid within {ATTITUDE_S:g} s: no stars in view?")
            probe.sleep(0.1)
        length = sum(float(seen[bound[name]]) ** 2 for name in QUATERNION) ** 0.5
        check(abs(length - 1.0) < tolerance, "a quaternion of length 1", f"{length:.7f}")

    return run


# --- lengths and limits ---


def _lengths(icd: InterfaceDefinition) -> Iterator[Case[UnitProbe]]:
    for row in icd.rows:
        whole = row.encode(row.example()) if row.kind == "telecommand" else b""
        for why, data in (("long", whole + b"\0"), ("short", whole[:-1])):
            if data != whole:
                title = f"{row.name} with {len(data)} bytes of data ({why}) is refused for its length"
                run, name = _refused(row, data, ErrorCode.INVALID_LENGTH), f"{row.name}.{why}"
                intrusive = row.kind == "telecommand"
                yield _case("lengths", name, title, run, clause_of_row(row), intrusive=intrusive)


def _limits(icd: InterfaceDefinition) -> Iterator[Case[UnitProbe]]:
    for row in icd.telecommands.values():
        for name, field in row.named_fields.items():
            for why, data in bad_values(row, field):
                run, full = _refused(row, data, ErrorCode.INVALID_PARAMETER), f"{row.name}.{name}.{why}"
                title = f"{row.name} with {name} {why} is refused"
                yield _case("limits", full, title, run, clause_of_row(row), intrusive=True)


def _refused(row: Row, data: bytes, code: ErrorCode) -> Run:
    return lambda probe: probe.expect_refusal(probe.request(row, data), code)


# --- telecommands ---


def _settings(icd: InterfaceDefinition) -> Iterator[Case[UnitProbe]]:
    used = marks(icd)
    for row in icd.telecommands.values():
        if row.action in (None, "nothing") or row.action in icd.plugin.actions:
            title = f"{row.name} is accepted"
            yield _case("commands", row.name, title, _accepted(row), clause_of_row(row), intrusive=True)
    for row in icd.telemetry.values():
        source = next((field.telecommand for field in row.named_fields.values() if field.telecommand), None)
        if source is not None and icd.telecommands[source].action in (None, "nothing"):
            title = f"{row.name} reports the bytes set by {source}"
            run = _read_back(icd.telecommands[source], row, used)
            yield _case("settings", row.name, title, run, clause_of_row(row), intrusive=True)


def _accepted(row: Row) -> Run:
    return lambda probe: probe.command(row, row.encode(row.example()))


def _read_back(command: Row, row: Row, used: bytes) -> Run:
    def run(probe: UnitProbe) -> None:
        before = probe.telemetry(row).data
        rng = random.Random(row.id)  # noqa: S311 -- data, not a secret
        for turn in range(3):
            values = {name: _value(field, used, turn, rng) for name, field in command.named_fields.items()}
            data = command.encode(values)
            probe.command(command, data)
            check_equal(probe.telemetry(row).data, data, f"the bytes of {command.name}")
        probe.command(command, before)

    return run


def _value(field: Field, used: bytes, turn: int, rng: random.Random) -> Value:
    """Return a value within the limits, if possible of bytes special in the framing, or else random."""
    pattern = (
        (used * (turn + field.size))[turn:][: field.size] if turn < 2 and used else rng.randbytes(field.size)
    )
    match field.kind:
        case "bytes":
            return pattern
        case "text":
            return "star"[: field.size]
        case "flag":
            return rng.random() < 0.5
        case "enum":
            return rng.choice(list(field.enum.values)) if field.enum is not None else 0
        case "float":
            (value,) = struct.unpack(field.slot.format, pattern)
            low, high = field.physical_limits
            return float(min(max(value, low), high)) if abs(value) < 1e30 else 0.0
        case _:
            low_raw, high_raw = field.raw_limits
            raw = int.from_bytes(pattern, field.slot.order)
            return field.to_physical(raw if low_raw <= raw <= high_raw else rng.randint(low_raw, high_raw))


# --- echoes ---


def _echoes(icd: InterfaceDefinition) -> Iterator[Case[SerialUnitProbe]]:
    for row in icd.rows:
        if "echo" in row.answers:
            title = f"{row.name} is echoed byte for byte before any other answer"
            intrusive = row.kind == "telecommand"
            yield _case("echo", row.name, title, _echoed(row), clause_of_row(row), intrusive=intrusive)


def _echoed(row: Row) -> Callable[[SerialUnitProbe], None]:
    def run(probe: SerialUnitProbe) -> None:
        request = probe.request(row, row.encode(row.example()) if row.kind == "telecommand" else b"")
        sent = probe.stack.encode_request(request)
        probe.ask(request)
        check_equal(probe.raw[: len(sent)] or None, sent, "the echo")

    return run


# --- subscriptions and the clock ---


def _subscriptions(icd: InterfaceDefinition) -> Iterator[Case[UnitProbe]]:
    for row in icd.telecommands.values():
        fields = [
            name
            for name, field in row.named_fields.items()
            if (field.argument or "").startswith("telemetry[")
        ]
        klass = str(row.arguments.get("class", ""))
        offered = [item for item in icd.telemetry.values() if klass in ("", item.klass)][:2]
        if row.action == "subscribe" and fields and offered:
            title = f"{row.name} starts and stops unsolicited telemetry"
            run = _subscribed(row, fields, offered)
            yield _case("subscriptions", row.name, title, run, clause_of_row(row), intrusive=True)


def _subscribed(command: Row, fields: list[str], offered: list[Row]) -> Run:
    nothing = command.encode({**command.example(), **dict.fromkeys(fields, 0)})

    def run(probe: UnitProbe) -> None:
        chosen = dict.fromkeys(fields, 0) | {name: row.id for name, row in zip(fields, offered, strict=False)}
        probe.command(command, command.encode({**command.example(), **chosen}))
        seen = probe.unsolicited_replies(3.0)
        probe.command(command, nothing)
        probe.sleep(0.5)
        wanted = {(row.klass, row.id, row.size) for row in offered[: len(fields)]}
        check(len(seen) >= len(wanted), "a message of each row within 3 s", f"{len(seen)} messages")
        check_equal({(reply.klass, reply.id, len(reply.data)) for reply in seen}, wanted, "rows and sizes")
        check_equal(len(probe.unsolicited_replies(2.0)), 0, "messages after the end of the subscription")

    return run


def _clock(icd: InterfaceDefinition, stack: object) -> Iterator[Case[UnitProbe]]:
    if not isinstance(stack, ComposedStack) or "time" not in stack.reply_header.roles:
        return
    timed = next(field.classes for field in stack.reply_header.fields if field.role == "time")
    row = next((row for row in icd.telemetry.values() if timed is None or row.klass in timed), None)
    for command in icd.telecommands.values():
        arguments = {field.argument: name for name, field in command.named_fields.items()}
        if command.action == "set_clock" and "microseconds" in arguments and row is not None:
            title = "the times in replies follow the clock after it was set"
            run = _clock_runs(command, arguments["microseconds"], row)
            yield _case("clock", command.name, title, run, clause_of_row(command), intrusive=True)


def _clock_runs(command: Row, name: str, row: Row) -> Run:
    field = command.named_fields[name]

    def run(probe: UnitProbe) -> None:
        before, began = probe.telemetry(row).time_ns, probe.now()
        probe.command(command, command.encode({name: field.to_physical(CLOCK_S * 1_000_000)}))
        first = probe.telemetry(row).time_ns
        probe.sleep(0.5)
        second = probe.telemetry(row).time_ns
        back = before + round((probe.now() - began) * SECOND_NS)
        probe.command(command, command.encode({name: field.to_physical(back // 1000)}))
        check(0 <= first - CLOCK_S * SECOND_NS <= SECOND_NS, f"a time just after {CLOCK_S} s", f"{first} ns")
        check(0.4 <= (second - first) / SECOND_NS <= 1.5, "half a second more", f"{second - first} ns")

    return run


# --- recovery ---


def _recovery() -> Iterator[Case[SerialUnitProbe]]:
    def noise(probe: SerialUnitProbe) -> None:
        rng = random.Random(7)  # noqa: S311 -- noise, not a secret
        used = marks(probe.icd)
        for _ in range(10):
            probe.send(bytes(byte for byte in rng.randbytes(200) if byte not in used))
        probe.sleep_past_timeout()
        probe.expect_alive()

    yield _case("recovery", "noise", "after noise and a pause the next request is answered", noise)


def _flood(probe: UnitProbe) -> None:
    rows = sorted(probe.icd.telemetry.values(), key=lambda row: row.size)[:2] * (FLOOD // 2)
    for row in rows:
        probe.post(probe.request(row))
    for row in rows:
        probe.expect_telemetry(row)
