"""A whole run in one process, with a pipeline that renders no images: scenarios, files, pumps, refusals."""

import asyncio
import csv
import os
import re
import resource
import time

import pytest

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.state_store import FileStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.run import Run
from starhil.emulator.run.truth_log import COLUMNS
from starhil.emulator.sensor.pipeline.messages import PipelineReady
from starhil.emulator.truth.file import read_truth_file
from starhil.hil_tests.rig.private_can_bus import hub_thread
from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.files.bundled import bundled
from starhil.protocol.messages import ErrorCode
from starhil.protocol.unit import load_unit
from tests.emulator.runs import CAMERA, Control, FakeImager, command
from tests.waiting import until


def test_a_scenario_reads_its_truth_files_when_the_run_starts(run, tmp_path):
    truth, path = tmp_path / "truth.csv", tmp_path / "day.toml"
    path.write_text(
        f'[[at]]\nrun_time_s = 2.0\ntruth = {{ kind = "file", path = "{truth}", start = "now" }}\n'
    )

    async def scenario(emulation, _line):
        truth.unlink()
        await emulation.stepper.step(7.0)
        return emulation.device.surroundings.truth.state(7.0).attitude

    options = RunOptions(scenario=str(path))
    with pytest.raises(EmulatorError, match="truth file"):
        run(scenario, options=options)
    truth.write_text("t,ra_deg,dec_deg,roll_deg\n0,10,20,0\n10,10,20,50\n")
    assert run(scenario, options=options).roll_deg == pytest.approx(25.0)


def test_the_ready_line_names_links_seed_and_clock(run):
    async def scenario(emulation, line):
        words = dict(word.split("=", 1) for word in line.removeprefix("ready ").split())
        assert words["serial"].startswith("/dev/pts/")
        assert words["dialect"] == "b"
        assert words["unit"] == "cubestar"
        assert words["seed"] == "1"
        assert words["orbit"] == "none"
        assert words["clock"] == "stepped"
        assert words["control"].startswith("unix:/")

    run(scenario)


def test_the_real_clock_advances_by_itself(run):
    async def scenario(emulation, _line):
        device = emulation.device
        assert device.modes.mode.value == "standby"
        command(emulation, "set_mode", mode="lost_in_space")
        await until(lambda: device.cycle.published >= 5)
        assert device.latest.valid
        async with Control(emulation) as control:
            answer = await control.do("step", seconds=1.0)
            assert "stepped" in answer["error"]

    run(scenario, clock="scaled:20", device={"boot_s": 0.1}, parameters={"update_rate": 10.0, "exposure": 50})


def test_the_truth_log_has_a_row_a_frame(run, tmp_path):
    path = tmp_path / "truth.csv"

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(2.5)
        run.pipeline.fail = "no_match"
        await emulation.stepper.step(1.0)

    run(scenario, options=RunOptions(truth_log=path))
    rows = [line.split(",") for line in path.read_text().splitlines()]
    assert tuple(rows[0]) == COLUMNS
    records = [dict(zip(COLUMNS, row, strict=True)) for row in rows[1:]]
    assert [record["valid"] for record in records] == ["1", "1", "1", "0"]
    assert float(records[0]["cross_boresight_arcsec"]) < 1e-3
    assert records[-1]["measured_qx"] == ""
    assert records[-1]["reason"] == "no_match"


def test_a_truth_log_on_a_full_disk_ends_with_a_whole_row_and_the_run_continues(run, tmp_path, caplog):
    path = tmp_path / "truth.csv"
    room = len(",".join(COLUMNS)) + 700  # the head, a frame, and a part of the next

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(6.0)
        return emulation.device.cycle.published

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        frames = run(scenario, options=RunOptions(truth_log=path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert 1 < len(rows) < frames
    assert {len(row) for row in rows} == {len(COLUMNS)}
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert str(path) in said
    assert "it ends here; the run continues" in said


def test_a_truth_log_can_be_replayed(run, tmp_path):
    path = tmp_path / "truth.csv"
    rate = {"kind": "rate", "attitude": {"ra_deg": 10.0, "dec_deg": 20.0}, "rate_deg_s": [0.1, 0.2, 0.3]}
    expected = []

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        command(emulation, "set_mode", mode="lost_in_space")
        await emulation.stepper.step(5.0)
        expected.append(emulation.device.surroundings.truth.state(2.4))

    run(scenario, options=RunOptions(truth_log=path), truth=rate)
    replayed = read_truth_file(path).state(2.4)
    assert replayed.attitude.error_to(expected[0].attitude).total_arcsec < 1e-3
    assert replayed.rate_rad_s == pytest.approx(expected[0].rate_rad_s, rel=1e-5)


def test_scenario_events_happen_at_their_simulation_times(run, tmp_path):
    path = tmp_path / "day.toml"
    path.write_text(
        """
        [[at]]
        run_time_s = 3.0
        clear_faults = true
        truth = { kind = "fixed", attitude = { ra_deg = 10.0, dec_deg = 20.0 } }
        [[at]]
        run_time_s = 2.0
        fault = { device = { stuck = true }, optical = { false_stars = 3 } }
        """
    )

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.99)
        assert not emulation.device.unresponsive
        await emulation.stepper.step(0.02)
        assert run.first_head().faults.describe() == {
            "optical": {"false_stars": 3},
            "device": {"stuck": True},
        }
        await emulation.stepper.step(1.0)
        assert run.first_head().faults.describe() == {}
        assert emulation.device.surroundings.truth.state(9.0).attitude.ra_deg == pytest.approx(10.0)

    run(scenario, options=RunOptions(scenario=str(path)))


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ('fault = { device = { reset = "foo" } }', "device.reset: 'foo' is not one of unknown, power_on"),
        ('fault = { device = { error = "foo" } }', "device.error: 'foo' is not one of catalogue, "),
        ('fault = { device = { error = "none" } }', "device.error: 'none' is not one of catalogue, "),
        ("fault = { can = { drop = 1.0 } }", "can: this run has no such link"),
        ('truth = { kind = "file", path = "gone.csv" }', "gone.csv: cannot be read"),
    ],
)
def test_an_impossible_scenario_event_is_rejected_at_the_start_and_not_counted(run, tmp_path, event, message):
    path = tmp_path / "day.toml"
    path.write_text(f"[[at]]\nrun_time_s = 90.0\n{event}\n")
    started = []

    async def scenario(emulation, _line):
        started.append(emulation)

    with pytest.raises(EmulatorError) as refusal:
        run(scenario, options=RunOptions(scenario=str(path)))
    assert "scenario at 90 s: " in str(refusal.value)
    assert message in str(refusal.value)
    assert not started


def test_a_truth_file_of_a_scenario_is_read_at_the_start_and_starts_at_its_time(run, tmp_path):
    path, table = tmp_path / "day.toml", tmp_path / "table.csv"
    table.write_text("t,ra_deg,dec_deg,roll_deg\n0,10,0,0\n1,20,0,0\n")
    path.write_text(
        f'[[at]]\nrun_time_s = 3.0\ntruth = {{ kind = "file", path = "{table}", start = "now" }}\n'
    )

    async def scenario(emulation, _line):
        table.unlink()
        await emulation.stepper.step(4.0)
        return emulation.device.surroundings.truth.state(3.5).attitude.ra_deg

    assert run(scenario, options=RunOptions(scenario=str(path))) == pytest.approx(15.0)


def test_no_error_is_not_a_fault(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Control(emulation) as control:
            answer = await control.do("fault", device={"error": "none"})
        assert "device.error: 'none' is not one of" in answer["error"]
        assert emulation.device.modes.mode is Mode.STANDBY

    run(scenario)


@pytest.mark.parametrize("name", bundled("scenario"))
def test_every_scenario_of_the_product_is_valid(name):
    assert load_scenario(name).name == name


@pytest.mark.parametrize("name", ["bad_dya", ""])
def test_an_unknown_scenario_is_answered_with_the_known_ones(name):
    with pytest.raises(EmulatorError, match=f"scenario '{name}': not found; give a path, or one of: bad_day"):
        load_scenario(name)


def test_an_empty_name_of_a_profile_or_unit_is_not_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "unit.toml").write_text("[unit]\n")
    with pytest.raises(EmulatorError, match="profile '': not found"):
        load_profile("")
    with pytest.raises(IcdError, match="unit '': not found"):
        load_unit("")
    with pytest.raises(EmulatorError, match="unit: unit '': not found"):
        load_profile("ideal", ["unit="])


@pytest.mark.parametrize(
    ("options", "overrides", "message"),
    [
        (RunOptions(control="nowhere"), {}, "--control nowhere: must be off, auto, unix:/PATH or HOST:PORT"),
        (
            RunOptions(control="127.0.0.1:99999"),
            {},
            "--control 127.0.0.1:99999: must be off, auto, unix:/PATH or HOST:PORT",
        ),
        (
            RunOptions(control="127.0.0..1:9000"),
            {},
            r"control channel 127.0.0..1:9000: cannot listen \(.+\); choose another port, or auto",
        ),
        (
            RunOptions(),
            {"truth": {"kind": "live", "port": 1, "host": "192.0.2.1"}},
            r"truth feed udp:192.0.2.1:1: cannot listen \(.+\); choose another port, or 0",
        ),
        (
            RunOptions(),
            {"parameters": {"exposure": 0}},
            "profile ideal: parameters.exposure: 0 is outside 1 to 5000 ms",
        ),
        (
            RunOptions(),
            {"links": {"can": {"channel": "off"}, "serial": {"port": "/dev/no_such"}}},
            r"serial /dev/no_such: no such port; plug the adapter in, wait for the ready line of the emulator, or .+",
        ),
        (
            RunOptions(),
            {"run": {"clock": "sundial"}},
            "clock: must be real, scaled:FACTOR or stepped, not 'sundial'",
        ),
    ],
)
def test_unavailable_resources_are_reported_in_one_line(run, options, overrides, message):
    async def scenario(_emulation, _line):
        pytest.fail("started")

    with pytest.raises((EmulatorError, ProtocolError)) as refusal:
        run(scenario, options=options, **overrides)
    assert re.fullmatch(message, str(refusal.value))


def test_a_start_that_is_rejected_is_not_counted(run, tmp_path, monkeypatch):
    state = {"clock": "stepped", "state_dir": str(tmp_path)}
    bad_port = {"can": {"channel": "off"}, "serial": {"port": "/dev/no_such"}}

    async def scenario(emulation, _line):
        return emulation.device.boot_count

    assert run(scenario, run=state) == 1
    with pytest.raises(ProtocolError):
        run(scenario, run=state, links=bad_port)
    with pytest.raises(EmulatorError):
        run(scenario, run=state, options=RunOptions(control="127.0.0.1:99999"))
    assert run(scenario, run=state) == 2

    async def fail(_imager) -> PipelineReady:
        raise EmulatorError("no catalogue")

    with monkeypatch.context() as patch:
        patch.setattr(FakeImager, "start", fail)
        with pytest.raises(EmulatorError, match="no catalogue"):
            run(scenario, run=state)
    assert run(scenario, run=state) == 3


def test_a_camera_beyond_its_parameters_is_rejected_and_all_resources_are_released(
    run, tmp_path, monkeypatch
):
    link = tmp_path / "tty"
    links = {"serial": {"port": "auto", "symlink": str(link)}, "can": {"channel": "off"}}
    state = {"clock": "stepped", "state_dir": str(tmp_path)}

    async def odd(_imager) -> PipelineReady:
        return PipelineReady({**CAMERA, "centre_px": [-5.0, 468.0]}, 5, 0.0)

    async def scenario(emulation, _line):
        return emulation.device.boot_count

    with monkeypatch.context() as patch:
        patch.setattr(FakeImager, "start", odd)
        with pytest.raises(EmulatorError, match="profile odd: camera: centroid_x: -5 is outside"):
            run(scenario, name="odd", run=state, links=links)
    assert not link.is_symlink()
    assert run(scenario, run=state, links=links) == 1


def test_a_symlink_in_use_is_rejected_and_stays(run, tmp_path):
    link = tmp_path / "tty"
    links = {"serial": {"port": "auto", "symlink": str(link)}, "can": {"channel": "off"}}

    async def scenario(_emulation, _line):
        first = link.readlink()
        second = Run([Profile.model_validate({"run": {"clock": "stepped"}, "links": links})])
        with pytest.raises(EmulatorError, match="in use by another emulator"):
            await second.open()
        await second.close()
        assert link.readlink() == first

    run(scenario, links=links)
    assert not link.is_symlink()


def can_links(channel, address=4, node=0):
    can = {"channel": channel, "address": address}
    return {"serial": {"port": "off"}, "can": can, "canopen": {"node": node}}


def test_an_address_in_use_on_a_bus_with_a_name_is_rejected(run):
    async def scenario(first, _line):
        [head] = first.heads
        second = Run([Profile.model_validate({"links": can_links(head.ready_fields["can"])})])
        with pytest.raises(EmulatorError, match="address 4: in use by another emulator"):
            await second.open()
        await second.close()

    with hub_thread() as channel:
        run(scenario, links=can_links(channel))


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (can_links("auto", address=5), True),
        (can_links("auto"), False),
        (can_links("auto", address=5, node=44), False),
    ],
)
def test_auto_is_a_new_hub_if_an_address_is_in_use_on_the_usual_bus(run, monkeypatch, caplog, other, same):
    with hub_thread() as channel:  # its port is free again afterwards
        usual = int(re.split("[:/]", channel)[2])
    monkeypatch.setattr("starhil.protocol.transports.can.kernel_can_is_up", lambda _: False)
    monkeypatch.setattr("starhil.protocol.transports.can.DEFAULT_PORT", usual)

    async def scenario(first, _line):
        both = [other, can_links("auto", address=6)]
        second = Run(
            [Profile.model_validate({"run": {"clock": "stepped"}, "links": links}) for links in both]
        )
        try:
            await second.open()
            return [head.ready_fields["can"] for head in (*first.heads, *second.heads)]
        finally:
            await second.close()

    buses = run(scenario, links=can_links("auto", node=44))
    assert buses[0] == f"socketcand:127.0.0.1:{usual}/vcan0"
    assert buses[1] == buses[2], "heads of one run share the bus"
    assert (buses[0] == buses[1]) is same
    assert ("starts a CAN hub on a free port" in caplog.text) is not same


def test_a_truth_log_that_cannot_be_written_is_rejected(run, tmp_path):
    async def scenario(_emulation, _line):
        pytest.fail("started")

    with pytest.raises(EmulatorError, match="truth log"):
        run(scenario, options=RunOptions(truth_log=tmp_path / "no" / "log.csv"))


class Unclosable:
    """A part of a run that does not close."""

    def __init__(self, part) -> None:
        self._part = part

    def __getattr__(self, name):
        return getattr(self._part, name)

    def close(self):
        self._part.close()
        raise RuntimeError("does\nnot close")


def test_a_part_that_fails_to_close_keeps_no_other_open(run, tmp_path, caplog):
    link, log = tmp_path / "tty", tmp_path / "truth.csv"
    links = {"serial": {"port": "auto", "symlink": str(link)}, "can": {"channel": "off"}}

    async def scenario(emulation, _line):
        closed = []
        run.launched.control = Unclosable(run.launched.control)
        emulation.imager.close = lambda: closed.append("imager") or 1 / 0
        emulation._closers.append(lambda: 1 / 0)
        return closed

    closed = run(scenario, links=links, options=RunOptions(truth_log=log, control="auto"))
    assert closed == ["imager"]
    assert not link.is_symlink()
    said = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert len(said) == 3
    assert all(line.startswith("closing: ") and "\n" not in line for line in said)


def test_a_save_that_fails_in_an_unforeseen_way_ends_the_acknowledge(run, monkeypatch):
    async def scenario(emulation, _line):
        device = emulation.device
        monkeypatch.setattr(device.store, "save", lambda _content: {}["no such key"])
        command(emulation, "save_parameters")
        await until(lambda: device.acknowledge.processed)
        assert device.acknowledge.error.name == "INTERNAL"
        assert device.parameters.state.differs_from_store is False

    run(scenario, clock="real", device={"boot_s": 0.1})


def test_a_scenario_that_replaces_a_live_truth_closes_its_port(run, tmp_path):
    path = tmp_path / "day.toml"
    path.write_text(
        """
        [[at]]
        run_time_s = 2.0
        truth = { kind = "fixed", attitude = { ra_deg = 10.0, dec_deg = 20.0 } }
        """
    )

    async def scenario(emulation, _line):
        protocol, host, port = emulation.ready_fields["truth"].split(":")
        assert protocol == "tcp"
        _, writer = await asyncio.open_connection(host, int(port))
        writer.close()
        await emulation.stepper.step(3.0)
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection(host, int(port))
        assert emulation.feed is None

    live = {"kind": "live", "protocol": "tcp", "port": 0}
    run(scenario, options=RunOptions(scenario=str(path)), truth=live)


@pytest.mark.parametrize("clock", ["stepped", "scaled:20"])
def test_an_observer_that_fails_stops_neither_the_frames_nor_the_other_observers(run, caplog, clock):
    async def scenario(emulation, _line):
        device = emulation.device
        modes = []
        device.signals.frame_published.observers.insert(0, lambda _measurement: 1 / 0)
        device.signals.frame_published.connect(modes.append)
        if emulation.stepper:
            await emulation.stepper.step(1.0)  # the boot
        assert command(emulation, "set_mode", mode="lost_in_space") is ErrorCode.OK
        while len(modes) < 3:
            await (emulation.stepper.step(1.0) if emulation.stepper else asyncio.sleep(0.01))

    run(scenario, clock=clock, device={"boot_s": 0.1})
    assert "frame: internal error: ZeroDivisionError" in caplog.text
    assert caplog.text.count("Traceback") == 0


@pytest.mark.parametrize("clock", ["stepped", "scaled:20"])
def test_an_event_that_fails_is_logged_and_time_continues(run, caplog, clock):
    async def scenario(emulation, _line):
        done = []
        now_ns = emulation.clock.now_ns()
        emulation.device.scheduler.at(now_ns + 1, lambda _due: 1 / 0)
        emulation.device.scheduler.at(now_ns + 2, done.append)
        while not done:
            await (emulation.stepper.step(1.0) if emulation.stepper else asyncio.sleep(0.01))

    run(scenario, clock=clock, device={"boot_s": 0.1})
    assert "ZeroDivisionError" in caplog.text
    assert caplog.text.count("Traceback") == 0


def test_a_run_that_was_asked_for_many_saves_ends_soon_with_the_last(run, tmp_path):
    contents = []

    async def scenario(emulation, _line):
        device = emulation.device
        save = device.store.save

        def save_slowly(content):
            contents.append(content)
            time.sleep(0.05)
            save(content)

        device.store.save = save_slowly
        for exposure in range(100, 200):
            device.parameters.set({"exposure": exposure})
            device.save_parameters()

    run(scenario, clock="real", device={"boot_s": 0.1}, run={"clock": "real", "state_dir": str(tmp_path)})
    assert len(contents) <= 3  # 5 s for each request alone
    assert FileStore(tmp_path).load()["parameters"]["exposure"] == 199


@pytest.mark.parametrize("name", ["a b", "a\nb"])
def test_a_port_whose_name_would_split_the_ready_line_is_rejected(run, tmp_path, name):
    symlink = tmp_path / name
    with pytest.raises(EmulatorError, match="without blanks") as refusal:
        run(lambda *_: None, links={"serial": {"port": "auto", "symlink": str(symlink)}})
    assert "\n" not in str(refusal.value)
    assert not os.path.lexists(symlink)
