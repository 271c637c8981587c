"""Requests in pieces, damage that changes a byte, and addresses that change while a link is open."""

import asyncio
import random

import pytest

from starhil.emulator.launch.simulated_loop import SimulatedLoop
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.canopen import CanopenLink
from starhil.emulator.links.serial import JUNK_BYTES, SerialDamage, SerialLink
from starhil.emulator.links.wire_faults import WireFault, WireFaults
from starhil.emulator.sensor.pipeline.messages import ImageRequest, ImageResult
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.simulation.scheduler import Scheduler
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.storage import ParameterStorage, StorageError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.serial.stack import SerialStack
from tests.emulator.wire import Wire
from tests.protocol.serial.composed_links import CUBESPACE

NODE = 44


def test_junk_is_a_few_random_bytes():
    rng = random.Random(1)
    sizes = {len(SerialDamage().junk(rng)) for _ in range(200)}
    assert sizes == set(range(1, JUNK_BYTES + 1))


def test_damage_changes_every_byte_string():
    rng = random.Random(1)
    assert all(
        SerialDamage().corrupt(item, rng) != item for item in (b"\xff" * 8, b"\x00" * 8) for _ in range(50)
    )


def test_each_corrupted_item_differs_in_one_bit_and_is_shown_as_it_is_sent():
    sent, received = [], []
    clock = SteppedClock()
    faults = WireFaults(sent.append, SerialDamage(), clock, Scheduler(), seed=1)
    faults.listener = received.append
    faults.settings = WireFault(corrupt=1.0)
    for _ in range(3):
        faults.send(bytes(4))
    assert [int.from_bytes(item).bit_count() for item in sent] == [1, 1, 1]
    assert received == sent
    assert len(sent) == 3


def test_a_request_in_two_pieces_is_answered(bench):
    async def scenario():
        uart = Wire()
        link = SerialLink(bench.requests, uart)
        await link.start()
        data = SerialStack(bench.icd).encode_request(Request.of(128))
        uart.arrive(data[:2])
        bench.step(0.01)
        uart.arrive(data[2:])
        assert uart.take()
        await link.close()

    asyncio.run(scenario())


def test_a_new_can_address_is_that_under_which_the_unit_is_seen(bench, caplog):
    async def scenario():
        bus = Wire()
        link = CanLink(bench.requests, bus)
        await link.start()
        bench.device.parameters.set({"can_address": 9})
        caplog.clear()
        bus.arrive(CanFrame(5 << 24 | 128 << 16 | 9 << 8 | 1, bytes(8)))  # telemetry from 9 to 1
        assert "address 9: also used by another node" in caplog.text
        await link.close()

    asyncio.run(scenario())


def canopen_link(bench, test, storage=None):
    async def scenario():
        bus = Wire()
        link = CanopenLink(bench.requests, bus, storage)
        await link.start()
        test(bus)
        await link.close()

    asyncio.run(scenario())


@pytest.fixture
def node_bench(make_bench):
    bench = make_bench().start()
    bench.device.parameters.set({"canopen_node": NODE})
    return bench


def test_a_reset_of_the_node_takes_over_the_stored_node_id(node_bench):
    def test(bus):
        node_bench.device.parameters.set({"canopen_node": 50})
        node_bench.command("save_parameters")
        bus.take()
        bus.arrive(CanFrame(0, bytes((0x81, NODE)), extended=False))
        assert [frame.id for frame in bus.take() if frame.data == b"\0"] == [0x700 + 50]

    canopen_link(node_bench, test)


def test_a_restart_of_the_device_after_a_reset_of_the_node_boots_the_node(node_bench):
    node_bench.command("save_parameters")

    def test(bus):
        bus.arrive(CanFrame(0, bytes((0x81, NODE)), extended=False))
        bus.take()
        node_bench.device.reset("watchdog")
        assert [frame.id for frame in bus.take() if frame.data == b"\0"] == [0x700 + NODE]

    canopen_link(node_bench, test)


def test_another_parameter_leaves_the_node_id_that_lss_stored(node_bench):
    storage = ParameterStorage()
    storage.save("lss", {"node_id": b"\x30", "bit_rate": (1_000_000).to_bytes(4, "little")})

    def test(_bus):
        node_bench.device.parameters.set({"exposure": 150})
        assert storage.load("lss")["node_id"] == b"\x30"

    canopen_link(node_bench, test, storage)


def test_a_stored_node_id_that_cannot_be_deleted_is_a_fault_of_the_store(node_bench, caplog):
    class Kept(ParameterStorage):
        def clear(self, group):
            raise StorageError(f"{group}: read-only")

    def test(_bus):
        caplog.clear()
        node_bench.device.parameters.set({"canopen_node": 50})
        assert "lss: read-only" in caplog.text

    canopen_link(node_bench, test, Kept())


def test_a_rate_that_is_set_back_before_the_acknowledge_is_sent_is_no_change(bench, monkeypatch):
    async def scenario():
        uart = Wire()
        link = SerialLink(bench.requests, uart)
        await link.start()
        before = bench.device.parameters["serial_baud"]

        def set_twice(_request, *, console):
            for baud in (57600, before):
                bench.device.parameters.set({"serial_baud": baud})
            return [Reply(ReplyKind.ACK, 98)]

        with monkeypatch.context() as context:
            context.setattr(bench.requests, "handle", set_twice)
            uart.arrive(CUBESPACE.encode_request(Request.of(98)))
        assert uart.take() == [b"\x1f\x7f\x00\x1f\xff"]
        bench.device.parameters.set({"serial_baud": 57600})
        assert uart.take() == [57600]
        await link.close()

    asyncio.run(scenario())


def test_after_a_gap_without_frames_the_next_one_is_sent_at_once(bench):
    async def scenario():
        bus = Wire()
        link = CanLink(bench.requests, bus, frame_gap_s=0.001)
        await link.start()
        for _ in range(2):
            bus.arrive(CanFrame(4 << 24 | 128 << 16 | 1 << 8 | 4))
            assert len(bus.take()) == 1
            await asyncio.sleep(0.02)
        await link.close()

    loop = SimulatedLoop()
    loop.run_until_complete(scenario())
    loop.close()


def test_stored_parameters_that_cannot_be_read_are_a_fault_of_the_store(make_bench, caplog):
    class Unreadable(ParameterStorage):
        def load(self, group):
            raise StorageError(f"{group}: damaged")

    bench = make_bench().start()
    canopen_link(bench, lambda _bus: None, Unreadable())
    assert "damaged" in caplog.text


def test_an_object_that_cannot_be_read_aborts_and_is_logged(node_bench, caplog):
    def fail():
        raise ProtocolError("no such value")

    async def scenario():
        bus = Wire()
        link = CanopenLink(node_bench.requests, bus)
        await link.start()
        link.slave.dictionary.find(0x6001, 1).reader = fail
        bus.take()
        bus.arrive(CanFrame(0x600 + NODE, bytes.fromhex("4001600100000000"), extended=False))
        assert [frame.data.hex() for frame in bus.take()] == ["8001600100000008"]
        await link.close()

    asyncio.run(scenario())
    assert "SDO 6001h:01h: no such value" in caplog.text


def test_an_image_that_the_pipeline_does_not_have_is_a_hardware_error(node_bench, monkeypatch):
    imager = node_bench.device.images._imager
    submit = imager.submit

    def without_image(request, done):
        if isinstance(request, ImageRequest):
            done(ImageResult(0, 0, -1, b""))
        else:
            submit(request, done)

    monkeypatch.setattr(imager, "submit", without_image)

    def test(bus):
        bus.take()
        bus.arrive(CanFrame(0x600 + NODE, bytes.fromhex("2f40600501000000"), extended=False))
        node_bench.step(5.0)
        answers = [frame.data.hex() for frame in bus.take() if frame.id == 0x580 + NODE]
        assert answers == ["8040600500000606"]

    canopen_link(node_bench, test)
