"""Faults in the content of telemetry: what an OBC reads, on every link."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.can import CanLink
from starhil.emulator.links.serial import SerialLink
from starhil.emulator.links.wire_faults import WireFault
from starhil.emulator.profile import Profile
from starhil.emulator.run.faults import FaultRequest, Faults
from starhil.emulator.truth.source import FixedTruth
from starhil.protocol.can.cubespace import CanHostReceiver, encode_request_frames
from starhil.protocol.messages import FaultKind, LinkFault, Reply
from starhil.protocol.serial.stack import SerialStack
from starid.attitude import Attitude
from tests.emulator.wire import Wire

ROW = "precise_attitude"
VALUES = ("q_x", "q_y", "q_z")


@pytest.fixture
def found(make_bench):
    """A device that has found its attitude."""

    def make(unit="cubestar", **keys):
        bench = make_bench(
            Profile(parameters={"start_mode": "lost_in_space", "update_rate": 5.0}, **keys), unit=unit
        )
        bench.start().step(2.0)
        bench.links = {}
        bench.faults = Faults(bench.requests, bench.links)
        bench.inject = lambda **fault: bench.faults.inject(FaultRequest(telemetry=[fault]))
        return bench

    return make


def attitude_of(reading):
    x, y, z = (reading[name] for name in VALUES)
    return Attitude(np.array([x, y, z, math.sqrt(1.0 - x * x - y * y - z * z)]))


def test_a_field_is_overridden_and_all_others_stay(found):
    bench = found()
    before = bench.read(ROW)
    bench.inject(row=ROW, set={"q_x": 0.5, "valid": False}, offset={"time_of_exposure": 10.0}, negate=["q_y"])
    after = bench.read(ROW)
    assert after["q_x"] == 0.5
    assert after["valid"] is False
    assert after["q_y"] == -before["q_y"]
    assert after["time_of_exposure"] == pytest.approx(before["time_of_exposure"] + 10.0)
    same = before.keys() - {"q_x", "q_y", "valid", "time_of_exposure"}
    assert {key: after[key] for key in same} == {key: before[key] for key in same}
    assert bench.read("quaternion") != {}
    bench.faults.clear()
    assert bench.read(ROW) == before


def test_not_a_number_and_a_value_outside_its_limits_are_sent(found):
    bench = found()
    bench.inject(row=ROW, nan=["q_x"])
    assert math.isnan(bench.read(ROW)["q_x"])
    bench.inject(row="device_status", set={"mode": 200})
    assert bench.read("device_status")["mode"] == 200


def test_a_frozen_attitude_has_running_counters_and_a_frozen_row_has_not(found):
    bench = found()
    bench.faults.inject(FaultRequest(telemetry={"freeze": "attitude"}))
    bench.device.surroundings.truth = FixedTruth(Attitude.from_radec_roll(10.0, 20.0, 30.0))
    first = bench.read(ROW)
    bench.step(3.0)
    later = bench.read(ROW)
    assert [later[name] for name in VALUES] == [first[name] for name in VALUES]
    assert later["valid"] is True
    assert later["time_of_exposure"] > first["time_of_exposure"]
    bench.inject(row=ROW, freeze="all")
    first = bench.data(ROW)
    bench.step(3.0)
    assert bench.data(ROW) == first
    bench.faults.clear()
    assert bench.data(ROW) != first


def test_a_wrong_attitude_is_off_by_the_angle_in_every_form_with_all_flags_good(found):
    bench = found()
    true = attitude_of(bench.read(ROW))
    bench.faults.inject(FaultRequest(telemetry={"turn_deg": [0.0, 0.5, 0.0]}))
    reading = bench.read(ROW)
    assert reading["valid"] is True
    error = attitude_of(reading).error_to(true)
    assert np.degrees(error.rotation_vector_rad) == pytest.approx([0.0, 0.5, 0.0], abs=1e-4)
    bench.inject(jump_deg=2.0)
    rows = []
    for _ in range(3):
        angle = attitude_of(bench.read(ROW)).error_to(true)
        assert angle.total_arcsec == pytest.approx(7200.0, abs=1.0)
        assert attitude_of(bench.read(ROW)).error_to(attitude_of(bench.read(ROW))).total_arcsec < 1e-3
        rows.append(tuple(np.round(angle.rotation_vector_rad, 6)))
        bench.step(0.2)
    assert len(set(rows)) == 3


def test_a_quaternion_is_conjugated(found):
    bench = found()
    before = attitude_of(bench.read(ROW)).matrix
    bench.inject(row=ROW, conjugate=True)
    assert attitude_of(bench.read(ROW)).matrix == pytest.approx(before.T, abs=1e-6)


def test_stale_time_is_old_by_that_much(found):
    bench = found()
    before = bench.read(ROW)["time_of_exposure"]
    bench.inject(stale_s=7.0)
    assert bench.read(ROW)["time_of_exposure"] == pytest.approx(before - 7.0)


def test_the_pattern_in_time_the_count_and_the_probability(found):
    bench = found()

    def wrong(reads, gap_s=0.1):
        values = []
        for _ in range(reads):
            values.append(bench.read("device_status")["mode"] == 200)
            bench.step(gap_s)
        return values

    bench.inject(row="device_status", set={"mode": 200}, after_s=0.25, for_s=0.15, every_s=1.0)
    assert [index for index, hit in enumerate(wrong(24)) if hit] == [3, 13, 23]
    bench.inject(row="device_status", set={"mode": 200}, count=2)
    assert wrong(5) == [True, True, False, False, False]
    bench.inject(row="device_status", set={"mode": 200}, probability=0.3)
    share = sum(wrong(400, 0.001)) / 400
    assert 0.22 < share < 0.38  # 3.5 sigma


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"row": "precise_attitud", "freeze": "all"}, "did you mean precise_attitude?"),
        ({"row": ROW, "set": {"q_xx": 0.5}}, "row precise_attitude has no field 'q_xx'"),
        ({"set": {"no_such_field": 1}}, "no row of unit cubestar has a field 'no_such_field'"),
        ({"row": "device_status", "nan": ["mode"]}, "mode is not a float"),
        ({"row": "device_status", "set": {"mode": 300}}, "telemetry.set.mode: "),
        ({"row": "device_status", "conjugate": True}, "device_status has no quaternion"),
        ({"row": "set_mode", "freeze": "all"}, "set_mode is a telecommand"),
        ({"wrong_check": True}, "no link of this run (serial) has a checksum in its messages"),
        ({"wrong_sequence": True}, "no link of this run (serial) has a sequence number"),
        ({"answer_with": "nothing"}, "telemetry.answer_with: no telemetry row named 'nothing'"),
    ],
)
def test_what_can_have_no_effect_is_rejected(found, fault, message):
    bench = found()
    bench.links["serial"] = SimpleNamespace(
        bus="serial",
        shown_in_replies=SerialStack(bench.icd).shown_in_replies,
        wire=SimpleNamespace(settings=WireFault()),
    )
    with pytest.raises(EmulatorError) as error:
        bench.inject(**fault)
    assert message in str(error.value)
    assert bench.faults.describe() == {}


@pytest.mark.parametrize("unit", ["st200", "sagitta"])
def test_a_wrong_check_in_a_well_formed_message_is_seen_as_such(found, unit):
    bench = found(unit)
    row = bench.icd.readable[0]

    async def scenario():
        wire = Wire()
        link = SerialLink(bench.requests, wire)
        await link.start()
        bench.links["serial"] = link
        host = SerialStack(bench.icd).host()

        def ask():
            wire.arrive(host.request(bench.icd.request(row)))
            return [event for item in wire.take() for event in host.feed(item, 0.0)]

        assert isinstance(ask()[0], Reply)
        bench.inject(row=row.name, wrong_check=True, count=1)
        (fault,) = ask()
        assert isinstance(fault, LinkFault)
        assert fault.kind is FaultKind.UART_CHECK
        assert isinstance(ask()[0], Reply)
        await link.close()

    asyncio.run(scenario())


def test_messages_on_can_have_a_wrong_id_or_segment_counter_or_come_short_twice_or_not(found):
    bench = found()

    async def scenario():
        wire = Wire()
        link = CanLink(bench.requests, wire)
        await link.start()
        bench.links["can"] = link

        def ask(name=ROW):
            host = CanHostReceiver(1)
            (frame,) = encode_request_frames(bench.icd.request(bench.icd.telemetry[name]), 1, 4)
            wire.arrive(frame)
            return [event for item in wire.take() for event in host.feed(item, 0.0)]

        (usual,) = ask()
        bench.inject(row=ROW, wrong_id=222)
        assert [reply.id for reply in ask()] == [222]
        bench.inject(row=ROW, wrong_sequence=True)
        assert [fault.kind for fault in ask()] == [FaultKind.CAN_SEQUENCE]
        bench.inject(row=ROW, truncate=3)
        assert [reply.data for reply in ask()] == [usual.data[:-3]]
        bench.inject(row=ROW, duplicate=True)
        assert ask() == [usual, usual]
        bench.inject(row=ROW, drop=True)
        assert ask() == []
        assert len(ask("device_status")) == 1
        bench.inject(row=ROW, answer_with="device_status")
        (other,) = ask()
        assert (other.id, other.data) == (
            bench.icd.telemetry["device_status"].id,
            bench.data("device_status"),
        )
        await link.close()

    asyncio.run(scenario())
