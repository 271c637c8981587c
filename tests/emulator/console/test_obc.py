"""The console's OBC: telecommands, rows read, the session and the candump log that are saved, units and their links."""

import asyncio
import tomllib
from types import SimpleNamespace

import pytest

from starhil.emulator.console.obc import ConsoleObc, Exchange, toml
from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, SerialHostLink
from starhil.hil_tests.session.script import load_script
from starhil.protocol.unit import load_unit
from tests.candump import parse_candump
from tests.emulator.console.pages import OPTIONS, Page
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prompt_pages")]

LINKS_OFF = {"serial": {"port": "off"}, "can": {"channel": "off"}}


def test_a_telecommand_is_sent_over_a_link_and_its_outcome_shown(run):
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


async def as_obc(emulation, icd, bus):
    """Request telemetry twice as an OBC on a link."""
    if bus == "serial":
        link = SerialHostLink(icd, emulation.ready_fields["serial"], dialect=emulation.serial_dialect())
    else:
        link = CanHostLink(
            emulation.ready_fields["can"], device_address=emulation.device.parameters["can_address"]
        )
    client = AsyncObcClient(link, icd)
    await client.start()
    row = next(row for row in icd.telemetry.values() if row.answers == ("reply",))
    for _ in range(2):
        await client.transact(icd.request(row, b""), row.name)
    await client.close()


@pytest.mark.parametrize(
    ("unit", "bus", "links"),
    [
        ("cubestar", "can", {"can": {"channel": "virtual:console-heard"}}),
        ("cubestar", "serial", {"serial": {"port": "auto"}}),
        ("sagitta", "serial", {"serial": {"port": "auto"}}),
    ],
)
def test_the_requests_of_the_obc_are_counted_and_those_of_the_console_are_not(run, unit, bus, links):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        name = {"can": "CAN", "serial": "serial"}[bus]
        async with Page(emulation) as page:
            row = page.messages[0]["telemetry"][0]["name"]
            await page.ask(do="subscribe", rows=[row])
            await page.message("telemetry", lambda item: item["outcome"] == "ok")
            assert (await page.ask(do="read", row=row))["outcome"] == "ok"
            status = await page.message("status")
            assert status["heard"] == [{"link": name, "requests": 0, "age_s": None}]
            assert emulation.device.counters.telemetry == 0
            await as_obc(emulation, emulation.icd, bus)
            status = await page.message("status", lambda item: item["heard"][0]["requests"] == 2)
            assert 0.0 <= status["heard"][0]["age_s"] < PATIENCE_S
            assert emulation.device.counters.telemetry == 2

    run(scenario, options=OPTIONS, unit=unit, links={**LINKS_OFF, **links})


def test_a_page_shows_the_present_values_of_parameters(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            parameters = {item["name"]: item for item in page.messages[0]["parameters"]}
            emulation.device.parameters.set({"exposure": 250})
            values = (await page.ask(do="parameters"))["values"]
            assert (values["exposure"], parameters["exposure"]["unit"]) == (250, "ms")
            assert parameters.keys() <= values.keys()

    run(scenario, options=OPTIONS)


def test_what_the_console_sent_is_a_session_script(run, tmp_path):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            assert "nothing has been sent yet" in await page.get("/session.toml")
            await page.ask(do="send", row="set_mode", values={"mode": "lost_in_space"})
            await page.ask(do="send", row="set_update_rate", values={"rate": "500"})
            await page.ask(do="send", row="clear_counters", values={})
            await page.ask(do="read", row="device_status")
            path = tmp_path / "session.toml"
            path.write_text(await page.get("/session.toml"))
            script = load_script(path, load_unit())
            mode, rate, *others = [step for step in script.steps if not step.name.startswith("wait")]
            assert mode.values == {"mode": "lost_in_space"}
            assert rate.refused == "invalid_parameter"
            assert len(others) == 2
            await page.ask(do="clear_session")
            assert "nothing has been sent yet" in await page.get("/session.toml")

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


def test_a_page_that_subscribes_to_the_wire_gets_it_decoded(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", wire=True)
            peer = open(emulation.ready_fields["serial"], "r+b", buffering=0)  # noqa: PTH123, SIM115
            peer.write(bytes.fromhex("1F7FE61FFF"))
            request = await page.message(
                "wire", lambda item: any("quaternion?" in line["text"] for line in item["items"])
            )
            line = next(line for line in request["items"] if "quaternion?" in line["text"])
            assert (line["bus"], line["out"], line["raw"]) == ("serial", False, "1F 7F E6 1F FF")
            await page.message(
                "wire", lambda item: any(line["text"].startswith("quaternion q_x") for line in item["items"])
            )
            peer.close()

    run(scenario, options=OPTIONS)


def test_the_candump_log_has_the_frames_and_the_name_of_the_bus(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:
            await page.ask(do="subscribe", wire=True)
            await page.ask(do="send", row="clear_counters", values={})
            text = await page.get("/wire.log")
            seen = [(channel, frame.id) for channel, frame in map(parse_candump, text.splitlines())]
            assert seen == [("console-test", 0x0167FD04), ("console-test", 0x026704FD)]

    run(
        scenario,
        options=OPTIONS,
        links={"serial": {"port": "off"}, "can": {"channel": "virtual:console-test"}},
    )


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
            line = await page.until(
                lambda: next(
                    (each for each in page.items("wire") if each["raw"] == shown["cansend"][0]), None
                )
            )
            assert line["text"] == "node 44 write 4000h status = lost_in_space"
            refused = await page.ask(do="send", row="set_status", values={"status": "77"})
            assert (refused["outcome"], refused["refused"]) == ("invalid_parameter", True)
            assert (await page.ask(do="read", row="status"))["values"] == {"status": "lost_in_space"}

    run(
        scenario,
        options=OPTIONS,
        unit="oresat",
        links={**LINKS_OFF, "can": {"channel": "virtual:console-sdo"}},
    )


@pytest.mark.parametrize("text", ['a\nb"\\c\t\r\0\x1f\x7f\x9f', "→ \U0001f6f0", ""])
def test_a_saved_session_quotes_every_character(text):
    assert tomllib.loads(f"text = {toml(text)}") == {"text": text}
