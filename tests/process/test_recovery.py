"""Power cuts, peers that do not read, lost buses, two masters, incomplete messages."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import tty
from concurrent.futures import ThreadPoolExecutor

import canopen
import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.client.raw_traffic import send_and_listen
from starhil.hil_tests.errors import BenchError, DeviceError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.rig.private_can_bus import hub_thread
from starhil.protocol.can.frame import CanFrame
from tests.process.conftest import FAST_BAUD, NO_IMAGES
from tests.process.reference import frame_request
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.process

MEMORY_LIMIT = 500e6


def answers(client: ObcClient, row: str = "identification") -> bool:
    try:
        return len(client.telemetry(row, timeout_s=1.0)) == len(client.icd.telemetry[row].named_fields)
    except DeviceError:
        return False


@pytest.fixture
def own(tmp_path):
    """Make emulators with a parameter store that lasts over the test."""
    processes = []

    def _make(settings=(), **options) -> EmulatorProcess:
        command = emulator_command(
            seed=1, state_dir=tmp_path / "state", settings=[*NO_IMAGES, *settings], **options
        )
        process = EmulatorProcess(command)
        processes.append(process)
        return process.start()

    yield _make
    for process in processes:
        process.kill()


NODE = 44
HEARTBEAT, STORE = 0x1017, 0x1010
SAVE = int.from_bytes(b"save", "little")


@contextlib.contextmanager
def canopen_master(channel: str):
    """A master of the `canopen` library, and its view of the node without an EDS."""
    host, _, port = channel.removeprefix("socketcand:").partition("/")[0].rpartition(":")
    network = canopen.Network()
    network.connect(interface="socketcand", host=host, port=int(port), channel="vcan0")
    try:
        node = network.add_node(NODE, canopen.ObjectDictionary())
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        yield network, node.sdo
    finally:
        network.disconnect()


def test_power_cuts_while_parameters_and_canopen_settings_are_being_stored_lose_none_of_them(own, tmp_path):
    """The cut comes before, while or after the last ones are stored."""
    rng = random.Random(5)
    exposures, heartbeats = {300}, {1000}
    with hub_thread() as channel:
        emulator = own(
            can=channel,
            settings=["device.boot_s=0", "parameters.update_rate=0.2"],
            extra=["--canopen", str(NODE)],
        )
        for turn in range(3):
            with (
                ObcClient.open(serial=emulator.ready["serial"], timeout_s=PATIENCE_S) as obc,
                canopen_master(channel) as (network, sdo),
            ):
                assert obc.get_parameter("exposure") in exposures, f"after cut {turn}"
                assert int.from_bytes(sdo.upload(HEARTBEAT, 0), "little") in heartbeats, f"after cut {turn}"
                assert obc.telemetry("boot_status")["boot_count"] == turn + 1
                if turn == 2:
                    break
                for value in range(1000 + 100 * turn, 1003 + 100 * turn):
                    obc.set_parameter("exposure", value)
                    obc.command("save_parameters")  # answered when it is done
                kept, last = 2000 + turn, 3000 + turn
                sdo.download(HEARTBEAT, 0, kept.to_bytes(2, "little"))
                sdo.download(STORE, 1, SAVE.to_bytes(4, "little"))  # answered when it is on the disk
                sdo.download(HEARTBEAT, 0, last.to_bytes(2, "little"))
                obc.set_parameter("exposure", last)
                save = frame_request(obc.icd.telecommands["save_parameters"].id)
                network.send_message(0x600 + NODE, bytes((0x23, 0x10, 0x10, 1)) + b"save")
                (answered,) = obc.run(send_and_listen(obc.core, [save], rng.random() * 0.01))
                exposures = {last} if answered else {value, last}
                heartbeats = {kept, last}
                emulator.kill()  # to close the connections takes longer than to store anything
            emulator.start()
        emulator.stop()
    files = sorted(path for path in (tmp_path / "state").iterdir() if path.is_file())
    assert files
    for path in files:
        if path.suffix == ".json":
            json.loads(path.read_text())


def test_a_serial_peer_that_never_reads_does_not_stop_the_device(emulator, can_obc):
    port = os.open(emulator.ready["serial"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(port)
        sent = 0
        for _ in range(400):
            with contextlib.suppress(BlockingIOError):
                sent += os.write(port, frame_request(211))
            assert can_obc.telemetry("identification")["interface_version"] == 1
        assert sent > 400
    finally:
        os.close(port)
    with ObcClient.open(serial=emulator.ready["serial"], timeout_s=1.0) as obc:
        wait_until(lambda: answers(obc, "star_tracker"))  # late replies to the flood come first


def test_an_incomplete_message_is_abandoned_and_the_next_one_is_answered(serial_obc, can_obc):
    serial_obc.command("clear_counters")
    serial_obc.run(_send(serial_obc, frame_request(2, bytes(6))[:5]))
    can_obc.run(_send(can_obc, CanFrame(0x07250104, bytes(7) + b"\x07")))
    wait_until(lambda: can_obc.telemetry("communication_status")["can_telecommand_error"])
    status = serial_obc.telemetry("communication_status")
    assert status["uart_incomplete"]
    assert not status["uart_protocol_error"]


async def _send(client: ObcClient, item) -> None:
    client.core.link.send(item)


def test_two_masters_on_one_bus_get_their_own_replies(emulator):
    channel = emulator.ready["can"]
    with (
        ObcClient.open(can=channel, host_address=1, timeout_s=PATIENCE_S) as first,
        ObcClient.open(can=channel, host_address=77, timeout_s=PATIENCE_S) as second,
        ThreadPoolExecutor(2) as threads,
    ):
        read = threads.map(lambda obc: [obc.telemetry("star_tracker") for _ in range(50)], (first, second))
        assert [len(readings) for readings in read] == [50, 50]
        assert not first.stray_replies
        assert not second.stray_replies
        assert not first.faults
        assert not second.faults


def test_the_device_comes_back_by_itself_when_the_hub_does(own):
    with contextlib.ExitStack() as stack:
        with hub_thread() as channel:
            emulator = own(serial="off", can=channel)
            obc = stack.enter_context(ObcClient.open(can=channel, timeout_s=0.5))
            wait_until(lambda: answers(obc))
        assert not answers(obc)
        with hub_thread(int(re.split("[:/]", channel)[2])):
            wait_until(lambda: answers(obc))
            assert emulator.running
            emulator.stop()


def test_memory_stays_below_its_limit_while_frames_are_solved(emulator, can_obc):
    can_obc.set_parameter("update_rate", 5.0)
    can_obc.command("set_mode", mode="lost_in_space")
    can_obc.wait_for("precise_attitude", lambda reading: bool(reading["valid"]), within_s=PATIENCE_S)
    first = can_obc.telemetry("device_status")["frames_captured"]
    can_obc.wait_for(
        "device_status", lambda reading: reading["frames_captured"] >= first + 15, within_s=PATIENCE_S
    )
    assert emulator.memory_bytes() < MEMORY_LIMIT
    can_obc.command("set_mode", mode="standby")


def test_sigterm_ends_it_in_good_order_and_gives_the_pty_back(own, tmp_path):
    link = tmp_path / "port"
    emulator = own(can="off", extra=["--symlink", str(link)])
    assert link.is_symlink()
    with ObcClient.open(serial=str(link)) as obc:
        wait_until(lambda: answers(obc))
    emulator.stop()
    assert not link.is_symlink()


def test_a_port_that_another_program_holds_is_refused(emulator, own):
    taken = emulator.ready["serial"]
    with ObcClient.open(serial=taken) as obc:
        wait_until(lambda: answers(obc))
        baud = [f"links.serial.baud={FAST_BAUD}"]
        with pytest.raises(BenchError, match=r"^serial /dev/no-such-tty: no such port"):
            own(serial="/dev/no-such-tty", can="off", settings=baud)
