"""A client for OreSat's star tracker card, written from its object dictionary: SDO and PDO frames byte by byte."""

from __future__ import annotations

import asyncio
import struct

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.errors import NackError
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.files.bundled import UNITS_FOLDER
from starhil.protocol.unit import load_unit
from tests.emulator.units.clients import Emulated, arcseconds_between, true_matrix, with_unit
from tests.protocol.canopen.conftest import import_eds
from tests.waiting import PATIENCE_S

NODE = 0x2C
STANDBY, STAR_TRACK = 2, 4
FILTER = {"enable": 0, "lower_bound": 3, "lower_percentage": 5, "upper_bound": 7, "upper_percentage": 9}


def upload(unit: Emulated, index: int, subindex: int = 0) -> bytes:
    """Read an entry by an expedited upload."""
    request = struct.pack("<BHB4x", 0x40, index, subindex)
    (reply,) = [f for f in unit.ask_can(0x600 + NODE, request, extended=False) if f.id == 0x580 + NODE]
    command, found_index, found_subindex = struct.unpack_from("<BHB", reply.data)
    assert (found_index, found_subindex) == (index, subindex)
    assert command & 0xE3 == 0x43, reply.data.hex()
    return reply.data[4 : 8 - (command >> 2 & 3)]


def download(unit: Emulated, index: int, value: int) -> int:
    """Write a byte; return the abort code, 0 for none."""
    request = struct.pack("<BHB", 0x2F, index, 0) + bytes([value, 0, 0, 0])
    (reply,) = [f for f in unit.ask_can(0x600 + NODE, request, extended=False) if f.id == 0x580 + NODE]
    return 0 if reply.data[0] == 0x60 else struct.unpack_from("<I", reply.data, 4)[0]


def long_upload(unit: Emulated, index: int, subindex: int = 0) -> bytes:
    """Read an entry of 8 bytes by a segmented upload."""
    request = struct.pack("<BHB4x", 0x40, index, subindex)
    (reply,) = [f for f in unit.ask_can(0x600 + NODE, request, extended=False) if f.id == 0x580 + NODE]
    assert reply.data[:1] == b"\x41", reply.data.hex()
    assert struct.unpack_from("<I", reply.data, 4) == (8,)
    data = b""
    for command in (0x60, 0x70):
        (reply,) = [
            f
            for f in unit.ask_can(0x600 + NODE, bytes([command, *bytes(7)]), extended=False)
            if f.id == 0x580 + NODE
        ]
        data += reply.data[1 : 8 - (reply.data[0] >> 1 & 7)]
    return data


def test_the_clock_is_read_and_set_in_both_codes():
    def scenario(unit: Emulated) -> None:
        def clock() -> tuple[float, float]:
            coarse, fine = struct.unpack("<II", long_upload(unit, 0x2010))
            day, milliseconds, microseconds = struct.unpack("<HIH", long_upload(unit, 0x2011))
            return coarse + fine / 1e6, day * 86400 + milliseconds / 1e3 + microseconds / 1e6

        scet, utc = clock()
        assert 0.0 <= utc - scet < 0.1
        value = struct.pack("<HIH", 20_000, 45_296_789, 123)  # day 20000, 12:34:56.789123
        unit.ask_can(0x600 + NODE, struct.pack("<BHBI", 0x21, 0x2011, 0, 8), extended=False)
        for command, piece in ((0x00, value[:7]), (0x1D, value[7:].ljust(7, b"\0"))):
            unit.ask_can(0x600 + NODE, bytes([command]) + piece, extended=False)
        scet, utc = clock()
        assert 0.0 <= scet - (20_000 * 86400 + 45_296.789123) < 0.5
        assert 0.0 <= utc - scet < 0.1

    with_unit("oresat", "canopen", scenario)


def test_the_objects_of_the_common_profile_are_there():
    def scenario(unit: Emulated) -> None:
        assert upload(unit, 0x1200, 3) == b"\x01"
        assert upload(unit, 0x1023, 2) == b"\x00"

    with_unit("oresat", "canopen", scenario)


def operational(unit: Emulated) -> None:
    unit.ask_can(0, bytes([1, NODE]), extended=False)


def rotation_matrix(i: float, j: float, k: float, real: float):
    """Return the rotation of vectors by a quaternion, from its definition v' = q v q*."""
    import numpy as np

    def product(a, b):
        return np.append(a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3]), a[3] * b[3] - a[:3] @ b[:3])

    q = np.array([i, j, k, real])
    conjugate = q * [-1, -1, -1, 1]
    columns = [product(product(q, np.append(axis, 0.0)), conjugate)[:3] for axis in np.eye(3)]
    return np.array(columns).T


def test_status_is_commanded_and_read():
    def scenario(unit: Emulated) -> None:
        assert upload(unit, 0x4000) == bytes([STANDBY])
        assert download(unit, 0x4000, STAR_TRACK) == 0
        assert upload(unit, 0x4000) == bytes([STAR_TRACK])
        assert download(unit, 0x4000, 77) != 0
        assert upload(unit, 0x4000) == bytes([STAR_TRACK])

    with_unit("oresat", "canopen", scenario)


def test_orientation_is_the_truth_and_known():
    def scenario(unit: Emulated) -> None:
        download(unit, 0x4000, STAR_TRACK)
        unit.step(3.0)
        i, j, k, real = (struct.unpack("<f", upload(unit, 0x4002, n))[0] for n in (1, 2, 3, 5))
        assert arcseconds_between(rotation_matrix(i, j, k, real), true_matrix()) < 0.1
        assert upload(unit, 0x4002, 6) == b"\x01"
        midnight_ms = struct.unpack("<I", upload(unit, 0x4002, 4))[0]
        assert midnight_ms == unit.bench.device.snapshot().frame.mid_unix_ns // 1_000_000 % 86_400_000

    with_unit("oresat", "canopen", scenario)


def test_attitude_is_unknown_when_the_lens_is_covered():
    def scenario(unit: Emulated) -> None:
        download(unit, 0x4000, STAR_TRACK)
        unit.step(3.0)
        unit.cover()
        unit.step(3.0)
        assert upload(unit, 0x4002, 6) == b"\x00"

    with_unit("oresat", "canopen", scenario)


def test_pdos_of_each_frame_have_the_published_can_ids_and_the_attitude():
    def scenario(unit: Emulated) -> None:
        operational(unit)
        download(unit, 0x4000, STAR_TRACK)
        unit.step(3.0)
        frames = {frame.id: frame.data for frame in unit.step(1.0)}
        assert {0x3AC, 0x4AC, 0x1AD} <= set(frames)
        status, known, midnight_ms = struct.unpack("<BBI", frames[0x3AC])
        assert (status, known) == (STAR_TRACK, 1)
        assert midnight_ms == unit.bench.device.snapshot().frame.mid_unix_ns // 1_000_000 % 86_400_000
        real, i = struct.unpack("<2f", frames[0x4AC])
        j, k = struct.unpack("<2f", frames[0x1AD])
        assert arcseconds_between(rotation_matrix(i, j, k, real), true_matrix()) < 0.1

    with_unit("oresat", "canopen", scenario)


def test_housekeeping_pdos_come_by_their_timers():
    def scenario(unit: Emulated) -> None:
        operational(unit)
        frames = unit.step(60.5)
        assert len([frame for frame in frames if frame.id == 0x1AC and len(frame.data) == 6]) == 2
        assert len([frame for frame in frames if frame.id == 0x2AC and len(frame.data) == 2]) == 12

    with_unit("oresat", "canopen", scenario)


def test_card_is_restarted_by_an_entry():
    def scenario(unit: Emulated) -> None:
        before = unit.bench.device.boot_count
        request = struct.pack("<BHB", 0x2F, 0x3003, 1) + bytes([1, 0, 0, 0])
        unit.ask_can(0x600 + NODE, request, extended=False)
        unit.step(3.0)
        assert unit.bench.device.boot_count == before + 1
        assert struct.unpack("<H", upload(unit, 0x3003, 6))[0] == before + 1

    with_unit("oresat", "canopen", scenario)


def test_refusals_keep_the_abort_codes_of_canopen_whatever_the_unit_numbers_and_echoes(tmp_path):
    definition = (UNITS_FOLDER / "oresat" / "oresat.toml").read_text(encoding="utf-8")
    echoed = definition.replace(
        'kind = "telecommand"\n', 'kind = "telecommand"\nanswer = ["echo", "reply"]\n'
    )
    (tmp_path / "unit.toml").write_text(f"{echoed}\n[errors]\nother = 99\n", encoding="utf-8")

    def scenario(unit: Emulated) -> None:
        request = struct.pack("<BHB", 0x2F, 0x3003, 1) + bytes([1, 0, 0, 0])
        unit.ask_can(0x600 + NODE, request, extended=False)
        unit.step(0.01)
        assert download(unit, 0x4000, STAR_TRACK) == 0x08000022  # while it boots

    with_unit(str(tmp_path), "canopen", scenario)


def test_time_of_the_c3_card_sets_the_clock():
    def scenario(unit: Emulated) -> None:
        operational(unit)
        unit.ask_can(0x181, struct.pack("<II", 1_800_000_000, 500_000), extended=False)
        unit.step(0.6)
        assert struct.unpack("<I", upload(unit, 0x3003, 4))[0] == 1_800_000_001

    with_unit("oresat", "canopen", scenario)


def test_unit_whose_only_link_is_canopen_opens_it_by_itself(run):
    async def scenario(emulation, line):
        assert list(emulation.links) == ["canopen"]
        return line

    links = {"serial": {"port": "auto"}, "can": {"channel": "auto"}}
    line = run(scenario, unit="oresat", links=links)
    assert f"canopen={NODE}" in line.split()


def test_the_bench_commands_and_reads_a_card_with_custom_error_numbers_by_name(run, tmp_path):
    channel, unit = "virtual:oresat-bench", str(tmp_path)
    definition = (UNITS_FOLDER / "oresat" / "oresat.toml").read_text(encoding="utf-8")
    (tmp_path / "unit.toml").write_text(f"{definition}\n[errors]\ninvalid_parameter = 99\n", encoding="utf-8")

    def drive():
        with ObcClient.open(can=channel, unit=unit, timeout_s=PATIENCE_S) as obc:
            obc.command("set_status", status="lost_in_space")
            with pytest.raises(NackError, match="invalid_parameter"):
                obc.command("set_status", status=77, checked=False)
            obc.command("set_capture_filter", **FILTER)
            assert obc.telemetry("capture_filter") == FILTER
            return obc.telemetry("status"), obc.telemetry("orientation")["attitude_known"]

    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        return await asyncio.to_thread(drive)

    links = {"serial": {"port": "off"}, "can": {"channel": channel}}
    assert run(scenario, unit=unit, links=links) == ({"status": "lost_in_space"}, False)


def test_the_rest_of_the_card_reads_its_defaults_keeps_settings_and_has_no_files():
    def exchange(unit: Emulated, command: int, index: int, subindex: int, data: bytes = b"") -> bytes:
        request = struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")
        (reply,) = [f for f in unit.ask_can(0x600 + NODE, request, extended=False) if f.id == 0x580 + NODE]
        return reply.data

    def scenario(unit: Emulated) -> None:
        assert upload(unit, 0x3000) == upload(unit, 0x3009) == b"\0"
        assert upload(unit, 0x3001) == b"\x01"  # flight mode
        assert upload(unit, 0x3002, 1) == b"0.0"  # version of the hardware
        assert upload(unit, 0x3004, 2) == b"[]"  # files to read
        assert [upload(unit, 0x4001, n) for n in (1, 2, 3, 7, 8)] == [
            b"\x01",
            (100).to_bytes(4, "little"),
            (1).to_bytes(4, "little"),
            bytes(4),
            b"\x01",
        ]
        assert exchange(unit, 0x27, 0x3004, 3, b"a.t")[0] == 0x60
        assert upload(unit, 0x3004, 3) == b"a.t"
        no_data = (0x0800_0024).to_bytes(4, "little")
        assert exchange(unit, 0x40, 0x3004, 4)[4:] == exchange(unit, 0x40, 0x4001, 4)[4:] == no_data
        assert exchange(unit, 0x2F, 0x3005, 4, b"x")[4:] == no_data

    with_unit("oresat", "canopen", scenario)


def test_the_capture_filter_has_the_sub_indices_limits_and_defaults_of_the_source():
    """base/star_tracker.yaml, 4003h: enable, lower bound and percentage, upper bound and percentage, both up to 100."""
    dictionary = import_eds(build_eds(DeviceDictionary(load_unit("oresat"))), NODE)
    entries = [dictionary[0x4003][number] for number in range(1, 6)]
    assert [item.name for item in entries] == [
        "enable", "lower_bound", "lower_percentage", "upper_bound", "upper_percentage",
    ]  # fmt: skip
    assert [item.max for item in entries] == [1, 255, 100, 255, 100]

    def scenario(unit: Emulated) -> None:
        assert b"".join(upload(unit, 0x4003, number) for number in range(1, 6)) == bytes((1, 0, 0, 0, 0))

    with_unit("oresat", "canopen", scenario)
