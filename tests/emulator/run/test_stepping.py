"""Steps of the stepped clock on a real port: nothing is lost however long they are, and the bus is served between events."""

import asyncio
import os
import threading
import time

import pytest

from starhil.protocol.messages import Request
from tests.protocol.serial.composed_links import CUBESPACE
from tests.waiting import until

pytestmark = pytest.mark.long

STEP_S = 12.0
PEER_BYTES_S = 300_000.0
"""How fast the peer reads, bytes a second: slower than a step sends that does not wait."""

ROW = 211
RATE_HZ = 100.0
SETTINGS = {
    "links": {"serial": {"port": "auto", "dialect": "c"}, "can": {"channel": "off"}},
    "parameters": {"unsolicited_selection": ROW, "unsolicited_rate": RATE_HZ},
}


class Peer:
    """Reads a port in its own thread, slowly."""

    def __init__(self, path):
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.data = bytearray()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        try:
            while part := os.read(self.fd, 4096):
                self.data += part
                time.sleep(len(part) / PEER_BYTES_S)
        except OSError:
            return


@pytest.fixture
def long_step(run):
    """Make a long step with a peer that reads; return the bytes that reach it, and how often the loop came around."""

    def long_step():
        async def scenario(emulation, line):
            peer = Peer(emulation.ready_fields["serial"])
            turns = 0

            async def count():
                nonlocal turns
                while True:
                    turns += 1
                    await asyncio.sleep(0)

            counting = asyncio.create_task(count())
            await emulation.stepper.step(STEP_S)
            counting.cancel()
            statistics = emulation.links["serial"].transport.statistics
            assert statistics.dropped == 0
            await until(lambda: len(peer.data) >= statistics.sent)
            return bytes(peer.data), turns

        return run(scenario, **SETTINGS)

    return long_step


def test_a_long_step_loses_no_byte_and_gives_the_same_ones_again(long_step):
    (first, turns), (second, _) = long_step(), long_step()
    assert len(first) > STEP_S * RATE_HZ * 20
    assert first == second
    assert turns > STEP_S * RATE_HZ


def test_a_request_is_answered_in_the_middle_of_a_long_step(run):
    async def scenario(emulation, _line):
        peer = Peer(emulation.ready_fields["serial"])
        stepping = asyncio.create_task(emulation.stepper.step(STEP_S))
        asked = emulation.device.counters.telemetry
        os.write(peer.fd, CUBESPACE.encode_request(Request.of(128)))
        while emulation.device.counters.telemetry == asked:
            assert not stepping.done()
            await asyncio.sleep(0)
        await stepping

    run(scenario, **SETTINGS)


def test_a_peer_that_does_not_read_is_waited_for_once_and_then_again_when_it_reads(run, monkeypatch, caplog):
    monkeypatch.setattr("starhil.emulator.run.pump.PEER_PATIENCE_S", 0.05)

    async def scenario(emulation, _line):
        statistics = emulation.links["serial"].transport.statistics
        os.open(emulation.ready_fields["serial"], os.O_RDWR | os.O_NOCTTY)  # a peer that reads nothing
        await emulation.stepper.step(STEP_S)
        await emulation.stepper.step(STEP_S)
        assert statistics.dropped > 0
        assert caplog.text.count("does not read") == 1
        peer = Peer(emulation.ready_fields["serial"])
        await emulation.links["serial"].transport.drain()
        dropped = statistics.dropped
        await emulation.stepper.step(STEP_S)
        assert statistics.dropped == dropped
        await until(lambda: len(peer.data) >= statistics.sent)

    run(scenario, **SETTINGS)


def test_wire_delays_use_simulation_time(run):
    async def scenario(emulation, _line):
        peer = Peer(emulation.ready_fields["serial"])
        emulation.links["serial"].wire.settings = type(emulation.links["serial"].wire.settings)(delay_s=5.0)
        os.write(peer.fd, CUBESPACE.encode_request(Request.of(128)))
        await until(lambda: emulation.device.counters.telemetry != 0)
        await emulation.stepper.step(4.9)
        assert emulation.links["serial"].transport.statistics.sent == 0
        await emulation.stepper.step(0.2)
        assert emulation.links["serial"].transport.statistics.sent > 0

    run(scenario)
