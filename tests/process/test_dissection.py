"""Bus recordings of sessions next to a busy CANopen node, dissected by Wireshark."""

from __future__ import annotations

import queue

import canopen
import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.unit import load_unit
from tests.candump import read_candump
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES
from tests.process.test_sessions import starhil
from tests.protocol.export.dissection import dissect
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

NODE = 44
TRIES = 10
TIMED_OUT = 0x05040000
BOOT_UP = 0


def read_by_blocks(node: canopen.RemoteNode, index: int) -> bytes:
    """Upload an object.

    Again after a reset if the transfer timed out because a process was paused.
    """
    states: queue.Queue[int] = queue.Queue()
    node.nmt.add_heartbeat_callback(states.put)
    for _ in range(TRIES):
        try:
            with node.sdo[index].open("rb", block_transfer=True) as file:
                return file.read()
        except canopen.SdoAbortedError as error:
            if error.code != TIMED_OUT:
                raise
        node.nmt.state = "RESET COMMUNICATION"
        while states.get(timeout=PATIENCE_S) != BOOT_UP:  # answers that are still under way come before it
            pass
    pytest.fail(f"no block upload of {index:04X}h went through in {TRIES} tries")


def talk_canopen(hub: str, folder) -> None:
    """Drive the node as a master does: heartbeat, PDOs by event and by SYNC, a block upload, an abort."""
    host, _, port = hub.removeprefix("socketcand:").partition("/")[0].rpartition(":")
    eds = folder / "unit.eds"
    eds.write_text(build_eds(DeviceDictionary(load_unit())), encoding="ascii")
    network = canopen.Network()
    network.connect(interface="socketcand", host=host, port=int(port), channel="vcan0")
    try:
        node = network.add_node(NODE, str(eds))
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        node.sdo["Producer heartbeat time"].raw = 100
        node.tpdo.read()
        node.tpdo[2].trans_type = 1
        node.tpdo[2].save()
        node.nmt.state = "OPERATIONAL"
        network.sync.transmit()
        with pytest.raises(canopen.SdoAbortedError):
            node.sdo.upload(0x5FFF, 0)
        assert len(read_by_blocks(node, 0x1021)) > 10_000
    finally:
        network.disconnect()


def test_no_frame_of_sessions_with_a_canopen_node_is_malformed(tmp_path):
    recording = tmp_path / "hub.log"
    with EmulatorProcess([*hub_command(), "--log", str(recording)]) as hub:
        channel = hub.ready["can"]
        command = emulator_command(
            profile="ideal",
            serial="off",
            can=channel,
            seed=1,
            settings=["truth.attitude.roll_deg=30", *NO_IMAGES],  # what first_light expects
            state_dir=tmp_path / "state",
            extra=["--canopen", str(NODE)],
        )
        with EmulatorThread(command):
            talk_canopen(channel, tmp_path)
            for name in ("first_light", "errors"):
                options = ("--can", channel, "--assume-truth", "--intrusive", "--log", tmp_path / name)
                done = starhil("session", name, *options)
                assert (done.returncode, done.stderr) == (0, ""), done.stdout
    frames = dissect(recording)
    assert len(frames) == sum(1 for _ in read_candump(recording)) > 1_000
    assert [frame for frame in frames if frame.malformed] == []
    of_node = [frame for frame in frames if not frame.extended and frame.identifier & 0x7F == NODE]
    assert len(of_node) > 1_000
    assert [frame for frame in of_node if frame.protocols[-1] != "canopen"] == []
    words = {frame.words for frame in frames if not frame.extended}
    for service in ("Boot-up", "Operational", "SYNC", "PDO2 (tx)", "Block upload", "Abort transfer"):
        assert any(service in word for word in words), service
