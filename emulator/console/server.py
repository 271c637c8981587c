"""HTTP server of the console: pages, WebSocket, exports, and reports of session and conformance runs."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import logging
import secrets
import socket
import sys
import zlib
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import quote, urlsplit

from aiohttp import WSMsgType, web
from aiohttp.http import HttpProcessingError

from starhil.emulator.console.console import Console
from starhil.emulator.console.pcapng import pcapng
from starhil.emulator.console.viewer import Viewer
from starhil.emulator.control.channel import REQUEST_S
from starhil.emulator.control.token import is_token
from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.threads import in_thread
from starhil.emulator.truth.json_lines import JsonError, parse_object
from starhil.protocol.errors import escape_controls, reason
from starhil.protocol.export import export
from starhil.protocol.transports.connections import (
    WINDOW,
    Budget,
    ConnectionLimit,
    Gate,
    Listener,
    detect_lost_peer,
    listen,
)

log = logging.getLogger("starhil.console")

STATIC: Final = Path(__file__).resolve().parent / "static"

KINDS: Final = {
    ".css": "text/css",
    ".html": "text/html",
    ".js": "text/javascript",
    ".LICENSE": "text/plain",
}
"""Suffix of a file of the page → its type."""

DOCS: Final = Path(__file__).resolve().parents[2] / "docs"
"""Folder of the pages of the documentation, in the installation or checkout."""

LARGEST_MESSAGE: Final = 1 << 16
"""Longest message that a page may send, bytes."""

MAX_HEADERS: Final = 64
"""Maximum number of headers of a request; browsers send some twenty."""

LARGEST_REPORT: Final = 1 << 20
"""Longest report that is accepted, bytes."""

MAX_REQUESTS: Final = 16
"""Maximum number of concurrent requests of a page."""

HEARTBEAT_S: Final = 20.0
"""Time after which a page that does not answer is disconnected, seconds."""

MAX_VIEWERS: Final = 32

REQUEST_TIME_S: Final = 0.0003
"""Processor time that aiohttp spends on a request beside what is done here, seconds."""

BEHIND_S: Final = 0.01
"""Interval at which it is checked whether a page has read what it was sent, seconds."""

EXPORT_PAUSE_S: Final = 0.2
"""Shortest time between two exports, of any pages, seconds."""

LINGER_S: Final = 1.0
"""Time for which the rest of a rejected request is read, so that its peer receives the answer, seconds."""

BUSY: Final = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"503: too many connections; close other pages of the console\n"
)

HEADERS: Final = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ConsoleServer:
    """Serves the consoles of all heads at an address with a token; `head` in the address selects a head.

    Parameters
    ----------
    view_token
        Another token, whose pages may look but not command; empty: there is none.
    command_token
        Token of pages that may command; empty: a random one.
    """

    def __init__(self, consoles: Sequence[Console], view_token: str = "", command_token: str = "") -> None:
        self._consoles = consoles
        self.token = command_token or secrets.token_urlsafe(18)
        self._view_token = view_token
        self._budget = Budget()
        self._exporting = asyncio.Lock()
        """Held while a thread makes an export: several would take the interpreter from the links."""
        self._static_files = {
            str(file.relative_to(STATIC)): file for file in STATIC.rglob("*") if file.suffix in KINDS
        }
        """Files of the page by their paths in requests: a request is looked up, and never makes a path."""
        self._files: dict[str, tuple[bytes, str]] = {}
        """Files of the page that have been read: compressed, and their tag."""
        self._runner: web.AppRunner | None = None
        self._listener: Listener | None = None

    async def start(self, where: str) -> dict[str, str]:
        """Listen on `auto` (loopback interface, a free port) or HOST:PORT; return the addresses of the page.

        They are fields of the ready line: `view`, and with a view token `view_only`.
        """
        host, port = parse_address(where)
        app = web.Application(middlewares=[self._guard], client_max_size=LARGEST_REPORT)
        for path in ("/", "/runs"):
            app.router.add_get(path, _page)
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/session.toml", self._session)
        app.router.add_get("/wire.log", self._wire_log)
        app.router.add_get("/wire.txt", self._wire_text)
        app.router.add_get("/wire.pcapng", self._wire_pcapng)
        app.router.add_get("/record.mcap", self._record)
        app.router.add_get("/docs/icd", self._interface)
        app.router.add_get("/docs/{page}", _docs)
        app.router.add_post("/runs", self._report)
        app.router.add_get("/static/{path:.*}", self._static)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            logger=_ServerLog(log),
            handle_signals=False,
            shutdown_timeout=0.5,
            keepalive_timeout=REQUEST_S,
            lingering_time=LINGER_S,
            max_headers=MAX_HEADERS,
        )
        await self._runner.setup()
        server, limit = cast("web.Server", self._runner.server), ConnectionLimit("console", BUSY)

        def admits(transport: asyncio.BaseTransport) -> bool:
            admitted = limit.admits(transport, len(server.connections))
            if admitted:
                detect_lost_peer(transport, must_read=True)
            return admitted

        try:
            self._listener = await listen(lambda: Gate(self._budget, server, admits), host, port, limit.size)
        except (OSError, UnicodeError) as error:
            await self.close()
            raise EmulatorError(
                f"--view {where}: cannot listen ({reason(error)}); choose another port, or auto"
            ) from None
        bound = self._listener.address
        name = f"[{bound[0]}]" if ":" in bound[0] else bound[0]
        page = f"http://{name}:{bound[1]}/?token="
        only = {"view_only": page + quote(self._view_token, safe="")} if self._view_token else {}
        return {"view": page + quote(self.token, safe=""), **only}

    async def close(self) -> None:
        """Stop listening and close all connections."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Respond within the budget of all peers."""
        return await self._budget.run(self._respond(request, handler), REQUEST_TIME_S)

    async def _respond(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Reject other origins and, except for static files, requests without the token."""
        if not all(value.isascii() for value in request.headers.values()):  # aiohttp fails on some of them
            return web.Response(status=400, text="400: a header is not ASCII\n", headers=HEADERS)
        if not _is_same_origin(request):
            return web.Response(
                status=403, text="403: the request comes from a page of another origin\n", headers=HEADERS
            )
        commands = self._has_token(request, self.token)
        looks = request.method == "GET" and self._has_token(request, self._view_token)
        if not (commands or looks or request.path.startswith("/static/")):
            text = (
                "403: the token in the address is missing or wrong; the ready line of `starhil run` has it\n"
            )
            return web.Response(status=403, text=text, headers=HEADERS)
        try:
            response = await handler(request)
        except EmulatorError as error:
            return web.Response(status=400, text=f"{error}\n", headers=HEADERS)
        except web.RequestPayloadError as error:
            return web.Response(status=400, text=f"400: the body cannot be read ({error})\n", headers=HEADERS)
        except ConnectionError:  # the page is closed, and nobody reads the response
            return web.Response()
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    @staticmethod
    def _has_token(request: web.Request, token: str) -> bool:
        return token != "" and is_token(request.query.get("token", ""), token)

    def _console(self, request: web.Request) -> Console:
        """Return the console of the head that a request names; default: the first."""
        head = request.query.get("head", "1")
        consoles = {str(number): console for number, console in enumerate(self._consoles, start=1)}
        if head not in consoles:
            raise EmulatorError(f"head: must be 1 to {len(consoles)}, not {head!r}")
        return consoles[head]

    async def _static(self, request: web.Request) -> web.Response:
        """Return a file of the page, compressed."""
        path = request.match_info["path"]
        file = self._static_files.get(path)
        if file is None:
            return web.Response(status=404, text="404: no such file\n")
        kind = KINDS[file.suffix]
        if path not in self._files:
            data = await asyncio.to_thread(lambda: gzip.compress(file.read_bytes()))
            self._files[path] = data, f'"{zlib.crc32(data):08x}"'
        data, tag = self._files[path]
        headers = {"ETag": tag}
        if request.headers.get("If-None-Match") == tag:
            return web.Response(status=304, headers=headers)
        if "gzip" not in request.headers.get("Accept-Encoding", ""):
            return web.Response(
                body=gzip.decompress(data), content_type=kind, charset="utf-8", headers=headers
            )
        headers["Content-Encoding"] = "gzip"
        return web.Response(body=data, content_type=kind, charset="utf-8", headers=headers)

    async def _session(self, request: web.Request) -> web.Response:
        text = self._console(request).obc.session("Recorded in the console")
        return _download(text, "session.toml", "application/toml")

    async def _interface(self, request: web.Request) -> web.Response:
        """Return the interface definition of the unit that runs, in Markdown."""
        icd = self._console(request).icd
        async with self._export_turn():
            text = await in_thread(export, icd, "markdown")
        return web.Response(text=text, content_type="text/plain", charset="utf-8")

    async def _wire_log(self, request: web.Request) -> web.Response:
        trace = self._console(request).trace
        async with self._export_turn():
            text = await in_thread(trace.candump, trace.items())
        return _download(text, "wire.log", "text/plain")

    async def _wire_text(self, request: web.Request) -> web.Response:
        trace = self._console(request).trace
        async with self._export_turn():
            text = await in_thread(trace.text, trace.items())
        return _download(text, "wire.txt", "text/plain")

    async def _wire_pcapng(self, request: web.Request) -> web.Response:
        trace = self._console(request).trace
        async with self._export_turn():
            data = await in_thread(pcapng, trace.items())
        return _download(data, "wire.pcapng", "application/octet-stream")

    async def _record(self, request: web.Request) -> web.Response:
        """Return what is known of the last hour as an MCAP file."""
        console = self._console(request)
        async with self._export_turn():
            data = await console.recording()
        return _download(data, "record.mcap", "application/octet-stream")

    async def _report(self, request: web.Request) -> web.Response:
        try:
            async with asyncio.timeout(REQUEST_S):
                body = await request.read()
        except TimeoutError:
            response = web.Response(status=408, text=f"408: no complete report within {REQUEST_S:g} s\n")
            response.force_close()
            return response
        try:
            event = parse_object(body)
        except JsonError as error:
            raise EmulatorError(f"report: {error}") from None
        self._consoles[0].runs.report(event)
        return web.json_response({"ok": True})

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        """Connect a page: answer its requests and send its subscriptions."""
        console = self._console(request)
        if sum(len(each.viewers) for each in self._consoles) >= MAX_VIEWERS:
            return web.Response(status=503, text=f"503: {MAX_VIEWERS} pages are already open\n")
        socket = web.WebSocketResponse(autoping=False, heartbeat=HEARTBEAT_S, max_msg_size=LARGEST_MESSAGE)
        await socket.prepare(request)
        if request.transport is not None:
            _limit_unsent(request.transport)
        viewer = Viewer(
            socket,
            console.history,
            console.trace,
            console.events,
            commands=self._has_token(request, self.token),
        )
        tasks: set[asyncio.Task[None]] = set()
        try:
            await console.welcome(viewer)
            console.join(viewer)
            tasks.add(asyncio.create_task(_pump(viewer, socket)))
            await self._receive(console, socket, viewer, tasks)
        except ConnectionError:
            pass  # the page was closed
        finally:
            console.leave(viewer)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return socket

    @contextlib.asynccontextmanager
    async def _export_turn(self) -> AsyncIterator[None]:
        """Wait until no other export is being made, and the links have had the interpreter for a while."""
        async with self._exporting:
            await asyncio.sleep(EXPORT_PAUSE_S)
            yield

    async def _receive(
        self, console: Console, socket: web.WebSocketResponse, viewer: Viewer, tasks: set[asyncio.Task[None]]
    ) -> None:
        """Execute the requests of a page until it closes.

        Pings and pongs have their turns too: aiohttp would answer a flood of them without leaving the loop.
        """
        async for message in socket:
            await asyncio.sleep(0)
            if message.type is WSMsgType.PING:
                await socket.pong(message.data)
            if message.type is not WSMsgType.TEXT:
                continue
            try:
                request = parse_object(message.data)
            except JsonError as wrong:
                viewer.send(json.dumps({"type": "answer", "id": None, "ok": False, "error": str(wrong)}))
                continue
            if request.get("do") == "received":
                viewer.acknowledge(request.get("at"))
                continue
            if len(tasks) > MAX_REQUESTS:
                error = f"more than {MAX_REQUESTS} requests at a time"
                answer = {"type": "answer", "id": request.get("id"), "ok": False, "error": error}
                viewer.send(json.dumps(answer))
                continue
            task = asyncio.create_task(self._answer(console, viewer, request))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

    async def _answer(self, console: Console, viewer: Viewer, request: dict[str, object]) -> None:
        """Answer a request, once the page has read what it was sent and its earlier requests have begun."""
        async with viewer.turn:
            while viewer.behind:
                await asyncio.sleep(BEHIND_S)

        async def execute() -> None:
            viewer.send(json.dumps(await console.answer(viewer, request)))

        await (execute() if viewer.commands else self._budget.run(execute()))


class _ServerLog(logging.LoggerAdapter[logging.Logger]):
    """Logs a request that is not HTTP, or whose body cannot be decoded, at level debug: its peer could fill the log."""

    def log(self, level: int, msg: object, *args: object, **options: Any) -> None:
        error = options.get("exc_info")
        if error is True:
            error = sys.exception()
        from_peer = isinstance(error, (HttpProcessingError, web.RequestPayloadError))
        super().log(logging.DEBUG if from_peer else level, msg, *args, **options)


async def _pump(viewer: Viewer, socket: web.WebSocketResponse) -> None:
    """Send a page its queued messages until it closes."""
    with contextlib.suppress(ConnectionError):
        await viewer.pump()
    await socket.close()


async def _page(_request: web.Request) -> web.StreamResponse:
    return web.FileResponse(STATIC / "index.html")


def _is_same_origin(request: web.Request) -> bool:
    """Return whether a request comes from a page of this server, or from no page."""
    origin = request.headers.get("Origin")
    try:
        return origin is None or urlsplit(origin).netloc == request.host
    except ValueError:
        return False


async def _docs(request: web.Request) -> web.StreamResponse:
    """Return a page of the documentation, in Markdown."""
    page = request.match_info["page"]
    path = next((each for each in DOCS.glob("*.md") if each.stem == page), None)
    if path is None:
        raise EmulatorError(f"docs: there is no page {escape_controls(page)}")
    return web.Response(text=path.read_text(encoding="utf-8"), content_type="text/plain", charset="utf-8")


def _download(content: str | bytes, name: str, kind: str) -> web.Response:
    body = content.encode() if isinstance(content, str) else content
    return web.Response(
        body=body, content_type=kind, headers={"Content-Disposition": f'attachment; filename="{name}"'}
    )


def parse_address(where: str) -> tuple[str, int]:
    """Return host and port of `auto` or HOST:PORT."""
    if where == "auto":
        return "127.0.0.1", 0
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise EmulatorError(f"--view {where}: must be auto or HOST:PORT")
    return host.strip("[]"), int(port)


def _limit_unsent(transport: asyncio.BaseTransport) -> None:
    """Limit what a TCP connection buffers before it is sent, without a limit of what is under way."""
    cast("asyncio.WriteTransport", transport).set_write_buffer_limits(WINDOW)
    connection = transport.get_extra_info("socket")
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, WINDOW)
