"""The benchmark of latency: what it takes for a reply, what it counts as lost, and how it is summarised."""

import asyncio
import math
import signal

import pytest
from aiohttp import web

from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, SerialHostLink
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.private_can_bus import hub_thread
from starhil.hil_tests.timing import latency
from starhil.hil_tests.timing.console_viewer import ROWS, view
from starhil.hil_tests.timing.latency import Echo, Viewers, ask_in_turn, exchange, measure
from starhil.protocol.messages import ErrorCode
from starhil.protocol.unit import load_unit
from tests.hil_tests.fake_device import FakeDevice

pytestmark = pytest.mark.long

ICD = load_unit()
ROW = ICD.telemetry["quaternion"]


@pytest.fixture
def device():
    with FakeDevice() as fake:
        yield fake


@pytest.fixture
def processes(monkeypatch, device, hub):
    """Replace the processes of a measurement by a canned device; return their command lines and the viewers."""
    bus = device.open_can(hub)
    ready = {"serial": device.open_serial(), "can": bus, "view": "http://console/?token=x"}
    started, viewers = [], []

    class Process:
        def __init__(self, command):
            started.append(command)
            self.ready = {"can": bus} if "hub" in command else ready

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def memory_bytes(self):
            return len(started) << 20

    class Watching:
        def __init__(self, address, count):
            viewers.append((address, count))

        def close(self):
            viewers.append("closed")

    monkeypatch.setattr(latency, "EmulatorProcess", Process)
    monkeypatch.setattr(latency, "Viewers", Watching)
    monkeypatch.setattr(latency, "SETTLE_S", 0.0)
    return ready, started, viewers


@pytest.mark.process
def test_each_link_is_measured_at_each_rate_without_and_with_viewers(processes):
    _, started, viewers = processes
    lines = []
    rows, process = measure("cubestar", [0.0, 5.0], 0.2, "thread", lines.append, viewers=2)
    links = ("serial", "can", "echo")
    assert [(row.update_rate_hz, row.viewers, row.link) for row in rows] == [
        (rate, count, link) for rate in (0.0, 5.0) for count in (0, 2) for link in links
    ]
    assert lines == ["thread: 0 Hz", "thread: 5 Hz"]
    for row in rows:
        assert (row.worker, row.lost) == ("thread", 0)
        assert row.requests > 0
        assert 0.0 < row.p50_ms <= row.p99_ms <= row.max_ms
    assert process.memory_mb == 4.0  # the larger of both emulators
    standby, moving = (" ".join(map(str, started[number])) for number in (1, 3))
    assert "start_mode=standby" in standby
    assert "update_rate=5.0" in moving
    assert "--view auto" in moving
    alternating = [("http://console/?token=x", 0), "closed", ("http://console/?token=x", 2), "closed"]
    assert viewers == 2 * latency.PAIRS * alternating


def test_requests_without_a_reply_are_lost_and_have_no_latency(processes, device, monkeypatch):
    monkeypatch.setattr(latency, "REPLY_WITHIN_S", 0.02)
    device.mute = 1_000_000
    rows, _ = measure("cubestar", [0.0], 0.1, "thread")
    serial, can, echo = rows
    assert serial.lost > 0
    assert can.lost == serial.lost == echo.requests + echo.lost
    assert math.isnan(serial.p50_ms)


@pytest.mark.parametrize(("without", "links"), [("can", ["serial", "echo"]), ("serial", None)])
def test_only_links_that_the_emulator_has_are_measured(processes, without, links):
    del processes[0][without]
    if links is None:
        with pytest.raises(BenchError, match=f"unit {ICD.name} has no serial link to measure"):
            measure("cubestar", [0.0], 0.05, "thread")
    else:
        assert [row.link for row in measure("cubestar", [0.0], 0.05, "thread")[0]] == links


def test_a_refusal_has_a_latency_but_no_reply(device):
    device.refuse[ROW.name] = ErrorCode.BUSY

    async def main():
        client = AsyncObcClient(SerialHostLink(ICD, device.open_serial()), ICD)
        await client.start()
        latency, reply = await exchange(client, ICD.request(ROW), ROW.name)
        await client.close()
        assert (0.0 < latency < math.inf, reply) == (True, None)

    asyncio.run(main())


def test_requests_on_a_lost_bus_have_no_reply():
    async def main():
        with hub_thread() as channel:
            client = AsyncObcClient(CanHostLink(channel), ICD, timeout_s=0.02)
            await client.start()
        for _ in range(2):
            assert await exchange(client, ICD.request(ROW), ROW.name) == (math.inf, None)
        await client.close()

    asyncio.run(main())


def test_an_echo_that_does_not_come_is_infinite(monkeypatch):
    async def main():
        echo = Echo(ICD)
        await echo.start()
        assert 0.0 < await echo.ask(ROW) < math.inf
        echo._process.send_signal(signal.SIGSTOP)
        monkeypatch.setattr(latency, "REPLY_WITHIN_S", 0.02)
        assert await echo.ask(ROW) == math.inf
        await echo.close()

    asyncio.run(main())


def test_peers_are_asked_in_turn_with_the_same_rows():
    rows = []

    def peer(name):
        async def ask(row):
            rows.append((name, row))
            return float(len(rows))

        return ask

    found = asyncio.run(ask_in_turn({"one": peer("one"), "two": peer("two")}, ["a", "b", "c"], 0.1))
    assert rows[:8] == [(name, row) for row in "abca" for name in ("one", "two")]
    assert found["one"][:4] == [1.0, 3.0, 5.0, 7.0]
    assert len(found["one"]) == len(found["two"]) == len(rows) / 2


def test_viewers_end_with_the_measurement():
    viewers = Viewers("http://127.0.0.1:1/?token=x", 2)
    viewers.close()
    assert [process.poll() is not None for process in viewers._processes] == [True, True]


def test_a_viewer_subscribes_as_a_page_and_reads_until_the_console_ends():
    commands = []

    async def serve(request):
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        commands.append((request.query["token"], await socket.receive_json()))
        await socket.send_str("{}")
        await socket.send_bytes(bytes(100))
        await socket.close()
        return socket

    async def main():
        app = web.Application()
        app.router.add_get("/ws", serve)
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        port = site._server.sockets[0].getsockname()[1]
        await view(f"http://127.0.0.1:{port}/?token=abc")
        await runner.cleanup()

    asyncio.run(main())
    assert commands == [("abc", {"id": 1, "do": "subscribe", "frames": True, "rows": list(ROWS)})]
