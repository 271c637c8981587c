"""Truth from 42: its blocks, its acknowledge, and lock-step with the stepped clock."""

from __future__ import annotations

import asyncio
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.simulator_42 import Format42
from starid.attitude import propagate
from tests.emulator.runs import Control
from tests.emulator.truth.simulators import (
    ORION,
    POSITION_M,
    RATE_DEG_S,
    VELOCITY_M_S,
    Stub42,
    block_of_42,
    blocks_of_42,
)
from tests.waiting import PATIENCE_S, until

MILLIARCSECOND = 1e-3
START_UNIX_S = datetime(2024, 12, 31, 23, tzinfo=UTC).timestamp()


def apart_arcsec(one, other):
    return one.error_to(other).total_arcsec


@pytest.mark.parametrize("form", [{}, {"brackets": False, "bodies_only": True}])
def test_a_block_gives_the_conjugate_attitude_the_rate_and_the_orbit(form):
    message = Format42().decode(block_of_42(3.0, ORION, **form))
    assert apart_arcsec(message.attitude, ORION) < MILLIARCSECOND
    assert np.degrees(message.rate_rad_s) == pytest.approx(RATE_DEG_S)
    moved = np.multiply(3.0, VELOCITY_M_S) + ([0.0, 0.0, 0.0] if form else [10.0, 0.0, 0.0])
    assert message.orbit.position_m == pytest.approx(np.add(POSITION_M, moved), rel=1e-12)
    assert message.orbit.velocity_m_s == pytest.approx(VELOCITY_M_S)


def test_time_counts_from_the_first_block_to_the_nanosecond_over_the_turn_of_a_year():
    read = Format42()
    before = block_of_42(0.1, ORION)
    after = before.replace(b"2024-366-23:00:00.1", b"2025-001-00:00:00.3")
    assert read.decode(before).t == 0.0
    message = read.decode(after)
    assert message.t == 3600.2
    assert message.unix_s == datetime(2025, 1, 1, 0, 0, 0, 300_000, UTC).timestamp()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"TIME", b"TAME", "no line TIME"),
        (b"TIME 20", b"TIME 21", "TIME is not a date from 1970 to 2100"),
        (b"[ENDMSG]", b"", r"without \[ENDMSG\]"),
        (b"qn = ", b"qm = ", r"no SC\[0\].qn; give 42 the prefixes"),
        (b"wn = ", b"wm = ", r"no SC\[0\].B\[0\].wn"),
        (b"SC[0]", b"SC[1]", r"no SC\[0\].qn"),
        (b"qn = [", b"qn = [1 ", r"SC\[0\].qn is not 4 finite numbers"),
        (b"wn = [", b"wn = [x", "not 3 finite numbers"),
        (b"e-01", b"e+00", "not of length 1"),
        (b"PosN = [", b"PosN = [nan ", "PosN is not 3 finite numbers"),
    ],
)
def test_a_bad_block_is_rejected_by_name(old, new, said):
    block = block_of_42(0.0, ORION)
    with pytest.raises(FeedError, match=said):
        Format42().decode(block.replace(old, new))


@pytest.mark.parametrize(
    ("number", "said"),
    [
        ({"orbit": 3}, r"no Orb\[3\].PosN; the block has Orb\[0\]: set truth.orbit"),
        ({"spacecraft": 2}, r"no SC\[2\].qn; the block has SC\[0\]: set truth.spacecraft"),
    ],
)
def test_a_spacecraft_or_orbit_that_42_does_not_have_is_rejected_with_those_that_it_has(number, said):
    with pytest.raises(FeedError, match=said):
        Format42(**number).decode(block_of_42(0.0, ORION))


def test_blocks_without_an_orbit_are_reported_once(caplog):
    read = Format42()
    for t in (0.0, 0.1):
        block = b"\n".join(line for line in block_of_42(t, ORION).splitlines() if not line.startswith(b"Orb"))
        assert read.decode(block).orbit is None
    (said,) = [record.getMessage() for record in caplog.records]
    assert said == (
        "truth feed: 42 sends no orbit, so there is neither Earth nor aberration: "
        'give 42 the prefixes "SC" and "Orb" in Inp_IPC.txt'
    )


def test_42_reads_the_configuration_on_the_page():
    page = (Path(__file__).resolve().parents[3] / "docs/simulators.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```text\n([^`]*Number of Sockets.*?)```", page, re.DOTALL)
    lines = iter(shown.splitlines())
    next(lines)  # 42 skips the first line, and a line before each socket
    value = [line.split("!")[0].split() for line in lines]
    assert value[0] == ["1"]
    assert value[2:9] == [
        ["TX"],
        ['"State00.42"'],
        ["SERVER"],
        ["localhost", "4242"],
        ["TRUE"],
        ["FALSE"],
        ["2"],
    ]
    assert value[9:] == [['"SC"'], ['"Orb"']]


def test_a_rate_too_high_for_any_image_is_rejected_by_name():
    with pytest.raises(FeedError, match="exceeds 600 degrees per second"):
        Format42().decode(block_of_42(0.0, ORION, (0.0, 700.0, 0.0)))


def truth_of(port, **keys):
    return {"truth": {"kind": "42", "port": port, **keys}}


def lockstep(run, tmp_path, name, blocks, role="client"):
    """Run a device in lock-step with the stub; return truth log and simulation time."""
    log = tmp_path / name

    async def scenario(emulation, _line):
        stub = Stub42(blocks)
        if role == "client":
            port = await stub.listen()
            await emulation.truth.set(type(emulation.profile).model_validate(truth_of(port)).truth)
        else:
            await stub.connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        async with asyncio.timeout(PATIENCE_S):
            await stub.done.wait()
        assert stub.acknowledged == len(blocks)
        feed = emulation.truth.source
        assert (feed.accepted, feed.refused) == (len(blocks), 0), feed.last_fault
        return emulation.clock.now_ns()

    settings = {} if role == "client" else truth_of(0, role="server")
    parameters = {"start_mode": "lost_in_space", "update_rate": 2.0}
    options = RunOptions(truth_log=log)
    ended_ns = run(scenario, options=options, parameters=parameters, **settings)
    return log.read_bytes(), ended_ns


@pytest.mark.parametrize("role", ["client", "server"])
def test_lock_step_gives_the_same_truth_log_twice_and_time_passes_as_in_42(run, tmp_path, role):
    blocks = blocks_of_42(101)
    first, ended_ns = lockstep(run, tmp_path, "1.csv", blocks, role)
    again, _ = lockstep(run, tmp_path, "2.csv", blocks, role)
    assert ended_ns == 10_000_000_000
    assert first == again
    assert first.count(b",ok,") >= 18


def test_an_exposure_in_lock_step_sees_the_attitude_of_its_time(run):
    async def scenario(emulation, _line):
        frames = []
        emulation.device.signals.frame_published.connect(frames.append)
        stub = Stub42(blocks_of_42(51))
        await stub.connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        return frames

    parameters = {"start_mode": "lost_in_space", "update_rate": 2.0}
    frames = run(scenario, parameters=parameters, **truth_of(0, role="server"))
    assert len(frames) >= 8
    for frame in frames:
        expected = propagate(ORION, np.radians(RATE_DEG_S), frame.mid_ns / 1e9)
        assert apart_arcsec(frame.truth.attitude, expected) < MILLIARCSECOND
        assert np.degrees(frame.truth.rate_rad_s) == pytest.approx(RATE_DEG_S)
        assert frame.truth.orbit.velocity_m_s == pytest.approx(VELOCITY_M_S)
        assert frame.truth.unix_s == pytest.approx(START_UNIX_S + frame.mid_ns / 1e9, abs=1e-5)
        assert frame.truth.status == "ok"


def test_a_bad_block_is_acknowledged_and_a_repeated_one_changes_nothing(run):
    blocks = blocks_of_42(4)
    blocks[2:2] = [blocks[1], b"TIME nonsense\n[ENDMSG]\n"]

    async def scenario(emulation, _line):
        stub = Stub42(blocks)
        await stub.connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        async with Control(emulation) as control:
            status = await control.do("status")
        assert status["truth_kind"] == "42"
        assert status["feed"]["refused"] == 1
        assert "no line TIME" in status["feed"]["last_fault"]
        assert status["run_time_s"] == pytest.approx(0.3)

    run(scenario, **truth_of(0, role="server"))


def test_a_restarted_42_continues_at_the_clock(run):
    async def scenario(emulation, _line):
        port = int(emulation.ready_fields["truth"].rpartition(":")[2])
        for _ in range(2):
            await Stub42(blocks_of_42(31)).connect(port)
        return emulation.clock.now_ns(), emulation.truth.source.refused

    assert run(scenario, **truth_of(0, role="server")) == (6_000_000_000, 0)


def test_on_the_real_clock_42_is_acknowledged_and_followed(run):
    async def scenario(emulation, _line):
        stub = Stub42([blocks_of_42(1)[0], *blocks_of_42(30)])
        await stub.connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        assert (emulation.truth.source.accepted, emulation.truth.source.refused) == (31, 0)
        return emulation.truth.source.state(emulation.clock.now_ns() / 1e9)

    state = run(scenario, clock="real", **truth_of(0, role="server"))
    assert np.degrees(np.linalg.norm(state.rate_rad_s)) == pytest.approx(np.linalg.norm(RATE_DEG_S), rel=0.6)


def test_a_42_that_comes_later_is_connected_to(run, caplog, monkeypatch):
    monkeypatch.setattr("starhil.emulator.truth.feed.RETRY_S", 0.02)

    async def scenario(emulation, _line):
        gone = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
        port = gone.sockets[0].getsockname()[1]
        gone.close()
        await emulation.truth.set(type(emulation.profile).model_validate(truth_of(port)).truth)
        await until(lambda: "no connection" in caplog.text)
        stub = Stub42(blocks_of_42(11))
        await asyncio.start_server(stub.send, "127.0.0.1", port)
        async with asyncio.timeout(PATIENCE_S):
            await stub.done.wait()
        return emulation.clock.now_ns()

    assert run(scenario) == 1_000_000_000
    assert caplog.text.count("no connection") == 1


@pytest.mark.parametrize(
    ("truth", "clock", "message"),
    [
        ({"kind": "live", "lockstep": True}, "stepped", 'lockstep needs protocol = "tcp"'),
        ({"kind": "live", "lockstep": True, "protocol": "tcp"}, "real", "run with --clock stepped"),
        ({"kind": "42", "port": 0}, "stepped", 'port: 0 needs role = "server"'),
    ],
)
def test_settings_that_cannot_work_are_rejected_with_the_remedy(run, truth, clock, message):
    async def scenario(_emulation, _line):
        raise AssertionError

    with pytest.raises((EmulatorError, ValueError), match=message):
        run(scenario, clock=clock, truth=truth)
