"""The client of the control channel: requests, rejections, a channel that ends, and the reset to power-on."""

from __future__ import annotations

import json
import socket
import socketserver
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig import control
from starhil.hil_tests.rig.control import ControlClient, Truth
from starhil.protocol.icd.conventions import Conventions

pytestmark = pytest.mark.long

Answer = Callable[[dict], dict | bytes | None]


@pytest.fixture
def channel():
    """Serve clients over TCP, or on a Unix socket; return the list of requests, which a function answers, and the address.

    The answer None closes the connection.
    """
    with ExitStack() as servers:

        def serve(answer: Answer, path: Path | None = None) -> tuple[list[dict], str]:
            requests: list[dict] = []

            class Handler(socketserver.StreamRequestHandler):
                def handle(self) -> None:
                    for line in self.rfile:
                        requests.append(json.loads(line))
                        if (reply := answer(requests[-1])) is None:
                            return
                        text = reply if isinstance(reply, bytes) else json.dumps(reply).encode()
                        self.wfile.write(text + b"\n")

            server: socketserver.BaseServer
            if path is None:
                server = socketserver.TCPServer(("127.0.0.1", 0), Handler)
                address = f"127.0.0.1:{server.server_address[1]}"
            else:
                server, address = socketserver.UnixStreamServer(str(path), Handler), f"unix:{path}"
            servers.enter_context(server)
            thread = threading.Thread(target=server.serve_forever, args=(0.01,))
            thread.start()
            servers.callback(thread.join)
            servers.callback(server.shutdown)
            return requests, address

        yield serve


def test_a_request_is_a_line_and_its_answer_is_returned_without_its_flag(channel):
    asked, address = channel(lambda _request: {"ok": True, "mode": "standby"})
    with ControlClient(address) as client:
        assert client.do("status", of=1) == {"mode": "standby"}
    assert asked == [{"do": "status", "of": 1}]


def test_a_channel_on_a_socket_in_a_folder_is_used(channel, tmp_path):
    _, address = channel(
        lambda _request: {"ok": True, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}, tmp_path / "control"
    )
    with ControlClient(address) as client:
        assert Truth(client, Conventions()).attitude() == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"ok": False, "error": "no such fault"}, "control channel: fault: no such fault"),
        (None, "control channel: fault: closed by the emulator"),
    ],
)
def test_a_rejection_and_the_end_of_the_channel_are_reported(channel, answer, message):
    _, address = channel(lambda _request: answer)
    with ControlClient(address) as client, pytest.raises(BenchError, match=message):
        client.do("fault")


@pytest.mark.parametrize(
    "answer",
    [
        b"HTTP/1.1 400 Bad Request",
        b"< hi >",
        b"{}",
        b"[]",
        b"5",
        b"null",
        b'{"ok": true}',
        b'{"ok": false}',
        b'{"ok": 1, "mode": 2',
        b"{\xff}",
        b'{"ok":' * 100_000,
    ],
    ids=lambda answer: answer[:20],
)
def test_a_peer_that_is_no_control_channel_is_reported_in_one_line(channel, answer):
    """The address of the console in its place ended in a traceback."""
    _, address = channel(lambda _request: answer)
    with ControlClient(address) as client, pytest.raises(BenchError) as refusal:
        assert client.do("status")["clock"]
    assert str(refusal.value) == (
        f"control channel: status: {address} does not answer as an emulator; give the address `control=` of its ready line"
    )


def test_a_peer_that_sends_no_end_of_a_line_is_given_up_at_once_or_in_time(channel, monkeypatch):
    monkeypatch.setattr(control, "ANSWER_WITHIN_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        for sent, said in ((b"< hi >", "does not answer as an emulator"), (b"{", "no answer: timed out")):
            with ControlClient(address) as client:
                peer, _ = server.accept()
                with peer:
                    peer.sendall(sent)
                    begin_s = time.monotonic()
                    with pytest.raises(BenchError, match=said):
                        client.do("status")
                    assert time.monotonic() - begin_s < 30.0


@pytest.mark.parametrize("address", ["unix:/no/such/socket", "127.0.0.1:1", "127.0.0.1:x"])
def test_a_channel_that_is_not_there_is_reported(address):
    with pytest.raises(BenchError, match=f"control channel {address}: "):
        ControlClient(address)


def test_an_ipv6_address_stands_in_brackets(monkeypatch):
    class ConnectedError(Exception):
        pass

    def connect(address, _timeout):
        raise ConnectedError(address)

    monkeypatch.setattr(control.socket, "create_connection", connect)
    with pytest.raises(ConnectedError) as caught:
        ControlClient("[::1]:4711")
    assert caught.value.args == (("::1", 4711),)


@pytest.mark.parametrize(("clock", "polls"), [("real", 3), ("stepped", 1)])
def test_a_reset_ends_when_the_device_has_booted_which_takes_steps_of_a_stepped_clock(channel, clock, polls):
    modes = iter(["boot", "boot", "standby"])

    def answer(request):
        return (
            {"ok": True, "clock": clock, "mode": next(modes)} if request["do"] == "status" else {"ok": True}
        )

    requests, address = channel(answer)
    with ControlClient(address) as client:
        client.reset()
    assert [request["do"] for request in requests] == [
        "clear_faults",
        "set_truth",
        "fault",
        *["status"] * polls,
    ]
    assert requests[2]["device"] == {"reset": "power_on"}


def test_a_device_that_does_not_boot_is_reported(channel, monkeypatch):
    monkeypatch.setattr(control, "BOOT_WITHIN_S", 0.05)
    _, address = channel(lambda _request: {"ok": True, "clock": "real", "mode": "boot"})
    with ControlClient(address) as client, pytest.raises(BenchError, match=r"has not booted within 0\.05 s"):
        client.reset()


def test_the_truth_is_set_and_read_at_a_time(channel):
    requests, address = channel(lambda _request: {"ok": True, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]})
    with ControlClient(address) as client:
        truth = Truth(client, Conventions())
        truth.point(83.8, -1.2, 30.0)
        assert truth.error([0.0, 0.0, 0.0, 1.0], 5.0).total_arcsec == 0.0
    attitude = {"ra_deg": 83.8, "dec_deg": -1.2, "roll_deg": 30.0}
    assert requests == [
        {"do": "set_truth", "truth": {"kind": "fixed", "attitude": attitude}},
        {"do": "truth", "unix_s": 5.0},
    ]
