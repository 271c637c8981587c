"""Mutants of units on composed links, put in at the same seams as those of the CubeStar."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from typing import Any

from starhil.emulator.device.device import Device
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.formats import MessageFormat
from starhil.protocol.serial.stack import SerialStack
from tests.conformance.mutant_seams import Damage, handling, incoming, only_acknowledged, outgoing
from tests.conformance.simulated import SimulatedUnit

Change = Callable[[Reply, Device], Reply | None]


@dataclasses.dataclass(frozen=True)
class UnitMutant:
    """A defect of a unit, and the case that has to fail because of it."""

    unit: str
    name: str
    caught_by: str
    damage: Damage


def stack_of(unit: SimulatedUnit) -> SerialStack:
    stack: SerialStack = unit.link._stack
    return stack


def bodies(change: Callable[[bytes, SerialStack], bytes], message_class: str = "") -> Damage:
    """Change the bodies of the frames that the device sends, in the format of a class."""

    def damage(unit: SimulatedUnit) -> None:
        framing = stack_of(unit).reply_formats.of(message_class).framing
        encode = framing.encode
        framing.encode = lambda body: encode(change(body, stack_of(unit)))  # type: ignore[method-assign]

    return damage


def raw_frames(change: Callable[[bytes, SerialStack], bytes]) -> Damage:
    """Change the bytes that the device sends, knowing its link."""

    def damage(unit: SimulatedUnit) -> None:
        outgoing(lambda data: [change(data, stack_of(unit))])(unit)

    return damage


def replies(change: Change) -> Damage:
    """Change the replies, or drop those that become None."""

    def changed(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
        found = handle(request) or []
        return [new for reply in found if (new := change(reply, device)) is not None]

    return handling(changed)


def telemetry_data(change: Callable[[bytes, Row], bytes]) -> Damage:
    """Change the data of telemetry."""

    def changed(reply: Reply, device: Device) -> Reply:
        row = device.icd.row(reply.id or 0, reply.message_class)
        if reply.kind is not ReplyKind.TELEMETRY or row is None or not reply.data:
            return reply
        return dataclasses.replace(reply, data=change(reply.data, row))

    return replies(changed)


def reversed_numbers(data: bytes, row: Row) -> bytes:
    return b"".join(
        data[slot.offset : slot.offset + slot.size][:: -1 if slot.type != "bytes" else 1]
        for slot in row.slots
    )


def with_code(old: ErrorCode, code: ErrorCode | None) -> Damage:
    """Give refusals another code, or accept what would be refused."""

    def changed(reply: Reply, device: Device) -> Reply:
        if reply.kind is not ReplyKind.NACK or reply.code is not old:
            return reply
        if code is None:
            return dataclasses.replace(reply, kind=ReplyKind.ACK, code=ErrorCode.OK)
        return dataclasses.replace(reply, code=code)

    return replies(changed)


def plant(form: MessageFormat, method: str, change: Callable[..., object]) -> None:
    """Replace a method of a format, which is frozen."""
    object.__setattr__(form, method, change)


def unchecked(unit: SimulatedUnit) -> None:
    """Accept any check."""
    plant(stack_of(unit).requests, "_checks", lambda *_: True)


def only_whole_check_missing(unit: SimulatedUnit) -> None:
    """Compare the lowest byte of the check only."""
    form = stack_of(unit).requests

    def checks(body: bytes, size: int, end: int) -> bool:
        covered = form._covered(body[:size], body[size:end])
        return form.check.compute(covered)[:1] == body[end:][:1]

    plant(form, "_checks", checks)


def any_address(unit: SimulatedUnit) -> None:
    """Take messages to other addresses for one's own."""
    form = stack_of(unit).requests
    opened = form.open

    def open_any(body: bytes) -> Any:
        result = opened(body)
        if isinstance(result, LinkFault) and result.kind is FaultKind.UART_ADDRESS:
            envelope: Any = form.header.unpack(body[: len(body) - form.check.size])
            return envelope, body[envelope.size : len(body) - form.check.size]
        return result

    plant(form, "open", open_any)


def any_class(unit: SimulatedUnit) -> None:
    """Take an unknown class for that of telemetry."""
    stack = stack_of(unit)
    for form in stack.request_formats.all:
        for code in range(256):
            form.header._classes.setdefault(code, "telemetry")


def times_out_never(unit: SimulatedUnit) -> None:
    stack = stack_of(unit)
    stack.link = stack.link.model_copy(update={"timeout": 1e9})  # type: ignore[misc]
    unit.link._receiver = unit.link._new_receiver()


def takes_any_length(unit: SimulatedUnit) -> None:
    stack = stack_of(unit)
    stack.max_size = 1 << 20  # type: ignore[misc]
    unit.link._receiver = unit.link._new_receiver()


def unescaped(data: bytes, stack: SerialStack) -> bytes:
    """Send the body as it is between the marks of a SLIP frame."""
    framing: Any = stack.requests.framing
    body = b"".join(framing.bodies(data.strip(framing.end)))
    return framing.end + body + framing.end


def escapes_left(data: bytes) -> list[bytes]:
    """Replace escaped bytes on their way in, so that they reach the device changed."""
    return [data.replace(b"\xdb\xdc", b"\x5b\xdc").replace(b"\xdb\xdd", b"\x5b\xdd")]


def every_fifth_missing() -> Damage:
    count = iter(range(10**9))
    return replies(lambda reply, _device: None if next(count) % 5 == 4 else reply)


def twice(data: bytes) -> list[bytes]:
    return [data, data]


def class_changed(reply: Reply, device: Device) -> Reply:
    other = {"telemetry": "parameter", "parameter": "telemetry"}.get(reply.message_class, reply.message_class)
    return dataclasses.replace(reply, message_class=other)


def subscription_deaf(
    _device: Device, request: Request, handle: Callable[[Request], list[Reply]]
) -> list[Reply]:
    if (request.message_class, request.id) == ("set", 18) and not any(request.data):
        return [
            Reply(ReplyKind.ACK, request.id, message_class=request.message_class, destination=request.source)
        ]
    return handle(request)


def cut_to_size(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
    row = device.icd.row(request.id, request.message_class)
    size = row.size if row is not None and row.kind == "telecommand" else 0
    return handle(dataclasses.replace(request, data=request.data[:size].ljust(size, b"\0")))


def without_limits(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
    return [
        dataclasses.replace(reply, kind=ReplyKind.ACK, code=ErrorCode.OK)
        if reply.kind is ReplyKind.NACK and reply.code is ErrorCode.INVALID_PARAMETER
        else reply
        for reply in handle(request)
    ]


def clock_stays(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
    if (request.message_class, request.id) == ("action", 14):
        return [
            Reply(ReplyKind.ACK, request.id, message_class=request.message_class, destination=request.source)
        ]
    return handle(request)


def setting_forgotten(
    device: Device, request: Request, handle: Callable[[Request], list[Reply]]
) -> list[Reply]:
    if (request.message_class, request.id) == ("set", 9):
        return [
            Reply(ReplyKind.ACK, request.id, message_class=request.message_class, destination=request.source)
        ]
    return handle(request)


def similar_texts(unit: SimulatedUnit) -> None:
    """Look at the first four letters of a request only."""
    stack = stack_of(unit)
    row_by_text = {text[:4]: row for text, row in stack._by_text.items()}

    class Similar(dict[str, Row]):
        def get(self, text: str, default: Any = None) -> Any:
            return row_by_text.get(text[:4], default)

    stack._by_text = Similar()


def fields_permuted(*names: str) -> Damage:
    """Send each of these fields in the place of the one before it, and the first in that of the last."""

    def changed(data: bytes, row: Row) -> bytes:
        places = [
            slice(item.offset, item.offset + item.size) for item in (row.named_fields[name] for name in names)
        ]
        moved = bytearray(data)
        for place, source in zip(places, (*places[1:], places[0]), strict=True):
            moved[place] = data[source]
        return bytes(moved)

    return telemetry_data(changed)


def conjugated(data: bytes, row: Row) -> bytes:
    """Turn the sign of the vector part."""
    turned = bytearray(data)
    for name in ("q1", "q2", "q3"):
        turned[row.named_fields[name].offset] ^= 0x80
    return bytes(turned)


def ping_answered(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
    found = handle(request)
    return found or [Reply(ReplyKind.ACK, request.id, message_class=request.message_class)]


def st200() -> Iterator[UnitMutant]:
    """Mutants of a unit with texts, and a record in another format than they."""
    one, attitude, command = "framing.one", "attitude.record", "commands.set_keep_alive"

    def unstuffed(data: bytes) -> list[bytes]:
        return [re.sub(rb"\xf0([\x00-\x0f])", lambda damages: bytes((0xF0 | damages[1][0],)), data)]

    damages: dict[str, tuple[str, Damage]] = {
        "the check is wrong": (one, bodies(lambda body, _stack: body[:-1] + bytes((body[-1] ^ 1,)), "record")),
        "no check is sent": (one, bodies(lambda body, _stack: body[:-1], "record")),
        "the check does not cover the start mark": (one, bodies(lambda body, stack: body[:-1] + stack.reply_formats.of("record").check.compute(body[:-1]), "record")),
        "the start mark is wrong": (one, outgoing(lambda data: [data.replace(b"\xf1", b"\xf2", 1)])),
        "replies are not stuffed": ("telemetry.record", outgoing(unstuffed)),
        "the scalar part comes first": (attitude, fields_permuted("q1", "q4", "q3", "q2")),
        "the quaternion is the conjugate": (attitude, telemetry_data(conjugated)),
        "pitch and yaw are exchanged": (attitude, fields_permuted("pitch", "yaw")),
        "similar texts are accepted": ("texts.set_keep_alive", similar_texts),
        "unknown texts are acknowledged": ("texts.ping", with_code(ErrorCode.INVALID_ID, None)),
        "commands are not acknowledged": (command, replies(lambda reply, _device: None if reply.kind is ReplyKind.ACK else reply)),
        "the text READY is another": (command, outgoing(lambda data: [data.replace(b"READY", b"Ready")])),
        "a text ends with CR only": (command, outgoing(lambda data: [data.replace(b"READY\r\n", b"READY\r")])),
        "ping is answered": ("commands.ping", handling(ping_answered)),
        "messages of any length are taken": ("framing.overlong", takes_any_length),
    }  # fmt: skip
    for name, (caught_by, damage) in damages.items():
        yield UnitMutant("st200", name, f"serial.{caught_by}", damage)


def mutants() -> Iterator[UnitMutant]:
    first = {"sagitta": "auto_blob", "nos3": "housekeeping", "st16": "ping", "st200": "record"}
    for unit, row in first.items():
        one = "serial.framing.one"
        yield UnitMutant(unit, "replies come twice", one, outgoing(twice))
        yield UnitMutant(
            unit,
            "a stray byte follows each reply",
            "serial.framing.reply-form",
            outgoing(lambda data: [data + b"\x42"]),
        )
        yield UnitMutant(
            unit,
            "the last byte of telemetry is missing",
            f"serial.telemetry.{row}",
            telemetry_data(lambda data, _row: data[:-1]),
        )
        yield UnitMutant(unit, "replies are missing", "serial.recovery.flood", every_fifth_missing())
        yield UnitMutant(unit, "incomplete messages never time out", "serial.framing.half", times_out_never)
        yield UnitMutant(
            unit,
            "only the first request of a piece is taken",
            "serial.framing.two-at-once",
            incoming(lambda data: [data[: (len(data) + 1) // 2]] if len(data) > 12 else [data]),
        )
    for unit, row in (("sagitta", "solution"), ("nos3", "data"), ("st200", "record")):
        yield UnitMutant(
            unit,
            "fields are shifted by a byte",
            f"serial.attitude.{row}",
            telemetry_data(lambda data, _row: data[1:] + data[:1]),
        )
        yield UnitMutant(
            unit,
            "numbers have the other byte order",
            f"serial.attitude.{row}",
            telemetry_data(reversed_numbers),
        )
    for unit in ("sagitta", "st16"):
        one = "serial.framing.one"
        yield UnitMutant(
            unit, "the check is wrong", one, bodies(lambda body, _stack: body[:-1] + bytes((body[-1] ^ 1,)))
        )
        yield UnitMutant(
            unit,
            "the check has the other byte order",
            one,
            bodies(
                lambda body, stack: (
                    body[: -stack.requests.check.size] + body[-stack.requests.check.size :][::-1]
                )
            ),
        )
        yield UnitMutant(
            unit, "no check is sent", one, bodies(lambda body, stack: body[: -stack.requests.check.size])
        )
        yield UnitMutant(unit, "the check of requests is not looked at", "serial.check.wrong", unchecked)
        yield UnitMutant(
            unit, "one byte of the check is looked at", "serial.check.wrong", only_whole_check_missing
        )
        yield UnitMutant(unit, "other addresses are answered", "serial.header.address", any_address)
        yield UnitMutant(
            unit,
            "replies come from another address",
            one,
            bodies(
                lambda body, stack: stack.requests.close(
                    bytes((body[0] ^ 1, body[1] ^ 1)) + body[2 : -stack.requests.check.size], b""
                )
            ),
        )
        yield UnitMutant(
            unit,
            "replies carry another identifier",
            one,
            replies(lambda reply, _device: dataclasses.replace(reply, id=(reply.id or 0) ^ 1)),
        )
        yield UnitMutant(
            unit, "messages of any length are taken", "serial.framing.overlong", takes_any_length
        )
        yield UnitMutant(
            unit,
            "unknown identifiers are accepted",
            "serial.identifiers.unknown" if unit == "st16" else "serial.identifiers.set",
            with_code(ErrorCode.INVALID_ID, None),
        )
        yield UnitMutant(
            unit,
            "data of any length are taken",
            "serial.lengths.init.long" if unit == "st16" else "serial.lengths.set_camera.short",
            handling(cut_to_size),
        )
    sagitta: dict[str, tuple[str, Damage]] = {
        "escapes of replies are swallowed": ("serial.settings.camera", raw_frames(unescaped)),
        "escapes of requests are not undone": ("serial.settings.camera", incoming(escapes_left)),
        "replies carry another class": ("serial.framing.one", replies(class_changed)),
        "unknown classes are answered": ("serial.header.class", any_class),
        "a wrong length gets another code": ("serial.lengths.set_camera.short", with_code(ErrorCode.INVALID_LENGTH, ErrorCode.BUSY)),
        "limits are not checked": ("serial.fields.set_camera.focal_length.nan", handling(without_limits)),
        "a setting is acknowledged and forgotten": ("serial.settings.camera", handling(setting_forgotten)),
        "a subscription does not end": ("serial.subscriptions.set_subscription", handling(subscription_deaf)),
        "the clock is not set": ("serial.clock.set_time", handling(clock_stays)),
        "unsolicited telemetry has the class of a reply": ("serial.subscriptions.set_subscription", _as_replies),
    }  # fmt: skip
    for name, (caught_by, damage) in sagitta.items():
        yield UnitMutant("sagitta", name, caught_by, damage)
    nos3: dict[str, tuple[str, Damage]] = {
        "the echo is missing": ("serial.echo.noop", replies(lambda reply, _device: None if reply.kind is ReplyKind.ECHO else reply)),
        "the echo is altered": ("serial.echo.noop", replies(lambda reply, _device: dataclasses.replace(reply, flags=1) if reply.kind is ReplyKind.ECHO else reply)),
        "the echo comes after the reply": ("serial.framing.one", handling(lambda _device, request, handle: handle(request)[::-1])),
        "the end mark is wrong": ("serial.framing.one", outgoing(lambda data: [data[:-1] + b"\xee"])),
        "unknown commands are answered": ("serial.identifiers.unknown", handling(_answers_all)),
    }  # fmt: skip
    for name, (caught_by, damage) in nos3.items():
        yield UnitMutant("nos3", name, caught_by, damage)
    yield from st200()
    yield from gen2()


def gen2(link: str = "serial") -> Iterator[UnitMutant]:
    """Mutants of a unit that is no CubeStar on the links of one: its rows, and the framing `1F 7F … 1F FF`."""

    def stuffing_missing(data: bytes) -> list[bytes]:
        return [data[:2] + data[2:-2].replace(b"\x1f\x1f", b"\x1f") + data[-2:]]

    one = "framing.one" if link == "serial" else "frames.telemetry"
    length, setting = "lengths.set_unix_time.long", "settings.unsolicited_telemetry"
    damages: dict[str, tuple[str, Damage]] = {
        "replies come twice": (one, outgoing(twice)),
        "replies are missing": ("recovery.flood", every_fifth_missing()),
        "the last byte of telemetry is missing": ("telemetry.identification", telemetry_data(lambda data, _row: data[:-1])),
        "unknown identifiers are accepted": ("identifiers.telecommands", with_code(ErrorCode.INVALID_ID, None)),
        "data of any length are taken": (length, handling(cut_to_size)),
        "a wrong length gets another code": (length, with_code(ErrorCode.INVALID_LENGTH, ErrorCode.BUSY)),
        "limits are not checked": ("fields.set_unix_time.nanoseconds.high", handling(without_limits)),
        "a setting is acknowledged and forgotten": (setting, only_acknowledged(112)),
    }  # fmt: skip
    if link == "serial":
        damages |= {
            "a stray byte follows each reply": ("framing.reply-form", outgoing(lambda data: [data + b"\x42"])),
            "replies carry another identifier": (one, replies(lambda reply, _device: dataclasses.replace(reply, id=(reply.id or 0) ^ 1))),
            "replies are not stuffed": (setting, outgoing(stuffing_missing)),
            "stuffed bytes of requests are changed": (setting, incoming(lambda data: [data.replace(b"\x1f\x1f", b"\x1e")])),
        }  # fmt: skip
    for name, (caught_by, damage) in damages.items():
        yield UnitMutant("cubestar-gen2", name, f"{link}.{caught_by}", damage)


def _as_replies(unit: SimulatedUnit) -> None:
    send = unit.link._send_unsolicited
    unit.device.signals.unsolicited.observers[:] = [
        lambda reply: send(dataclasses.replace(reply, kind=ReplyKind.TELEMETRY))
    ]


def _answers_all(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
    if device.icd.row(request.id, request.message_class) is not None:
        return handle(request)
    return [Reply(ReplyKind.TELEMETRY, request.id, bytes(4), message_class=request.message_class)]
