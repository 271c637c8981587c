"""Conformance on the serial line: framing, check, header, echoes, pace and recovery, for the link of any unit.

Edge cases of a CubeSpace line are bytes in a file; those of a composed line alter one part of a message that the judge has
encoded.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Final

from starhil.hil_tests.conformance.case import (
    Case,
    CaseFailed,
    CaseSkipped,
    case_in,
    check,
    check_equal,
    rule,
)
from starhil.hil_tests.conformance.case_file import CUBESPACE_CASES, text_cases
from starhil.hil_tests.conformance.link_probe import INVALID_ID, INVALID_LENGTH, lively_row
from starhil.hil_tests.conformance.row_cases import CLOCK_S, row_cases, sent_cases
from starhil.hil_tests.conformance.serial_probe import BITS_A_BYTE, SerialProbe
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.framings import Framing
from starhil.hil_tests.judge.headers import Header
from starhil.hil_tests.judge.rows import Row
from starhil.hil_tests.judge.serial import Headed, SerialLine

CLAUSE: Final = "[link.serial]"
CUBESPACE: Final = "serial framing 1F 7F … 1F FF (libCubeObc, AlbertaSat adcs_io.c)"
DEFAULT_MAX_SIZE: Final = 512
"""Longest message that a receiver accepts, unless the definition or a row asks for more."""
ESCAPE: Final = 0x1F
"""Escape byte of CubeSpace, and the ID that it would be: 31."""
CLOCK_GRAIN_S: Final = 1e-4

Run = Callable[[SerialProbe], None]


def serial_cases(unit: Unit) -> Iterator[Case[Any]]:
    line = SerialLine(unit)
    if not unit.readable:
        yield from sent_cases(unit)
        return
    lively = lively_row(unit, line.envelope.can_refuse)
    framing, envelope = line.request_format(lively.message_class)
    yield from _framing(line, framing, in_text=bool(lively.request))
    highest = 255
    if line.dialect is not None:
        yield from text_cases(CUBESPACE_CASES, "serial", serial_names(unit))
    texts = [row for row in unit.rows if row.request]
    if texts:
        yield from _texts(texts)
    if isinstance(envelope, Headed):
        yield from _check(envelope)
        yield from _header(unit, envelope)
        yield from _clock(unit, envelope.replies)
        highest = _highest_id(unit)
    yield from _echoes(unit)
    yield case_in(
        "timing", "pace", "a long reply takes at least its time on the line", pace, "8N1: ten bits a byte"
    )
    yield from row_cases(
        unit,
        lengths=unit.serial.framing.kind != "fixed" and not texts,
        numbers=not texts,
        marks=framing.marks,
        highest_id=highest,
        sizes=envelope.data_sizes,
    )
    yield case_in("recovery", "noise", "after noise and a pause the next request is answered", noise, rule(9))


def _highest_id(unit: Unit) -> int:
    """Return the highest ID that the bits of the request header hold, or 255."""
    bits = [bit.width for item in unit.serial.request_header for bit in item.bits if bit.role == "id"]
    return (1 << bits[0]) - 1 if bits else 255


# --- framing ---


def _asked(probe: SerialProbe, times: int = 1) -> bytes:
    """Return the bytes of a request for the lively row, which is expected to be answered."""
    return b"".join(probe.line.post(probe.unit.request(probe.lively)) for _ in range(times))


def _answered(probe: SerialProbe, times: int = 1) -> None:
    for _ in range(times):
        probe.expect_telemetry(probe.lively)
    probe.expect_silence("no more was requested")


def _framing(line: SerialLine, framing: Framing, *, in_text: bool) -> Iterator[Case[SerialProbe]]:
    """Yield the cases of the framing of requests, which may be texts."""
    marks = framing.marks
    plain = bytes(byte for byte in range(0x20, 0x60) if byte not in marks)
    clause = CLAUSE if line.dialect is None else CUBESPACE

    def one(probe: SerialProbe) -> None:
        probe.send(_asked(probe))
        _answered(probe)

    def two(probe: SerialProbe) -> None:
        probe.send(_asked(probe, 2))
        _answered(probe, 2)

    def bytewise(probe: SerialProbe) -> None:
        for byte in _asked(probe):
            probe.send(bytes((byte,)))
            probe.sleep(0.005)
        _answered(probe)

    def junk(probe: SerialProbe) -> None:
        probe.send(plain[:9])
        probe.sleep_past_timeout()
        probe.drain()
        one(probe)

    def half(probe: SerialProbe) -> None:
        whole = probe.line.encode(probe.unit.request(probe.lively))
        probe.send(whole[: len(whole) // 2])
        probe.sleep_past_timeout()
        probe.send(whole[len(whole) // 2 :])
        if in_text:  # the second half is an unknown text
            _expect_text_refused(probe)
        else:
            probe.expect_silence("the message has timed out")
        probe.sleep_past_timeout()
        probe.expect_alive()

    def overlong(probe: SerialProbe) -> None:
        size = probe.unit.serial.max_size or max(DEFAULT_MAX_SIZE, *(row.size for row in probe.unit.rows))
        request = probe.unit.request(probe.lively)
        envelope = probe.line.request_format(request.message_class)[1]
        if in_text:
            probe.send(framing.encode(_body(probe) + plain[:1] * (size + 64)))
        elif size + 64 in envelope.data_sizes(request.message_class):
            probe.send(probe.line.encode(replace(request, data=plain[:1] * (size + 64))))
        else:  # the longest message that its length field can state is not too long, but longer than the row
            longest = envelope.data_sizes(request.message_class)[-1]
            probe.expect_refusal(probe.lively, plain[:1] * longest, INVALID_LENGTH)
        probe.expect_silence("the message was too long")
        probe.sleep_past_timeout()
        probe.expect_alive()

    def form(probe: SerialProbe) -> None:
        sent = _asked(probe)
        probe.send(sent)
        answer = probe.expect_telemetry(probe.lively)
        probe.sleep(probe.times.quiet_s)
        echo = sent if "echo" in probe.lively.answers else b""
        whole = echo + probe.line.telemetry_frame(answer.body, probe.lively.message_class)
        end = (
            marks[:1] if probe.unit.serial.framing.kind == "slip" else b""
        )  # which may be omitted before a frame
        check_equal(probe.raw.strip(end), whole.strip(end), "bytes")

    for name, title, run, source in (
        ("one", "a request is answered once", one, clause),
        ("reply-form", "a reply is one frame without extra bytes", form, clause),
        ("two-at-once", "two requests sent together are both answered, in order", two, clause),
        ("byte-by-byte", "a request may be sent byte by byte", bytewise, clause),
        ("junk", "bytes that are not a message are ignored", junk, clause),
        ("half", "an incomplete message is dropped after a time-out", half, rule(2)),
        ("overlong", "a message that is too long is dropped, and the next one answered", overlong, rule(4)),
    ):
        yield case_in("framing", name, title, run, source)


def serial_names(unit: Unit) -> dict[str, str]:
    """Return the texts for names in braces.

    `row`, `other`, `lively`: ID of telemetry in hexadecimal, `row_id` decimal; `read`: CubeSpace's request for `row`; `no_row_31`:
    the ID 31, if no row has it.
    """
    small = sorted(unit.readable.values(), key=lambda row: row.size)[:2]
    lively = lively_row(unit, SerialLine(unit).envelope.can_refuse)
    names: dict[str, str] = {}
    for name, row in (("row", small[0]), ("other", small[-1]), ("lively", lively)):
        names |= {name: f"{row.id:02X}", f"{name}_id": str(row.id)}
    names["read"] = f"1F 7F {names['row']} 1F FF"
    if all(row.id != ESCAPE for row in unit.rows):
        names["no_row_31"] = str(ESCAPE)
    return names


# --- texts ---


def _expect_text_refused(probe: SerialProbe) -> None:
    """Take the refusal of an unknown text, or silence if the unit has no text for it."""
    if not probe.can_refuse(""):
        probe.expect_silence("no text refuses a request on this link")
        return
    probe.line.expect(probe.unit.request(probe.lively))
    probe.expect_nack("the text of a refusal for an unknown request", INVALID_ID)


def _texts(rows: list[Row]) -> Iterator[Case[SerialProbe]]:
    """Yield the cases of requests that are texts: each as it is defined, and no other."""
    requests = {row.request for row in rows}

    def others(text: str) -> list[str]:
        letter = "x" if text[-1] != "x" else "y"
        wrong = (text[:-1] + letter, letter + text[1:], text + letter, text[:-1], text.swapcase())
        return [other for other in wrong if other.strip() and other not in requests]

    def refused(row: Row) -> Run:
        def run(probe: SerialProbe) -> None:
            framing, envelope = probe.line.request_format(row.message_class)
            for text in others(row.request):
                if isinstance(envelope, Headed):
                    probe.send(framing.encode(envelope.closed(b"", text.encode())))
                _expect_text_refused(probe)
                probe.drain()
            probe.expect_alive()

        return run

    for row in rows:
        title = f"the text {row.request!r} with a letter changed, added or left out is refused"
        yield case_in("texts", row.name, title, refused(row), row, intrusive=not row.is_telemetry)


# --- check ---


def _body(probe: SerialProbe) -> bytes:
    return probe.line.request_format(probe.lively.message_class)[1].body(probe.unit.request(probe.lively))


def _check(envelope: Headed) -> Iterator[Case[SerialProbe]]:
    size = envelope.check_size
    if not size:
        return

    def silent(change: Callable[[bytes], Iterator[bytes]]) -> Run:
        def run(probe: SerialProbe) -> None:
            for body in change(_body(probe)):
                probe.send(probe.line.request_format(probe.lively.message_class)[0].encode(body))
            probe.expect_silence("the check is wrong")
            probe.sleep_past_timeout()  # a length that was changed may announce more bytes
            probe.drain()
            probe.expect_alive()

        return run

    def flipped(body: bytes, bits: range) -> Iterator[bytes]:
        for bit in bits:
            damaged = bytearray(body)
            damaged[bit // 8] ^= 1 << bit % 8
            yield bytes(damaged)

    def wrong(body: bytes) -> Iterator[bytes]:
        return flipped(body, range(8 * (len(body) - size), 8 * len(body)))

    def damaged(body: bytes) -> Iterator[bytes]:
        return flipped(body, range(8 * (len(body) - size)))

    def swapped(body: bytes) -> Iterator[bytes]:
        yield body[:-size] + body[-size:][::-1]

    def missing(body: bytes) -> Iterator[bytes]:
        yield body[:-size]

    cases = [("wrong", "a message with a bit of the check flipped is not answered", wrong)]
    if "header" in envelope.covers:
        cases.append(("damaged", "a message with a bit flipped is not answered", damaged))
    cases.append(("missing", "a message without the check is not answered", missing))
    if size > 1:
        cases.append(("swapped", "a check with its bytes in the other order is not accepted", swapped))
    for name, title, change in cases:
        yield case_in("check", name, title, silent(change), CLAUSE)


# --- header ---


def _header(unit: Unit, envelope: Headed) -> Iterator[Case[SerialProbe]]:
    for item in unit.serial.request_header:
        if item.role == "address":
            own = item.const if item.const is not None else item.default or 0
            top = 1 << 8 * envelope.requests.place(item, "")[1] - 1 if item.classes is None else 1
            values = [own ^ 1, own ^ top, 0 if own else 1]
            yield _silent_header(envelope, "address", item, values, "another address")
        elif item.role == "class":
            codes = {message_class.code for message_class in unit.classes}
            values = [code for code in range(256) if code not in codes][:8]
            yield _silent_header(envelope, "class", item, values, "a class that the unit does not have")
        elif item.role is None and item.const is not None:
            yield _silent_header(envelope, "constant", item, [item.const ^ 1], "another constant")
    if "reply" in envelope.replies.counted():
        yield case_in("header", "numbers", "replies are numbered in the order of sending", _numbers, CLAUSE)


def _numbers(probe: SerialProbe) -> None:
    for _ in range(5):
        probe.expect_alive()
    probe.check_numbers(probe.numbered)


def _silent_header(envelope: Headed, name: str, item: Any, values: list[int], what: str) -> Case[SerialProbe]:
    def run(probe: SerialProbe) -> None:
        message_class = probe.lively.message_class
        header = _body(probe)[: envelope.requests.size(message_class)]
        offset, size = envelope.requests.place(item, message_class)
        for value in values:
            piece = (value % (1 << 8 * size)).to_bytes(size, item.order or probe.unit.conventions.byte_order)
            changed = header[:offset] + piece + header[offset + size :]
            probe.send(probe.line.request_format(message_class)[0].encode(envelope.closed(changed, b"")))
        probe.expect_silence(what)
        probe.drain()
        probe.expect_alive()

    return case_in("header", name, f"a message with {what} is not answered", run, CLAUSE)


def _clock(unit: Unit, replies: Header) -> Iterator[Case[SerialProbe]]:
    row = next((row for row in unit.readable.values() if "time" in replies.roles(row.message_class)), None)
    for command in unit.telecommands.values():
        names = {item.argument: name for name, item in command.named.items()}
        if command.action == "set_clock" and "microseconds" in names and row is not None:
            title = "the times in replies follow the clock after it was set"
            run = partial(_clock_runs, command, names["microseconds"], row)
            yield case_in("clock", command.name, title, run, command, intrusive=True)


def _clock_runs(command: Row, name: str, row: Row, probe: SerialProbe) -> None:
    def time_s() -> float:
        probe.post(row)
        return probe.expect_telemetry(row).time_s

    def set_clock(seconds: float) -> None:
        probe.command(command.name, **{name: command.named[name].physical(round(seconds * 1e6))})

    before, began = time_s(), probe.now()
    set_clock(CLOCK_S)
    first = time_s()
    probe.sleep(0.5)
    second = time_s()
    set_clock(before + probe.now() - began)
    check(0 <= first - CLOCK_S <= 1, f"a time just after {CLOCK_S} s", f"{first:.6f} s")
    check(0.4 <= second - first <= 1.5, "half a second more", f"{second - first:.6f} s")


# --- echoes, time, noise ---


def _echoes(unit: Unit) -> Iterator[Case[SerialProbe]]:
    for row in unit.rows:
        if "echo" in row.answers:
            title = f"{row.name} is echoed byte for byte before any other answer"
            yield case_in("echo", row.name, title, partial(_echoed, row), row, intrusive=not row.is_telemetry)


def _echoed(row: Row, probe: SerialProbe) -> None:
    data = b"" if row.is_telemetry else row.encode()
    probe.ask(row, data)
    sent = probe.sent
    check_equal(probe.raw[: len(sent)] or None, sent, "the echo")


def pace(probe: SerialProbe) -> None:
    if probe.baud is None:
        raise CaseSkipped("the pace is checked only with --baud, the bit rate of the line")
    row = max(probe.unit.readable.values(), key=lambda row: row.size)
    begin = probe.now()
    probe.post(row)
    probe.expect_telemetry(row)
    seconds = probe.now() - begin
    least = len(probe.raw) * BITS_A_BYTE / probe.baud
    if seconds < least - CLOCK_GRAIN_S:
        raise CaseFailed(f"at least {least * 1e3:.2f} ms at {probe.baud} baud", f"{seconds * 1e3:.2f} ms")


def noise(probe: SerialProbe) -> None:
    rng = random.Random(7)  # noqa: S311 -- noise, not a secret
    # without its start byte, bytes are no CubeSpace message; in other framings any mark may end or begin one
    marks = probe.line.request_format(probe.lively.message_class)[0].marks
    left_out = marks[1:2] if probe.dialect is not None else marks
    for _ in range(20):
        probe.send(bytes(byte for byte in rng.randbytes(200) if byte not in left_out))
        probe.sleep(0.01)
    probe.sleep_past_timeout()
    probe.drain()
    probe.expect_alive()
