"""A recorded run, played again on the stepped clock, sends and measures the same to the byte."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
import os
import platform
import re
import shutil
import socket

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions, machine
from starhil.emulator.launch.recording import copy_state, prepare_recording, read_run
from starhil.emulator.launch.replay import replay
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.run.recorder import EVENTS_FILE, RUN_FILE, SCENARIO_FILE, TRUTH_FILE
from starhil.emulator.sensor.pipeline.messages import PipelineEnded, PipelineReady
from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, SerialHostLink
from starhil.hil_tests.errors import BenchError
from starhil.protocol.files.bundled import UNITS_FOLDER
from tests.emulator.cli.command_line import run_command_line
from tests.emulator.runs import CAMERA, Control
from tests.emulator.truth.simulators import Stub42, blocks_of_42
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.long

PARAMETERS = {"start_mode": "lost_in_space", "update_rate": 5.0}
ROUNDS = 10


@pytest.fixture
def record(run, tmp_path):
    """Record a run with a scenario; return the folder."""

    def record(scenario, *, script="", **keys):
        folder = tmp_path / "recorded"
        options = RunOptions(control="auto", record=folder, scenario=script)
        run(scenario, options=options, parameters=PARAMETERS, **keys)
        return folder

    return record


def report_of(folder):
    return asyncio.run(replay(folder))


async def talk(emulation, frames):
    """Command and read the device over its serial line, as an OBC does, for some frames."""
    client = AsyncObcClient(
        SerialHostLink(emulation.icd, emulation.ready_fields["serial"]), emulation.icd, timeout_s=PATIENCE_S
    )
    await client.start()
    await client.set_parameter("exposure", 80)
    await client.command("save_parameters")
    rounds = 0
    async with asyncio.timeout(PATIENCE_S):
        while emulation.device.cycle.published < frames or rounds < ROUNDS:
            if emulation.stepper is not None:
                await emulation.stepper.step(0.05)
            for name in ("precise_attitude", "identification", "device_status"):
                await client.telemetry(name)
            rounds += 1
            await asyncio.sleep(0.01)
    await client.close()


async def talk_over_a_bad_wire(emulation):
    """Read telemetry of which some does not arrive whole."""
    client = AsyncObcClient(
        SerialHostLink(emulation.icd, emulation.ready_fields["serial"]), emulation.icd, timeout_s=0.1
    )
    await client.start()
    for _ in range(10):
        with contextlib.suppress(BenchError):
            await client.telemetry("precise_attitude")
    await client.close()


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return tmp_path_factory.mktemp("original") / "recorded"


@pytest.fixture
def recorded(record, original, tmp_path):
    """A copy of a short recording, which is made once."""

    async def scenario(emulation, _line):
        await talk(emulation, 3)

    if not original.exists():
        shutil.copytree(record(scenario), original)
    return shutil.copytree(original, tmp_path / "recorded", dirs_exist_ok=True)


@pytest.mark.parametrize("clock", ["real", "scaled:3", "stepped"])
def test_a_run_is_repeated_to_the_byte(record, clock, tmp_path):
    async def scenario(emulation, _line):
        await talk(emulation, 3)
        async with Control(emulation) as control:
            await control.do("fault", serial={"corrupt": 0.2}, optical={"false_stars": 3})
            await control.do("set_truth", truth={"kind": "rate", "rate_deg_s": [0.1, 0.2, 0.3]})
            await control.do("status")
        await talk_over_a_bad_wire(emulation)
        async with Control(emulation) as control:
            await control.do("clear_faults")
        await talk(emulation, 8)

    state = tmp_path / "state"
    folder = record(scenario, clock=clock, run={"clock": clock, "state_dir": str(state)})
    assert state.is_dir()
    report = report_of(folder)
    assert report.differences == []
    assert report.sent["serial"] > 1000
    assert (folder / "truth.csv").read_text().count("\n") >= 9


@pytest.mark.parametrize("clock", ["real", "stepped"])
def test_faults_of_telemetry_and_clock_and_waits_for_a_phase_are_repeated_to_the_byte(record, clock):
    faults = [
        {"row": "precise_attitude", "offset": {"q_x": 0.1}, "jump_deg": 3.0, "probability": 0.5},
        {"row": "device_status", "truncate": 1, "count": 3},
    ]

    async def scenario(emulation, _line):
        await talk(emulation, 3)
        async with Control(emulation) as control:
            assert (await control.do("wait", phase="mid_frame"))["ok"]
            assert (await control.do("fault", telemetry=faults, phase="exposure"))["ok"]
            assert (await control.do("fault", clock={"jump_s": -3.0, "drift_ppm": 80.0, "jitter_s": 0.005}))[
                "ok"
            ]
            assert (await control.do("wait", phase="readout"))["ok"]
        await talk_over_a_bad_wire(emulation)
        async with Control(emulation) as control:
            assert len((await control.do("status"))["faults"]["telemetry"]) == 2
            await control.do("clear_faults")
        await talk(emulation, 8)

    folder = record(scenario, clock=clock, run={"clock": clock})
    report = report_of(folder)
    assert report.differences == []
    assert report.sent["serial"] > 1000


def test_runs_with_other_state_folders_are_recorded_alike(tmp_path):
    written = []
    for name in ("one", "two"):
        folder = tmp_path / f"{name}-recorded"
        prepare_recording(folder, Profile(run={"state_dir": str(tmp_path / name)}), "")
        written.append((folder / RUN_FILE).read_bytes())
    assert written[0] == written[1]
    assert read_run(folder).profile.run.state_dir == "state"


@pytest.fixture
def unit_of_others(tmp_path):
    """Return the folder of a unit whose Python file leaves a mark, and the mark."""
    mark, unit = tmp_path / "mark", tmp_path / "others" / "unit"
    shutil.copytree(UNITS_FOLDER / "st16", unit)
    with (unit / "unit.py").open("a") as file:
        file.write(f"\nopen({str(mark)!r}, 'w').close()\n")
    return unit, mark


def test_nothing_runs_that_only_a_recording_names(tmp_path, unit_of_others, monkeypatch):
    unit, mark = unit_of_others
    folder = tmp_path / "recorded"
    prepare_recording(folder, Profile(unit=str(unit), run={"worker": "error_model"}), "")
    status, _, err = run_command_line("replay", str(folder))
    assert (status, mark.exists()) == (2, False)
    assert err.count("\n") == 1
    assert (
        f"whose Python file unit.py would run; if you trust it, name the unit yourself: --unit {unit}" in err
    )
    # nor a unit that is inside a recording, wherever that lies
    content = json.loads((folder / RUN_FILE).read_text())
    content["folder"], content["profile"]["unit"] = ".", "others/unit"
    (folder / RUN_FILE).write_text(json.dumps(content))
    monkeypatch.chdir(tmp_path)
    assert run_command_line("replay", str(folder))[0] == 2
    assert not mark.exists()
    assert run_command_line("replay", str(folder), "--set", "device.boot_s=1")[0] == 2
    assert not mark.exists()
    status, _, err = run_command_line("replay", str(folder), "--unit", "others/unit")
    assert mark.exists()
    assert f"{folder / EVENTS_FILE}: cannot be read" in err  # there is no tape


@pytest.mark.parametrize("capture", [0, "http://127.0.0.1:{port}/night.avi"])
def test_no_camera_or_address_is_opened_that_only_a_recording_names(tmp_path, capture):
    """OpenCV opens addresses, and where it has GStreamer whole pipelines, which may write files."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        named = capture.format(port=server.getsockname()[1]) if isinstance(capture, str) else capture
        folder = tmp_path / "recorded"
        prepare_recording(folder, Profile(images={"capture": named}), "")
        (folder / EVENTS_FILE).write_text('{"do": "end", "ns": 0}\n')
        status, _, err = run_command_line("replay", str(folder))
        with pytest.raises(BlockingIOError):
            server.accept()
    assert status == 2
    assert f"took images from {named!r}, which it does not contain; give a profile of your own" in err


def test_a_unit_of_toml_alone_is_replayed_from_where_it_was(tmp_path):
    unit = tmp_path / "unit"
    shutil.copytree(UNITS_FOLDER / "st200", unit)
    folder = tmp_path / "recorded"
    prepare_recording(folder, Profile(unit=str(unit), run={"worker": "error_model"}), "")
    _, _, err = run_command_line("replay", str(folder))
    assert f"{folder / EVENTS_FILE}: cannot be read" in err


@pytest.mark.parametrize("trap", ["loop", "device", "pipe"])
def test_of_a_state_folder_only_the_files_of_a_device_are_copied(tmp_path, trap):
    state = tmp_path / "state"
    state.mkdir()
    (state / "device.json").write_text("{}")
    match trap:
        case "loop":
            (state / "loop").symlink_to(".")
        case "device":
            (state / "zero").symlink_to("/dev/zero")
        case _:
            os.mkfifo(state / "pipe")
    folder = tmp_path / "recorded"
    prepare_recording(folder, Profile(run={"state_dir": str(state)}), "")
    assert [path.name for path in (folder / "state").iterdir()] == ["device.json"]
    copy_state(state, tmp_path / "copy")
    assert [path.name for path in (tmp_path / "copy").iterdir()] == ["device.json"]


def test_a_state_file_that_cannot_be_read_is_named(tmp_path):
    folder = tmp_path / "recorded"
    prepare_recording(folder, Profile(run={"state_dir": str(tmp_path / "none")}), "")
    (folder / "state").mkdir()
    os.mkfifo(folder / "state" / "device.json")
    status, _, err = run_command_line("replay", str(folder))
    assert (status, err.count("\n")) == (2, 1)
    assert f"replay {folder / 'state'}: cannot be read (not a regular file)" in err


def test_can_frames_and_canopen_are_repeated(record):
    bus = "virtual:recorded"

    async def scenario(emulation, _line):
        client = AsyncObcClient(CanHostLink(bus), emulation.icd, timeout_s=PATIENCE_S)
        await client.start()
        async with asyncio.timeout(PATIENCE_S):
            while emulation.device.cycle.published < 4:
                await client.telemetry("precise_attitude")
                await asyncio.sleep(0.02)
        await client.close()

    links = {"serial": {"port": "off"}, "can": {"channel": bus}, "canopen": {"node": 5}}
    report = report_of(record(scenario, clock="real", links=links))
    assert report.differences == []
    assert report.sent["can"] > 8
    assert report.sent["canopen"] >= 1


def test_frames_that_are_sent_with_gaps_and_delays_are_repeated(record):
    """The gap between two frames passes after the request, while other entries arrive."""

    async def scenario(emulation, _line):
        client = AsyncObcClient(CanHostLink("virtual:gaps"), emulation.icd, timeout_s=PATIENCE_S)
        await client.start()
        async with Control(emulation) as control:
            for fault in ({"delay_s": 0.02}, {}):
                await control.do("fault", can=fault)
                for _ in range(5):
                    await client.telemetry("precise_attitude")
        await client.close()

    links = {"serial": {"port": "off"}, "can": {"channel": "virtual:gaps", "frame_gap_s": 0.003}}
    assert report_of(record(scenario, clock="real", links=links)).differences == []


def test_a_unit_without_dialects_is_repeated_at_its_own_bit_rate(record):
    async def scenario(emulation, _line):
        client = AsyncObcClient(
            SerialHostLink(emulation.icd, emulation.ready_fields["serial"]),
            emulation.icd,
            timeout_s=PATIENCE_S,
        )
        await client.start()
        for _ in range(5):
            await client.telemetry("solution")
        await client.close()

    folder = record(scenario, unit="sagitta")
    assert report_of(folder).differences == []
    run = json.loads((folder / RUN_FILE).read_text())
    given = Profile.model_validate(run["profile"]).links.serial.model_fields_set
    assert given.isdisjoint({"dialect", "baud"})


@pytest.mark.parametrize("clock", ["real", "stepped"])
def test_a_simulator_is_not_needed_for_the_replay(record, clock):
    async def scenario(emulation, _line):
        await Stub42(blocks_of_42(31)).connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        await until(lambda: emulation.device.cycle.published >= 3)

    folder = record(scenario, clock=clock, truth={"kind": "42", "role": "server", "port": 0})
    assert report_of(folder).differences == []
    assert "0.279" in (folder / "truth.csv").read_text()


@pytest.mark.parametrize("clock", ["real", "stepped"])
def test_a_run_whose_pipeline_dies_and_is_restarted_is_repeated(record, clock):
    async def scenario(emulation, _line):
        imager, device = emulation.imager, emulation.device
        handle = imager._handle

        async def restart():
            imager._handle = handle
            return PipelineReady(CAMERA, 5, 0.0)

        await talk(emulation, 3)
        imager.restart = restart
        imager._handle = lambda _request: PipelineEnded("killed")
        imager.ended.emit("killed")
        assert device.modes.mode.value == "error"
        await until(lambda: device.warm)
        client = AsyncObcClient(
            SerialHostLink(emulation.icd, emulation.ready_fields["serial"]),
            emulation.icd,
            timeout_s=PATIENCE_S,
        )
        await client.start()
        await client.command("set_mode", mode="standby")
        await client.command("set_mode", mode="lost_in_space")
        await client.close()
        await talk(emulation, device.cycle.published + 3)

    folder = record(scenario, run={"clock": clock})
    kinds = [json.loads(line)["do"] for line in (folder / EVENTS_FILE).read_text().splitlines()]
    assert kinds.count("pipeline_lost") == 1
    assert kinds.count("ready") == 2
    assert report_of(folder).differences == []


def test_a_frame_that_fails_with_the_pipeline_fails_in_the_replay(record):
    async def scenario(emulation, _line):
        await emulation.stepper.step(2.0)
        handle, emulation.imager._handle = emulation.imager._handle, lambda _request: PipelineEnded("killed")
        await emulation.stepper.step(0.2)
        emulation.imager._handle = handle
        await emulation.stepper.step(2.0)

    folder = record(scenario)
    assert "processing_error" in (folder / TRUTH_FILE).read_text()
    assert report_of(folder).differences == []


def test_a_scenario_is_part_of_the_recording(record, tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text('[[at]]\nrun_time_s = 0.5\ntruth = { kind = "rate", rate_deg_s = [0.0, 0.5, 0.0] }\n')

    async def scenario(emulation, _line):
        await talk(emulation, 4)

    folder = record(scenario, script=str(path))
    path.unlink()
    report = report_of(folder)
    assert report.differences == []
    assert "0.5" in (folder / "truth.csv").read_text()


def changed_byte(folder, link, changed):
    """Change the last recorded item of a link by a function; return its time, seconds."""
    events = folder / EVENTS_FILE
    lines = [json.loads(line) for line in events.read_text().splitlines()]
    entry = [entry for entry in lines if entry["do"] == "out" and entry["link"] == link][-1]
    entry["data"] = changed(entry["data"])
    events.write_text("".join(json.dumps(entry) + "\n" for entry in lines))
    return entry["ns"] / 1e9


def test_a_changed_byte_is_named_by_time_row_and_place(record):
    async def scenario(emulation, _line):
        await talk(emulation, 2)  # device_status is the last row that is read

    folder = record(scenario)
    at_s = changed_byte(folder, "serial", lambda data: data[:8] + "a9" + data[10:])
    (difference,) = report_of(folder).differences
    place = re.escape(f"serial: at {at_s:.3f} s, device_status, byte 2: recorded a9, now ")
    assert re.fullmatch(place + "[0-9a-f]{2}", difference)


@pytest.mark.parametrize("last", [False, True], ids=["others follow", "last"])
@pytest.mark.parametrize(
    ("at", "place"),
    [
        (0, "byte 0 of the message"),
        (3, "byte 3 of the message"),
        (16, "byte 12"),
        (-1, "byte 30 of the message"),
    ],
    ids=["begin", "header", "data", "end"],
)
def test_a_changed_byte_of_a_message_that_no_longer_decodes_is_named(record, at, place, last):
    """The check of the recorded message is now wrong; messages of another row may follow."""

    async def scenario(emulation, _line):
        client = AsyncObcClient(
            SerialHostLink(emulation.icd, emulation.ready_fields["serial"]),
            emulation.icd,
            timeout_s=PATIENCE_S,
        )
        await client.start()
        await client.command("go")
        await client.telemetry("ping")
        if not last:
            await client.command("go")
            await client.command("go")
        await client.close()

    folder = record(scenario, unit="st16")
    events = folder / EVENTS_FILE
    lines = [json.loads(line) for line in events.read_text().splitlines()]
    entry = [entry for entry in lines if entry["do"] == "out"][1]
    data = bytearray.fromhex(entry["data"])
    assert data[4:10] == b"starhi"
    was = data[at]
    data[at] ^= 1
    entry["data"] = data.hex()
    events.write_text("".join(json.dumps(line) + "\n" for line in lines))
    at_s = entry["ns"] / 1e9
    assert report_of(folder).differences == [
        f"serial: at {at_s:.3f} s, ping, {place}: recorded {data[at]:02x}, now {was:02x}"
    ]


def test_a_changed_address_of_a_can_frame_is_shown_in_both_frames(record):
    bus = "virtual:id"

    async def scenario(emulation, _line):
        client = AsyncObcClient(CanHostLink(bus), emulation.icd, timeout_s=PATIENCE_S)
        await client.start()
        for name in ("identification", "device_status", "identification"):
            await client.telemetry(name)
        await client.close()

    links = {"serial": {"port": "off"}, "can": {"channel": bus}}
    folder = record(scenario, clock="real", links=links)
    changed_byte(folder, "can", lambda data: [data[0] ^ 1, *data[1:]])
    (difference,) = report_of(folder).differences
    assert re.fullmatch(
        r"can: at \d+\.\d{3} s, identification: recorded frame \w{8}#\w+, now \w{8}#\w+", difference
    )


def test_a_changed_can_frame_is_named_by_its_row_or_its_meaning_in_canopen(record):
    bus = "virtual:changed"

    async def scenario(emulation, _line):
        client = AsyncObcClient(CanHostLink(bus), emulation.icd, timeout_s=PATIENCE_S)
        await client.start()
        await client.telemetry("device_status")
        await client.close()

    links = {"serial": {"port": "off"}, "can": {"channel": bus}, "canopen": {"node": 5}}
    folder = record(scenario, clock="real", links=links)
    for link, name in (("can", "device_status"), ("canopen", "node 5 heartbeat")):
        at_s = changed_byte(folder, link, lambda data: [data[0], "a9" + data[1][2:], *data[2:]])
        (difference,) = (found for found in report_of(folder).differences if found.startswith(link + ":"))
        assert difference.startswith(f"{link}: at {at_s:.3f} s, {name}, byte ")
        assert ": recorded a9, now " in difference


def test_a_link_on_which_nothing_is_sent_is_counted(record):
    async def nothing(_emulation, _line):
        return

    assert report_of(record(nothing)).sent == {"serial": 0}


def test_traffic_is_reported_while_it_is_recorded(record):
    passed = []

    async def scenario(emulation, _line):
        emulation.traffic.passed.connect(passed.append)
        await talk(emulation, 2)

    record(scenario)
    assert {item.outgoing for item in passed} == {True, False}


def test_a_changed_device_is_found(recorded):
    run_file = recorded / RUN_FILE
    run = json.loads(run_file.read_text())
    run["profile"]["device"]["firmware_minor"] = 9
    run_file.write_text(json.dumps(run))
    (difference,) = report_of(recorded).differences
    assert re.fullmatch(r"serial: at \d+\.\d{3} s, identification, byte 3: recorded 00, now 09", difference)


@pytest.mark.parametrize("rest", [0, 8])
def test_a_truncated_recording_is_played_to_its_end_and_called_truncated(recorded, rest):
    """Cut after an entry that is followed by output, or within the next line."""

    events = recorded / EVENTS_FILE
    text = events.read_text()
    cut = text.index("\n", len(text) // 2)
    while '"do": "in"' not in text[:cut].rpartition("\n")[2]:
        cut = text.index("\n", cut + 1)
    events.write_text(text[: cut + 1 + rest])
    report = report_of(recorded)
    assert 0 < report.entries < text.count("\n")
    (difference,) = report.differences
    assert difference.startswith(f"{events}: truncated at ")


def test_a_recording_that_goes_on_after_its_end_is_damaged(recorded):
    """It was called identical, and only the entries before its end were counted."""

    lines = (recorded / EVENTS_FILE).read_text().splitlines(keepends=True)
    after = next(number for number, line in enumerate(lines) if number > 3 and '"do": "in"' in line)
    end = json.dumps({"ns": json.loads(lines[after - 1])["ns"], "do": "end"})
    (recorded / EVENTS_FILE).write_text("".join([*lines[:after], end, "\n", *lines[after:]]))
    with pytest.raises(EmulatorError, match=rf"line {after + 2}: comes after the entry `end`"):
        report_of(recorded)


def test_a_missing_truth_log_is_a_difference(recorded):
    (recorded / "truth.csv").unlink()
    assert report_of(recorded).differences == [f"{recorded / 'truth.csv'}: missing"]


def changed_cell(folder, column, change):
    """Change the last cell of a column of the truth log by a function of its number."""
    path = folder / TRUTH_FILE
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    row = [row for row in rows if row[column]][-1]
    row[column] = repr(change(float(row[column])))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


@pytest.mark.parametrize(
    ("column", "change", "is_named"),
    [
        ("measured_qx", lambda value: value + 4e-12, False),
        ("measured_qx", lambda value: value + 4e-10, True),
        ("true_wx_deg_s", lambda value: value + 1e-9, False),
        ("true_wx_deg_s", lambda value: value + 1e-3, True),
        ("cross_boresight_arcsec", lambda value: value * 1.00001, False),
        ("cross_boresight_arcsec", lambda value: value * 1.001 + 1e-3, True),
        ("run_time_s", lambda value: value + 1e-9, True),
        ("stars_matched", lambda value: int(value) + 1, True),
    ],
)
def test_a_truth_log_is_compared_to_its_resolution_and_a_difference_names_the_machine(
    recorded, column, change, is_named
):
    run = json.loads((recorded / RUN_FILE).read_text())
    assert set(run["machine"]) == {"processor", "python", "numpy", "numba", "libc"}
    run["machine"]["libc"] = "musl 9"
    (recorded / RUN_FILE).write_text(json.dumps(run))
    assert report_of(recorded).differences == []
    changed_cell(recorded, column, change)
    differences = report_of(recorded).differences
    if is_named:
        difference, machine = differences
        assert re.match(rf"truth log: row \d+ differs in {column}: recorded ", difference)
        assert re.fullmatch(r"recorded on another machine: libc musl 9 \(here .+\)", machine)
    else:
        assert differences == []


def test_a_machine_without_a_description_of_its_processor_is_named_by_its_architecture(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "PROCESSOR_FILE", tmp_path / "cpuinfo")
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert machine.description()["processor"] == f"{platform.machine()}, kernels for generic"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("device.firmware_minor=0", "identical"),
        ("device.firmware_minor=9", "identification, byte 3: recorded 00, now 09"),
        ("truth={kind='fixed', attitude={ra_deg=10.0, dec_deg=0.0}}", "truth log: row 1 differs"),
        ("parameters.update_rate=0.5", "the device behaves differently"),
    ],
)
def test_another_profile_is_compared_with_the_recording(recorded, tmp_path, override, message):
    mine = tmp_path / "mine.toml"
    mine.write_text('[parameters]\nstart_mode = "lost_in_space"\nupdate_rate = 5.0\n')
    status, out, err = run_command_line("replay", str(recorded), "--profile", str(mine), "--set", override)
    assert (status, err) == (0 if message == "identical" else 1, "")
    assert message in out


def test_a_key_of_the_recorded_profile_is_changed_and_the_fields_that_differ_are_listed(recorded, tmp_path):
    table = tmp_path / "new" / "differences.csv"
    words = ["replay", str(recorded), "--set", "device.firmware_minor=9", "--csv", str(table)]
    status, out, err = run_command_line(*words)
    assert (status, err) == (1, "")
    assert "identification, byte 3: recorded 00, now 09" in out
    (row,) = csv.DictReader(table.read_text().splitlines())
    messages = int(row["messages"])
    assert messages >= ROUNDS
    assert (row["link"], row["row"], row["field"]) == ("serial", "identification", "firmware_minor")
    assert (row["differ"], row["largest"], row["recorded"], row["now"]) == (str(messages), "9.0", "0", "9")
    shown = rf"serial +identification +firmware_minor +{messages} of {messages} +9 +{float(row['first_s']):.3f} +0 +9\s"
    assert re.search(shown, out)
    status, out, err = run_command_line(*words[:2], "--csv", str(table))
    assert (status, err, table.read_text().count("\n")) == (0, "", 1)


def test_another_truth_shows_in_the_fields_of_the_attitude_alone(recorded):
    report = asyncio.run(
        replay(recorded, settings=["truth={kind='fixed', attitude={ra_deg=10.0, dec_deg=0.0}}"])
    )
    fields = {(item.row, item.field): item for item in report.fields}
    assert {row for row, _ in fields} == {"precise_attitude"}
    assert fields["precise_attitude", "q_x"].largest > 0.1
    assert fields["precise_attitude", "q_x"].first_s > 0.0


@pytest.mark.parametrize("key", ["run.seed", "links.serial.port"])
def test_what_stays_as_recorded_is_not_set(tmp_path, key):
    status, _, err = run_command_line("replay", str(tmp_path), "--set", f"{key}=1")
    assert (status, err.count("\n")) == (2, 1)
    assert f"--set {key}=1: a replay has `links` and `run`, except the algorithm, as recorded" in err


@pytest.mark.parametrize("content", [None, "{}", '{"profile": {"x": 1}, "folder": "."}'])
def test_a_folder_without_a_recording_is_named(tmp_path, content):
    if content is not None:
        (tmp_path / RUN_FILE).write_text(content)
    with pytest.raises(EmulatorError, match=f"replay {os.fspath(tmp_path)}"):
        report_of(tmp_path)


def test_a_folder_with_files_is_not_recorded_to(record, tmp_path):
    (tmp_path / "recorded").mkdir()
    (tmp_path / "recorded" / "notes.txt").write_text("x")
    with pytest.raises(EmulatorError, match="not empty"):
        record(None)


def test_a_recording_is_of_one_head(run, tmp_path):
    with pytest.raises(EmulatorError, match="records one head"):
        run(
            None,
            options=RunOptions(record=tmp_path / "recorded"),
            others=[{"links": {"can": {"address": 5}}}],
        )
    assert not (tmp_path / "recorded").exists()


DAMAGED_LINES = {
    "not JSON": "}",
    "not an object": "7",
    "empty": "",
    "a list": "[]",
    "nested too deeply": "[" * 100_000,
    "no time": '{"do": "event"}',
    "a time in words": '{"ns": "soon", "do": "event"}',
    "a time before the start": '{"ns": -1, "do": "event"}',
    "a time without end": '{"ns": 1e400, "do": "event"}',
    "a fraction of a nanosecond": '{"ns": 0.5, "do": "event"}',
    "nothing to do": '{"ns": 0}',
    "an unknown kind": '{"ns": 0, "do": "dance"}',
    "a kind that is no text": '{"ns": 0, "do": {}}',
    "input without link": '{"ns": 0, "do": "in", "data": "00"}',
    "input of an unknown link": '{"ns": 0, "do": "in", "link": "radio", "data": "00"}',
    "input without data": '{"ns": 0, "do": "in", "link": "serial"}',
    "half a byte": '{"ns": 0, "do": "in", "link": "serial", "data": "0"}',
    "no hexadecimal": '{"ns": 0, "do": "out", "link": "serial", "data": "xy"}',
    "a number as bytes": '{"ns": 0, "do": "out", "link": "serial", "data": 5}',
    "a CAN frame on a serial line": '{"ns": 0, "do": "in", "link": "serial", "data": [1, "00", true, false]}',
    "bytes on a CAN bus": '{"ns": 0, "do": "out", "link": "can", "data": "00"}',
    "part of a CAN frame": '{"ns": 0, "do": "out", "link": "can", "data": [1, "00"]}',
    "a CAN frame that cannot exist": '{"ns": 0, "do": "out", "link": "can", "data": [1, "00112233445566778899", true, false]}',
    "a feed without data": '{"ns": 0, "do": "feed"}',
    "a feed that is not bytes": '{"ns": 0, "do": "feed", "data": "\u2192"}',
    "no truth": '{"ns": 0, "do": "truth"}',
    "an unknown truth": '{"ns": 0, "do": "truth", "config": {"kind": "x"}, "start_s": 0}',
    "a truth that starts never": '{"ns": 0, "do": "truth", "config": {"kind": "fixed"}, "start_s": NaN}',
    "no fault": '{"ns": 0, "do": "fault"}',
    "an unknown fault": '{"ns": 0, "do": "fault", "request": {"weather": 1}}',
    "a fault of a link that is off": '{"ns": 0, "do": "fault", "request": {"can": {"drop": 1.0}}}',
    "no UTF-8": b"\xff",
}


IMPOSSIBLE_LINES = {
    "input of a link that is off": '{"ns": 0, "do": "in", "link": "can", "data": [1, "00", true, false]}',
    "no feed": '{"ns": 0, "do": "feed", "data": "{}"}',
    "a reply to nothing": '{"ns": 0, "do": "reply"}',
    "the end of no write": '{"ns": 0, "do": "stored"}',
}
"""Entries that cannot happen to the device."""


def with_line(recorded, line):
    """Insert a line into the tape; return its place."""
    events = recorded / EVENTS_FILE
    lines = events.read_bytes().splitlines(keepends=True)
    lines.insert(3, (line if isinstance(line, bytes) else line.encode()) + b"\n")
    events.write_bytes(b"".join(lines))
    return f"{events}: line 4: "


@pytest.mark.parametrize("line", IMPOSSIBLE_LINES.values(), ids=IMPOSSIBLE_LINES)
def test_a_line_that_cannot_be_played_is_a_difference(recorded, line):
    where = with_line(recorded, line)
    assert report_of(recorded).differences[0].startswith(where)


@pytest.mark.parametrize("line", DAMAGED_LINES.values(), ids=DAMAGED_LINES)
def test_a_damaged_line_is_named(recorded, line):
    where = with_line(recorded, line)
    with pytest.raises(EmulatorError) as caught:
        report_of(recorded)
    assert where in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_time_before_that_of_the_entry_above_is_damage(recorded):
    with_line(recorded, '{"ns": 999000000000, "do": "out", "link": "serial", "data": "00"}')
    with pytest.raises(EmulatorError) as caught:
        report_of(recorded)
    where = f"replay {recorded / EVENTS_FILE}: line 5: time "
    assert str(caught.value).startswith(where)
    assert "ns is before that of the entry above, 999000000000 ns" in str(caught.value)


DAMAGED_FILES = {
    "run: nested too deeply": (RUN_FILE, b"[" * 100_000),
    "run: no UTF-8": (RUN_FILE, b"\xff"),
    "run: not an object": (RUN_FILE, b"[]"),
    "run: no folder": (RUN_FILE, b'{"profile": {}}'),
    "run: a number as folder": (RUN_FILE, b'{"profile": {}, "folder": 5}'),
    "scenario: not JSON": (SCENARIO_FILE, b"{"),
    "scenario: no UTF-8": (SCENARIO_FILE, b"\xff"),
    "scenario: nested too deeply": (SCENARIO_FILE, b"[" * 100_000),
    "scenario: another table": (SCENARIO_FILE, b'{"at": []}'),
    "truth log: no UTF-8": (TRUTH_FILE, b"frame\n\xff\n"),
    "truth log: an endless cell": (TRUTH_FILE, b"frame\n" + b"1" * 200_000),
}


@pytest.mark.parametrize(("name", "content"), DAMAGED_FILES.values(), ids=DAMAGED_FILES)
def test_a_damaged_file_is_named(recorded, name, content):
    (recorded / name).write_bytes(content)
    with pytest.raises(EmulatorError) as caught:
        report_of(recorded)
    assert f"{recorded / name}: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [RUN_FILE, EVENTS_FILE, SCENARIO_FILE, TRUTH_FILE])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_not_a_file_is_named_without_waiting(recorded, name, make):
    (recorded / name).unlink(missing_ok=True)
    make(recorded / name)
    with pytest.raises(EmulatorError) as caught:
        report_of(recorded)
    assert f"{recorded / name}: " in str(caught.value)


def test_a_run_with_truth_and_orbit_from_standard_files_is_repeated(record, tmp_path):
    """The truth is in the recording, the orbit is read from its original place."""
    quaternions = [f"2026-03-20T12:00:{s:02d} 0.0 0.0 0.0 1.0" for s in (0, 30)]
    keywords = [
        "REF_FRAME_A = ICRF",
        "REF_FRAME_B = SC_BODY_1",
        "TIME_SYSTEM = UTC",
        "ATTITUDE_TYPE = QUATERNION",
    ]
    aem = [
        "CCSDS_AEM_VERS = 2.0",
        "META_START",
        *keywords,
        "META_STOP",
        "DATA_START",
        *quaternions,
        "DATA_STOP",
    ]
    keywords = ["REF_FRAME = EME2000", "CENTER_NAME = EARTH", "TIME_SYSTEM = UTC"]
    places = [f"2026-03-20T12:00:{s:02d} 7000.0 0.0 {7.5 * s} 0.0 0.0 7.5" for s in (0, 30)]
    oem = ["CCSDS_OEM_VERS = 2.0", "META_START", *keywords, "META_STOP", *places]
    (tmp_path / "truth").write_text("\n".join(aem) + "\n")
    (tmp_path / "orbit").write_text("\n".join(oem) + "\n")
    answers = []

    async def scenario(emulation, _line):
        await talk(emulation, 3)
        truth = emulation.device.surroundings.state(2_000_000_000)
        answers.append((truth.unix_s, float(truth.orbit.position_m[2])))

    folder = record(
        scenario,
        run={"clock": "stepped"},
        truth={"kind": "file", "path": str(tmp_path / "truth")},
        orbit={"kind": "file", "path": str(tmp_path / "orbit")},
    )
    (tmp_path / "truth").unlink()
    (tmp_path / "orbit").unlink()
    assert report_of(folder).differences == []
    assert answers[0] == (1774008002.0, pytest.approx(15_000.0, abs=1.0))


def test_paths_of_the_profile_refer_to_its_folder_and_the_copied_truth_to_the_recording(tmp_path):
    site, folder = tmp_path / "site", tmp_path / "recorded"
    site.mkdir()
    (site / "truth.csv").write_text("time_s,ra_deg,dec_deg,roll_deg\n0,10,20,30\n")
    (site / "mine.toml").write_text(
        '[truth]\nkind = "file"\npath = "truth.csv"\n[catalog]\npath = "hip.dat"\n[images]\nfolder = "sky"\n'
    )
    prepare_recording(folder, load_profile(str(site / "mine.toml")), "")
    profile = read_run(folder).profile
    paths = (profile.catalog.path, profile.images.folder, profile.truth.path)
    assert [profile.folder / path for path in paths] == [
        site / "hip.dat",
        site / "sky",
        folder / "truth_source.csv",
    ]
