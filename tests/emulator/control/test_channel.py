"""The control channel of a whole run: time, truth, feeds, faults, and requests that are none."""

import asyncio
import json
import os
import socket
import threading
from typing import get_args

import pytest

import starhil.protocol.transports.can
from starhil.emulator.control.channel import MAX_LINE
from starhil.emulator.device.cycle import MAX_AWAITED
from starhil.emulator.errors import EmulatorError
from starhil.emulator.run.truth_log import COLUMNS
from starhil.emulator.truth.config import TruthConfig
from starhil.emulator.truth.file import read_truth_file
from tests.emulator.runs import Control, command
from tests.waiting import PATIENCE_S

REQUESTS = 10_000

KINDS = [
    repr(each.model_fields["kind"].annotation.__args__[0]) for each in get_args(get_args(TruthConfig)[0])
]
"""Kinds of truth sources."""


def test_time_passes_only_by_steps(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            assert (await control.do("status"))["mode"] == "boot"
            for _ in range(10):  # each takes some time
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


def test_a_wait_ends_at_a_phase_of_the_next_exposure(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.do("wait", phase="exposure", within_s=3.0)
            assert answer["error"] == "wait: no exposure has begun within 3 s (mode standby)"
            command(emulation, "set_mode", mode="lost_in_space")
            begins = [(await control.do("wait", phase="exposure"))["run_time_s"] for _ in range(3)]
            period_s = 1.0 / float(emulation.device.parameters["update_rate"])
            assert begins[2] - begins[1] == pytest.approx(period_s)
            exposure_s = emulation.device.cycle.exposure_s
            (mid,) = [(await control.do("wait", phase="mid_frame"))["run_time_s"]]
            assert (mid - begins[2]) % period_s == pytest.approx(exposure_s / 2.0)
            for wrong in ({}, {"seconds": 1.0}, {"phase": "exposur"}, {"seconds": 1.0, "phase": "exposure"}):
                assert not (await control.do("wait", **wrong))["ok"]

    run(scenario)


def test_a_fault_acts_at_its_phase_unless_all_are_cleared_before(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            command(emulation, "set_mode", mode="lost_in_space")
            answer = await control.do("fault", phase="mid_frame", device={"error": "sensor"})
            assert answer["ok"]
            assert (await control.do("wait", phase="exposure"))["ok"]
            assert (await control.do("status"))["mode"] == "lost_in_space"
            await control.do("step", seconds=emulation.device.cycle.exposure_s / 2.0)
            assert (await control.do("status"))["mode"] == "error"
            command(emulation, "set_mode", mode="standby")
            await control.do("fault", phase="exposure", device={"error": "sensor"})
            await control.do("clear_faults")
            command(emulation, "set_mode", mode="lost_in_space")
            await control.do("step", seconds=3.0)
            assert (await control.do("status"))["mode"] == "tracking"

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
            for wrong, message in (
                ({"truth": 3}, "truth: must be an object with the keys of [truth] in a profile"),
                ({"truth": {"kind": "fixed", "x": 1}}, "truth.x: unknown key; known: attitude, kind, mount"),
                ({"truth": {}}, f"truth.kind: must be one of {', '.join(sorted(KINDS))}"),
                (
                    {"truth": {"kind": "fixed", "attitude": {"ra_deg": "x"}}},
                    "truth.attitude.ra_deg: must be a number (given: 'x')",
                ),
            ):
                assert await control.do("set_truth", **wrong) == {"ok": False, "error": message}
            bad = await control.do("set_truth", truth={"kind": "rate"})
            assert bad == {"ok": False, "error": "truth.rate_deg_s: missing"}
            assert not (await control.do("set_truth", truth={"kind": "file", "path": "gone.csv"}))["ok"]
            assert (await control.do("truth"))["rate_deg_s"] == pytest.approx([0.0, 0.0, 2.0])
            assert (await control.do("set_truth"))["kind"] == "fixed"  # the profile's
            assert (await control.do("truth"))["ra_deg"] == pytest.approx(83.8)

    run(scenario)


def test_a_slow_truth_file_holds_up_nothing_else(run, tmp_path, monkeypatch):
    path = tmp_path / "truth.csv"
    path.write_text("t,ra_deg,dec_deg,roll_deg\n0,10,20,0\n100,10,20,50\n")
    go = threading.Event()

    def slowly(*arguments, **options):
        assert go.wait(PATIENCE_S)
        return read_truth_file(*arguments, **options)

    monkeypatch.setattr("starhil.emulator.truth.reading_process.read_truth_file", slowly)

    async def scenario(emulation, _line):
        async with Control(emulation) as control, Control(emulation) as other:
            await control.do("step", seconds=1.0)
            swap = asyncio.create_task(
                control.do("set_truth", truth={"kind": "file", "path": str(path), "start": "now"})
            )
            await asyncio.sleep(0)
            assert (await other.do("status"))["truth_kind"] == "fixed"
            await other.do("step", seconds=2.0)
            go.set()
            assert (await swap)["ok"]
            assert (await control.do("truth", run_time_s=13.0))["roll_deg"] == pytest.approx(5.0)

    run(scenario)


def test_a_truth_that_is_set_later_does_not_wait_for_a_file_that_is_never_read(run, tmp_path, monkeypatch):
    path = tmp_path / "truth.csv"
    path.write_text("t,ra_deg,dec_deg,roll_deg\n0,10,20,0\n")
    (tmp_path / "scenario.toml").write_text(
        f'[[at]]\nrun_time_s = 1\ntruth = {{ kind = "file", path = "{path}" }}\n'
    )
    begun, go = threading.Semaphore(0), threading.Event()

    def never(*_arguments):
        begun.release()
        assert go.wait(PATIENCE_S)
        raise EmulatorError("too late")

    monkeypatch.setattr("starhil.emulator.truth.reading_process.read_truth_file", never)

    async def scenario(emulation, _line):
        async with Control(emulation) as control, Control(emulation) as other, Control(emulation) as third:
            first = asyncio.create_task(control.do("set_truth", truth={"kind": "file", "path": str(path)}))
            await asyncio.to_thread(begun.acquire)
            second = asyncio.create_task(other.do("scenario", name=str(tmp_path / "scenario.toml")))
            await asyncio.to_thread(begun.acquire)
            answer = await third.do("set_truth", truth={"kind": "rate", "rate_deg_s": [0.0, 0.0, 2.0]})
            assert (answer["ok"], (await third.do("status"))["truth_kind"]) == (True, "rate")
            for waiting in (first, second):
                assert "a later set_truth or scenario has taken its place" in (await waiting)["error"]
            go.set()
            assert (await third.do("status"))["truth_kind"] == "rate"

    run(scenario)


def test_a_limited_number_of_requests_awaits_an_exposure(run):
    """In standby there is none; each request that gave up waiting was kept."""

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            for _ in range(MAX_AWAITED):
                await control.do("fault", phase="exposure", device={"stuck": False})
            for request in (
                {"do": "fault", "phase": "exposure", "device": {"stuck": False}},
                {"do": "wait", "phase": "readout", "within_s": 0.1},
            ):
                assert (
                    "256 requests await the next exposure already"
                    in (await control.raw(json.dumps(request).encode()))["error"]
                )
            command(emulation, "set_mode", mode="lost_in_space")
            await control.do("step", seconds=2.0)
            assert (await control.do("wait", phase="readout"))["ok"]

    run(scenario)


def test_a_truth_file_that_is_a_pipe_is_rejected_at_once(run, tmp_path):
    os.mkfifo(tmp_path / "pipe")

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.do("set_truth", truth={"kind": "file", "path": str(tmp_path / "pipe")})
            assert "not a regular file" in answer["error"]
            assert (await control.do("status"))["truth_kind"] == "fixed"

    run(scenario)


def test_frames_are_reported_with_truth_and_error(run):
    run.pipeline.turn_rad = 1e-5

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            command(emulation, "set_mode", mode="lost_in_space")
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


@pytest.mark.parametrize("begun", [b'{"do": "sta', b"x" * (MAX_LINE + 1)])
def test_a_line_that_is_not_completed_in_time_ends_its_connection_only(run, monkeypatch, begun):
    monkeypatch.setattr("starhil.emulator.control.channel.REQUEST_S", 0.2)

    async def scenario(emulation, _line):
        async with Control(emulation) as silent, Control(emulation) as control:
            control.writer.write(begun)
            answer, rest = json.loads(await control.reader.readline()), await control.reader.read()
            assert (answer, rest) == ({"ok": False, "error": "no complete line within 10 s"}, b"")
            assert (await silent.raw(b'{"do": "status"}'))["ok"], "silent between lines for as long"

    run(scenario)


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ({"kind": "file", "path": "a\0b"}, "embedded null"),
        ({"kind": "live", "host": "127.0.0..1"}, "truth feed udp:127.0.0..1:0: cannot listen"),
        ({"kind": "live", "protocol": "tcp", "host": "a\0b"}, "cannot listen"),
        ({"kind": "rate", "rate_deg_s": [1e200, 0.0, 0.0]}, "truth.rate_deg_s.0: must be at most 600"),
        (
            {"kind": "slew", "segments": [{"do": "rate", "seconds": 1e308, "rate_deg_s": [9.0, 0.0, 0.0]}]},
            "seconds: must be at most",
        ),
        (
            {
                "kind": "slew",
                "segments": [{"do": "slew", "to": {"ra_deg": 1.0, "dec_deg": 0.0}, "max_rate_deg_s": 5e-324}],
            },
            "max_rate_deg_s: must be at least",
        ),
    ],
)
def test_an_invalid_truth_is_rejected_and_the_connection_kept(run, truth, message):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.do("set_truth", truth=truth)
            assert not answer["ok"]
            assert message in answer["error"]
            assert "\n" not in answer["error"]
            assert (await control.do("status"))["truth_kind"] == "fixed"

    run(scenario)


def test_an_internal_error_is_answered_and_logged_and_the_connection_kept(run, monkeypatch, caplog):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            with monkeypatch.context() as patch:
                patch.setattr(run.first_head().faults, "describe", lambda: {}[0])
                answer = await control.do("clear_faults", id=4)
            assert answer["id"] == 4
            assert not answer["ok"]
            assert "internal error: KeyError; see" in answer["error"]
            (record,) = [each for each in caplog.records if each.name == "starhil.control"]
            assert record.exc_info
            assert (await control.do("status"))["ok"]

    run(scenario)


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_a_live_feed_stays_until_its_replacement_is_open(run, protocol):
    live = {"kind": "live", "protocol": protocol}

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            first = emulation.feed
            where = emulation.ready_fields["truth"]
            refused = await control.do("set_truth", truth={**live, "host": "192.0.2.1", "port": 5000})
            assert not refused["ok"]
            assert emulation.feed is first
            assert (first._datagrams or first._server) is not None
            assert (await control.do("status"))["feed"]["address"] == where
            port = int(where.rsplit(":", 1)[1])
            again = await control.do("set_truth", truth={**live, "port": port})
            assert again == {"ok": True, "kind": "live", "address": where}
            gone = await control.do("set_truth", truth={"kind": "fixed"})
            assert gone == {"ok": True, "kind": "fixed", "address": ""}
            assert emulation.feed is None
            by_name = {**live, "host": "localhost", "port": port}
            for _ in range(2):
                assert (await control.do("set_truth", truth=by_name))["ok"]

    run(scenario, truth=live)


@pytest.mark.parametrize("channel", ["off", "virtual:emulation-faults"])
def test_faults_of_the_can_bus_reach_canopen_too(run, monkeypatch, channel):
    real = starhil.protocol.transports.can.open_can
    monkeypatch.setattr(
        "starhil.protocol.transports.can.open_can", lambda _spec, **_options: real("virtual:emulation-faults")
    )

    async def scenario(emulation, _line):
        wires = [link.wire for link in emulation.links.values() if link.bus == "can"]
        assert len(wires) == (1 if channel == "off" else 2)
        async with Control(emulation) as control:
            answer = await control.do("fault", can={"drop": 0.5})
            assert answer["faults"]["can"]["drop"] == 0.5
            assert [wire.settings.drop for wire in wires] == [0.5] * len(wires)
            assert (await control.do("clear_faults"))["faults"] == {}
            assert all(wire.settings.none for wire in wires)

    links = {"serial": {"port": "off"}, "can": {"channel": channel}, "canopen": {"node": 44}}
    run(scenario, links=links)


def test_faults_are_brought_about_and_cleared(run):
    async def scenario(emulation, _line):
        device = emulation.device
        async with Control(emulation) as control:
            await control.do("step", seconds=1.0)
            assert (await control.do("fault", device={"stuck": True}))["faults"] == {
                "device": {"stuck": True}
            }
            assert device.unresponsive
            await control.do("fault", serial={"drop": 0.5, "split": 4}, device={"error": "injected"})
            assert device.modes.error == "injected"
            assert emulation.links["serial"].wire.settings.drop == 0.5
            assert not device.unresponsive
            assert (await control.do("clear_faults"))["faults"] == {}
            assert emulation.links["serial"].wire.settings.none
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
            command(emulation, "set_mode", mode="lost_in_space")
            await control.do("step", seconds=1.0)
            assert run.pipeline.frames[-1].faults == {"false_stars": 7, "blocked_share": 0.25}
            await control.do("clear_faults")
            await control.do("step", seconds=1.0)
            assert run.pipeline.frames[-1].faults == {}

    run(scenario)


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_a_live_feed_drives_the_truth(run, protocol):
    message = json.dumps({"t": 5.0, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.0, 1.0]}).encode()

    async def scenario(emulation, line):
        kind, host, port = emulation.ready_fields["truth"].split(":")
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
            assert status["feed"]["last_fault"] == "not a JSON object on one line"
            assert (await control.do("truth", run_time_s=0.5))["roll_deg"] >= 0.0
            assert (await control.do("truth", run_time_s=0.5))["status"] == "extrapolated"
            assert (await control.do("truth", run_time_s=9.0))["status"] == "stale"
        transport.close()

    run(scenario, truth={"kind": "live", "protocol": protocol})


def test_quit_ends_the_run(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            assert (await control.do("quit"))["ok"]
        await asyncio.wait_for(run.launched.ended.wait(), 5.0)

    run(scenario)


def test_a_scenario_of_which_one_event_is_impossible_changes_nothing(run, tmp_path):
    """The first event is valid; the second one needs a link that the run does not have."""
    path = tmp_path / "half.toml"
    path.write_text(
        "[[at]]\nrun_time_s = 0.5\nfault = { device = { stuck = true } }\n"
        "[[at]]\nrun_time_s = 1.0\nfault = { can = { drop = 1.0 } }\n"
    )

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.do("scenario", name=str(path))
            assert not answer["ok"]
            assert "no such link" in answer["error"]
            await control.do("step", seconds=2.0)
            return await control.do("status")

    assert run(scenario)["faults"] == {}


@pytest.mark.long
def test_many_requests_in_one_write_leave_the_loop_to_the_links(run):
    """The peer reads in a thread: otherwise the answers that it has not read hold up the requests."""

    async def scenario(emulation, _line):
        turns = 0

        async def count():
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        def ask():
            with socket.socket(socket.AF_UNIX) as peer:
                peer.connect(emulation.ready_fields["control"].removeprefix("unix:"))
                threading.Thread(target=peer.sendall, args=[b'{"do": "status"}\n' * REQUESTS]).start()
                with peer.makefile("rb") as answers:
                    return sum(1 for _ in zip(range(REQUESTS), answers, strict=False))

        counting = asyncio.create_task(count())
        answered = await asyncio.to_thread(ask)
        counting.cancel()
        return answered, turns

    answered, turns = run(scenario)
    assert answered == REQUESTS
    assert turns >= REQUESTS
