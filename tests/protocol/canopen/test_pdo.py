"""RPDOs and TPDOs: transmission types, timers, gating, configuration rules, lengths."""

from __future__ import annotations

import pytest

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError

pytestmark = pytest.mark.lowest("canopen")

OFF = 0x8000_0000
NO_RTR = 0x4000_0000
RPDO1 = 0x22C
TPDO1 = 0x1AC
HEARTBEAT_OFF = (0x1017, 0, 0, 2)


def configure_tpdo(bench, number=1, *, kind=254, inhibit=0, event_ms=0, start=0, mapping=(0x6000_0008,)):
    """Configure a TPDO by the rule of CiA 301: disable, map, set up, enable."""
    index, cob_id = 0x1800 + number - 1, 0x180 + 0x100 * (number - 1) + bench.node
    steps = [
        (index, 1, OFF | NO_RTR | cob_id, 4),
        (0x200 + index, 0, 0, 1),
        *((0x200 + index, position, value, 4) for position, value in enumerate(mapping, 1)),
        (0x200 + index, 0, len(mapping), 1),
        (index, 2, kind, 1),
        (index, 3, inhibit, 2),
        (index, 5, event_ms, 2),
        (index, 6, start, 1),
        (index, 1, NO_RTR | cob_id, 4),
    ]
    assert [bench.write(*step) for step in steps] == [0] * len(steps)


def configure_rpdo(bench, number=1, *, kind=255, event_ms=0, mapping=(0x6000_0008,)):
    index, cob_id = 0x1400 + number - 1, 0x200 + 0x100 * (number - 1) + bench.node
    steps = [
        (index, 1, OFF | cob_id, 4),
        (0x200 + index, 0, 0, 1),
        *((0x200 + index, position, value, 4) for position, value in enumerate(mapping, 1)),
        (0x200 + index, 0, len(mapping), 1),
        (index, 2, kind, 1),
        (index, 5, event_ms, 2),
        (index, 1, cob_id, 4),
    ]
    assert [bench.write(*step) for step in steps] == [0] * len(steps)


def disable_all_tpdos(bench):
    for number in range(4):
        bench.write(0x1800 + number, 1, OFF | NO_RTR | 0x180 + 0x100 * number + bench.node)


@pytest.fixture
def quiet(bench):
    """A slave with no heartbeat and no PDO but those that a test makes."""
    bench.write(*HEARTBEAT_OFF)
    disable_all_tpdos(bench)
    bench.application.rows["device_status"] = {"mode": "tracking"}
    return bench


def sync(bench, counter=None):
    return bench.frame(0x80, b"" if counter is None else bytes([counter]))


def notify(bench, row="device_status"):
    frames = bench.slave.notify(bench.dictionary.sources[row], bench.now)
    return [(frame.id, frame.data) for frame in frames]


MODE = (TPDO1, b"\x03")


# Synchronous TPDOs


@pytest.mark.parametrize("kind", [1, 2, 3, 240])
def test_cyclic_every_nth_sync(quiet, kind):
    configure_tpdo(quiet, kind=kind)
    quiet.operational()
    answers = [sync(quiet) for _ in range(2 * kind)]
    assert [position for position, answer in enumerate(answers, 1) if answer] == [kind, 2 * kind]
    assert answers[kind - 1] == [MODE]
    assert notify(quiet) == []


def test_acyclic_at_the_sync_after_an_event(quiet):
    configure_tpdo(quiet, kind=0)
    quiet.operational()
    assert sync(quiet) == []
    assert notify(quiet) == []
    quiet.application.rows["device_status"] = {"mode": "standby"}
    assert sync(quiet) == [(TPDO1, b"\x01")]
    assert sync(quiet) == []


def test_sync_start_value(quiet):
    assert quiet.write(0x1019, 0, 8, 1) == 0
    configure_tpdo(quiet, kind=2, start=3)
    quiet.operational()
    sent = [counter for counter in (1, 2, 3, 4, 5, 6, 7, 8, 1) if sync(quiet, counter)]
    assert sent == [3, 5, 7, 1]


@pytest.mark.parametrize("command", [128, 2])
def test_nothing_outside_operational(quiet, command):
    configure_tpdo(quiet, 1, kind=1)
    configure_tpdo(quiet, 2, kind=254, event_ms=10)
    quiet.operational()
    quiet.nmt(command)
    assert sync(quiet) == []
    assert notify(quiet) == []
    assert quiet.advance(0.1) == []


# Event-driven TPDOs


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven(quiet, kind):
    configure_tpdo(quiet, kind=kind)
    assert quiet.operational() == [MODE]
    assert notify(quiet) == [MODE]
    assert notify(quiet, "star_timing") == []
    assert sync(quiet) == []
    assert quiet.advance(1.0) == []


def test_inhibit_time_spaces_events_and_sends_the_latest(quiet):
    configure_tpdo(quiet, inhibit=500)  # 50 ms
    quiet.operational()
    start = quiet.now
    assert notify(quiet) == []
    quiet.advance(0.02)
    quiet.application.rows["device_status"] = {"mode": "error"}
    assert notify(quiet) == []
    assert quiet.advance(0.1) == [(pytest.approx(start + 0.05), TPDO1, b"\x04")]
    assert notify(quiet) == [(TPDO1, b"\x04")]


def test_event_timer(quiet):
    configure_tpdo(quiet, event_ms=100)
    quiet.operational()
    start = quiet.now
    assert [round(time - start, 6) for time, _, _ in quiet.advance(0.25)] == [0.1, 0.2]
    assert notify(quiet) == [MODE]  # an event restarts the timer
    assert [round(time - start, 6) for time, _, _ in quiet.advance(0.12)] == [0.35]


def test_lateness_of_the_event_timer_does_not_accumulate(quiet):
    configure_tpdo(quiet, event_ms=100)
    quiet.operational()
    start, times = quiet.now, []
    for late in (0.003, 0.001, 0.002):
        quiet.now = quiet.slave.next_deadline() + late
        times += [quiet.now - start for _ in quiet.slave.tick(quiet.now)]
    assert times == pytest.approx([0.103, 0.201, 0.302])
    quiet.now = (
        quiet.slave.next_deadline() + 0.5
    )  # whole periods too late: those in between are not made up for
    assert len(quiet.slave.tick(quiet.now)) == 1
    assert quiet.slave.next_deadline() == pytest.approx(quiet.now + 0.1)


def test_event_timer_waits_for_the_inhibit_time(quiet):
    configure_tpdo(quiet, event_ms=10, inhibit=250)
    quiet.operational()
    start = quiet.now
    assert [round(time - start, 6) for time, _, _ in quiet.advance(0.06)] == [0.025, 0.05]


def test_write_to_a_mapped_object_is_an_event(quiet):
    configure_tpdo(quiet, mapping=(0x6020_0110,))
    quiet.operational()
    request = bytes.fromhex("2b206001c8000000")
    assert quiet.frame(0x62C, request) == [(0x5AC, bytes.fromhex("6020600100000000")), (TPDO1, b"\xc8\x00")]


def test_object_that_cannot_be_read_is_not_sent(quiet):
    configure_tpdo(quiet)

    def refuse(row):
        raise SdoAbortError(AbortCode.NO_DATA, row.name)

    quiet.application.telemetry = refuse
    quiet.events()
    assert quiet.operational() == []
    assert ("refused", 1) in quiet.events()


# Configuration rules


@pytest.mark.parametrize(
    ("index", "subindex", "value", "size", "code"),
    [
        (0x1800, 1, NO_RTR | 0x1B0, 4, AbortCode.VALUE_RANGE),  # identifier of a living PDO
        (0x1800, 1, 0x1AC, 4, AbortCode.VALUE_RANGE),  # remote requests
        (0x1800, 1, NO_RTR | 0x2000_01AC, 4, AbortCode.VALUE_RANGE),
        (0x1800, 3, 10, 2, AbortCode.VALUE_RANGE),  # inhibit time of a living PDO
        (0x1800, 6, 1, 1, AbortCode.VALUE_RANGE),
        (0x1800, 4, 0, 1, AbortCode.NO_SUBINDEX),
        (0x1800, 2, 241, 1, AbortCode.VALUE_RANGE),
        (0x1800, 2, 252, 1, AbortCode.VALUE_RANGE),
        (0x1800, 2, 253, 1, AbortCode.VALUE_RANGE),
        (0x1400, 2, 252, 1, AbortCode.VALUE_RANGE),
        (0x1400, 1, 0x230, 4, AbortCode.VALUE_RANGE),
        (0x1A00, 0, 0, 1, AbortCode.UNSUPPORTED_ACCESS),
        (0x1A00, 1, 0x6000_0008, 4, AbortCode.UNSUPPORTED_ACCESS),
        (0x1600, 0, 0, 1, AbortCode.UNSUPPORTED_ACCESS),
    ],
)
def test_writes_to_an_enabled_pdo_are_answered_with_their_abort_code(
    bench, index, subindex, value, size, code
):
    assert bench.write(index, subindex, value, size) == code


@pytest.mark.parametrize(
    "identifier", [0x000, 0x07F, 0x101, 0x180, 0x581, 0x601, 0x6E0, 0x701, 0x77F, 0x7FF, 0x800]
)
def test_restricted_can_ids(quiet, identifier):
    assert quiet.write(0x1800, 1, NO_RTR | identifier) == AbortCode.VALUE_RANGE
    assert quiet.write(0x1800, 1, NO_RTR | OFF | identifier) == 0


@pytest.mark.parametrize(
    ("value", "code"),
    [
        (0x5FFF_0008, AbortCode.NO_OBJECT),
        (0x6001_3008, AbortCode.NO_OBJECT),
        (0x1000_0020, AbortCode.NOT_MAPPABLE),
        (0x6042_0010, AbortCode.NOT_MAPPABLE),  # write-only
        (0x6040_0108, AbortCode.NOT_MAPPABLE),  # bulk data
        (0x6000_0010, AbortCode.NOT_MAPPABLE),  # another length
        (0x0005_0008, AbortCode.NO_OBJECT),  # a TPDO has no placeholders
        (0x6000_0008, 0),
        (0x1001_0008, 0),
        (0x0000_0000, 0),
    ],
)
def test_mapping_entries_of_a_tpdo(quiet, value, code):
    assert quiet.write(0x1A00, 0, 0, 1) == 0
    assert quiet.write(0x1A00, 1, value) == code


@pytest.mark.parametrize(
    ("value", "code"),
    [
        (0x6001_0108, AbortCode.NOT_MAPPABLE),  # read-only
        (0x6000_0008, 0),
        (0x6060_0020, 0),
        (0x0005_0008, 0),
        (0x0007_0020, 0),
        (0x0007_0008, AbortCode.NOT_MAPPABLE),
        (0x0008_0020, AbortCode.NO_OBJECT),
        (0x0005_0108, AbortCode.NO_OBJECT),
    ],
)
def test_mapping_entries_of_an_rpdo(quiet, value, code):
    assert quiet.write(0x1400, 1, OFF) == 0
    assert quiet.write(0x1600, 0, 0, 1) == 0
    assert quiet.write(0x1600, 1, value) == code


def test_mapping_is_fixed_while_its_count_is_set(quiet):
    assert quiet.write(0x1A00, 1, 0x6000_0008) == AbortCode.UNSUPPORTED_ACCESS


def test_mapping_limits(quiet):
    quiet.write(0x1A00, 0, 0, 1)
    for position in range(1, 9):
        assert quiet.write(0x1A00, position, 0x6011_0318) == AbortCode.NOT_MAPPABLE
        assert quiet.write(0x1A00, position, 0x6011_0418) == 0
    assert quiet.write(0x1A00, 0, 3, 1) == AbortCode.PDO_LENGTH
    assert quiet.write(0x1A00, 0, 9, 1) == AbortCode.PDO_LENGTH
    assert quiet.write(0x1A00, 0, 254, 1) == AbortCode.PDO_LENGTH
    assert quiet.write(0x1A00, 0, 2, 1) == 0


def test_mapping_count_over_an_empty_slot(quiet):
    quiet.write(0x1A00, 0, 0, 1)
    quiet.write(0x1A00, 1, 0)
    assert quiet.write(0x1A00, 0, 1, 1) == AbortCode.NO_OBJECT


def test_remapping_while_operational(quiet):
    configure_tpdo(quiet, mapping=(0x6001_0108, 0x6001_0510))
    assert quiet.operational() == [(TPDO1, b"\x03\x00\x00")]
    quiet.application.rows["device_status"] = {"mode": "tracking", "boot_count": 0x1234}
    configure_tpdo(quiet, mapping=(0x6001_0510, 0x6001_0108), kind=1)
    assert sync(quiet) == [(TPDO1, b"\x34\x12\x03")]


def test_can_id_changes(quiet):
    assert quiet.write(0x1800, 1, NO_RTR | OFF | 0x3F0) == 0
    assert quiet.write(0x1800, 1, NO_RTR | 0x3F0) == 0
    quiet.operational()
    assert notify(quiet)[0][0] == 0x3F0


# RPDOs


def test_event_driven_rpdo_acts_at_once_and_only_in_operational(quiet):
    quiet.frame(RPDO1, "03")
    assert quiet.application.commands == []
    quiet.operational()
    quiet.frame(RPDO1, "03")
    assert quiet.application.commands == [("set_mode", {"mode": "tracking"})]
    quiet.nmt(2)
    quiet.frame(RPDO1, "01")
    assert len(quiet.application.commands) == 1


def test_synchronous_rpdo_acts_at_the_next_sync_on_the_latest(quiet):
    configure_rpdo(quiet, kind=1)
    quiet.operational()
    quiet.frame(RPDO1, "03")
    quiet.frame(RPDO1, "02")
    assert quiet.application.commands == []
    sync(quiet)
    sync(quiet)
    assert quiet.application.commands == [("set_mode", {"mode": "lost_in_space"})]


def test_pdos_waiting_for_sync_are_dropped_on_leaving_operational(quiet):
    configure_rpdo(quiet, kind=1)
    quiet.operational()
    quiet.frame(RPDO1, "03")
    quiet.nmt(128)
    quiet.operational()
    sync(quiet)
    assert quiet.application.commands == []


def test_place_holders_skip_bytes(quiet):
    configure_rpdo(quiet, mapping=(0x0006_0010, 0x6000_0008))
    quiet.operational()
    quiet.frame(RPDO1, "ffff03")
    assert quiet.application.commands == [("set_mode", {"mode": "tracking"})]


def test_short_rpdo_is_not_processed(quiet):
    configure_rpdo(quiet, mapping=(0x6000_0008, 0x6020_0110))
    quiet.operational()
    assert quiet.frame(RPDO1, "0364") == [(0xAC, bytes.fromhex("1082 11 0102000000"))]
    assert quiet.frame(RPDO1, "0364") == []
    assert quiet.application.commands == []
    assert quiet.frame(RPDO1, "036400") == [(0xAC, bytes.fromhex("0000 00 1082000000"))]


def test_long_rpdo_is_processed_and_reported(quiet):
    quiet.operational()
    assert quiet.frame(RPDO1, "0399") == [(0xAC, bytes.fromhex("2082 11 0102000000"))]
    assert quiet.application.commands == [("set_mode", {"mode": "tracking"})]
    assert quiet.frame(RPDO1, "03") == [(0xAC, bytes.fromhex("0000 00 2082000000"))]


def test_refused_value_is_reported_and_nothing_else_written(quiet):
    configure_rpdo(quiet, mapping=(0x6020_0110, 0x6000_0008))
    quiet.operational()
    ((identifier, data),) = quiet.frame(RPDO1, "c80000")  # exposure 200, mode 0
    assert (identifier, data) == (0xAC, bytes.fromhex("0082 11 01 30000906"))
    assert quiet.number(0x6020, 1) == 100
    quiet.frame(RPDO1, "c80003")
    assert quiet.number(0x6020, 1) == 200
    assert quiet.number(0x1001) == 0


def test_rpdo_deadline(quiet):
    configure_rpdo(quiet, event_ms=100)
    quiet.operational()
    assert quiet.advance(1.0) == []  # begins with the first message
    quiet.frame(RPDO1, "03")
    quiet.advance(0.09)
    quiet.frame(RPDO1, "03")
    start = quiet.now
    assert quiet.advance(0.2) == [(pytest.approx(start + 0.1), 0xAC, bytes.fromhex("5082 11 0100000000"))]
    assert quiet.frame(RPDO1, "03") == [(0xAC, bytes.fromhex("0000 00 5082000000"))]


def test_remote_and_extended_frames_are_not_rpdos(quiet):
    quiet.operational()
    quiet.frame(RPDO1, remote=True)
    quiet.frame(RPDO1, "03", extended=True)
    assert quiet.application.commands == []
    assert quiet.number(0x1001) == 0


# The default PDOs carry an attitude that cannot be put together wrongly


def attitude(counter, valid=True):
    return {
        "frame_counter": counter,
        "valid": valid,
        "time_of_exposure": 1_800_000_000.5 + counter,
        "q_x": 0.5,
        "q_y": -0.5,
        "q_z": 0.5,
        "q_w": -0.5,
    }


def signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


@pytest.mark.parametrize("kind", [254, 1])
def test_attitude_pdos_share_sequence_and_flags(bench, kind):
    for index in (0x1801, 0x1802, 0x1803):
        assert bench.write(index, 2, kind, 1) == 0
    bench.operational()
    indices = []

    def telemetry(row):
        indices.append(row.name)
        return row.encode(attitude(len(indices)) if row.name == "precise_attitude" else {})

    bench.application.telemetry = telemetry
    frames = notify(bench, "precise_attitude") if kind == 254 else sync(bench)
    assert indices == ["precise_attitude"]  # one sample for all of them
    time, first, second = (data for identifier, data in frames if identifier in {0x2AC, 0x3AC, 0x4AC})
    assert time[:2] == first[:2] == second[:2] == b"\x01\x01"
    assert int.from_bytes(time[2:], "little") / 65536 == 1_800_000_001.5
    scale = 1 / 8388607
    values = [signed(data[at : at + 3]) * scale for data in (first, second) for at in (2, 5)]
    assert values == pytest.approx([0.5, -0.5, 0.5, -0.5], abs=scale)


@pytest.mark.parametrize(("counter", "sequence"), [(0, 0), (255, 255), (256, 0), (70_000, 70_000 & 0xFF)])
def test_sequence_is_the_low_byte_of_the_counter(bench, counter, sequence):
    bench.application.rows["precise_attitude"] = attitude(counter, valid=False)
    assert bench.read(0x6011, 1) == bytes([sequence])
    assert bench.read(0x6011, 2) == b"\0"


def test_packed_values_are_clipped(bench):
    bench.application.rows["precise_attitude"] = {
        "uncertainty_cross": 1e9,
        "rate_x": -400.0,
        "q_x": 1.0,
        "q_y": -1.0,
    }
    assert bench.read(0x6011, 8) == b"\xff\xff"
    assert signed(bench.read(0x6011, 9)) == -32768
    assert (signed(bench.read(0x6011, 4)), signed(bench.read(0x6011, 5))) == (8388607, -8388607)
