"""The device on serial and CAN at once, over transports that only pass on what they are given."""

import asyncio
import contextlib
import os
import random
import socket
import tty
from dataclasses import replace
from itertools import pairwise
from urllib.parse import urlsplit

import pytest

from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.base import MAX_HELD
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialDamage, SerialLink
from starhil.emulator.links.wire_faults import MAX_DELAYED, WireFault, WireFaults
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.simulation.scheduler import Scheduler
from starhil.protocol.can.cubespace import CanHostReceiver, CanId, MessageType, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.transports.python_can import QUEUE_LIMIT
from starhil.protocol.transports.serial import open_serial
from tests.emulator.wire import Wire
from tests.process.reference import bodies_in
from tests.protocol.serial.composed_links import CUBESPACE, CUBESTAR
from tests.waiting import PATIENCE_S, until

SEED = 20260101
JUNK = 10_000


class Linked:
    """A device with a serial and a CAN link."""

    def __init__(self, bench, dialect="b") -> None:
        bench.device.parameters.set({"serial_dialect": dialect})
        self.bench = bench
        self.uart, self.bus = Wire(), Wire()
        self.serial = SerialLink(bench.requests, self.uart)
        self.can = CanLink(bench.requests, self.bus)

    async def start(self):
        await self.serial.start()
        await self.can.start()
        return self

    def over_serial(self, identifier, data=b"", dialect=None) -> list[Reply | LinkFault]:
        request = Request.of(identifier, data)
        host = CUBESTAR.host(Dialect(dialect or self.bench.device.parameters["serial_dialect"]))
        self.uart.take()
        self.uart.arrive(host.request(request))
        return host.feed(b"".join(self.uart.take()), 0.0)

    def over_can(self, identifier, data=b"", source=1, destination=4) -> list[Reply | LinkFault]:
        host = CanHostReceiver(source, destination)
        self.bus.take()
        for frame in encode_request_frames(Request.of(identifier, data), source, destination):
            self.bus.arrive(frame)
        return [event for frame in self.bus.take() for event in host.feed(frame, 0.0)]


def in_loop(scenario):
    asyncio.run(scenario)


def test_what_a_request_causes_follows_its_answer_also_when_the_answer_takes_time(bench, monkeypatch):
    async def scenario():
        linked = await Linked(bench).start()
        saved = PendingAnswer()

        def save():
            bench.device.signals.unsolicited.emit(Reply(ReplyKind.UNSOLICITED, 230, bytes(16), destination=1))
            return saved

        monkeypatch.setattr(bench.device, "save_parameters", save)
        assert linked.over_can(bench.icd.telecommands["save_parameters"].id) == []
        saved.end(None)
        host = CanHostReceiver(1, 4)
        events = [event for frame in linked.bus.take() for event in host.feed(frame, 0.0)]
        assert [event.kind for event in events] == [ReplyKind.ACK, ReplyKind.UNSOLICITED]

    in_loop(scenario())


@pytest.mark.parametrize("fails", [False, True])
def test_a_save_is_answered_on_its_link_when_the_disk_is_done(bench, fails):
    async def scenario():
        linked = await Linked(bench).start()
        waiting = []
        bench.device._background = lambda _work, done: waiting.append(done)
        row = bench.icd.telecommands["save_parameters"].id
        error = EmulatorError("state file: cannot be written") if fails else None
        code = ErrorCode.INTERNAL if fails else ErrorCode.OK
        assert linked.over_can(row) == []
        waiting.pop()(error)
        host = CanHostReceiver(1, 4)
        (reply,) = [event for frame in linked.bus.take() for event in host.feed(frame, 0.0)]
        assert (reply.id, reply.code) == (row, code)
        assert linked.uart.take() == []
        assert linked.over_serial(row) == []
        waiting.pop()(error)
        assert linked.uart.take()
        assert linked.bus.take() == []

    in_loop(scenario())


def test_replies_keep_the_order_of_the_requests_while_a_save_is_pending(bench):
    async def scenario():
        linked = await Linked(bench).start()
        waiting = []
        bench.device._background = lambda _work, done: waiting.append(done)
        save = CUBESPACE.encode_request(Request.of(bench.icd.telecommands["save_parameters"].id))
        linked.uart.arrive(save + CUBESPACE.encode_request(Request.of(128)) + save)
        assert linked.uart.take() == []
        waiting.pop()(None)
        assert [len(body) for body in bodies_in(b"".join(linked.uart.take()))] == [1, 8]
        waiting.pop()(None)
        assert [len(body) for body in bodies_in(b"".join(linked.uart.take()))] == [1]
        assert len(linked.over_serial(128)) == 1

    in_loop(scenario())


def test_while_a_save_is_pending_requests_beyond_a_limit_are_lost_and_flagged_as_an_overrun(bench):
    """A million requests of 6 bytes were kept, and then answered at once."""

    async def scenario():
        linked = await Linked(bench).start()
        waiting = []
        bench.device._background = lambda _work, done: waiting.append(done)
        linked.over_serial(bench.icd.telecommands["save_parameters"].id)
        request = CUBESPACE.encode_request(Request.of(128))
        linked.uart.arrive(request * MAX_HELD)
        assert "telecommand_overrun" not in bench.device.counters.flags
        linked.uart.arrive(request * 3)
        assert "telecommand_overrun" in bench.device.counters.flags
        waiting.pop()(None)
        assert len(linked.uart.take()) == 1 + MAX_HELD
        linked.uart.arrive(request * 2 * MAX_HELD)
        assert len(linked.uart.take()) == 2 * MAX_HELD

    in_loop(scenario())


def test_a_restart_ends_the_wait_for_a_pending_save(bench):
    async def scenario():
        linked = await Linked(bench).start()
        waiting = []
        bench.device._background = lambda _work, done: waiting.append(done)
        linked.over_serial(bench.icd.telecommands["save_parameters"].id)
        assert linked.over_serial(128) == []
        bench.device.reset("command")
        assert len(linked.over_serial(128)) == 1

    in_loop(scenario())


@pytest.mark.parametrize("dialect", ["a", "b", "c"])
def test_serial_answers_in_each_dialect(bench, dialect):
    async def scenario():
        linked = await Linked(bench, dialect).start()
        (reply,) = linked.over_serial(128)
        assert (reply.kind, reply.id) == (ReplyKind.TELEMETRY, 128)
        assert bench.icd.telemetry["identification"].decode(reply.data)["node_type"] == 0x53
        (reply,) = linked.over_serial(96, b"\x02")
        assert (reply.kind, reply.id) == (ReplyKind.ACK, 96)
        (reply,) = linked.over_serial(96, b"\x09")
        assert (reply.kind, reply.code) == (ReplyKind.NACK, ErrorCode.INVALID_PARAMETER)

    in_loop(scenario())


def test_the_answer_to_a_change_of_the_bit_rate_goes_out_at_the_old_one(bench):
    async def scenario():
        linked = await Linked(bench).start()
        number = bench.icd.parameters["serial_baud"].id
        for baud in (57600, 57600, 115200):
            value = bench.icd.telecommands["set_parameter"].encode({"parameter": number, "value": baud})
            linked.uart.arrive(CUBESPACE.encode_request(Request.of(98, value)))
            await asyncio.sleep(0)
        acknowledge = b"\x1f\x7f\x00\x1f\xff"
        assert linked.uart.take() == [acknowledge, 57600, acknowledge, acknowledge, 115200]

    in_loop(scenario())


def test_a_change_of_rate_and_dialect_waits_for_a_pending_answer(bench):
    """The answer went out in the old dialect, but at the rate that another link had set meanwhile."""

    async def scenario():
        linked = await Linked(bench, "b").start()
        waiting = []
        bench.device._background = lambda _work, done: waiting.append(done)
        linked.over_serial(bench.icd.telecommands["save_parameters"].id)
        bench.device.parameters.set({"serial_baud": 57600, "serial_dialect": "a"})
        await asyncio.sleep(0)
        assert linked.uart.take() == []
        waiting.pop()(None)
        assert linked.uart.take() == [b"\x1f\x7f\x00\x1f\xff", 57600]
        assert linked.serial.dialect == "a"

    in_loop(scenario())


def test_the_answer_to_a_change_of_dialect_goes_out_in_the_old_one(bench):
    async def scenario():
        linked = await Linked(bench, "b").start()
        value = bench.icd.telecommands["set_parameter"].encode({"parameter": 36, "value": 0.0})
        (reply,) = linked.over_serial(98, value, dialect="b")
        assert reply.kind is ReplyKind.ACK
        (reply,) = linked.over_serial(128, dialect="a")
        assert reply.id == 128

    in_loop(scenario())


def test_can_answers_whoever_asks_in_segments(bench):
    async def scenario():
        linked = await Linked(bench).start()
        for source in (1, 77):
            (reply,) = linked.over_can(211, source=source)
            assert (reply.kind, len(reply.data)) == (ReplyKind.TELEMETRY, 54)
            (reply,) = linked.over_can(96, b"\x01", source=source)
            assert reply.kind is ReplyKind.ACK
        assert linked.over_can(128, destination=5) == []

    in_loop(scenario())


def test_the_answer_to_a_change_of_address_comes_from_the_old_one(bench):
    async def scenario():
        linked = await Linked(bench).start()
        value = bench.icd.telecommands["set_parameter"].encode({"parameter": 34, "value": 9.0})
        assert linked.over_can(98, value)[0].kind is ReplyKind.ACK
        assert linked.over_can(128) == []
        assert linked.over_can(128, destination=9)[0].id == 128

    in_loop(scenario())


def test_both_links_reach_one_device(bench):
    async def scenario():
        linked = await Linked(bench).start()
        linked.over_serial(96, b"\x02")
        (reply,) = linked.over_can(240)
        assert bench.icd.telemetry["acknowledge"].decode(reply.data)["last_telecommand"] == 96

    in_loop(scenario())


def test_unsolicited_telemetry_goes_to_can_and_to_dialect_c_only(bench):
    async def scenario():
        linked = await Linked(bench, "b").start()
        linked.over_can(
            104, bench.icd.telecommands["set_unsolicited"].encode({"telemetry": 230, "rate": 2.0})
        )
        bench.step(0.9)
        host = CanHostReceiver(1, 4)
        events = [event for frame in linked.bus.take() for event in host.feed(frame, 0.0)]
        assert [(e.kind, e.id) for e in events] == [(ReplyKind.UNSOLICITED, 230)] * 2
        assert linked.uart.take() == []
        bench.device.parameters.set({"serial_dialect": "c"})
        bench.step(0.5)
        host = CUBESPACE.host(Dialect.C)
        (event,) = host.feed(b"".join(linked.uart.take()), 0.0)
        assert (event.kind, event.id) == (ReplyKind.UNSOLICITED, 230)

    in_loop(scenario())


def test_a_gap_between_frames_is_kept(bench):
    async def scenario():
        bus = Wire()
        link = CanLink(bench.requests, bus, frame_gap_s=0.003)
        await link.start()
        for frame in encode_request_frames(Request.of(211), 1, 4):
            bus.arrive(frame)
        assert len(bus.sent) == 1
        await until(lambda: len(bus.sent) >= 8)
        await link.close()

    in_loop(scenario())


def test_the_acknowledge_of_a_reset_is_sent_in_its_turn(bench):
    async def scenario():
        bus = Wire()
        link = CanLink(bench.requests, bus, frame_gap_s=0.001)
        await link.start()
        reset = bench.icd.telecommands["reset"]
        for request in (Request.of(211), Request.of(reset.id, reset.encode({}))):
            for frame in encode_request_frames(request, 1, 4):
                bus.arrive(frame)
        boots = bench.device.boot_count
        bench.step(0.1)
        assert bench.device.boot_count == boots + 1
        await until(lambda: len(bus.sent) >= 9)  # eight of the telemetry, one of the acknowledge
        assert CanId.unpack(bus.sent[-1].id).type == MessageType.TELECOMMAND_ACK
        await link.close()

    in_loop(scenario())


def test_ten_thousand_random_strings_do_no_harm(bench):
    async def scenario():
        linked = await Linked(bench).start()
        rng = random.Random(SEED)
        counted = 0
        handle = bench.requests.handle

        def watched(request, **options):
            nonlocal counted
            counted += 1
            replies = handle(request, **options)
            row = bench.icd.row(request.id)
            if row is None:
                assert replies[0].code is ErrorCode.INVALID_ID
            elif len(request.data) != (0 if request.id >= 128 else row.size):
                checked = request.id < 128 and len(request.data) == row.size + 1
                assert replies[0].code is (ErrorCode.CRC if checked else ErrorCode.INVALID_LENGTH)
            return replies

        bench.requests.handle = watched
        for _ in range(JUNK):
            junk = rng.randbytes(rng.randint(1, 40))
            if rng.random() < 0.5:  # as hard as can be: whole messages with any id and content
                junk = b"\x1f\x7f" + junk + b"\x1f\xff"
            linked.uart.arrive(junk)
        linked.uart.arrive(b"\x1f\xff\x1f\xff")  # ends whatever was begun
        status = bench.device.counters
        bench.requests.handle = handle
        assert counted > JUNK // 4
        assert status.telecommands + status.telemetry == counted
        assert "uart_protocol_error" in status.flags
        (reply,) = linked.over_serial(128)
        assert reply.kind is ReplyKind.TELEMETRY

    in_loop(scenario())


def test_ten_thousand_random_frames_do_no_harm(bench):
    async def scenario():
        linked = await Linked(bench).start()
        rng = random.Random(SEED)
        requests = 0
        handle = bench.requests.handle

        def watched(request, **options):
            nonlocal requests
            requests += 1
            return handle(request, **options)

        bench.requests.handle = watched
        for _ in range(JUNK):
            identifier = CanId(
                rng.randrange(32), rng.randrange(256), rng.randrange(256), rng.choice((4, 4, 4, 9))
            )
            linked.bus.arrive(CanFrame(identifier.pack(), rng.randbytes(rng.randint(0, 8))))
        sent = [CanId.unpack(frame.id) for frame in linked.bus.take()]
        assert {identifier.source for identifier in sent} <= set(range(256))
        assert {identifier.type for identifier in sent} <= {
            MessageType.TELECOMMAND_ACK, MessageType.TELECOMMAND_NACK, MessageType.TELEMETRY, MessageType.TELEMETRY_NACK,
            MessageType.TELEMETRY_EXTENDED,
        }  # fmt: skip
        bench.requests.handle = handle
        assert bench.device.counters.telecommands + bench.device.counters.telemetry == requests
        assert "can_telecommand_error" in bench.device.counters.flags
        bench.device.parameters.set({"can_address": 4})
        assert linked.over_can(128)[0].kind is ReplyKind.TELEMETRY

    in_loop(scenario())


def test_an_incomplete_message_is_abandoned_and_counted(bench, monkeypatch):
    async def scenario():
        linked = await Linked(bench).start()
        linked.uart.arrive(b"\x1f\x7f\x80")
        frame = CanFrame(CanId(7, 37, 1, 4).pack(), bytes(7) + b"\x07")
        linked.bus.arrive(frame)
        bench.step(0.5)
        assert bench.device.counters.flags == set()
        bench.step(0.02)
        assert bench.device.counters.flags == {"uart_incomplete", "can_telecommand_error"}
        (reply,) = linked.over_serial(144)
        assert bench.icd.telemetry["communication_status"].decode(reply.data)["uart_incomplete"]
        await linked.serial.close()
        await linked.can.close()

    in_loop(scenario())


@pytest.mark.parametrize("kind", ["pty", "tty", "listen"])
def test_a_flood_on_the_serial_line_leaves_the_loop_to_others_after_some_80_faults(bench, kind):
    """Of 64 kB, 1 365 faults were counted at once, and replies on CAN waited several times as long."""

    async def scenario():
        master, slave = os.openpty()
        tty.setraw(slave)
        spec = {"pty": "pty", "tty": os.ttyname(slave), "listen": "listen://127.0.0.1:0"}[kind]
        link = SerialLink(bench.requests, open_serial(spec, 921_600))
        port = await link.start()
        counts = [0]
        with contextlib.ExitStack() as stack:
            stack.callback(os.close, slave)
            stack.callback(os.close, master)
            peer = master
            if kind == "pty":
                peer = os.open(port, os.O_WRONLY | os.O_NOCTTY)
                stack.callback(os.close, peer)
            elif kind == "listen":
                address = urlsplit(port)
                peer = stack.enter_context(
                    socket.create_connection((address.hostname, address.port))
                ).fileno()
            written = os.write(peer, b"\x1f\x7f\x80" * 1300)
            async with asyncio.timeout(PATIENCE_S):
                while counts[-1] < written // 3 - 1:
                    await asyncio.sleep(0)
                    counts.append(sum(bench.device.counters.faults.values()))
            await link.close()
        assert max(after - before for before, after in pairwise(counts)) <= 86

    in_loop(scenario())


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (WireFault(drop=1.0), 0),
        (WireFault(split=3, gap_s=0.0), 4),
        (WireFault(junk=1.0), 2),
        (WireFault(corrupt=1.0), 1),
        (WireFault(delay_s=0.01), 0),
    ],
)
def test_wire_faults_damage_outgoing_bytes(bench, settings, expected):
    async def scenario():
        linked = await Linked(bench).start()
        linked.uart.arrive(CUBESPACE.encode_request(Request.of(128)))
        (good,) = linked.uart.take()
        bench.device.clock.set_ns(bench.device.clock.now_ns())
        linked.serial.wire.settings = settings
        linked.uart.arrive(CUBESPACE.encode_request(Request.of(128)))
        sent = linked.uart.take()
        assert len(sent) == expected
        if settings.corrupt:
            assert sum((a ^ b).bit_count() for a, b in zip(sent[0], good, strict=True)) == 1
        if settings.split:
            assert b"".join(sent) == good
        if settings.delay_s:
            bench.step(settings.delay_s / 2)
            assert linked.uart.take() == []
            bench.step(settings.delay_s / 2)
            assert linked.uart.take() == [good]
        linked.serial.wire.settings = WireFault()
        assert linked.over_serial(128)[0].kind is ReplyKind.TELEMETRY

    in_loop(scenario())


def test_pieces_of_one_reply_are_not_mixed_with_those_of_the_next():
    clock, scheduler, sent = SteppedClock(), Scheduler(), []
    wire = WireFaults(
        lambda item: sent.append((clock.now_ns() / 1e9, item)), SerialDamage(), clock, scheduler, 1
    )
    wire.settings = WireFault(split=2, gap_s=0.5)
    wire.send(b"abcd")
    wire.send(b"efg")
    wire.settings = WireFault(delay_s=0.25)
    wire.send(b"hi")
    wire.settings = WireFault()
    wire.send(b"jk")
    while (event := scheduler.pop_due(10**10)) is not None:
        clock.set_ns(event.due_ns)
        event.action(event.due_ns)
    assert sent == [
        (0.0, b"ab"), (0.5, b"cd"), (1.0, b"ef"), (1.5, b"g"), (2.0, b"hi"), (2.0, b"jk"),
    ]  # fmt: skip
    wire.send(b"l")
    assert sent[-1] == (2.0, b"l")


def test_of_what_a_delay_holds_back_the_oldest_is_kept_up_to_a_limit():
    clock, scheduler, sent = SteppedClock(), Scheduler(), []
    wire = WireFaults(sent.append, SerialDamage(), clock, scheduler, 1)
    wire.settings = WireFault(delay_s=60.0)
    for number in range(MAX_DELAYED + 5):
        wire.send(number.to_bytes(4, "big"))
    while (event := scheduler.pop_due(10**11)) is not None:
        clock.set_ns(event.due_ns)
        event.action(event.due_ns)
    assert sent == [number.to_bytes(4, "big") for number in range(MAX_DELAYED)]


def test_frames_beyond_a_limit_do_not_wait_for_the_gap_between_frames(bench):
    async def scenario():
        bus = Wire()
        link = CanLink(bench.requests, bus, frame_gap_s=0.5)
        await link.start()
        frames = encode_request_frames(Request.of(128), 1, 4)
        for _ in range(QUEUE_LIMIT + 50):
            for frame in frames:
                bus.arrive(frame)
        assert len(link._waiting) == QUEUE_LIMIT
        assert bus.statistics.dropped > 0
        await link.close()

    in_loop(scenario())


def test_can_faults_lose_frames_and_the_host_notices(bench):
    async def scenario():
        linked = await Linked(bench).start()
        linked.can.wire.settings = WireFault(drop=0.3)
        answers = [linked.over_can(211) for _ in range(20)]
        whole = [a for a in answers if a and isinstance(a[-1], Reply)]
        assert len(whole) < 20
        linked.can.wire.settings = WireFault()
        assert len(linked.over_can(211)[0].data) == 54

    in_loop(scenario())


def test_the_same_commands_give_the_same_bytes(make_bench):
    """Seed, configuration and commands decide every byte on the stepped clock."""

    def run() -> bytes:
        out = bytearray()

        async def scenario():
            bench = make_bench().start()
            linked = await Linked(bench, "c").start()
            for identifier, data in (
                (2, bytes(6)),
                (97, b"\x00\x00\xa0\x40"),
                (96, b"\x02"),
                (104, b"\xa0\x00\x00\x80\x40"),
            ):
                linked.uart.arrive(CUBESPACE.encode_request(Request.of(identifier, data)))
            for _ in range(12):
                bench.step(0.137)
                for row in bench.icd.telemetry.values():
                    linked.uart.arrive(CUBESPACE.encode_request(Request.of(row.id)))
                    for frame in encode_request_frames(Request.of(row.id), 1, 4):
                        linked.bus.arrive(frame)
                out.extend(b"".join(linked.uart.take()))
                for frame in linked.bus.take():
                    out.extend(frame.id.to_bytes(4, "little") + frame.data)

        in_loop(scenario())
        return bytes(out)

    first = run()
    assert len(first) > 4000
    assert first == run()


def test_an_incomplete_message_is_abandoned_after_the_timeout_of_the_unit(bench):
    async def scenario():
        serial = bench.icd.link.serial.model_copy(update={"timeout": 0.1})
        bench.device.icd = replace(bench.icd, link=bench.icd.link.model_copy(update={"serial": serial}))
        linked = await Linked(bench).start()
        linked.uart.arrive(b"\x1f\x7f\x80")
        bench.step(0.1)
        assert bench.device.counters.flags == set()
        bench.step(0.02)
        assert bench.device.counters.flags == {"uart_incomplete"}
        await linked.serial.close()
        await linked.can.close()

    in_loop(scenario())
