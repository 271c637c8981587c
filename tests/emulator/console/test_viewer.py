"""What a page of the console receives, also one that does not read or comes late, and how often it is served."""

import asyncio
import gc
import json
import socket
import struct
import time
import warnings
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest

from starhil.emulator.console.console import Console
from starhil.emulator.console.history import COLUMNS, MODES, History, Image
from starhil.emulator.console.viewer import PAUSE_S, QUEUE_LIMIT, TURN_ITEMS, Viewer
from starhil.emulator.links.traffic import WireItem
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.connections import Budget
from tests.emulator.conftest import PREVIEW
from tests.emulator.console.pages import ALONG_X, OPTIONS, Page, column
from tests.emulator.runs import command, read
from tests.waiting import until

pytestmark = [pytest.mark.long, pytest.mark.lowest("aiohttp")]


def test_previews_are_made_only_while_a_page_shows_images(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(2.0)
        assert not any(request.preview for request in run.pipeline.frames)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=False)
            await emulation.stepper.step(1.0)
            assert not any(request.preview for request in run.pipeline.frames)
            before = len(run.pipeline.frames)
            await page.ask(do="subscribe", frames=True)
            await emulation.stepper.step(2.0)
            assert all(request.preview for request in run.pipeline.frames[before + 1 :])
            await page.until(lambda: page.frames)
        await until(lambda: not emulation.imager.watchers)
        seen = len(run.pipeline.frames)
        await emulation.stepper.step(2.0)
        assert len(run.pipeline.frames) > seen
        assert not run.pipeline.frames[-1].preview

    run(scenario, options=OPTIONS)


def test_a_page_receives_description_history_and_each_frame_with_its_numbers(run):
    run.pipeline.turn_rad = 1e-5

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(4.0)
        count = emulation.device.cycle.published
        async with Page(emulation) as page:
            hello = page.messages[0]
            assert hello["columns"] == list(COLUMNS)
            assert {row["name"] for row in hello["telemetry"]} == set(emulation.device.icd.telemetry)
            assert {row["name"] for row in hello["telecommands"]} == set(emulation.device.icd.telecommands)
            assert hello["star_names"]["27989"] == "Betelgeuse"
            await page.ask(do="subscribe", frames=True)
            await page.until(lambda: len(page.rows) >= count)
            frames = page.history[~np.isnan(column(page.history.T, "frame"))]
            assert len(frames) == count
            assert column(frames.T, "error_x") == pytest.approx(1e-5 * 206264.806, rel=1e-3)
            await emulation.stepper.step(1.0)
            head, jpeg = await page.until(lambda: page.frames and page.frames[-1])
            assert jpeg == PREVIEW.jpeg
            assert head["hips"] == [32349]
            assert column(head["row"], "frame") > count
            assert MODES[int(column(head["row"], "mode"))] == "tracking"
            attitude = read(emulation, "precise_attitude")
            for name in ("x", "y", "z", "w"):
                assert column(head["row"], f"q{name}") == pytest.approx(attitude[f"q_{name}"], abs=1e-6)

    run(scenario, options=OPTIONS)


def test_an_invalid_frame_has_its_reason_and_no_numbers(run):
    run.pipeline.fail = "too_few_stars"

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=True)
            await emulation.stepper.step(2.0)
            await page.until(lambda: page.rows and column(page.history[-1], "frame") > 0)
            row = page.history[-1]
            assert column(row, "valid") == 0
            assert np.isnan(column(row, "error_cross"))
            wanted = await page.message("reasons", lambda item: "too_few_stars" in item["reasons"])
            assert wanted["reasons"][int(column(row, "reason"))] == "too_few_stars"

    run(scenario, options=OPTIONS)


def test_a_mode_without_frames_is_in_the_history_from_its_beginning(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(2.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=True)
            await page.until(lambda: len(page.rows) >= 3)
            modes = [MODES[int(number)] for number in column(page.history.T, "mode")]
            assert modes[:3] == ["boot", "standby", "lost_in_space"]
            begin_s, before = emulation.clock.now_ns() * 1e-9, len(page.rows)
            emulation.device.modes.fail("sensor")
            await page.until(lambda: len(page.rows) > before)
            row = page.history[-1]
            assert MODES[int(column(row, "mode"))] == "error"
            assert column(row, "run_s") == begin_s
            assert np.isnan(column(row, "frame"))
            assert column(row, "valid") == 0
            reasons = [item["reasons"] for item in page.messages if item["type"] == "reasons"][-1]
            assert reasons[int(column(row, "reason"))] == "no_images"

    run(scenario, options=OPTIONS)


def test_the_status_says_since_when_the_device_is_unresponsive(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            stuck = {"do": "fault", "device": {"stuck": True}}
            await page.message("status", lambda item: item["unresponsive_since_s"] is None)
            await page.ask(do="control", request=stuck)
            await emulation.stepper.step(2.0)
            await page.ask(do="control", request=stuck)
            await page.message("status", lambda item: item["unresponsive_since_s"] == 1.0)
            page.messages.clear()
            await page.ask(do="control", request={"do": "clear_faults"})
            await page.message("status", lambda item: item["unresponsive_since_s"] is None)

    run(scenario, options=OPTIONS)


def test_five_pages_receive_every_frame(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        async with AsyncExitStack() as stack:
            pages = [await stack.enter_async_context(Page(emulation)) for _ in range(5)]
            for page in pages:
                await page.ask(do="subscribe", frames=True)
            for _ in range(3):
                await emulation.stepper.step(1.0)
                for page in pages:
                    await page.until_frame(emulation.device.cycle.published)

    run(scenario, options=OPTIONS)


def test_a_page_that_joins_late_receives_the_newest_image_at_once(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        async with Page(emulation) as first:
            await first.ask(do="subscribe", frames=True)
            await emulation.stepper.step(3.0)
            newest = emulation.device.cycle.published
            await first.until_frame(newest)
            async with Page(emulation) as late:
                await late.ask(do="subscribe", frames=True)
                await late.until_frame(newest)
                assert late.frames[-1][1] == PREVIEW.jpeg

    run(scenario, options=OPTIONS)


def test_each_head_has_its_own_page_on_a_shared_clock(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as first, Page(emulation, head=2) as second:
            for number, page in enumerate((first, second), start=1):
                assert page.messages[0]["head"] == number
                assert len(page.messages[0]["heads"]) == 2
                assert page.messages[0]["seed"] == number
                await page.ask(do="subscribe", frames=True)
            await first.ask(do="clock", speed=10)
            await second.message("status", lambda item: item["stepping"] == 10)
            await second.until(lambda: second.frames and column(second.frames[-1][0]["row"], "valid"))
            await second.ask(do="clock", speed=0)
            await second.ask(do="control", request={"do": "fault", "device": {"stuck": True}})
            assert (await second.ask(do="read", row="device_status"))["outcome"] == "no_reply"
            assert (await first.ask(do="read", row="device_status"))["outcome"] == "ok"
            assert run.first_head().faults.describe() == {}
            slew = {"kind": "slew", "to": {"star": "rigel", "roll_deg": 20.0}, "max_rate_deg_s": 5.0}
            await second.ask(do="point", **slew)
            await emulation.stepper.step(60.0)
            truth = await second.ask(do="control", request={"do": "truth"})
            assert (truth["ra_deg"], truth["dec_deg"]) == pytest.approx((78.634, -8.202), abs=0.01)
            assert truth["roll_deg"] == pytest.approx(20.0)
            assert "head: must be 1 to 2, not '3'" in await Page(emulation, head=3).refusal()

    links = {"serial": {"port": "off"}, "can": {"channel": "off"}}
    parameters = {"start_mode": "lost_in_space"}
    mounted = {"kind": "fixed", "mount": ALONG_X}
    second = {
        "links": links,
        "parameters": parameters,
        "truth": mounted,
        "run": {"clock": "stepped", "seed": 2},
    }
    run(scenario, options=OPTIONS, others=[second], links=links, parameters=parameters)


class KeepingSocket:
    """Keeps what is sent."""

    def __init__(self):
        self.sent = []

    async def send_bytes(self, data):
        self.sent.append(data)

    def turn(self, number=-1):
        """Return the JSON of a turn, and what follows it."""
        data = self.sent[number]
        (length,) = struct.unpack_from("<I", data)
        return json.loads(data[4 : 4 + length]), data[4 + length :]


class StalledSocket:
    """A page that never reads."""

    async def send_bytes(self, _data):
        await asyncio.Event().wait()


class Numbers:
    """A log of which the latest numbers are kept."""

    def __init__(self, end=0, kept=1000):
        self.end = end
        self.kept = kept

    @property
    def start(self):
        return max(0, self.end - self.kept)

    def texts(self, numbers):
        return [str(number) for number in numbers]


def viewer_of(socket_, history=None, trace=None, events=None):
    return Viewer(socket_, history or History(), trace or Numbers(), events or Numbers())


async def turn(viewer):
    await viewer.flush()
    viewer.acknowledge(None)


def test_a_page_that_does_not_read_keeps_a_bounded_queue_and_the_newest_image():
    async def scenario():
        viewer = viewer_of(StalledSocket())
        pump = asyncio.create_task(viewer.pump())
        messages = 8 * 3600 * 5  # eight hours at 5 Hz
        for number in range(messages):
            viewer.send(str(number))
            viewer.send_image(Image("", b"%d" % number))
            if number % 1000 == 0:
                await asyncio.sleep(0)
        assert viewer.waiting <= QUEUE_LIMIT + 1
        assert viewer.dropped >= 2 * messages - QUEUE_LIMIT - 10
        pump.cancel()

    asyncio.run(scenario())


def test_nothing_is_sent_until_the_last_turn_is_acknowledged_and_then_the_newest_image():
    async def scenario():
        socket_ = KeepingSocket()
        viewer = viewer_of(socket_)
        for number in range(4):
            viewer.send_image(Image(f'"n": {number}', b"jpeg %d" % number))
            viewer.send(str(number))
            await viewer.flush()
        head, rest = socket_.turn()
        assert (len(socket_.sent), head["messages"], head["image"]["n"], rest) == (1, [0], 0, b"jpeg 0")
        viewer.acknowledge(5.0)
        await viewer.flush()
        head, rest = socket_.turn()
        assert (len(socket_.sent), head["messages"], head["image"]["n"], rest) == (2, [1, 2, 3], 3, b"jpeg 3")
        assert head["echo"][0] == 5.0
        assert head["echo"][1] <= head["at"]

    asyncio.run(scenario())


def test_a_page_gets_few_turns_however_much_happens_and_the_past_without_pauses():
    async def scenario():
        socket_, trace, events = KeepingSocket(), Numbers(0), Numbers(1000)
        viewer = viewer_of(socket_, trace=trace, events=events)
        viewer.subscribe(frames=True, wire=True, history=0, events=0)
        pump = asyncio.create_task(viewer.pump())

        async def happen(times):
            before, count = len(socket_.sent), 0
            for _ in range(times):
                trace.end += 1
                viewer.send("0", state="status")
                await asyncio.sleep(0.002)
                if len(socket_.sent) > before + count:
                    count += 1
                    viewer.acknowledge(None)
            return count

        loop = asyncio.get_running_loop()
        past = await happen(50)  # six turns of events
        assert past >= 1000 / TURN_ITEMS
        begin = loop.time()
        turns = await happen(300)
        assert 2 <= turns <= (loop.time() - begin) / PAUSE_S + 2
        pump.cancel()

    asyncio.run(scenario())


def test_what_a_page_lacks_comes_newest_first_in_parts_and_what_is_new_before_it():
    async def scenario():
        socket_, events = KeepingSocket(), Numbers(950)
        viewer = viewer_of(socket_, events=events)
        viewer.subscribe(frames=True, wire=False, history=0, events=100)
        parts = []
        for _ in range(6):
            await turn(viewer)
            parts += [
                (message["items"][0], message["items"][-1]) for message in socket_.turn()[0]["messages"]
            ]
            events.end += len(parts) == 2
        assert parts == [(750, 949), (550, 749), (950, 950), (350, 549), (150, 349), (100, 149)]
        viewer.subscribe(frames=False, wire=False, history=0, events=0)
        events.end += 10
        viewer.subscribe(frames=True, wire=False, history=0, events=951)  # a page that was hidden for a while
        await turn(viewer)
        assert socket_.turn()[0]["messages"][0]["items"] == list(range(951, 961))

    asyncio.run(scenario())


def test_a_page_that_is_slow_is_told_how_many_items_of_the_trace_it_has_not_got():
    async def scenario():
        socket_, trace = KeepingSocket(), Numbers(100)
        viewer = viewer_of(socket_, trace=trace)
        viewer.subscribe(frames=False, wire=True, history=0, events=0)
        for expected in (0, 800, 0):
            await turn(viewer)
            (message,) = socket_.turn()[0]["messages"]
            assert message["left_out"] == expected
            trace.end += 1000 if expected == 0 else 10

    asyncio.run(scenario())


def test_a_slow_page_gets_only_the_last_of_each_state():
    async def scenario():
        socket_ = KeepingSocket()
        viewer = viewer_of(socket_)
        for number in range(100):
            viewer.send(f'"status {number}"', state="status")
            viewer.send(f'"rates {number}"', state="telemetry rates")
        viewer.send('"row"')
        await viewer.flush()
        assert socket_.turn()[0]["messages"] == ["status 99", "rates 99", "row"]

    asyncio.run(scenario())


def test_a_page_that_acknowledges_late_gets_the_numbers_of_every_frame(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=True)
            page.acknowledges = False
            await page.receive()
            before, turns = len(page.rows), page.turns
            await emulation.stepper.step(5.0)
            newest = emulation.device.cycle.published
            assert newest - before >= 3
            page.acknowledges = True
            await page.acknowledge()
            await page.until_frame(newest)
            numbers = [column(row, "frame") for row in page.history]
            assert [number for number in numbers if number > 0] == list(range(1, newest + 1))
            assert page.turns <= turns + 3
            assert len(page.frames) < newest

    run(scenario, options=OPTIONS)


@pytest.mark.parametrize("count", [1, 8])
def test_the_requests_of_pages_that_only_view_take_a_part_of_the_loop(run, monkeypatch, count):
    """32 pages that asked for messages of the trace were answered in bursts, which held up replies on the bus by 40 ms."""
    begun, each_s = [], 0.002
    message = Console._message

    async def busy(self, viewer, request):
        begun.append(asyncio.get_running_loop().time())
        begin_s = time.thread_time()
        while time.thread_time() - begin_s < each_s:
            pass
        return await message(self, viewer, request)

    monkeypatch.setattr(Console, "_message", busy)

    async def scenario(emulation, _line):
        emulation.traffic.passed.emit(
            WireItem(0.0, "can", outgoing=False, item=CanFrame(0x04800104, extended=True))
        )
        async with AsyncExitStack() as stack:
            pages = [
                await stack.enter_async_context(Page(emulation, field="view_only")) for _ in range(count)
            ]
            for number in range(16):
                text = json.dumps({"id": number, "do": "message", "n": 0})
                for page in pages:
                    await page.socket.send_str(text)
            for page in pages:
                await page.message("answer", lambda item: item["id"] == 15)

    run(scenario, options=replace(OPTIONS, console=replace(OPTIONS.console, view_token="look")))
    assert len(begun) == 16 * count
    assert len(begun) * each_s < 0.4 * (begun[-1] - begun[0] + each_s)


def test_the_requests_of_a_page_that_commands_do_not_wait_for_those_of_others(run, monkeypatch):
    count, answered, message = 200, [], Console._message

    async def busy(self, viewer, request):
        answered.append(viewer.commands)
        begin_s = time.thread_time()
        while not viewer.commands and time.thread_time() - begin_s < 0.01:
            pass
        return await message(self, viewer, request)

    monkeypatch.setattr(Console, "_message", busy)

    async def scenario(emulation, _line):
        emulation.traffic.passed.emit(
            WireItem(0.0, "can", outgoing=False, item=CanFrame(0x04800104, extended=True))
        )
        async with Page(emulation) as page, Page(emulation, field="view_only") as viewer:
            for number in range(count):
                await viewer.socket.send_str(json.dumps({"id": number, "do": "message", "n": 0}))
            for _ in range(3):
                await page.ask(do="message", n=0)

    run(scenario, options=replace(OPTIONS, console=replace(OPTIONS.console, view_token="look")))
    assert sum(answered) == 3
    assert len(answered) < count / 2


def test_a_page_that_closes_before_its_requests_are_executed_leaves_no_warning(run):
    async def scenario(emulation, _line):
        for _ in range(5):
            async with Page(emulation, field="view_only") as page:
                for number in range(16):
                    await page.socket.send_str(json.dumps({"id": number, "do": "parameters"}))
                await asyncio.sleep(0.002)
        gc.collect()

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run(scenario, options=replace(OPTIONS, console=replace(OPTIONS.console, view_token="look")))
    assert not [str(each.message) for each in said if "never awaited" in str(each.message)]


@pytest.mark.parametrize("kind", ["ping", "pong"])
def test_pings_and_pongs_of_a_page_have_their_turns_like_requests(run, monkeypatch, kind):
    """Two pages that only sent pings held up replies on the bus by more than a second."""
    count, turns = 30, []
    end_turn = Budget._end_turn

    def noted(self):
        turns.append(self)
        end_turn(self)

    monkeypatch.setattr(Budget, "_end_turn", noted)

    async def scenario(emulation, _line):
        async with Page(emulation, field="view_only") as page:
            before = len(turns)
            for _ in range(count):
                await getattr(page.socket, kind)(b"")
            await page.ask(do="parameters")
            return len(turns) - before

    options = replace(OPTIONS, console=replace(OPTIONS.console, view_token="look"))
    assert run(scenario, options=options) > count


CHUNKS = b"POST /runs HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n" + b"1\r\nx\r\n" * 200_000
"""A report of a stranger in chunks of a byte."""

FRAGMENTS = (
    b"GET /ws?token=look HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDAwMDAwMDAwMDAwMDAwMA==\r\n\r\n"
    b"\x01\x80\0\0\0\0" + b"\x00\x80\0\0\0\0" * 200_000
)
"""A message of a page for viewing only in empty fragments."""


@pytest.mark.parametrize("flood", [CHUNKS, FRAGMENTS], ids=["chunks", "fragments"])
def test_what_a_peer_sends_in_small_parts_takes_a_small_turn_of_the_loop(run, flood):
    """Parts of a byte are not requests, which have their turns: a flood of them held up replies on the bus by 0.2 s."""
    turns = []

    async def scenario(emulation, _line):
        def send():
            address = urlsplit(emulation.ready_fields["view"])
            with (
                suppress(OSError),  # it is closed, or read no further
                socket.create_connection((address.hostname, address.port), timeout=0.5) as peer,
            ):
                peer.sendall(flood)

        sending = asyncio.create_task(asyncio.to_thread(send))
        while not sending.done():
            before_s = time.thread_time()
            await asyncio.sleep(0)
            turns.append(time.thread_time() - before_s)
        await sending

    run(scenario, options=replace(OPTIONS, console=replace(OPTIONS.console, view_token="look")))
    assert max(turns) < 0.05


def test_a_page_that_comes_back_gets_the_rows_that_it_lacks_and_no_others(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=True)
            await emulation.stepper.step(3.0)
            await page.until_frame(emulation.device.cycle.published)
            await page.ask(do="subscribe", frames=False)  # hidden
            first_new = max(page.rows) + 1
            await emulation.stepper.step(3.0)
            await page.ask(do="subscribe", frames=True, history=first_new)
            newest = emulation.device.cycle.published
            await page.until(lambda: column(page.history[-1], "frame") == newest)
            assert sorted(page.rows) == list(range(len(page.rows)))
            assert len(page.rows) == page.rows_received > first_new + 2

    run(scenario, options=OPTIONS)


def test_the_timeline_has_what_happened_before_a_page_was_open_and_notes(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(3.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", frames=True)
            await page.ask(do="control", request={"do": "fault", "optical": {"blank": True}})
            await emulation.stepper.step(1.0)
            telemetry = [{"row": "precise_attitude", "freeze": "all"}, {"row": "quaternion", "freeze": "all"}]
            for count in (2, 1):
                answer = await page.ask(
                    do="control", request={"do": "fault", "telemetry": telemetry[:count], "phase": None}
                )
                assert answer["ok"], answer
            status = await page.message("status", lambda item: "telemetry" in item["status"]["faults"])
            assert any(fault.startswith("telemetry: ") for fault in status["heads"][0]["faults"])
            await page.ask(do="control", request={"do": "clear_faults"})
            await page.ask(do="send", row="set_unix_time", values={"seconds": "1", "nanoseconds": "0"})
            await page.ask(do="send", row="set_update_rate", values={"rate": "500"})
            assert (await page.ask(do="note", text="look here", at_s=2.0))["ok"]
            assert "must not be empty" in (await page.ask(do="note", text=" "))["error"]
            assert "at_s" in (await page.ask(do="note", text="x", at_s=1e6))["error"]
            await page.until(lambda: any(event["kind"] == "note" for event in page.items("events")))
            events = [
                (event["kind"], event["text"])
                for event in sorted(page.items("events"), key=lambda item: item["n"])
            ]
            kinds = [kind for kind, _ in events]
            assert ("telecommand", "set_mode mode=lost_in_space accepted") in events
            assert ("mode", "standby → lost in space (command)") in events
            assert ("attitude", "valid") in events
            assert ("fault", "begin: optical blank true") in events
            assert ("fault", "end: optical blank") in events
            assert ("fault", 'end: telemetry {"row": "quaternion", "freeze": "all"}') in events
            assert ("telecommand", "console: set_update_rate rate=500 refused: invalid_parameter") in events
            assert "clock" in kinds
            assert events[-1] == ("note", "look here")
            assert kinds[0] == "mode"

    run(scenario, options=OPTIONS)


def test_what_any_page_sends_is_listed_on_all_pages(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page, Page(emulation) as other:
            await page.ask(do="send", row="set_mode", values={"mode": "lost_in_space"})
            (item,) = (await other.message("sent", lambda message: message["items"]))["items"]
            assert (item["row"], item["values"], item["outcome"]) == (
                "set_mode",
                {"mode": "lost_in_space"},
                "ok",
            )
        async with Page(emulation) as later:
            assert [item["row"] for item in (await later.message("sent"))["items"]] == ["set_mode"]

    run(scenario, options=OPTIONS)


def test_a_message_of_the_trace_is_returned_with_its_fields_and_what_sends_it(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", wire=True)
            await page.ask(do="send", row="set_mode", values={"mode": "lost_in_space"})
            line = await page.until(
                lambda: next((each for each in page.items("wire") if "set_mode" in each["text"]), None)
            )
            message = await page.ask(do="message", n=line["n"])
            assert (message["row"], message["python"]) == (
                "set_mode",
                "client.command('set_mode', mode='lost_in_space')",
            )
            assert message["fields"] == [
                {"name": "mode", "value": "lost_in_space", "unit": "", "start": 0, "end": 1}
            ]
            assert "no longer kept" in (await page.ask(do="message", n=10**9))["error"]
            text = await page.get("/wire.txt")
            assert "set_mode mode=lost_in_space" in text

    run(scenario, options=OPTIONS)
