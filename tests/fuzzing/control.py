"""Targets of the control channel and the console."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

from starhil.emulator.console.console import Console
from starhil.emulator.console.events import EventLog
from starhil.emulator.console.obc import Exchange
from starhil.emulator.console.reported_runs import ReportedRuns
from starhil.emulator.console.server import ConsoleServer
from starhil.emulator.console.stepping import StepRunner
from starhil.emulator.console.viewer import Viewer
from starhil.emulator.control.channel import ControlServer
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run as EmulatorRun
from tests.emulator.conftest import FakePipeline
from tests.emulator.runs import FakeImager
from tests.fuzzing.edits import edited
from tests.fuzzing.target import ATTITUDE, NESTED, Run, target


class _Loop:
    """A run whose pipeline renders nothing, and a loop to call it in."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        pipeline = FakePipeline()
        keys = {"run": {"clock": "stepped"}, "links": {"serial": {"port": "off"}, "can": {"channel": "off"}}}
        with patch("starhil.emulator.run.run.make_pipeline", lambda *_, **__: FakeImager(pipeline.handle)):
            self.run = EmulatorRun([Profile.model_validate(keys)])
        self.call(self._start())
        self.control = ControlServer(self.run, lambda: None)

    async def _start(self) -> None:
        await self.run.open()
        self.run.begin()
        await self.run.ready()

    def call(self, awaitable: Any) -> Any:
        """Wait for a coroutine."""
        return self.loop.run_until_complete(asyncio.wait_for(awaitable, 20.0))


def opens_nothing(request: Any) -> bool:
    """Whether a request neither opens a port nor takes long: it sets no live truth and steps little."""
    if isinstance(request, dict):
        if isinstance(seconds := request.get("seconds"), (int, float)) and abs(seconds) > 60:
            return False
        return request.get("kind") not in ("live", "42") and all(map(opens_nothing, request.values()))
    return not isinstance(request, list) or all(map(opens_nothing, request))


REQUESTS = [
    {"do": "status"}, {"do": "truth", "run_time_s": 1.0}, {"do": "truth", "unix_s": 1.7e9}, {"do": "frames", "count": 3},
    {"do": "step", "seconds": 0.5}, {"do": "clear_faults"}, {"do": "quit"}, {"do": "scenario", "name": "bad_day"},
    {"do": "set_truth", "truth": {"kind": "fixed", "attitude": ATTITUDE}},
    {"do": "set_truth", "truth": {"kind": "rate", "attitude": ATTITUDE, "rate_deg_s": [0.0, 0.0, 2.0]}},
    {"do": "fault", "serial": {"drop": 0.2, "delay_s": 0.1}, "optical": {"false_stars": 40}, "device": {"stuck": True}},
]  # fmt: skip


def parsed(data: bytes, requests: list[dict[str, Any]]) -> Any:
    """Return an edited good request, or the bytes as JSON; None if they are not."""
    if data[:1] < b" ":
        request = requests[(data[0] if data else 0) % len(requests)]
        return edited({"r": request}, data[1:]).get("r")
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def request_edits(count: int) -> list[bytes]:
    """Good requests, and each with an edit."""
    return [
        bytes([number, *edit]) for number in range(count) for edit in (b"", b"\0\1\4\x10", b"\0\2\1\7")
    ] + [NESTED]


@target("control", lambda: request_edits(len(REQUESTS)))
def _control(_folder: Path) -> Run:
    run_ = _Loop()

    def run(data: bytes) -> None:
        request = parsed(data, REQUESTS)
        line = data if request is None else json.dumps(request)
        if opens_nothing(request):
            answer = run_.call(run_.control.answer(line))
            assert "internal error" not in answer.get("error", ""), answer
            json.dumps(answer)

    return run


class _Obc:
    """An OBC that is always answered with the row's own zeros."""

    async def start(self) -> None:
        """Nothing is opened."""

    async def close(self) -> None:
        """Nothing was opened."""

    async def exchange(self, row: Any, _data: bytes) -> Exchange:
        """Answer."""
        return Exchange("ok", latency_s=0.001, data=bytes(row.size if row.kind == "telemetry" else 0))


class _Socket:
    """A page that receives nothing."""

    async def send_bytes(self, data: bytes, /) -> None:
        """Take a message."""


ASKED = [
    {"do": "subscribe", "rows": ["identification"], "frames": True, "wire": True},
    {"do": "control", "request": {"do": "fault", "can": {"drop": 0.5}}},
    {"do": "point", "to": {"ra_deg": 10.0, "dec_deg": 20.0}, "rate_deg_s": 1.0}, {"do": "point", "to": {"star": "Sirius"}},
    {"do": "clock", "speed": 2.0}, {"do": "clear_session"}, {"do": "read", "row": "identification"},
    {"do": "encode", "row": "set_mode", "values": {"mode": "standby"}}, {"do": "send", "row": "set_mode", "values": {"mode": "standby"}},
    {"do": "note", "text": "a", "at_s": 0.0}, {"do": "message", "n": 0},
    {"do": "encode", "row": "set_parameter", "values": {"id": 1, "value": 1.5}},
]  # fmt: skip


def console_of(run_: _Loop) -> Console:
    """Return the console of a run."""
    head = run_.run.heads[0]
    return Console(run_.run, head, _Obc(), [EventLog(head)], StepRunner(run_.control.execute), ReportedRuns())


def viewer_of(console: Console) -> Viewer:
    """Return a page that receives nothing."""
    return Viewer(_Socket(), console.history, console.trace, console.events, clock=time.monotonic)


@target("console", lambda: request_edits(len(ASKED)))
def _console(_folder: Path) -> Run:
    run_ = _Loop()
    console = console_of(run_)
    viewer = viewer_of(console)

    async def answer(request: Any) -> dict[str, Any]:
        reply = await console.answer(viewer, request)
        console.stepping.run(0.0)
        console.obc.session("fuzz")
        return reply

    def run(data: bytes) -> None:
        request = parsed(data, ASKED)
        if isinstance(request, dict) and opens_nothing(request):
            reply = run_.call(answer(request))
            assert "internal error" not in reply.get("error", ""), reply
            json.dumps(reply)

    return run


UPGRADE = (
    b"GET /ws?token=t HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n\x81\x83\0\0\0\0{}}"
)
REPORT = b'POST /runs?token=t HTTP/1.1\r\nHost: a\r\nOrigin: http://a\r\nContent-Length: 29\r\n\r\n{"run": "1", "event": "begin"}'
HTTP = [
    b"GET /?token=t HTTP/1.1\r\nHost: a\r\n\r\n", b"GET /session.toml?token=t&head=1 HTTP/1.1\r\nHost: a\r\n\r\n",
    b"GET /static/../x HTTP/1.1\r\nHost: a\r\n\r\n", b"GET /wire.log?token=t HTTP/1.0\r\n\r\n", UPGRADE, REPORT,
    b"POST /runs?token=t HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
]  # fmt: skip


class _Errors(logging.Handler):
    """Keeps what is logged as an error."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.seen: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self.seen.append(self.format(record))


@target("http", lambda: HTTP)
def _http(_folder: Path) -> Run:
    run_ = _Loop()
    server = ConsoleServer([console_of(run_)])
    server.token = "t"
    view = run_.call(server.start("127.0.0.1:0"))["view"]
    host, _, port = view.removeprefix("http://").partition("/")[0].partition(":")
    errors = _Errors()
    logging.getLogger().addHandler(errors)
    logging.getLogger("starhil").addHandler(errors)

    async def exchange(data: bytes) -> bytes:
        reader, writer = await asyncio.open_connection(host, int(port))
        try:
            writer.write(data)
            if writer.can_write_eof():
                writer.write_eof()
            async with asyncio.timeout(3.0):
                return await reader.read(65536)
        except (ConnectionError, TimeoutError):
            return b""
        finally:
            writer.transport.abort()

    def run(data: bytes) -> None:
        answer = run_.call(exchange(data))
        assert b" 500 " not in answer[:20], answer
        assert not errors.seen, "\n".join(errors.seen)

    return run
