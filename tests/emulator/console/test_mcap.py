"""The recording: read back with mcap's own reader."""

import base64
import json
import resource
import shutil

import pytest
from mcap.reader import make_reader

from starhil.emulator.cli.console_client import ConsoleClient
from starhil.emulator.console import mcap as recorder_module
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import ConsoleOptions, RunOptions
from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, SerialHostLink
from starhil.protocol.unit import load_unit
from tests.emulator.conftest import ORION, PREVIEW
from tests.emulator.console.pages import OPTIONS, Page
from tests.emulator.runs import Control, command, every_row_read

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prompt_pages")]

ICD = load_unit()
JSON_TYPES = {"object": dict, "string": str, "number": (int, float), "integer": int, "boolean": bool}


def options(path, **more):
    return RunOptions(console=ConsoleOptions(ConsoleClient, files=(path,)), **more)


def messages(path):
    with path.open("rb") as stream:
        by_topic = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            by_topic.setdefault(channel.topic, []).append(
                (schema.name, message.log_time, json.loads(message.data))
            )
            properties = json.loads(schema.data)["properties"]
            for name, value in by_topic[channel.topic][-1][2].items():
                wanted = properties.get(name, {}).get("type")
                assert wanted is None or isinstance(value, JSON_TYPES[wanted]), (channel.topic, name, value)
        return by_topic


async def record(emulation):
    """Track for two seconds of simulation time, and wait until a row of telemetry was read."""
    await emulation.stepper.step(1.0)
    command(emulation, "set_mode", mode="lost_in_space")
    await emulation.stepper.step(2.0)
    await every_row_read(emulation)


def count(path):
    return sum(map(len, messages(path).values()))


def test_images_truth_measurements_telemetry_and_events_are_read_back(run, tmp_path):
    path = tmp_path / "run.mcap"
    published = []

    async def scenario(emulation, _line):
        emulation.device.signals.frame_published.connect(published.append)
        await record(emulation)

    run(scenario, options=options(path))
    by_topic = messages(path)
    assert len(published) >= 2
    for topic, schema in (
        ("/image", "foxglove.CompressedImage"),
        ("/truth", "foxglove.FrameTransform"),
        ("/measurement", "starhil.Measurement"),
    ):
        assert [name for name, _, _ in by_topic[topic]] == [schema] * len(published)
        assert [at for _, at, _ in by_topic[topic]] == [each.mid_unix_ns for each in published]
    assert base64.b64decode(by_topic["/image"][0][2]["data"]) == PREVIEW.jpeg
    rotation = by_topic["/truth"][0][2]["rotation"]
    x, y, z, w = ORION.quaternion_xyzw
    assert [rotation[name] for name in "xyzw"] == pytest.approx(
        [-x, -y, -z, w]
    )  # of the frame, not of its vectors
    measured = by_topic["/measurement"][-1][2]
    assert (measured["valid"], measured["mode"], measured["matched"]) == (True, "tracking", 35)
    events = [(event["name"], event["message"]) for _, _, event in by_topic["/events"]]
    assert ("mode", "standby → lost in space (command)") in events
    assert ("telecommand", "set_mode mode=lost_in_space accepted") in events
    assert by_topic["/telemetry/device_status"][0][2]["mode"] in (
        "boot",
        "standby",
        "lost_in_space",
        "tracking",
    )


def test_faults_traffic_units_and_what_identifies_the_run_are_read_back(run, tmp_path):
    path = tmp_path / "run.mcap"

    async def scenario(emulation, _line):
        client = AsyncObcClient(
            SerialHostLink(emulation.icd, emulation.ready_fields["serial"]), emulation.icd
        )
        await client.start()
        async with Control(emulation) as control:
            await control.do("fault", optical={"false_stars": 3})
        await emulation.stepper.step(1.0)
        await client.command("set_mode", mode="lost_in_space")
        async with Control(emulation) as control:
            await control.do("clear_faults")
        await client.close()
        await record(emulation)

    run(scenario, options=options(path, control="auto"))
    by_topic = messages(path)
    events = [event["message"] for _, _, event in by_topic["/events"]]
    assert "begin: optical false_stars 3" in events
    assert "end: optical false_stars" in events
    assert [faults for _, _, faults in by_topic["/faults"]] == [{"optical": {"false_stars": 3}}, {}]
    serial = [(line["out"], line["kind"], line["text"]) for _, _, line in by_topic["/bus/serial"]]
    assert (False, "telecommand", "set_mode mode=lost_in_space") in serial
    assert (True, "ack", "set_mode accepted") in serial
    with path.open("rb") as stream:
        reader = make_reader(stream)
        (metadata,) = reader.iter_metadata()
        schemas = {schema.name: json.loads(schema.data) for schema in reader.get_summary().schemas.values()}
    assert metadata.name == "starhil.run"
    assert (metadata.metadata["unit"], metadata.metadata["seed"]) == ("cubestar", "1")
    assert schemas["starhil.Measurement"]["properties"]["rate_x"]["unit"] == "deg/s"
    rate = schemas["starhil.Telemetry.precise_attitude"]["properties"]["rate_x"]
    assert (rate["unit"], rate["description"]) == (
        "deg/s",
        ICD.telemetry["precise_attitude"].named_fields["rate_x"].doc,
    )


def test_the_recorders_own_requests_are_not_recorded(run, tmp_path):
    path = tmp_path / "run.mcap"

    async def scenario(emulation, _line):
        client = AsyncObcClient(CanHostLink("virtual:recorded-bus"), emulation.icd)
        await client.start()
        await client.telemetry("identification")
        await record(emulation)
        await client.close()

    links = {"serial": {"port": "off"}, "can": {"channel": "virtual:recorded-bus"}}
    run(scenario, options=options(path), links=links)
    texts = [line["text"] for _, _, line in messages(path)["/bus/can"]]
    assert texts[0] == "1→4 identification?"
    assert all(text.startswith(("1→4", "4→1")) for text in texts)


def test_nothing_is_replaced_unless_asked_for(run, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"kept")

    async def nothing(_emulation, _line):
        return

    with pytest.raises(
        EmulatorError, match=r"exists and is not empty; choose another file, or replace it with"
    ):
        run(nothing, options=options(path))
    assert path.read_bytes() == b"kept"
    run(nothing, options=options(path, overwrite=True))
    assert path.read_bytes()[:5] == b"\x89MCAP"
    with pytest.raises(EmulatorError, match="cannot be written"):
        run(nothing, options=options(tmp_path / "no_folder" / "run.mcap"))


def test_a_full_disk_ends_the_recording_and_not_the_run(run, tmp_path, caplog):
    async def scenario(emulation, _line):
        await record(emulation)
        assert emulation.device.frames_valid > 0

    class FullDisk:
        """A disk with room for nothing."""

        def __init__(self, *_args, **_options):
            self.register_schema = self.register_channel = lambda **_options: 1
            self.start = lambda **_options: None
            self.add_metadata = lambda *_options: None

        def add_message(self, **_options):
            raise OSError(28, "No space left on device")

        finish = add_message

    original = recorder_module.Writer
    recorder_module.Writer = FullDisk
    try:
        run(scenario, options=options(tmp_path / "run.mcap"))
    finally:
        recorder_module.Writer = original
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(said) == 1
    assert "run.mcap: cannot be written (No space left on device); it ends here" in said[0]


@pytest.mark.parametrize("room", [0, 30_000])
def test_a_recording_of_which_the_disk_became_full_can_be_read(run, tmp_path, monkeypatch, room):
    """It had no end, and most readers rejected it."""
    path, begin = tmp_path / "run.mcap", tmp_path / "begin.mcap"
    monkeypatch.setattr(recorder_module, "CHUNK_BYTES", 20_000)

    async def scenario(emulation, _line):
        shutil.copy(path, begin)  # a chunk may have been written while the run started
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (begin.stat().st_size + room, limits[1]))
        try:
            for _ in range(3):
                await record(emulation)
            await run.launched.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    run(scenario, options=options(path))
    assert run.launched.failed
    assert path.stat().st_size <= begin.stat().st_size + room
    assert (count(path) > count(begin)) == (room > 0)


def test_a_recording_of_a_run_that_was_killed_can_be_read(run, tmp_path, monkeypatch):
    path, killed = tmp_path / "run.mcap", tmp_path / "killed.mcap"
    monkeypatch.setattr(recorder_module, "CHUNK_BYTES", 20_000)

    async def scenario(emulation, _line):
        await record(emulation)
        shutil.copy(path, killed)

    run(scenario, options=options(path))
    assert {*messages(killed)} <= {*messages(path)}
    assert messages(killed)


def test_what_happens_after_the_end_of_the_recording_is_no_error(run, tmp_path, caplog, monkeypatch):
    """Each end of a run that took images logged an internal error."""

    async def scenario(emulation, _line):
        await record(emulation)
        close, published = emulation.run.close, emulation.device.cycle.published

        async def close_later():
            await emulation.stepper.step(1.0)
            command(emulation, "set_mode", mode="standby")
            emulation.faults.clear()
            assert emulation.device.cycle.published > published
            await close()

        monkeypatch.setattr(emulation.run, "close", close_later)

    path = tmp_path / "run.mcap"
    run(scenario, options=options(path))
    assert messages(path)["/measurement"]
    assert caplog.text == ""


def test_each_head_has_its_own_file(run, tmp_path):
    async def scenario(emulation, _line):
        await emulation.stepper.step(4.0)

    off = {"serial": {"port": "off"}, "can": {"channel": "off"}}
    tracking = {"links": off, "parameters": {"start_mode": "lost_in_space"}}
    other = {"run": {"clock": "stepped", "seed": 2}, **tracking}
    run(scenario, options=options(tmp_path / "run.mcap"), others=[other], **tracking)
    first, second = (messages(tmp_path / name) for name in ("run.mcap", "run.2.mcap"))
    assert len(first["/measurement"]) == len(second["/measurement"]) >= 2


@pytest.mark.parametrize("unix_s", [(1 << 64) // 1_000_000, -1_000_000_000, (1 << 63) - 1])
def test_a_clock_telecommand_does_not_destroy_the_recording(run, tmp_path, caplog, unix_s):
    path = tmp_path / "run.mcap"

    async def scenario(emulation, _line):
        await record(emulation)
        emulation.device.time.set_unix_ns(unix_s * 1_000_000_000)
        for _ in range(5):
            await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="standby")
        emulation.device.time.set_unix_ns(1_800_000_000 * 1_000_000_000)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(3.0)

    run(scenario, options=options(path))
    found = messages(path)
    truths = found["/truth"]
    times = [at for _, at, _ in truths]
    assert times == sorted(times)
    assert times[-1] - times[0] < 20e9  # the run's own time
    assert [("timestamp" in content) for _, _, content in truths].count(False) >= 4
    assert truths[-1][2]["timestamp"]["sec"] // 10 == 180_000_000
    (said,) = [each.getMessage() for each in caplog.records if each.levelname in ("WARNING", "ERROR")]
    assert "its times are left out" in said


def test_what_the_console_keeps_is_recorded_afterwards(run, tmp_path):
    path = tmp_path / "later.mcap"

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        client = AsyncObcClient(
            SerialHostLink(emulation.icd, emulation.ready_fields["serial"]), emulation.icd
        )
        await client.start()
        await client.telemetry("identification")
        await client.close()
        await emulation.stepper.step(3.0)
        async with Page(emulation) as page, page.session.get(page.url("/record.mcap")) as response:
            path.write_bytes(await response.read())
        assert emulation.device.cycle.published > 0

    run(scenario, options=OPTIONS)
    found = messages(path)
    assert found["/measurement"][-1][2]["mode"] == "tracking"
    assert "standby → lost in space (command)" in [event["message"] for _, _, event in found["/events"]]
    assert "identification?" in [line["text"] for _, _, line in found["/bus/serial"]]
