"""The CANopen link: device, clock and slave bound together, on a stepped clock and a transport of paper."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.can import CanDamage
from starhil.emulator.links.canopen import (
    FRAME_QUANTITIES,
    STATUS_QUANTITY,
    CanopenLink,
    not_before,
    open_canopen,
    rows_reporting,
)
from starhil.emulator.run.faults import FaultRequest, Faults
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.context import NmtState
from starhil.protocol.canopen.storage import FileStorage, ParameterStorage
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.base import Transport
from starhil.protocol.unit import load_unit

NODE = 44


class PaperTransport(Transport[CanFrame]):
    """Writes down what is sent, hands in what a test receives."""

    def __init__(self) -> None:
        super().__init__("virtual:paper")
        self.frames: list[CanFrame] = []

    async def _open(self) -> None:
        pass

    def send(self, item: CanFrame) -> bool:
        self.frames.append(item)
        return True

    async def drain(self) -> None:
        pass

    async def close(self) -> None:
        pass

    def hand_in(self, frame: CanFrame) -> None:
        self._receive(frame)


class Link:
    """A device with its link, asked and commanded by frames."""

    def __init__(self, device_bench, link: CanopenLink, transport: PaperTransport) -> None:
        self.bench = device_bench
        self.device = device_bench.device
        self.link = link
        self.transport = transport

    def take(self) -> list[tuple[int, str]]:
        frames, self.transport.frames = self.transport.frames, []
        return [(frame.id, frame.data.hex()) for frame in frames]

    def frame(self, identifier: int, data: str = "", **fields) -> list[tuple[int, str]]:
        self.take()
        fields = {"extended": False} | fields
        self.transport.hand_in(CanFrame(identifier, bytes.fromhex(data), **fields))
        return self.take()

    def sdo(self, request: str) -> str:
        data = bytes.fromhex(request).ljust(8, b"\0").hex()
        return " ".join(
            answer for identifier, answer in self.frame(0x600 + NODE, data) if identifier == 0x580 + NODE
        )

    def upload(self, index: int, subindex: int) -> bytes:
        mux = index.to_bytes(2, "little").hex() + f"{subindex:02x}"
        answer = bytes.fromhex(self.sdo(f"40{mux}"))
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        assert answer[0] == 0x41, answer.hex()
        data, toggle = b"", 0
        while len(data) < int.from_bytes(answer[4:], "little"):
            part = bytes.fromhex(self.sdo(f"{0x60 | toggle:02x}"))
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            toggle ^= 0x10
        return data

    def step(self, seconds: float) -> list[tuple[int, str]]:
        self.take()
        self.bench.step(seconds)
        return self.take()


@pytest.fixture
def linked(make_bench):
    """Make a link to a device in standby and run a test within an event loop."""

    def run(test, storage=None, **device) -> None:
        async def within() -> None:
            bench = make_bench(**device).start()
            transport = PaperTransport()
            link = CanopenLink(bench.requests, transport, storage)
            await link.start()
            test(Link(bench, link, transport))
            await link.close()

        asyncio.run(within())

    return run


def test_boots_up_with_the_device(linked):
    def test(link):
        assert link.take() == [(0x700 + NODE, "00")]
        assert link.link.slave.state is NmtState.PRE_OPERATIONAL
        assert [answer for answer in link.step(3.0) if answer[0] == 0x700 + NODE] == [
            (0x700 + NODE, "7f")
        ] * 3

    linked(test)


def test_mode_command_reaches_the_device_and_its_refusal_the_client(linked):
    def test(link):
        assert link.sdo("2f 00 60 00 03") == "8000600022000008"  # no attitude to track from
        assert link.bench.mode == "standby"
        assert link.sdo("2f 00 60 00 02") == "6000600000000000"
        assert link.bench.mode == "lost_in_space"
        assert link.device.counters.telecommands == 2

    linked(test)


def test_rows_are_the_same_as_on_other_links(linked):
    def test(link):
        for name in ("identification", "precise_attitude", "star_config"):
            row = link.bench.icd.telemetry[name]
            assert link.upload(0x2000, row.id) == link.bench.requests.telemetry(name, link.device.snapshot())

    linked(test)


def test_parameters_both_ways(linked):
    def test(link):
        assert link.sdo("2b 20 60 01 c8 00") == "6020600100000000"
        assert link.device.parameters["exposure"] == 200
        link.device.parameters.set({"exposure": 300})
        assert link.upload(0x6020, 1) == (300).to_bytes(2, "little")
        assert link.sdo("2f 20 60 07 ff").startswith("80206007")  # fewest star pixels above the most

    linked(test)


def test_each_frame_sends_attitude_pdos_of_one_sample(linked):
    def test(link):
        link.frame(0, f"01{NODE:02x}")
        link.sdo("2f 00 60 00 02")
        sent = link.step(3.0)
        pdos = {
            n: [data for identifier, data in sent if identifier == 0x180 + 0x100 * n + NODE]
            for n in (1, 2, 3)
        }
        assert len(pdos[1]) == len(pdos[2]) == len(pdos[3]) >= 2
        for time, first, second in zip(pdos[1], pdos[2], pdos[3], strict=True):
            assert time[:4] == first[:4] == second[:4]
            assert int(time[2:4], 16) & 1  # valid
        assert len({data[:2] for data in pdos[1]}) == len(pdos[1])

    linked(test)


def test_mode_change_is_an_event(linked):
    def test(link):
        link.frame(0, f"01{NODE:02x}")
        link.take()
        link.bench.command("set_mode", mode="lost_in_space")
        assert (0x180 + NODE, "02") in [(identifier, data[:2]) for identifier, data in link.take()]

    linked(test)


def test_time_message_sets_the_clock(linked):
    def test(link):
        link.frame(0x100, (43_200_250).to_bytes(4, "little").hex() + (15_400).to_bytes(2, "little").hex())
        assert link.device.time.was_set
        assert link.device.time.unix_ns() == 1_772_366_400_250_000_000

    linked(test)


def test_reset_of_the_node_restarts_the_device_once(linked):
    def test(link):
        boots = link.device.boot_count
        assert link.frame(0, f"81{NODE:02x}").count((0x700 + NODE, "00")) == 1
        assert (link.device.boot_count, link.device.reset_cause) == (boots + 1, "command")
        assert link.bench.mode == "boot"

    linked(test)


def test_reset_of_the_communication_leaves_the_device(linked):
    def test(link):
        boots = link.device.boot_count
        assert link.frame(0, f"82{NODE:02x}") == [(0x700 + NODE, "00")]
        assert link.device.boot_count == boots

    linked(test)


def test_restart_of_the_device_boots_the_node_up(linked):
    def test(link):
        link.take()
        link.device.reset("watchdog")
        assert (0x700 + NODE, "00") in link.take()

    linked(test)


def test_restart_takes_over_the_stored_node_parameter(linked):
    def test(link):
        link.device.parameters.set({"canopen_node": 50})
        link.bench.command("save_parameters")
        assert link.link.slave.node_id == NODE
        link.take()
        link.device.reset("command")
        assert (0x700 + 50, "00") in link.take()

    linked(test)


def test_node_id_stored_by_lss_overrides_the_parameter_until_it_changes(linked):
    storage = ParameterStorage()
    storage.save("lss", {"node_id": b"\x30", "bit_rate": (1_000_000).to_bytes(4, "little")})

    def test(link):
        assert link.take() == [(0x730, "00")]
        link.device.parameters.set({"canopen_node": 50})
        assert storage.load("lss") == {}

    linked(test, storage)


def test_store_keeps_the_devices_parameters(linked, make_bench):
    def test(link):
        link.sdo("2b 20 60 01 c8 00")
        assert link.sdo("23 10 10 01 73 61 76 65") == "6010100100000000"
        link.device.parameters.set({"exposure": 5})
        link.frame(0, f"81{NODE:02x}")
        assert link.device.parameters["exposure"] == 200
        assert link.sdo("23 11 10 01 6c 6f 61 64") == "6011100100000000"
        assert link.device.parameters["exposure"] == 200
        link.frame(0, f"81{NODE:02x}")
        assert link.device.parameters["exposure"] == 100

    linked(test)


@pytest.mark.parametrize(("error", "answer"), [(None, "6000206400000000"), ("full", "80002064")])
def test_save_parameters_is_answered_when_the_disk_is_done(linked, error, answer):
    def test(link):
        waiting = []
        link.device._background = lambda _work, done: waiting.append(done)
        assert link.sdo("2f 00 20 64 01") == ""
        waiting.pop()(error and EmulatorError(error))
        ((identifier, data),) = link.take()
        assert identifier == 0x580 + NODE
        assert data.startswith(answer)

    linked(test)


@pytest.mark.parametrize("store", ["23 10 10 02 73 61 76 65", "23 11 10 02 6c 6f 61 64"])
def test_the_bus_does_not_wait_for_the_disk(linked, store):
    storage = ParameterStorage()
    storage.save("communication", {"1017:00": b"\x05\x00"})

    def test(link):
        waiting = []
        link.device._background = lambda work, done: waiting.append((work, done))
        assert link.sdo(store) == ""
        assert link.sdo("40 00 10 00").startswith("43")
        assert link.sdo(store).startswith("80")
        ((work, done),) = waiting
        work()
        done(None)
        assert link.sdo("40 00 10 00").startswith("43")

    linked(test, storage)


def test_take_is_answered_when_the_frame_can_be_read(linked):
    def test(link):
        assert link.sdo("40 40 60 01") == "8040600124000008"
        assert link.sdo("2f 40 60 05 01") == ""
        assert link.sdo("2f 40 60 05 01") == "8040600522000008"  # one is being taken
        link.step(2.0)
        assert link.sdo("40 40 60 02").startswith("4b")

    linked(test)


def test_image_that_was_stored(linked):
    def test(link):
        assert link.sdo("40 43 60 01") == "8043600124000008"
        assert link.sdo("2b 42 60 00 02 03") == "6042600000000000"  # star, 128 pixels
        link.step(2.0)
        assert link.upload(0x6043, 2) == (128).to_bytes(2, "little")
        assert link.upload(0x6043, 1) == link.device.images.state.stored.pixels

    linked(test)


def test_error_mode_is_an_emergency(linked):
    def test(link):
        link.take()
        link.device.modes.fail("sensor")
        number = link.bench.icd.enums["device_error"].values["sensor"]
        assert [frame for frame in link.take() if frame[0] == 0x80 + NODE] == [
            (0x80 + NODE, f"{number:02x}ff810000000000")
        ]
        link.bench.command("set_mode", mode="standby")
        assert [frame for frame in link.take() if frame[0] == 0x80 + NODE] == [
            (0x80 + NODE, f"000000{number:02x}ff000000")
        ]

    linked(test)


def test_an_unresponsive_device_neither_reads_nor_sends(linked):
    def test(link):
        link.device.unresponsive = True
        assert link.sdo("40 00 10 00") == ""
        assert link.step(3.0) == []
        link.device.unresponsive = False
        assert link.sdo("40 00 10 00") != ""
        assert link.step(3.0) != []

    linked(test)


def test_frames_of_the_29_bit_protocol_are_left_alone(linked):
    def test(link):
        assert link.frame(0x62C, "4000100000000000", extended=True) == []

    linked(test)


def test_bus_that_was_lost_and_is_back_is_an_emergency(linked):
    def test(link):
        link.transport.statistics.reconnects += 1
        codes = [data[:4] for identifier, data in link.step(1.5) if identifier == 0x80 + NODE]
        assert codes == ["4081", "0000"]

    linked(test)


@settings(derandomize=True, deadline=None)
@given(st.floats(0.0, 1e9))
def test_a_deadline_is_never_taken_for_a_time_before_it(deadline):
    due_ns = not_before(deadline)
    assert due_ns / NANOSECONDS >= deadline  # as the link reports the time
    assert Fraction(due_ns - 1, NANOSECONDS) < Fraction(deadline)


@pytest.mark.parametrize("period_ms", [100, 1000])
def test_heartbeats_continue_with_any_sum_of_deadlines(linked, period_ms):
    def test(link):
        link.bench.step(0.234)
        link.sdo(f"2b 17 10 00 {period_ms.to_bytes(2, 'little').hex(' ')}")
        link.take()
        clock, scheduler = link.bench.clock, link.device.scheduler
        end_ns = clock.now_ns() + 100 * period_ms * 1_000_000 + 1_000_000
        for _ in range(250):  # a wake-up a heartbeat, and room for those that are none
            event = scheduler.pop_due(end_ns)
            if event is None:
                break
            clock.set_ns(max(event.due_ns, clock.now_ns()))
            event.action(event.due_ns)
        assert event is None
        assert len([answer for answer in link.take() if answer[0] == 0x700 + NODE]) == 100

    linked(test)


def test_rows_that_make_events_follow_from_their_quantities():
    icd = load_unit()
    assert rows_reporting(icd, (STATUS_QUANTITY,)) == ("device_status",)
    frame = {"precise_attitude", "identified_stars", "star_magnitudes", "star_timing", "quaternion", "rates"}
    assert frame <= set(rows_reporting(icd, FRAME_QUANTITIES))
    assert rows_reporting(load_unit("oresat"), (STATUS_QUANTITY,)) == ("status",)
    assert rows_reporting(load_unit("oresat"), FRAME_QUANTITIES) == ("orientation",)


def test_storage_in_the_folder_of_the_state(make_bench, tmp_path):
    async def within() -> None:
        requests = make_bench().start().requests
        link = open_canopen(requests, PaperTransport(), tmp_path, 1)
        await link.start()
        link.slave.store.save_lss(60, 500_000, lambda _error: None)
        await link.close()

    asyncio.run(within())
    assert FileStorage(tmp_path / "canopen.json").load("lss")["node_id"] == bytes([60])


@pytest.mark.parametrize("data", [b"", b"\x01\x02"])
def test_damaged_frames_stay_frames_of_the_base_format(data):
    rng = random.Random(1)
    pieces = CanDamage(extended=False)
    frame = CanFrame(0x181, data, extended=False)
    for _ in range(50):
        damaged = pieces.corrupt(frame, rng)
        assert damaged != frame
        assert not damaged.extended
        assert not pieces.junk(rng).extended
    assert pieces.split(frame, 3) == [frame]


def test_pdos_and_sdo_answers_of_a_faulty_row_are_altered_and_no_others(linked):
    def test(link):
        link.frame(0, f"01{NODE:02x}")
        link.sdo("2f 00 60 00 02")
        link.step(3.0)
        row = link.bench.icd.telemetry["precise_attitude"]
        faults = Faults(link.bench.requests, {"canopen": link.link})

        def inject(**fault):
            faults.inject(FaultRequest(telemetry={"row": row.name, **fault}))

        usual = link.upload(0x2000, row.id)
        inject(set={"q_x": 0.25})
        assert row.decode(link.upload(0x2000, row.id))["q_x"] == 0.25
        assert link.upload(0x2000, row.id)[-2:] == usual[-2:]
        inject(duplicate=True)
        sent = Counter(identifier - NODE for identifier, _ in link.step(1.0))
        assert (sent[0x280], sent[0x380], sent[0x480], sent[0x700]) == (2, 2, 2, 1)
        inject(drop=True)
        assert link.frame(0x600 + NODE, f"400020{row.id:02x}00000000") == []
        assert link.upload(0x2000, link.bench.icd.telemetry["identification"].id)
        inject(answer_with="identification")
        assert link.sdo(f"40 00 20 {row.id:02x}").startswith("41002080")
        inject(wrong_sequence=True)
        link.sdo(f"40 00 20 {row.id:02x}")
        assert int(link.sdo("60")[:2], 16) & 0x10
        inject(wrong_id=0x123)
        assert [identifier for identifier, _ in link.frame(0x600 + NODE, f"400020{row.id:02x}00000000")] == [
            0x123
        ]
        faults.clear()
        assert len(link.upload(0x2000, row.id)) == row.size

    linked(test)
