"""The console's server: who may look, what a page receives and sends, and pages that do not read."""

import asyncio
import json
import socket
import tomllib
from contextlib import AsyncExitStack
from dataclasses import replace
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.console.describe import fault_controls
from starhil.emulator.console.history import COLUMNS, MODES
from starhil.emulator.console.obc import ConsoleObc, Exchange
from starhil.emulator.console.viewer import QUEUE_LIMIT, Viewer
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.run_feed import RunFeed
from starhil.hil_tests.script import load_script
from starhil.protocol.candump import parse_candump
from starhil.protocol.icd import load_unit
from tests.emulator.conftest import PREVIEW
from tests.emulator.runs import command, read

OPTIONS = RunOptions(control="auto", view="auto", make_client=ConsoleClient)
WITHIN_S = 20.0


class Page:
    """A page of a console."""

    def __init__(self, emulation, head=None):
        self.address = emulation.ready_fields["view"] + (f"&head={head}" if head is not None else "")
        self.messages = []
        self.frames = []
        self.history = None
        self._number = 0

    def url(self, path):
        return self.address.replace("/?", f"{path}?")

    async def __aenter__(self):
        self.session = aiohttp.ClientSession()
        self.socket = await self.session.ws_connect(self.url("/ws"), max_msg_size=0)
        hello = await self.until(lambda: self.history is not None)
        assert hello
        return self

    async def refusal(self):
        """Return the text with which a page is refused."""
        async with aiohttp.ClientSession() as session, session.get(self.url("/ws")) as response:
            return await response.text()

    async def __aexit__(self, *_):
        await self.socket.close()
        await self.session.close()

    async def receive(self):
        message = await asyncio.wait_for(self.socket.receive(), WITHIN_S)
        if message.type is aiohttp.WSMsgType.TEXT:
            self.messages.append(json.loads(message.data))
        elif message.data[:1] == b"F":
            sizes = [int.from_bytes(message.data[start : start + 4], "little") for start in (1, 5)]
            middle, end = 9 + sizes[0], 9 + sum(sizes)
            head = json.loads(message.data[9:middle]) | json.loads(message.data[middle:end])
            self.frames.append((head, message.data[end:]))
        else:
            self.history = np.frombuffer(message.data[8:]).reshape(-1, len(COLUMNS))

    async def until(self, condition):
        """Receive until a condition holds."""
        for _ in range(1000):
            if found := condition():
                return found
            await self.receive()
        raise AssertionError("never came")

    async def ask(self, **request):
        """Make a request and return its answer."""
        self._number += 1
        number = self._number
        await self.socket.send_str(json.dumps({"id": number, **request}))
        return await self.until(
            lambda: next(
                (item for item in self.messages if item["type"] == "answer" and item["id"] == number), None
            )
        )

    async def message(self, kind, condition=lambda _message: True):
        """Wait for a message of a kind."""
        return await self.until(
            lambda: next((item for item in self.messages if item["type"] == kind and condition(item)), None)
        )

    async def until_frame(self, number):
        """Wait for the frame of a number."""
        await self.until(lambda: self.frames and column(self.frames[-1][0]["row"], "frame") == number)

    async def get(self, path):
        async with self.session.get(self.url(path)) as response:
            return await response.text()


def column(row, name):
    return row[COLUMNS.index(name)]


@pytest.mark.parametrize("path", ["/", "/runs", "/ws", "/session.toml", "/wire.log"])
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


def test_previews_are_made_only_while_somebody_looks_at_the_images(run):
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
        async with asyncio.timeout(WITHIN_S):
            while emulation.imager.watchers:
                await asyncio.sleep(0.01)
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
        known = emulation.device.cycle.published
        async with Page(emulation) as page:
            hello = page.messages[0]
            assert hello["columns"] == list(COLUMNS)
            assert {row["name"] for row in hello["telemetry"]} == set(emulation.device.icd.telemetry)
            assert {row["name"] for row in hello["telecommands"]} == set(emulation.device.icd.telecommands)
            assert hello["star_names"]["27989"] == "Betelgeuse"
            assert len(page.history) == known
            assert column(page.history.T, "error_x") == pytest.approx(1e-5 * 206264.806, rel=1e-3)
            await page.ask(do="subscribe", frames=True)
            await emulation.stepper.step(1.0)
            head, jpeg = await page.until(lambda: page.frames and page.frames[-1])
            assert jpeg == PREVIEW.jpeg
            assert head["hips"] == [32349]
            assert column(head["row"], "frame") > known
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
            head, _ = await page.until(lambda: page.frames and page.frames[-1])
            assert head["reason"] == "too_few_stars"
            assert column(head["row"], "valid") == 0
            assert column(head["row"], "error_cross") is None
            reasons = (await page.message("reasons", lambda item: item["reasons"]))["reasons"]
            assert reasons[int(column(head["row"], "reason"))] == "too_few_stars"

    run(scenario, options=OPTIONS)


def test_a_telecommand_goes_over_a_link_and_its_outcome_comes_back(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            shown = await page.ask(do="encode", row="set_mode", values={"mode": "lost_in_space"})
            assert shown["serial"] == "1F 7F 60 02 1F FF"
            assert shown["cansend"] == ["0160FD04#02"]
            sent = await page.ask(do="send", row="set_mode", values={"mode": "lost_in_space"})
            assert sent["outcome"] == "ok"
            assert sent["latency_ms"] > 0
            assert emulation.device.counters.telecommands == 1
            assert emulation.device.modes.mode == "lost_in_space"
            refused = await page.ask(do="send", row="set_update_rate", values={"rate": "500"})
            assert (refused["outcome"], refused["refused"]) == ("invalid_parameter", True)
            problem = await page.ask(do="encode", row="set_update_rate", values={"rate": "500"})
            assert "set_update_rate.rate: 500.0 is outside 0.01 to 100 Hz" in problem["problem"]
            wrong = await page.ask(do="send", row="set_update_rate", values={"rate": "fast"})
            assert wrong["error"] == "rate: 'fast' is not a number"
            assert (await page.ask(do="send", row="no_such", values={}))[
                "error"
            ] == "no_such: no such telecommand"
            assert emulation.device.counters.telecommands == 2

    run(scenario, options=OPTIONS)


def test_only_the_rows_that_a_page_shows_are_read(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            assert emulation.device.counters.telemetry == 0
            await page.ask(do="subscribe", rows=["device_status", "quaternion", "no_such_row"])
            status = await page.message("telemetry", lambda item: item["row"] == "device_status")
            assert status["values"]["mode"] == "standby"
            await page.message("telemetry", lambda item: item["row"] == "quaternion")
            assert {item["row"] for item in page.messages if item["type"] == "telemetry"} == {
                "device_status",
                "quaternion",
            }

    run(scenario, options=OPTIONS)


def test_what_the_console_sent_is_a_session_script(run, tmp_path):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            assert "nothing was sent yet" in await page.get("/session.toml")
            await page.ask(do="send", row="set_mode", values={"mode": "lost_in_space"})
            await page.ask(do="send", row="set_update_rate", values={"rate": "500"})
            await page.ask(do="send", row="clear_counters", values={})
            await page.ask(do="read", row="device_status")
            path = tmp_path / "session.toml"
            path.write_text(await page.get("/session.toml"))
            script = load_script(path, load_unit())
            mode, rate, *others = [step for step in script.steps if not step.name.startswith("wait")]
            assert mode.action.values == {"mode": "lost_in_space"}
            assert rate.action.refused == "invalid_parameter"
            assert len(others) == 2
            await page.ask(do="clear_session")
            assert "nothing was sent yet" in await page.get("/session.toml")

    run(scenario, options=OPTIONS)


class SlowClient:
    """An OBC whose device answers after a while."""

    def __init__(self, clock):
        self.clock = clock

    async def exchange(self, _row, _data):
        self.clock.now_s += 0.8
        return Exchange("ok", latency_s=0.8)


def test_a_pause_between_two_telecommands_is_a_step_and_a_slow_reply_is_none():
    clock = SimpleNamespace(now_s=100.0)
    obc = ConsoleObc(SlowClient(clock), load_unit(), lambda: clock.now_s)

    async def scenario():
        await obc.send("clear_counters", {})
        await obc.send("clear_counters", {})
        clock.now_s += 1.5
        await obc.send("clear_counters", {})

    asyncio.run(scenario())
    steps = tomllib.loads(obc.session("Pauses"))["step"]
    assert steps == [
        {"command": "clear_counters"},
        {"command": "clear_counters"},
        {"wait_s": 1.5},
        {"command": "clear_counters"},
    ]


def test_faults_scenarios_and_truth_are_set_from_the_page_and_nothing_else(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(5.0)
        async with Page(emulation) as page:
            answer = await page.ask(do="control", request={"do": "fault", "optical": {"blank": True}})
            assert answer["faults"] == {"optical": {"blank": True}}
            status = await page.message("status", lambda item: item["status"]["faults"])
            assert status["status"]["faults"] == {"optical": {"blank": True}}
            wrong = await page.ask(do="control", request={"do": "fault", "optical": {"moon": 3}})
            assert wrong["error"].startswith("optical")
            assert (
                "request: do must be one of"
                in (await page.ask(do="control", request={"do": "quit"}))["error"]
            )
            assert (await page.ask(do="control", request=3))["error"] == "request: must be an object"
            assert "do: must be one of" in (await page.ask(do="fly"))["error"]
            assert (await page.ask(do="control", request={"do": "clear_faults"}))["faults"] == {}
            slew = await page.ask(do="point", kind="slew", to={"star": "rigel"}, max_rate_deg_s=2.0)
            assert slew["kind"] == "slew"
            await emulation.stepper.step(60.0)
            truth = await page.ask(do="control", request={"do": "truth"})
            assert (truth["ra_deg"], truth["dec_deg"]) == pytest.approx((78.634, -8.202), abs=0.01)
            unknown = await page.ask(do="point", kind="slew", to={"star": "Nibiru"})
            assert unknown["error"].startswith("star 'Nibiru': unknown")

    run(scenario, options=OPTIONS)


def test_every_fault_of_the_device_has_a_control_with_the_values_that_it_takes():
    icd = load_unit()
    device = next(level["controls"] for level in fault_controls(icd, ["can"]) if level["level"] == "device")
    controls = {control["name"]: control for control in device}
    upset = {control["name"]: control for control in controls.pop("upset")["controls"]}
    assert upset["parameter"]["values"] == list(icd.device_parameters)
    assert (upset["bit"]["kind"], upset["bit"]["min"], upset["bit"]["max"]) == ("integer", 0, 63)
    assert (upset["star"]["kind"], upset["star"]["max"]) == ("integer", 200_000)
    assert controls.pop("stuck")["kind"] == "flag"
    assert set(controls) == {"error", "reset"}
    assert all(control["kind"] == "choice" and control["values"] for control in controls.values())


def test_a_scenario_from_the_page_begins_now(run, tmp_path):
    path = tmp_path / "later.toml"
    path.write_text('name = "later"\n[[at]]\nrun_time_s = 2.0\nfault = { optical = { blank = true } }\n')

    async def scenario(emulation, _line):
        await emulation.stepper.step(10.0)
        async with Page(emulation) as page:
            assert (await page.ask(do="control", request={"do": "scenario", "name": str(path)}))[
                "events"
            ] == 1
            await emulation.stepper.step(1.9)
            assert run.launched.faults.describe() == {}
            await emulation.stepper.step(0.2)
            assert run.launched.faults.describe() == {"optical": {"blank": True}}
            missing = await page.ask(do="control", request={"do": "scenario", "name": "no_such"})
            assert "no such file" in missing["error"]

    run(scenario, options=OPTIONS)


def test_the_stepped_clock_runs_until_it_is_paused(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            assert (await page.ask(do="clock", speed=10))["speed"] == 10
            await page.message("status", lambda item: item["status"]["run_time_s"] > 2.0)
            assert (await page.ask(do="clock", speed=0))["speed"] == 0
            assert (await page.ask(do="clock", speed=1000))["error"] == "speed: 1000 is outside 0 … 100"

    run(scenario, options=OPTIONS)


def test_a_clock_that_passes_by_itself_cannot_be_stopped(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            assert (await page.ask(do="clock", speed=1))["error"] == "the clock is real: it cannot be stopped"

    run(scenario, clock="real", options=OPTIONS)


def test_the_wire_is_decoded_for_those_who_look_and_saved_as_a_candump_log(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", wire=True)
            peer = open(emulation.ready_fields["serial"], "r+b", buffering=0)  # noqa: PTH123, SIM115
            peer.write(bytes.fromhex("1F7FE61FFF"))
            request = await page.message(
                "wire", lambda item: any("quaternion?" in line["text"] for line in item["lines"])
            )
            line = next(line for line in request["lines"] if "quaternion?" in line["text"])
            assert (line["bus"], line["out"], line["raw"]) == ("serial", False, "1F 7F E6 1F FF")
            await page.message(
                "wire", lambda item: any(line["text"].startswith("quaternion q_x") for line in item["lines"])
            )
            peer.close()

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


ALONG_X = {"matrix": [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}


def test_each_head_has_a_page_of_its_own_on_a_clock_of_all(run):
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
            assert run.launched.heads[0].faults.describe() == {}
            slew = {"kind": "slew", "to": {"star": "rigel", "roll_deg": 20.0}, "max_rate_deg_s": 5.0}
            await second.ask(do="point", **slew)
            await emulation.stepper.step(60.0)
            truth = await second.ask(do="control", request={"do": "truth"})
            assert (truth["ra_deg"], truth["dec_deg"]) == pytest.approx((78.634, -8.202), abs=0.01)
            assert truth["roll_deg"] == pytest.approx(20.0)
            assert "head: '3' given, must be 1 to 2" in await Page(emulation, head=3).refusal()

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


@pytest.mark.parametrize("mount", [None, ALONG_X])
def test_the_sensor_points_turns_and_stands_as_the_page_asks_however_it_is_mounted(run, mount):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:

            async def truth():
                return await page.ask(do="control", request={"do": "truth"})

            begin = (await truth())["quaternion_xyzw"]
            await page.ask(do="point", kind="rate", rate_deg_s=[0.1, 0.2, 0.3])
            turning = await truth()
            assert turning["quaternion_xyzw"] == pytest.approx(begin)
            assert turning["rate_deg_s"] == pytest.approx([0.1, 0.2, 0.3])
            await emulation.stepper.step(10.0)
            before = (await truth())["quaternion_xyzw"]
            await page.ask(do="point", kind="fixed", to={})
            assert (await truth())["quaternion_xyzw"] == pytest.approx(before)
            await page.ask(do="point", kind="fixed", to={"ra_deg": 10.0, "dec_deg": 20.0, "roll_deg": 30.0})
            still = await truth()
            assert [still[f"{name}_deg"] for name in ("ra", "dec", "roll")] == pytest.approx(
                [10.0, 20.0, 30.0]
            )
            wrong = await page.ask(do="point", kind="fixed", to={"ra_deg": 10.0, "dec_deg": 95.0})
            assert "dec_deg" in wrong["error"]
            assert "kind" in (await page.ask(do="point", kind="fly"))["error"]
            assert "rate_deg_s" in (await page.ask(do="point", kind="rate", rate_deg_s=[1.0]))["error"]

    run(scenario, options=OPTIONS, truth={"kind": "fixed", "mount": mount} if mount else {"kind": "fixed"})


class StalledSocket:
    """A page that never reads."""

    async def send_str(self, _data):
        await asyncio.Event().wait()

    async def send_bytes(self, _data):
        await asyncio.Event().wait()


def test_a_page_that_does_not_read_keeps_a_bounded_queue_and_the_newest_image():
    async def scenario():
        viewer = Viewer(StalledSocket())
        pump = asyncio.create_task(viewer.pump())
        messages = 8 * 3600 * 5  # eight hours at 5 Hz
        for number in range(messages):
            viewer.send(str(number))
            viewer.send_frame(b"%d" % number)
            if number % 1000 == 0:
                await asyncio.sleep(0)
        assert viewer.waiting <= QUEUE_LIMIT + 1
        assert viewer.dropped >= 2 * messages - QUEUE_LIMIT - 10
        pump.cancel()

    asyncio.run(scenario())


def test_a_session_reports_its_results_to_the_console_while_it_goes_on(run):
    async def scenario(emulation, _line):
        address = emulation.ready_fields["view"]
        async with Page(emulation) as page:
            feed = await asyncio.to_thread(
                RunFeed, address, kind="session", title="First light", unit="can vcan0", planned=2
            )
            begun = await page.message("run")
            assert (begun["title"], begun["planned"], begun["end_s"]) == ("First light", 2, None)
            feed.result("the device answers", "passed", "ok", identity="1", link="can", seconds=0.1)
            feed.result("it tracks", "failed", "mode=standby", identity="2", traffic=("-> 1F 7F",))
            failed = await page.message("result", lambda item: item["result"]["status"] == "failed")
            assert failed["counts"] == {"passed": 1, "failed": 1, "skipped": 0, "not run": 0}
            await asyncio.to_thread(feed.close)
            await page.message("run", lambda item: item["end_s"] is not None)
        async with Page(emulation) as later:  # the report after the run
            report = await later.message("run")
            assert [result["name"] for result in report["results"]] == ["the device answers", "it tracks"]

    run(scenario, options=OPTIONS)


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


def test_the_candump_log_has_the_frames_of_the_bus(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", wire=True)
            await page.ask(do="send", row="clear_counters", values={})
            text = await page.get("/wire.log")
            ids = [parse_candump(line)[1].id for line in text.splitlines()]
            assert ids == [0x0167FD04, 0x026704FD]

    run(
        scenario,
        options=OPTIONS,
        links={"serial": {"port": "off"}, "can": {"channel": "virtual:console-test"}},
    )


LINKS_OFF = {"serial": {"port": "off"}, "can": {"channel": "off"}}


@pytest.mark.parametrize(
    ("unit", "links"),
    [
        ("sagitta", {"serial": {"port": "auto"}}),
        ("st16", {"serial": {"port": "auto"}}),
        ("cubestar-gen2", {"can": {"channel": "virtual:console-unit"}}),
        ("oresat", {"can": {"channel": "virtual:console-unit"}}),
        ("oresat", {}),
    ],
)
def test_a_unit_of_any_kind_is_reached_over_the_link_that_it_has(run, unit, links):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            hello = page.messages[0]
            assert hello["unit"]["name"] == emulation.icd.name
            for row in hello["telemetry"][:3]:
                answer = await page.ask(do="read", row=row["name"])
                assert answer["outcome"] == "ok"
                assert answer["values"]

    run(scenario, options=OPTIONS, unit=unit, links={**LINKS_OFF, **links})


def test_a_unit_with_canopen_only_is_commanded_by_sdo(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            shown = await page.ask(do="encode", row="set_status", values={"status": "4"})
            assert (shown["serial"], shown["cansend"]) == ("", ["62C#2F00400004000000"])
            await page.ask(do="subscribe", wire=True)
            assert (await page.ask(do="send", row="set_status", values={"status": "4"}))["outcome"] == "ok"
            assert emulation.device.modes.mode == "lost_in_space"
            traced = await page.message("wire", lambda item: item["lines"])
            assert traced["lines"][0]["raw"] == shown["cansend"][0]
            refused = await page.ask(do="send", row="set_status", values={"status": "77"})
            assert (refused["outcome"], refused["refused"]) == ("invalid_parameter", True)
            assert (await page.ask(do="read", row="status"))["values"] == {"status": "lost_in_space"}

    run(
        scenario,
        options=OPTIONS,
        unit="oresat",
        links={**LINKS_OFF, "can": {"channel": "virtual:console-sdo"}},
    )


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("nowhere", "must be auto or HOST:PORT"),
        ("127.0.0.1:99999", "must be auto or HOST:PORT"),
        ("no.such.host:1", "cannot listen"),
    ],
)
def test_an_address_that_is_none_ends_the_start_in_one_line(run, where, said):
    async def nothing(_emulation, _line):
        return

    with pytest.raises(EmulatorError, match=said):
        run(nothing, options=replace(OPTIONS, view=where))


def test_a_port_in_use_ends_the_start_in_one_line(run):
    async def nothing(_emulation, _line):
        return

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(EmulatorError, match="cannot listen"):
            run(nothing, options=replace(OPTIONS, view=f"127.0.0.1:{other.getsockname()[1]}"))
