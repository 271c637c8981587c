"""Conventions of a feed: which quaternion, in which order, on which mount, and lock-step over JSON lines."""

from __future__ import annotations

import asyncio
import json
import math

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from starhil.emulator.launch import RunOptions
from starhil.emulator.truth.config import MountConfig, TruthConfig
from starhil.emulator.truth.feed_message import JsonFormat
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.source import FixedTruth, RateTruth
from starhil.emulator.truth.truth import seen_from
from starid.attitude import Attitude, propagate
from tests.emulator.runs import Control
from tests.emulator.truth.simulators import ORION
from tests.waiting import until

MILLIARCSECOND = 1e-3
RATE_DEG_S = [0.4, 0.1, -0.2]
"""Far from (0, 1, 0) and (1, 0, 1), about which a wrong order together with a wrong convention turns the body: near them it cannot be detected."""
CONVENTIONS = [(convention, order) for convention in ("rotation", "attitude") for order in ("xyzw", "wxyz")]


def apart_arcsec(one, other):
    return one.error_to(other).total_arcsec


def written(attitude, convention, order):
    """Return a quaternion as a sender with these conventions writes it."""
    x, y, z, w = attitude.quaternion_xyzw.tolist()
    if convention == "attitude":
        x, y, z = -x, -y, -z
    return [x, y, z, w] if order == "xyzw" else [w, x, y, z]


def line(t, attitude, convention="rotation", order="xyzw", **keys):
    return json.dumps({"t": t, "q": written(attitude, convention, order), "rate": RATE_DEG_S, **keys})


@pytest.mark.parametrize(("convention", "order"), CONVENTIONS)
def test_a_quaternion_of_each_convention_gives_the_same_attitude(convention, order):
    message = JsonFormat(convention, order).decode(line(0.0, ORION, convention, order))
    assert apart_arcsec(message.attitude, ORION) < MILLIARCSECOND


@pytest.mark.parametrize("sent", CONVENTIONS)
@pytest.mark.parametrize("read", CONVENTIONS)
def test_a_wrong_convention_is_rejected_at_the_second_message(sent, read):
    live = LiveTruth(Attitude.identity(), message_format=JsonFormat(*read))
    taken = [
        live.receive(line(0.1 * n, propagate(ORION, np.radians(RATE_DEG_S), 0.1 * n), *sent), 0.1 * n)
        for n in range(20)
    ]
    assert taken == [True] + [sent == read] * 19
    assert sent == read or "truth.convention" in live.last_fault


def test_position_velocity_and_date_of_a_feed_reach_the_truth():
    live = LiveTruth(Attitude.identity(), timeline="run")
    velocity = [0.0, 7500.0, 0.0]
    for t in (0.0, 1.0):
        attitude = propagate(ORION, np.radians(RATE_DEG_S), t)
        position = [7e6, 7500.0 * t, 1.0]
        sent = line(t, attitude, position_m=position, velocity_m_s=velocity, unix_s=1.8e9 + t)
        assert live.receive(sent, t), live.last_fault
    for t in (0.25, 1.0, 1.5):
        state = live.state(t)
        assert state.orbit.position_m == pytest.approx([7e6, 7500.0 * t, 1.0])
        assert state.orbit.velocity_m_s == pytest.approx(velocity)
        assert state.unix_s == pytest.approx(1.8e9 + t, abs=1e-6)


def test_a_position_without_a_velocity_is_rejected():
    with pytest.raises(FeedError, match="both or none"):
        JsonFormat().decode(line(0.0, ORION, position_m=[7e6, 0.0, 1.0]))


def mount_of(**keys):
    return MountConfig.model_validate(keys).build()


def test_the_three_forms_of_a_mount_are_the_same_rotation():
    angles = [30.0, -20.0, 75.0]
    axes = Rotation.from_euler(
        "YXZ", angles, degrees=True
    ).inv()  # intrinsic: turns the axes, not the vectors
    euler = mount_of(euler_deg=angles, sequence="213")
    matrix = mount_of(matrix=np.round(axes.as_matrix(), 6).tolist())
    quaternion = mount_of(quaternion_xyzw=axes.as_quat().tolist())
    assert euler.matrix == pytest.approx(axes.as_matrix(), abs=1e-12)
    assert apart_arcsec(quaternion, euler) < MILLIARCSECOND
    assert apart_arcsec(matrix, euler) < 1.0  # it was rounded


def test_a_mounted_sensor_sees_along_its_axes_in_the_body_and_turns_with_the_body():
    mount = mount_of(matrix=[[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # boresight along the x axis of the body
    body = RateTruth(ORION, np.radians([0.0, 0.0, 0.5]))
    sensor, last = (seen_from(mount, body.state(t)) for t in (7.0, 10.0))
    x_axis = body.state(7.0).attitude.matrix[0]
    assert sensor.attitude.boresight == pytest.approx(x_axis, abs=1e-12)
    assert np.degrees(sensor.rate_rad_s) == pytest.approx([-0.5, 0.0, 0.0])
    later = propagate(sensor.attitude, sensor.rate_rad_s, 3.0)
    assert apart_arcsec(last.attitude, later) < MILLIARCSECOND


def test_without_a_mount_the_truth_is_the_sensor_s():
    state = FixedTruth(ORION).state(0.0)
    assert seen_from(None, state) is state


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({}, "give one of"),
        ({"euler_deg": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}, "give one of"),
        ({"quaternion_xyzw": [0, 0, 0, 2]}, "length 1"),
        ({"matrix": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "right-handed"),
        ({"matrix": [[1, 0, 0], [0, 1, 0], [0, 0.1, 1]]}, "orthonormal"),
        ({"euler_deg": [0, 0, 0], "sequence": "112"}, "twice in a row"),
        ({"euler_deg": [0, 0, 0], "sequence": "124"}, "pattern"),
    ],
)
def test_an_invalid_mount_is_rejected(keys, said):
    with pytest.raises(ValidationError, match=said):
        MountConfig.model_validate(keys)


@pytest.mark.parametrize("unix_s", [-1.0, 4.2e9, 1.0e14])
def test_a_date_for_which_there_is_no_sky_is_rejected(unix_s):
    with pytest.raises(FeedError, match="unix_s is not a date from 1970 to 2100"):
        JsonFormat().decode(json.dumps({"q": [0.0, 0.0, 0.0, 1.0], "unix_s": unix_s}))


@pytest.mark.parametrize("kind", ["fixed", "rate", "live", "42"])
def test_every_kind_of_truth_takes_a_mount(kind):
    keys = {"rate_deg_s": [0.0, 0.0, 0.0]} if kind == "rate" else {}
    config = TypeAdapter(TruthConfig).validate_python(
        {"kind": kind, "mount": {"euler_deg": [0.0, 90.0, 0.0]}, **keys}
    )
    assert config.mount.build().matrix[0] == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)


def test_a_mount_stays_when_the_truth_changes_without_one(run):
    mount = {"matrix": [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}

    async def scenario(emulation, _line):
        states = []
        async with Control(emulation) as control:
            for truth in ({"kind": "fixed"}, {"kind": "fixed", "mount": {"euler_deg": [0.0, 0.0, 0.0]}}):
                await control.do("set_truth", truth=truth | {"attitude": {"ra_deg": 0.0, "dec_deg": 0.0}})
                states.append((await control.do("truth"))["dec_deg"])
        return states

    along_x_of_the_body, along_its_z = run(scenario, truth={"kind": "fixed", "mount": mount})
    assert abs(along_x_of_the_body - along_its_z) > 1.0 or along_its_z == pytest.approx(0.0, abs=1e-9)
    assert along_its_z == pytest.approx(0.0, abs=1e-9)


def test_lock_step_over_json_steps_by_the_senders_time_and_answers_each_line(run):
    async def scenario(emulation, _line):
        host, port = emulation.ready_fields["truth"].removeprefix("tcp:").rsplit(":", 1)
        reader, writer = await asyncio.open_connection(host, int(port))
        answers = []
        rate = np.radians(RATE_DEG_S)
        for t in (100.0, 100.5, 101.25, 101.0):
            writer.write(line(t, propagate(ORION, rate, t)).encode() + b"\n")
            answers.append(json.loads(await reader.readline()))
        writer.write(b'{"q": [0, 0, 0, 1]}\n')
        answers.append(json.loads(await reader.readline()))
        writer.close()
        return answers

    truth = {"kind": "live", "protocol": "tcp", "lockstep": True}
    answers = run(scenario, truth=truth)
    assert [answer["run_time_s"] for answer in answers] == [0.0, 0.5, 1.25, 1.25, 1.25]
    assert [answer["ok"] for answer in answers] == [True, True, True, False, False]
    assert "not later" in answers[3]["error"]
    assert "lock-step needs the sender's time" in answers[4]["error"]


def test_an_unconjugated_feed_in_lock_step_is_rejected_in_the_answer(run):
    async def scenario(emulation, _line):
        host, port = emulation.ready_fields["truth"].removeprefix("tcp:").rsplit(":", 1)
        reader, writer = await asyncio.open_connection(host, int(port))
        answers = []
        for n in range(3):
            attitude = propagate(ORION, np.radians(RATE_DEG_S), 0.1 * n)
            writer.write(line(0.1 * n, attitude, "attitude").encode() + b"\n")
            answers.append(json.loads(await reader.readline()))
        writer.close()
        return answers

    answers = run(scenario, truth={"kind": "live", "protocol": "tcp", "lockstep": True})
    assert [answer["ok"] for answer in answers] == [True, False, False]
    assert "truth.convention" in answers[1]["error"]
    assert math.isclose(answers[2]["run_time_s"], 0.2)


@pytest.mark.parametrize("through", ["truth", "control"])
def test_a_run_that_ends_within_a_long_step_ends_quietly(run, caplog, through):
    async def scenario(emulation, _line):
        if through == "control":
            address = emulation.ready_fields["control"].removeprefix("unix:")
            _, writer = await asyncio.open_unix_connection(address)
            writer.write(b'{"do": "step", "seconds": 86400}\n')
        else:
            host, port = emulation.ready_fields["truth"].removeprefix("tcp:").rsplit(":", 1)
            _, writer = await asyncio.open_connection(host, int(port))
            writer.write(line(0.0, ORION).encode() + b"\n" + line(80_000.0, ORION).encode() + b"\n")
        await until(lambda: emulation.clock.now_ns() != 0)

    truth = {"kind": "live", "protocol": "tcp", "lockstep": True}
    run(scenario, truth=truth, options=RunOptions(control="auto"), parameters={"start_mode": "lost_in_space"})
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
