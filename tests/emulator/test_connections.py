"""Peers that open many connections, or send half a request, do not hold up the run or fill the log."""

import asyncio
import errno
import logging
import resource
import socket
import subprocess
import sys

import aiohttp
import pytest

from starhil.emulator.console import server
from starhil.emulator.launch import RunOptions
from starhil.emulator.simulation.guard import log_loop_errors_once
from starhil.protocol.transports import connections
from starhil.protocol.transports.hub import CanHub
from tests.emulator.console.pages import OPTIONS
from tests.emulator.runs import Control
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.long

DESCRIPTORS = 128
CONNECTIONS = 130

FLOOD = f"""
import socket, sys
port, begin = int(sys.argv[1]), sys.argv[2].encode()
peers = [socket.create_connection(("127.0.0.1", port), timeout={PATIENCE_S}) for _ in range({CONNECTIONS})]
for peer in peers:
    try:
        peer.sendall(begin)
    except ConnectionError:
        pass
print("connected", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def few_descriptors():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def flood(port, begin):
    """Hold many connections with the begin of a request from another process."""

    def many_descriptors():
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))

    command = [sys.executable, "-c", FLOOD, str(port), begin]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen(command, preexec_fn=many_descriptors, **pipes)


async def flooded(port, begin, check):
    """Call `check` while the connections are held."""
    peers = flood(port, begin)
    try:
        async with asyncio.timeout(PATIENCE_S):
            assert await asyncio.to_thread(peers.stdout.readline) == b"connected\n"
        await check()
    finally:
        await asyncio.to_thread(peers.communicate)


def view_port(emulation):
    return int(emulation.ready_fields["view"].split("/")[2].rpartition(":")[2])


async def until_full(caplog):
    """Wait until the limit of connections has been reached."""
    await until(lambda: "16 connections are open" in caplog.text)


async def answers(control):
    """Whether the control channel answers; a server without a limit runs out of descriptors, and never would."""
    async with asyncio.timeout(PATIENCE_S):
        return (await control.do("status"))["ok"]


@pytest.mark.process
def test_half_sent_requests_on_many_connections_leave_the_control_channel_free(run, few_descriptors, caplog):
    async def scenario(emulation, _line):
        async def check():
            await until_full(caplog)
            async with Control(emulation) as control:
                assert await answers(control)

        log_loop_errors_once(asyncio.get_running_loop())
        await flooded(view_port(emulation), "GET / HTTP/1.1\r\nHost: x\r\n", check)

    run(scenario, options=OPTIONS)
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == [
        "console: 16 connections are open, the maximum; further ones are closed, and not logged again"
    ]


@pytest.mark.process
def test_many_connections_to_the_control_channel_leave_an_open_one_and_the_console_free(
    run, few_descriptors, caplog
):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:

            async def check():
                await until_full(caplog)
                assert await answers(control)
                async with Control(emulation) as another:
                    assert await another.do("status") == {
                        "ok": False,
                        "error": "too many connections to the control channel; close others first",
                    }
                async with aiohttp.request("GET", emulation.ready_fields["view"]) as page:
                    assert page.status == 200

            assert await answers(control)
            port = int(emulation.ready_fields["control"].rpartition(":")[2])
            await flooded(port, '{"do": ', check)

    run(scenario, options=RunOptions(control="127.0.0.1:0", console=OPTIONS.console))
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == [
        "control channel: 16 connections are open, the maximum; further ones are closed, and not logged again"
    ]


@pytest.mark.parametrize("server_", ["console", "control channel"])
def test_a_peer_that_does_not_read_loses_its_connection(run, monkeypatch, server_):
    monkeypatch.setattr(connections, "UNREAD_LIMIT_MS", 300)

    async def scenario(emulation, _line):
        address = emulation.ready_fields["control"]
        port = view_port(emulation) if server_ == "console" else int(address.rpartition(":")[2])
        questions = {
            "console": b"GET /static/vendor/uPlot.esm.js HTTP/1.1\r\nHost: x\r\n\r\n",
            "control channel": b'{"do": "status"}\n',
        }[server_]
        with socket.socket() as peer:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.settimeout(0.0)
            loop = asyncio.get_running_loop()
            await loop.sock_connect(peer, ("127.0.0.1", port))

            async def ask_without_end():
                while True:
                    await loop.sock_sendall(peer, questions)

            with pytest.raises(ConnectionError):  # once the server has closed
                await asyncio.wait_for(ask_without_end(), PATIENCE_S)

    run(scenario, options=RunOptions(control="127.0.0.1:0", console=OPTIONS.console))


@pytest.mark.process
def test_with_a_token_peers_that_have_not_shown_it_leave_room_for_others(run, few_descriptors):
    options = RunOptions(control="127.0.0.1:0", control_token="secret")

    async def scenario(emulation, _line):
        async with Control(emulation) as first:

            async def check():
                async with Control(emulation) as another:
                    for control in (first, another):
                        assert (await control.do("status", token="secret"))["ok"]

            assert (await first.do("status", token="secret"))["ok"]
            await flooded(int(emulation.ready_fields["control"].rpartition(":")[2]), "", check)

    run(scenario, options=options)


@pytest.mark.process
def test_a_hub_rejects_clients_above_its_limit_and_serves_the_others(few_descriptors):
    async def main():
        hub = CanHub(port=0)
        await hub.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", hub.port)
        assert await reader.readexactly(6) == b"< hi >"

        async def check():
            await until(lambda: len(hub.clients) >= 16)
            writer.write(b"< echo >")
            assert await asyncio.wait_for(reader.readexactly(8), PATIENCE_S) == b"< echo >"
            assert len(hub.clients) == 16

        try:
            await flooded(hub.port, "< open", check)
            await until(lambda: len(hub.clients) <= 1)
        finally:
            writer.close()
            await hub.close()

    asyncio.run(main())


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        ("", b""),
        ("GET / HTTP/1.1\r\nHost: x\r\n", b""),
        ("POST /runs?{} HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n{{", b"HTTP/1.1 408"),
    ],
    ids=["nothing", "headers", "body"],
)
def test_a_half_sent_request_is_closed_after_a_time(run, monkeypatch, begin, end):
    monkeypatch.setattr(server, "REQUEST_S", 0.3)

    async def scenario(emulation, _line):
        reader, writer = await asyncio.open_connection("127.0.0.1", view_port(emulation))
        writer.write(begin.format(emulation.ready_fields["view"].partition("?")[2]).encode())
        answer = await asyncio.wait_for(reader.read(), PATIENCE_S)
        assert answer.startswith(end)
        assert bool(answer) == bool(end)
        writer.close()

    run(scenario, options=OPTIONS)


def test_an_error_of_the_event_loop_is_logged_once(caplog):
    async def main():
        loop = asyncio.get_running_loop()
        log_loop_errors_once(loop)
        full = OSError(errno.EMFILE, "Too many open files")
        for _ in range(100):
            loop.call_exception_handler(
                {"message": "socket.accept() out of system resource", "exception": full}
            )
        loop.call_exception_handler({"message": "another"})

    asyncio.run(main())
    assert [record.getMessage() for record in caplog.records] == [
        "event loop: socket.accept() out of system resource: OSError: [Errno 24] Too many open files",
        "event loop: another",
    ]


@pytest.mark.parametrize(
    "request_", [b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\nA B: c\r\n\r\n", b"GET /" + bytes(9000)]
)
def test_a_request_that_is_not_http_is_answered_and_not_logged(run, caplog, request_):
    async def scenario(emulation, _line):
        reader, writer = await asyncio.open_connection("127.0.0.1", view_port(emulation))
        writer.write(request_)
        # the line only: the connection is reset after it if some of the request has not been read
        assert (await asyncio.wait_for(reader.readline(), PATIENCE_S)).startswith(b"HTTP/1.0 400 ")
        writer.close()

    run(scenario, options=OPTIONS)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_an_internal_error_of_the_console_is_logged(run, caplog, monkeypatch):
    async def fail(_request):
        raise KeyError("stars")

    monkeypatch.setattr(server, "_page", fail)

    async def scenario(emulation, _line):
        async with aiohttp.request("GET", emulation.ready_fields["view"]) as page:
            assert page.status == 500

    run(scenario, options=OPTIONS)
    assert [record.levelno for record in caplog.records if record.levelno >= logging.WARNING] == [
        logging.ERROR
    ]


def test_a_request_with_more_headers_than_a_browser_sends_is_rejected(run):
    async def scenario(emulation, _line):
        address = emulation.ready_fields["view"]
        async with aiohttp.ClientSession() as session:
            for count, status in ((40, 200), (70, 400)):
                headers = {f"X-{number}": "x" for number in range(count)}
                async with session.get(address, headers=headers) as answer:
                    assert answer.status == status

    run(scenario, options=OPTIONS)
