"""Runs that report their results to the console."""

import asyncio
import json
import select
import socket
import time

import pytest

from starhil.emulator.console import server
from starhil.emulator.console.reported_runs import ReportedRuns
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.console_feed import RunFeed
from tests.emulator.console.pages import OPTIONS, Page
from tests.waiting import until

pytestmark = [pytest.mark.long, pytest.mark.lowest("aiohttp")]


def test_a_session_reports_its_results_to_the_console_as_they_arrive(run):
    async def scenario(emulation, _line):
        address = emulation.ready_fields["view"]
        async with Page(emulation) as page:
            feed = await asyncio.to_thread(
                RunFeed, address, kind="session", title="First light", unit="can vcan0", planned=2
            )
            begun = await page.message("run")
            assert (begun["title"], begun["planned"], begun["end_s"]) == ("First light", 2, None)
            feed.result(
                id="1", name="the device answers", status="passed", detail="ok", link="can", seconds=0.1
            )
            feed.result(id="2", name="it tracks", status="failed", detail="mode=standby", log=("-> 1F 7F",))
            failed = await page.message("result", lambda item: item["result"]["status"] == "failed")
            assert failed["counts"] == {"passed": 1, "failed": 1, "skipped": 0, "not run": 0}
            await asyncio.to_thread(feed.close)
            await page.message("run", lambda item: item["end_s"] is not None)
        async with Page(emulation) as later:  # the report after the run
            report = await later.message("run")
            assert [result["name"] for result in report["results"]] == ["the device answers", "it tracks"]

    run(scenario, options=OPTIONS)


def test_a_result_that_takes_longer_than_an_idle_connection_lives_is_reported(run, monkeypatch):
    monkeypatch.setattr(server, "REQUEST_S", 0.2)

    def idle_and_closed(connection):
        readable = connection.sock is not None and select.select([connection.sock], [], [], 0.0)[0]
        return bool(readable) and connection.sock.recv(1, socket.MSG_PEEK) == b""

    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            feed = await asyncio.to_thread(
                RunFeed, emulation.ready_fields["view"], kind="session", title="", unit="", planned=2
            )
            for name in ("first", "second"):
                await until(lambda: idle_and_closed(feed._connection))
                feed.result(id=name, name=name, status="passed")
                await page.message("result", lambda item, name=name: item["result"]["name"] == name)
            await asyncio.to_thread(feed.close)
            await page.message("run", lambda item: item["end_s"] is not None)

    run(scenario, options=OPTIONS)


def test_a_result_with_very_much_traffic_is_reported_with_its_last_lines(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            feed = await asyncio.to_thread(
                RunFeed, emulation.ready_fields["view"], kind="conformance", title="", unit="", planned=1
            )
            lines = tuple(f"-> {number} " + "00 " * 40 for number in range(10_000))
            feed.result(id="1", name="a case", status="failed", log=lines)
            shown = (await page.message("result"))["result"]["log"]
            assert shown == [line[:300] for line in lines[-len(shown) :]]
            assert len(shown) >= 100
            await asyncio.to_thread(feed.close)
            await page.message("run", lambda item: item["end_s"] is not None)

    run(scenario, options=OPTIONS)


def test_results_of_any_size_are_kept_in_bounded_memory():
    """A peer may send 2000 results of a megabyte in each of 20 runs."""
    runs = ReportedRuns()
    texts = dict.fromkeys(("id", "name", "link", "detail", "unknown"), "x" * 50_000)
    for name in "ab":
        runs.report({"event": "begin", "run": name, "planned": 10**400})
        for number in range(200):
            log = [*["y" * 100] * 1000, *[""] * 1000, {"z": number}]
            result = {**texts, "status": "failed", "seconds": 10**400, "log": log}
            runs.report({"event": "result", "run": name, "result": result})
    sizes = [len(message) for message in runs.messages()]
    assert len(sizes) == 2
    assert max(sizes) < 2_000_000
    last = json.loads(list(runs.messages())[-1])
    assert last["counts"]["failed"] == len(last["results"]) == 200
    assert last["planned"] == 0
    assert last["results"][-1]["log"][-1] == "{'z': 199}"
    assert "log" not in last["results"][0]
    assert "unknown" not in last["results"][0]


def test_a_page_that_opens_does_not_encode_all_results_again():
    """With ten runs of 400 results, pages that opened delayed replies from 13 to 260 ms."""
    runs = ReportedRuns()
    runs.report({"event": "begin", "run": "a"})
    for number in range(1000):
        result = {
            "status": "failed",
            "id": str(number),
            "name": "é" * 100,
            "detail": "x" * 400,
            "log": ["y" * 200],
        }
        runs.report({"event": "result", "run": "a", "result": result})
    (message,) = runs.messages()
    content = json.loads(message)

    def cost(work):
        begin_s = time.process_time()
        work()
        return time.process_time() - begin_s

    encoding_s = min(cost(lambda: json.dumps(content)) for _ in range(5))
    assert min(cost(lambda: list(runs.messages())) for _ in range(5)) < 0.3 * encoding_s


def test_a_report_to_no_console_is_an_error_in_one_line(run):
    with pytest.raises(BenchError, match="must be the address of a console"):
        RunFeed("vcan0", kind="session", title="", unit="", planned=0)
    with pytest.raises(BenchError, match="does not take reports"):
        RunFeed("http://127.0.0.1:9/?token=x", kind="session", title="", unit="", planned=0)

    async def scenario(emulation, _line):
        address = emulation.ready_fields["view"] + "x"
        with pytest.raises(BenchError, match="the token in the address is missing or wrong"):
            await asyncio.to_thread(RunFeed, address, kind="session", title="", unit="", planned=0)

    run(scenario, options=OPTIONS)
