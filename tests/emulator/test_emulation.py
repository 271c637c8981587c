"""A whole run in one process, with a pipeline that makes no pictures: control channel, feeds, files, pumps."""

import asyncio
import csv
import json
import resource

import pytest

import emulator.emulation
from emulator.clock import SteppedClock
from emulator.emulation import Emulation, RunOptions
from emulator.errors import EmulatorError
from emulator.imaging.frames import Warm
from emulator.imaging.imager import DirectImager, ProcessImager
from emulator.profile import Profile, RunConfig, configs_folder
from emulator.scenario import load_scenario
from emulator.truth.file import read_truth_file
from emulator.truth.log import COLUMNS
from protocol.errors import ProtocolError

CAMERA = {"focal_px": [1220.0, 1220.0], "centre_px": [468.0, 468.0], "distortion": [0.0] * 5}
ORION = {"ra_deg": 83.8, "dec_deg": -1.2}


class FakeImager(DirectImager):
    """A pipeline that is ready at once."""

    on_failure = None

    async def start(self) -> Warm:
        return Warm(CAMERA, 5, 0.0)

    async def close(self) -> None:
        return


@pytest.fixture
def run(monkeypatch, make_bench):
    """Run a scenario with an emulation that is started and ready."""
    picture = make_bench().picture
    monkeypatch.setattr(emulator.emulation.Emulation, "_make_imager", lambda *_: FakeImager(picture.handle))

    def run(scenario, *, clock="stepped", options=None, **overrides):
        profile = Profile.model_validate(
            {
                "run": {"clock": clock},
                "links": {"serial": {"port": "auto"}, "can": {"channel": "off"}},
                **overrides,
            }
        )

        async def whole():
            emulation = Emulation(profile, options or RunOptions(control="auto"))
            try:
                await emulation.start()
                line = await emulation.ready()
                return await scenario(emulation, line)
            finally:
                await emulation.close()

        return asyncio.run(whole())

    run.picture = picture
    return run


class Control:
    """A peer on the control channel."""

    def __init__(self, emulation) -> None:
        self.address = emulation.ready_words["control"].rsplit(":", 1)

    async def __aenter__(self):
        self.reader, self.writer = await asyncio.open_connection(*self.address)
        return self

    async def __aexit__(self, *_exc):
        self.writer.close()

    async def raw(self, line: bytes) -> dict:
        self.writer.write(line + b"\n")
        return json.loads(await self.reader.readline())

    async def do(self, action, **values) -> dict:
        return await self.raw(json.dumps({"do": action, **values}).encode())


def test_the_ready_line_tells_what_was_taken(run):
    async def scenario(emulation, line):
        words = dict(word.split("=", 1) for word in line.removeprefix("ready ").split())
        assert words["serial"].startswith("/dev/pts/")
        assert words["seed"] == "1"
        assert words["clock"] == "stepped"
        assert words["control"].startswith("127.0.0.1:")

    run(scenario)


def test_time_passes_only_by_steps(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            assert (await control.do("status"))["mode"] == "boot"
            await asyncio.sleep(0.05)
            assert (await control.do("status"))["run_time_s"] == 0.0
            assert (await control.do("step", seconds=1.0))["run_time_s"] == 1.0
            assert (await control.do("status"))["mode"] == "standby"
            for bad in (
                {},
                {"seconds": 0},
                {"seconds": -1},
                {"seconds": "1"},
                {"seconds": True},
                {"seconds": 1, "x": 2},
            ):
                answer = await control.do("step", **bad)
                assert not answer["ok"]
                assert answer["error"]

    run(scenario)


def test_truth_is_read_back_and_swapped_while_running(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            truth = await control.do("truth")
            assert (truth["ra_deg"], truth["dec_deg"]) == pytest.approx((83.8, -1.2))
            swap = {
                "kind": "rate",
                "attitude": {"ra_deg": 10.0, "dec_deg": 0.0},
                "rate_deg_s": [0.0, 0.0, 2.0],
            }
            assert (await control.do("set_truth", truth=swap))["ok"]
            later = await control.do("truth", run_time_s=4.0)
            assert later["rate_deg_s"] == pytest.approx([0.0, 0.0, 2.0])
            assert later["roll_deg"] == pytest.approx(6.0)  # three seconds after the swap
            by_unix = await control.do("truth", unix_s=truth["unix_s"] + 3.0)
            assert by_unix["roll_deg"] == pytest.approx(6.0, abs=1e-4)
            for wrong, said in (
                ({}, "truth: an object is needed, with the keys of [truth] in a profile"),
                ({"truth": 3}, "truth: an object is needed, with the keys of [truth] in a profile"),
                ({"truth": {"kind": "fixed", "x": 1}}, "truth.x: unknown key; known: attitude, kind"),
                ({"truth": {}}, "truth.kind: must be one of 'file', 'fixed', 'live', 'rate', 'slew'"),
                (
                    {"truth": {"kind": "fixed", "attitude": {"ra_deg": "x"}}},
                    "truth.attitude.ra_deg: must be a valid number (given: 'x')",
                ),
            ):
                assert await control.do("set_truth", **wrong) == {"ok": False, "error": said}
            bad = await control.do("set_truth", truth={"kind": "rate"})
            assert bad == {"ok": False, "error": "truth.rate_deg_s: missing; give it"}
            assert not (await control.do("set_truth", truth={"kind": "file", "path": "gone.csv"}))["ok"]
            assert (await control.do("truth"))["rate_deg_s"] == pytest.approx([0.0, 0.0, 2.0])

    run(scenario)


def test_frames_are_told_with_truth_and_error(run):
    run.picture.turn_rad = 1e-5

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
            await control.do("step", seconds=3.0)
            frames = (await control.do("frames", count=2))["frames"]
            assert [frame["frame"] for frame in frames] == [2, 3]
            assert frames[-1]["cross_boresight_arcsec"] == pytest.approx(2.0626, abs=1e-3)
            assert list(frames[-1]) == list(COLUMNS)
            assert not (await control.do("frames", count=0))["ok"]

    run(scenario)


@pytest.mark.parametrize(
    "line", [b"nonsense", b"[1]", b'{"do": "dance"}', b"{}", b'{"do": "status", "x": 1}', b"\xff\xfe"]
)
def test_bad_requests_are_answered_and_the_next_good_one_too(run, line):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.raw(line)
            assert answer["ok"] is False
            assert answer["error"]
            assert (await control.raw(b'{"do": "status", "id": [7]}'))["id"] == [7]

    run(scenario)


def test_faults_are_brought_about_and_cleared(run):
    async def scenario(emulation, _line):
        device = emulation.device
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            assert (await control.do("fault", device={"stuck": True}))["faults"] == {
                "device": {"stuck": True}
            }
            assert device.deaf
            await control.do("fault", serial={"drop": 0.5, "split": 4}, device={"error": "injected"})
            assert device.modes.error == "injected"
            assert emulation.serial.wire.settings.drop == 0.5
            assert not device.deaf
            assert (await control.do("clear_faults"))["faults"] == {}
            assert emulation.serial.wire.settings.none
            await control.do("fault", device={"reset": "watchdog"})
            assert device.reset_cause == "watchdog"
            assert device.modes.mode.value == "boot"
            for bad in (
                {"can": {"drop": 0.1}},
                {"device": {"error": "boredom"}},
                {"device": {"reset": "boredom"}},
                {"serial": {"drop": 2.0}},
                {"serial": {"dorp": 0.1}},
                {"weather": {}},
            ):
                answer = await control.do("fault", **bad)
                assert not answer["ok"], bad

    run(scenario)


def test_optical_faults_go_with_each_frame(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            assert (await control.do("fault", optical={"false_stars": 7, "blocked_share": 0.25}))["ok"]
            emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
            await control.do("step", seconds=1.0)
            assert run.picture.frames[-1].faults == {"false_stars": 7, "blocked_share": 0.25}
            await control.do("clear_faults")
            await control.do("step", seconds=1.0)
            assert run.picture.frames[-1].faults == {}

    run(scenario)


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_a_live_feed_drives_the_truth(run, protocol):
    message = json.dumps({"t": 5.0, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.0, 1.0]}).encode()

    async def scenario(emulation, line):
        kind, host, port = emulation.ready_words["truth"].split(":")
        assert kind == protocol
        assert f"truth={protocol}:127.0.0.1:" in line
        loop = asyncio.get_running_loop()
        if protocol == "udp":
            transport, _ = await loop.create_datagram_endpoint(
                asyncio.DatagramProtocol, remote_addr=(host, int(port))
            )
            transport.sendto(message + b"\nbad\n")
        else:
            _, transport = await asyncio.open_connection(host, int(port))
            transport.write(message + b"\nbad\n")
        async with Control(emulation) as control:
            while (status := await control.do("status"))["feed"]["refused"] == 0:
                await asyncio.sleep(0.01)
            assert status["feed"]["accepted"] == 1
            assert status["feed"]["last_fault"] == "not a JSON line"
            assert (await control.do("truth", run_time_s=0.5))["roll_deg"] >= 0.0
            assert (await control.do("truth", run_time_s=0.5))["status"] == "extrapolated"
            assert (await control.do("truth", run_time_s=9.0))["status"] == "stale"
        transport.close()

    run(scenario, truth={"kind": "live", "protocol": protocol})


def test_the_real_clock_goes_by_itself(run):
    async def scenario(emulation, _line):
        device = emulation.device
        assert device.modes.mode.value == "standby"
        device.telecommand("set_mode", {"mode": "lost_in_space"})
        while device.cycle.published < 5:
            await asyncio.sleep(0.01)
        assert device.latest.valid
        async with Control(emulation) as control:
            answer = await control.do("step", seconds=1.0)
            assert "stepped" in answer["error"]

    run(scenario, clock="scaled:20", device={"boot_s": 0.1}, parameters={"update_rate": 10.0, "exposure": 50})


def test_the_truth_log_has_a_row_a_frame(run, tmp_path):
    path = tmp_path / "truth.csv"

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
        await emulation.stepper.step(2.5)
        run.picture.fail = "no_match"
        await emulation.stepper.step(1.0)

    run(scenario, options=RunOptions(truth_log=path))
    rows = [line.split(",") for line in path.read_text().splitlines()]
    assert tuple(rows[0]) == COLUMNS
    records = [dict(zip(COLUMNS, row, strict=True)) for row in rows[1:]]
    assert [record["valid"] for record in records] == ["1", "1", "1", "0"]
    assert float(records[0]["cross_boresight_arcsec"]) < 1e-3
    assert records[-1]["measured_qx"] == ""
    assert records[-1]["reason"] == "no_match"


def test_a_truth_log_on_a_full_disk_ends_with_a_whole_row_and_the_run_goes_on(run, tmp_path, caplog):
    path = tmp_path / "truth.csv"
    room = len(",".join(COLUMNS)) + 700  # the head, a frame, and a part of the next

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
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
    assert f"it ends before frame {len(rows)}" in said


def test_a_truth_log_can_be_replayed(run, tmp_path):
    path = tmp_path / "truth.csv"
    rate = {"kind": "rate", "attitude": {"ra_deg": 10.0, "dec_deg": 20.0}, "rate_deg_s": [0.1, 0.2, 0.3]}
    wanted = []

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
        await emulation.stepper.step(5.0)
        wanted.append(emulation.device.cycle.truth.state(2.4))

    run(scenario, options=RunOptions(truth_log=path), truth=rate)
    replayed = read_truth_file(path).state(2.4)
    assert replayed.attitude.error_to(wanted[0].attitude).total_arcsec < 1e-3
    assert replayed.rate_rad_s == pytest.approx(wanted[0].rate_rad_s, rel=1e-5)


def test_a_scenario_happens_at_its_run_times(run, tmp_path):
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
        [[at]]
        run_time_s = 4.0
        fault = { can = { drop = 1.0 } }
        """
    )

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.99)
        assert not emulation.device.deaf
        await emulation.stepper.step(0.02)
        assert emulation.faults.describe() == {"optical": {"false_stars": 3}, "device": {"stuck": True}}
        await emulation.stepper.step(1.0)
        assert emulation.faults.describe() == {}
        assert emulation.device.cycle.truth.state(9.0).attitude.ra_deg == pytest.approx(10.0)
        await emulation.stepper.step(2.0)  # there is no CAN link to break: told in the log, and no more

    run(scenario, options=RunOptions(scenario=str(path)))


@pytest.mark.parametrize("name", sorted(p.stem for p in (configs_folder() / "scenarios").glob("*.toml")))
def test_every_scenario_of_the_product_is_valid(name):
    assert load_scenario(name).name == name


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "at: missing; give it"),
        ("[[at]]\nrun_time_s = 1.0\n", "give fault, truth or clear_faults"),
        (
            "[[at]]\nrun_time_s = 1.0\nfault = { optical = { false_star = 1 } }\n",
            "unknown key 'false_star'",
        ),
        ("[[at]]\nrun_time_s = 1.0\ntruth = { kind = 'live' }\n", "live feed"),
        ("[[at]]\nrun_time_s = -1.0\nclear_faults = true\n", "run_time_s"),
        ("[[at", "not TOML"),
    ],
)
def test_a_bad_scenario_is_named_with_file_and_key(tmp_path, text, said):
    path = tmp_path / "day.toml"
    path.write_text(text)
    with pytest.raises(EmulatorError) as refusal:
        load_scenario(str(path))
    assert said in str(refusal.value)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_an_unknown_scenario_tells_the_known_ones():
    with pytest.raises(EmulatorError, match="bad_day"):
        load_scenario("bad_dya")


def test_quit_ends_the_run(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            assert (await control.do("quit"))["ok"]
        await asyncio.wait_for(emulation.ended.wait(), 5.0)

    run(scenario)


@pytest.mark.parametrize(
    ("options", "overrides", "said"),
    [
        (RunOptions(control="nowhere"), {}, "--control nowhere"),
        (RunOptions(control="127.0.0.1:99999"), {}, "--control"),
        (RunOptions(), {"truth": {"kind": "live", "port": 1, "host": "192.0.2.1"}}, "choose another port"),
        (RunOptions(), {"parameters": {"exposure": 0}}, "exposure"),
        (
            RunOptions(),
            {"links": {"can": {"channel": "off"}, "serial": {"port": "/dev/no_such"}}},
            "/dev/no_such",
        ),
        (RunOptions(), {"run": {"clock": "sundial"}}, "sundial"),
    ],
)
def test_what_cannot_be_had_is_said_in_one_line(run, options, overrides, said):
    async def scenario(_emulation, _line):
        pytest.fail("started")

    with pytest.raises(Exception) as refusal:  # noqa: PT011 (errors of the emulator and of the protocol)
        run(scenario, options=options, **overrides)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_start_that_is_refused_is_not_counted(run, tmp_path, monkeypatch):
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

    async def fail(_imager) -> Warm:
        raise EmulatorError("no catalogue")

    with monkeypatch.context() as patch:
        patch.setattr(FakeImager, "start", fail)
        with pytest.raises(EmulatorError, match="no catalogue"):
            run(scenario, run=state)
    assert run(scenario, run=state) == 3


def test_a_symlink_in_use_is_refused_and_stays(run, tmp_path):
    link = tmp_path / "tty"
    links = {"serial": {"port": "auto", "symlink": str(link)}, "can": {"channel": "off"}}

    async def scenario(_emulation, _line):
        first = link.readlink()
        second = Emulation(Profile.model_validate({"run": {"clock": "stepped"}, "links": links}))
        with pytest.raises(EmulatorError, match="in use by another emulator"):
            await second.start()
        await second.close()
        assert link.readlink() == first

    run(scenario, links=links)
    assert not link.is_symlink()


def test_a_truth_log_that_cannot_be_written_is_refused(run, tmp_path):
    async def scenario(_emulation, _line):
        pytest.fail("started")

    with pytest.raises(EmulatorError, match="truth log"):
        run(scenario, options=RunOptions(truth_log=tmp_path / "no" / "log.csv"))


@pytest.mark.process
def test_a_pipeline_that_dies_is_told_and_comes_back():
    profile = Profile.model_validate(
        {"links": {"serial": {"port": "off"}, "can": {"channel": "off"}}, "run": {"clock": "stepped"}}
    )
    assert profile.run == RunConfig(clock="stepped")

    async def scenario():
        emulation = Emulation(profile)
        assert isinstance(emulation.imager, ProcessImager)
        assert isinstance(emulation.clock, SteppedClock)
        try:
            await emulation.start()
            await emulation.ready()
            await emulation.stepper.step(1.0)
            emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
            await emulation.stepper.step(2.0)
            assert emulation.device.latest.valid
            emulation.imager._worker.process.kill()
            while emulation.device.modes.mode.value != "error":
                await asyncio.sleep(0.01)
            assert emulation.device.modes.error == "processing"
            assert emulation.device.telemetry_values("precise_attitude")["reason"] == "processing_error"
            while not emulation.device.warm:  # another one comes up by itself
                await asyncio.sleep(0.05)
            emulation.device.telecommand("set_mode", {"mode": "standby"})
            emulation.device.telecommand("set_mode", {"mode": "lost_in_space"})
            await emulation.stepper.step(2.0)
            assert emulation.device.latest.valid
        finally:
            await emulation.close()

    asyncio.run(scenario())
