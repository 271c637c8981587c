"""Faults of composed serial links, resynchronisation after them, and input that no receiver minds."""

from __future__ import annotations

import os
import random

import pytest

from starhil.protocol.messages import FaultKind, LinkFault, Reply, Request
from tests.protocol.mutations import mutated
from tests.protocol.serial.composed_links import (
    LENGTH,
    NOS3,
    REPLIES,
    REQUESTS,
    SAGITTA,
    STACKS,
    TC,
    TLM,
    counted,
    faults,
    stack_of,
)

SEED = 20260517
FUZZ_INPUTS = int(os.environ.get("STARHIL_FUZZ_INPUTS", "1500"))
MARKS = b"\xc0\xdb\x10\x02\x03\x7e\x7d\xde\xad\xaa\x55\r\n$\xff\x00"


@pytest.mark.parametrize("name", [name for name, stack in STACKS.items() if stack.requests.check.size])
def test_each_flipped_bit_of_a_message_is_flagged_and_the_next_message_read(name: str) -> None:
    stack = STACKS[name]
    request = REQUESTS[name][0]
    sent = stack.encode_request(request)
    for bit in range(8 * len(sent)):
        damaged = bytearray(sent)
        damaged[bit // 8] ^= 1 << bit % 8
        receiver = stack.device()
        events = list(receiver.feed(bytes(damaged), 0.0))
        events += receiver.flush(1.0)
        events += receiver.feed(sent, 2.0)
        assert events[-1] == request, f"bit {bit}"
        assert len(events) > 1, f"bit {bit}"
        assert not [event for event in events[:-1] if isinstance(event, Request) and event != request], (
            f"bit {bit}"
        )


def test_wrong_check_is_flagged_as_such() -> None:
    sent = bytearray(SAGITTA.encode_request(REQUESTS["sagitta"][2]))
    sent[5] ^= 1
    (fault,) = SAGITTA.device().feed(bytes(sent), 0.0)
    assert isinstance(fault, LinkFault)
    assert fault.kind is FaultKind.UART_CHECK


def test_message_to_another_address_is_flagged_as_such() -> None:
    other = stack_of(
        {
            **SAGITTA.link.model_dump(exclude_none=True),
            "request_header": [
                {"role": "address", "type": "u8", "const": 0x22},
                {"role": "class", "type": "u8"},
                {"role": "id", "type": "u8"},
            ],
        },
        SAGITTA.icd.classes,
    )
    sent = other.encode_request(REQUESTS["sagitta"][2])
    assert faults(list(SAGITTA.device().feed(sent, 0.0))) == [FaultKind.UART_ADDRESS]


def test_unknown_class_is_flagged() -> None:
    body = bytes((0x21, 9, 24))
    sent = SAGITTA.requests.framing.encode(body + SAGITTA.requests.check.compute(body))
    assert faults(list(SAGITTA.device().feed(sent, 0.0))) == [FaultKind.UART_PROTOCOL]


def test_unknown_id_is_a_request_that_the_device_refuses() -> None:
    (request,) = SAGITTA.device().feed(
        SAGITTA.encode_request(Request(TLM, 99, message_class="telemetry")), 0.0
    )
    assert request == Request(TLM, 99, message_class="telemetry")


@pytest.mark.parametrize("name", STACKS)
def test_incomplete_message_is_flagged_after_the_timeout(name: str) -> None:
    receiver = STACKS[name].device()
    sent = STACKS[name].encode_request(REQUESTS[name][0])
    assert receiver.feed(sent[: len(sent) // 2], 0.0) == []
    assert receiver.busy
    assert receiver.flush(0.4) == []
    assert faults(receiver.flush(0.6)) == [FaultKind.UART_INCOMPLETE]
    assert not receiver.busy
    assert receiver.feed(sent, 0.7) == [REQUESTS[name][0]]


@pytest.mark.parametrize("name", ["sagitta", "nsp", "dle", "hdlc", "text", "length"])
def test_overlong_message_is_flagged_once_and_the_next_message_read(name: str) -> None:
    stack = STACKS[name]
    request = REQUESTS[name][0]
    head = stack.requests.framing.start or stack.requests.framing.end
    filler = b"\xff" if name == "length" else b"0"
    receiver = stack.device()
    events = [
        event
        for _ in range(30)
        for event in receiver.feed(head + filler * 99 if _ == 0 else filler * 100, 0.0)
    ]
    assert faults(events) == [FaultKind.UART_OVERLONG]
    events = receiver.feed(stack.requests.framing.end + stack.encode_request(request), 0.1)
    assert events[-1] == request


@pytest.mark.parametrize("name", ["nos3", "length", "dle", "text"])
def test_run_of_junk_before_a_message_is_flagged_once(name: str) -> None:
    request = REQUESTS[name][0]
    events = STACKS[name].device().feed(b"\x01\x02\x03" + STACKS[name].encode_request(request), 0.0)
    assert faults(events[:-1]) == [FaultKind.UART_PROTOCOL]
    assert events[-1] == request


def test_false_start_within_junk_does_not_swallow_the_message() -> None:
    request = REQUESTS["nos3"][1]
    events = NOS3.device().feed(b"\xde\xad\x01" + NOS3.encode_request(request), 0.0)
    assert faults(events[:-1]) == [FaultKind.UART_PROTOCOL]
    assert events[-1] == request


def test_length_that_is_wrong_does_not_swallow_the_messages_that_follow() -> None:
    request = REQUESTS["length"][0]
    sent = LENGTH.encode_request(request)
    wrong = sent[:3] + b"\x10" + sent[4:]
    events = LENGTH.device().feed(wrong + sent + sent, 0.0)
    assert faults(events[:1]) == [FaultKind.UART_CHECK]
    assert events[1:] == [request, request]


def test_link_without_a_start_is_in_step_again_after_a_silence() -> None:
    stack = counted(["data"], ["header", "data"], [])
    request = Request(TC, 7, b"\x01\x03")
    sent = stack.encode_request(request)
    receiver = stack.device()
    wrong = sent[:-1] + b"\x00"
    assert faults(list(receiver.feed(wrong + sent, 0.0))) == [FaultKind.UART_PROTOCOL]
    assert receiver.busy
    assert receiver.feed(sent, 0.1) == []
    assert receiver.flush(0.7) == []
    assert not receiver.busy
    assert receiver.feed(sent, 0.8) == [request]


@pytest.mark.parametrize("name", STACKS)
def test_receivers_survive_any_input(name: str) -> None:
    stack = STACKS[name]
    source = random.Random(SEED)
    requests = REQUESTS[name]
    seeds = [stack.encode_request(request) for request in requests]
    seeds += [stack.encode_reply(reply) for reply in REPLIES.get(name, [])]
    device, host = stack.device(), stack.host()
    now = 0.0
    for _ in range(FUZZ_INPUTS):
        data = mutated(seeds, source, MARKS)
        now += source.choice((0.0, 0.01, 0.6))
        host.overhear(source.choice(requests))
        for receiver in (device, host):
            for event in receiver.feed(data, now):
                assert isinstance(event, LinkFault | Request | Reply)
    for receiver in (device, host):
        receiver.flush(now + 1.0)
        assert not receiver.busy
    assert device.feed(seeds[0], now + 2.0) == [requests[0]]
