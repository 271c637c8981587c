"""The console's server: who may look, what it serves and exports, and where it listens."""

import asyncio
import re
import socket
import threading
import time
from dataclasses import replace

import aiohttp
import pytest

from starhil.emulator.console import server
from starhil.emulator.console.trace import WireTrace
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.traffic import Decoder, WireItem
from starhil.protocol.can.frame import CanFrame
from tests.emulator.console.pages import OPTIONS, Page

pytestmark = [pytest.mark.long, pytest.mark.lowest("aiohttp")]


@pytest.mark.parametrize(
    "path", ["/", "/runs", "/ws", "/session.toml", "/wire.log", "/wire.txt", "/record.mcap", "/docs/console"]
)
def test_a_wrong_token_and_another_origin_are_answered_403(run, path):
    async def scenario(emulation, _line):
        right = emulation.ready_fields["view"].replace("/?", f"{path}?")
        other = {"Origin": "http://elsewhere.example"}
        async with aiohttp.ClientSession() as session:
            for url, headers in (
                (right.partition("?")[0], {}),
                (right[:-1], {}),
                (right + "x", {}),
                (right, other),
                (right.partition("?")[0] + "?token=%C3%A4", {}),
            ):
                async with session.get(url, headers=headers) as response:
                    assert response.status == 403, (url, headers)
            own = {"Origin": right.partition("//")[0] + "//" + right.split("/")[2]}
            async with session.get(right, headers=own) as response:
                assert response.status != 403

    run(scenario, options=OPTIONS)


def test_every_page_that_a_tab_of_the_console_links_to_exists(run):
    script = (server.STATIC / "js" / "main.js").read_text(encoding="utf-8")
    named = {*re.findall(r'\w+: \["[^"]+", "(\w+)"\]', script), *re.findall(r'docs\("(\w+)"\)', script)}
    assert {"icd", "console", "control"} <= named

    async def scenario(emulation, _line):
        links = {}
        async with aiohttp.ClientSession() as session:
            for name in named:
                address = emulation.ready_fields["view"].replace("/?", f"/docs/{name}?")
                async with session.get(address) as response:
                    links[name] = (response.status, (await response.text()).splitlines()[0])
        return links

    pages = run(scenario, options=OPTIONS, unit="st16")
    assert {status for status, _ in pages.values()} == {200}
    assert pages["icd"][1] == "# Interface definition st16 2.0"


def test_reports_of_runs_need_the_token_and_the_files_of_the_page_do_not(run):
    async def scenario(emulation, _line):
        base = emulation.ready_fields["view"].partition("/?")[0]
        async with aiohttp.ClientSession() as session:
            async with session.post(f"{base}/runs", json={"run": "1", "event": "end"}) as response:
                assert response.status == 403
            async with session.get(f"{base}/static/js/main.js") as response:
                assert response.status == 200
            origin = {"Origin": "https://elsewhere.example"}
            async with session.get(f"{base}/static/js/main.js", headers=origin) as response:
                assert response.status == 403

    run(scenario, options=OPTIONS)


def test_a_page_with_the_view_token_sees_everything_and_commands_nothing(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation, field="view_only") as page:
            assert page.messages[0]["view_only"] is True
            await page.ask(do="subscribe", frames=True, wire=True, rows=["device_status"])
            await page.message("telemetry", lambda item: item["outcome"] == "ok")
            assert (await page.ask(do="encode", row="set_mode", values={"mode": "standby"}))["ok"]
            for request in (
                {"do": "send", "row": "set_mode", "values": {"mode": "lost_in_space"}},
                {"do": "read", "row": "device_status"},
                {"do": "control", "request": {"do": "fault", "device": {"stuck": True}}},
                {"do": "point", "kind": "fixed", "to": {}},
                {"do": "clock", "speed": 1},
                {"do": "clear_session"},
            ):
                assert "view only" in (await page.ask(**request))["error"]
            assert emulation.device.modes.mode == "standby"
            async with page.session.post(page.url("/runs"), json={"run": "1", "event": "end"}) as response:
                assert response.status == 403
        async with Page(emulation) as page:
            assert page.messages[0]["view_only"] is False

    run(
        scenario,
        options=replace(OPTIONS, console=replace(OPTIONS.console, view_token="for the wall & <screen>")),
    )


@pytest.mark.parametrize(
    ("headers", "status"),
    [({"Origin": "http://["}, 403), ({"Content-Type": "application/json; charset=foo"}, 400)],
    ids=["origin", "charset"],
)
def test_a_header_that_cannot_be_read_is_rejected(run, headers, status):
    async def scenario(_emulation, line):
        address = line.partition("view=")[2].split()[0]
        async with aiohttp.ClientSession() as session:
            reports = address.replace("/?", "/runs?")
            async with session.post(reports, data=b"{}", headers=headers) as answer:
                assert answer.status == status

    run(scenario, options=OPTIONS)


def test_a_page_that_closes_before_it_is_answered_leaves_no_error_in_the_log(run, caplog):
    async def scenario(emulation, _line):
        host, path = emulation.ready_fields["view"].removeprefix("http://").split("/")
        upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
        _, writer = await asyncio.open_connection(*host.split(":"))
        writer.write(f"GET /ws{path} HTTP/1.1\r\nHost: {host}\r\n{upgrade}\r\n\r\n".encode())
        writer.close()
        async with Page(emulation) as page:  # the other has been served
            assert (await page.ask(do="read", row="identification"))["ok"]

    run(scenario, options=OPTIONS)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.parametrize(
    "header",
    [b"Upgrade: \xff", b"Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: \xc3\xa9"],
)
def test_a_header_that_is_not_ascii_is_answered_400(run, caplog, header):
    async def scenario(emulation, _line):
        host, path = emulation.ready_fields["view"].removeprefix("http://").split("/")
        reader, writer = await asyncio.open_connection(*host.split(":"))
        writer.write(f"GET /ws{path} HTTP/1.1\r\nHost: {host}\r\n".encode() + header + b"\r\n\r\n")
        assert b" 400 " in await reader.readline()
        writer.close()

    run(scenario, options=OPTIONS)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        ("GET /static/" + 300 * "a", 404),
        ("GET /static/%00", 404),
        ("GET /static/js/../../server.py", 404),
        ("GET /docs/" + 300 * "a" + "?{token}", 400),
        ("POST /runs?{token}", 400),
        ("POST /runs", 403),
    ],
    ids=["long name", "null byte", "other folder", "long page", "body", "body without the token"],
)
def test_a_name_or_a_body_that_cannot_be_read_leaves_no_error_in_the_log(run, caplog, request_, status):
    async def scenario(emulation, _line):
        host, path = emulation.ready_fields["view"].removeprefix("http://").split("/")
        reader, writer = await asyncio.open_connection(*host.split(":"))
        line = request_.format(token=path.removeprefix("?"))
        body = "Content-Encoding: gzip\r\nContent-Length: 5\r\n\r\n....."
        writer.write(f"{line} HTTP/1.1\r\nHost: {host}\r\n{body}".encode())
        assert f" {status} ".encode() in await reader.readline()
        await reader.read()
        writer.close()

    run(scenario, options=OPTIONS)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


def test_exports_are_made_one_at_a_time_beside_the_loop_while_traffic_passes(run, monkeypatch):
    """The trace as text failed when an item passed meanwhile, and a log of 20 000 frames took the loop 60 ms.

    Interface definitions were made all at once: 24 readers of them held up replies on the bus by 200 ms.
    """
    making, threads = [], []

    async def scenario(emulation, _line):
        item = WireItem(0.0, "can", outgoing=False, item=CanFrame(0x04800104))
        emulation.traffic.passed.emit(item)

        def observed(method):
            def make(self, *arguments):
                making.append(method)
                threads.append((threading.current_thread(), len(making)))
                emulation.traffic.passed.emit(item)
                time.sleep(0.05)
                emulation.traffic.passed.emit(item)
                try:
                    return method(self, *arguments)
                finally:
                    making.remove(method)

            return make

        monkeypatch.setattr(Decoder, "line", observed(Decoder.line))
        monkeypatch.setattr(WireTrace, "candump", observed(WireTrace.candump))
        monkeypatch.setattr(server, "export", observed(server.export))
        async with Page(emulation) as page:
            paths = ("/docs/icd", "/wire.log", "/wire.txt", "/docs/icd")
            definition, log, text, again = await asyncio.gather(*map(page.get, paths))
        assert definition.startswith("# Interface definition")
        assert "04800104#" in log
        assert "identification?" in text
        assert again == definition

    run(scenario, options=OPTIONS)
    assert threading.main_thread() not in {thread for thread, _ in threads}
    assert {count for _, count in threads} == {1}


def test_text_is_compressed(run):
    async def scenario(emulation, _line):
        base = emulation.ready_fields["view"].partition("/?")[0]
        async with (
            aiohttp.ClientSession(auto_decompress=False) as session,
            session.get(f"{base}/static/js/main.js") as response,
        ):
            assert response.headers["Content-Encoding"] in ("gzip", "deflate")
            assert len(await response.read()) < (server.STATIC / "js" / "main.js").stat().st_size / 2

    run(scenario, options=OPTIONS)


def test_a_token_that_is_given_is_that_of_the_address(run):
    async def scenario(emulation, _line):
        assert emulation.ready_fields["view"].endswith("?token=of%20the%20bench")
        async with Page(emulation) as page:
            assert page.messages[0]["view_only"] is False

    run(scenario, options=replace(OPTIONS, console=replace(OPTIONS.console, command_token="of the bench")))


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("nowhere", "must be auto or HOST:PORT"),
        ("127.0.0.1:99999", "must be auto or HOST:PORT"),
        ("no.such.host:1", "cannot listen"),
    ],
)
def test_an_invalid_address_ends_startup_with_one_line(run, where, message):
    async def nothing(_emulation, _line):
        return

    with pytest.raises(EmulatorError, match=message):
        run(nothing, options=replace(OPTIONS, console=replace(OPTIONS.console, view=where)))


def test_a_port_in_use_ends_the_start_in_one_line(run):
    async def nothing(_emulation, _line):
        return

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(EmulatorError, match="cannot listen"):
            run(
                nothing,
                options=replace(
                    OPTIONS, console=replace(OPTIONS.console, view=f"127.0.0.1:{other.getsockname()[1]}")
                ),
            )
