"""Two emulators cannot start with one address on a bus; other nodes with that address are reported."""

import asyncio
import logging
import os

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.bus_address import BusAddress
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.canopen import CanopenLink
from starhil.emulator.links.name_lock import LockError
from starhil.protocol.can.cubespace import CanId, MessageType, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import Request
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.hub import CanHub
from tests.emulator.wire import Wire

BUS = "socketcand:127.0.0.1:1/test-of-addresses"
REQUEST = encode_request_frames(Request.of(128), 1, 4)[0]
REPLY = CanFrame(CanId(MessageType.TELEMETRY, 128, 4, 1).pack(), bytes(8))


def clashes(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_an_address_is_rejected_while_another_uses_it_and_free_afterwards(caplog):
    first, second = (BusAddress("address", "links.can.address") for _ in range(2))
    first.acquire(BUS, 4)
    second.acquire(BUS, 5)
    with pytest.raises(EmulatorError) as refused:
        second.acquire(BUS, 4)
    text = str(refused.value)
    assert text.startswith(f"CAN {BUS}: address 4: in use by another emulator, process {os.getpid()}; ")
    assert "--set links.can.address=5" in text
    assert "starhil hub --port 0" in text
    first.release()
    second.acquire(BUS, 4)
    second.release()
    assert clashes(caplog) == []


def test_an_address_changed_in_operation_is_reported_while_another_uses_it(caplog):
    first, second = (BusAddress("address", "links.can.address") for _ in range(2))
    first.acquire(BUS, 4)
    second.acquire(BUS, 5)
    second.change(BUS, 4)
    [text] = clashes(caplog)
    assert text.startswith(f"CAN {BUS}: address 4: in use by another emulator, process {os.getpid()}; ")
    second.release()
    first.release()


def test_an_address_that_the_system_cannot_lock_is_reported_and_used(caplog, monkeypatch):
    def refuse(*_):
        raise LockError("cannot be locked (Operation not permitted)")

    monkeypatch.setattr("starhil.emulator.links.bus_address.lock_name", refuse)
    address = BusAddress("address", "links.can.address")
    address.acquire(BUS, 4)
    assert clashes(caplog) == [f"CAN {BUS}: address 4: cannot be locked (Operation not permitted)"]
    assert address.number == 4


@pytest.mark.parametrize(("bus", "number"), [("virtual:pair", 4), (BUS, 0)])
def test_a_bus_of_one_process_and_a_node_that_is_off_have_no_clash(bus, number, caplog):
    addresses = [BusAddress("node", "links.canopen.node") for _ in range(2)]
    for address in addresses:
        address.acquire(bus, number)
    for address in addresses:
        address.release()
    assert clashes(caplog) == []


@pytest.mark.parametrize(
    ("kind", "remedy"), [(CanLink, "--set links.can.address=5"), (CanopenLink, "--set links.canopen.node=")]
)
def test_a_second_device_on_a_bus_is_rejected_at_its_start(kind, remedy, bench):
    async def main():
        hub = CanHub(port=0)
        await hub.start()
        if kind is CanopenLink:
            bench.device.parameters.set({"canopen_node": 44})
        links = [kind(bench.requests, open_can(f"socketcand:127.0.0.1:{hub.port}/vcan0")) for _ in range(2)]
        await links[0].start()
        with pytest.raises(EmulatorError, match=remedy):
            await links[1].start()
        for link in links:
            await link.close()
        await hub.close()

    asyncio.run(main())


def test_a_frame_from_a_node_of_the_same_address_is_reported_once(bench, caplog):
    async def main():
        bus = Wire()
        link = CanLink(bench.requests, bus)
        await link.start()
        caplog.clear()
        bus.arrive(REQUEST)
        assert clashes(caplog) == []
        for _ in range(3):
            bus.arrive(REPLY)
        [text] = clashes(caplog)
        assert "address 4: also used by another node" in text
        assert "--set links.can.address=5" in text
        await link.close()

    asyncio.run(main())
