"""The `canopen` library as the master: at the other end of a function call, and over python-can's virtual bus."""

from __future__ import annotations

import threading
import time
from typing import Self

import can
import canopen
import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.eds import build_eds
from tests.waiting import PATIENCE_S, wait_until

pytestmark = [pytest.mark.long, pytest.mark.lowest("canopen")]

FRAME = bytes(number * 7 & 0xFF for number in range(937 * 937))
BOOT_UP, OPERATIONAL = 0, 5
"""NMT states as in a heartbeat."""


def test_reads_and_writes_by_name(bench, master):
    assert master.sdo["Manufacturer device name"].raw == "CubeStar-like star sensor"
    assert master.sdo["Parameters"]["exposure"].raw == 100
    master.sdo["Parameters"]["limiting_magnitude"].raw = 5.5
    assert bench.application.parameter("limiting_magnitude") == 5.5
    master.sdo["Mode"].raw = 2
    assert bench.application.commands == [("set_mode", {"mode": "lost_in_space"})]


@pytest.mark.parametrize(
    ("index", "subindex", "code"),
    [(0x5FFF, 0, 0x06020000), (0x1018, 9, 0x06090011), (0x6042, 0, 0x06010001)],
)
def test_aborts_reach_the_master(master, index, subindex, code):
    with pytest.raises(canopen.SdoAbortedError) as caught:
        master.sdo.upload(index, subindex)
    assert caught.value.code == code


def test_telemetry_row_as_a_whole(bench, master):
    row = bench.dictionary.icd.telemetry["precise_attitude"]
    bench.application.rows[row.name] = values = row.example()
    data = master.sdo["Requests by identifier"]["precise_attitude"].raw
    assert row.decode(data) == row.decode(row.encode(values))


@pytest.mark.parametrize("size", [937 * 937, 889, 890, 7, 1])
def test_block_upload(bench, master, size):
    bench.show(FRAME[:size])
    with master.sdo["Frame"]["pixels"].open("rb", block_transfer=True) as file:
        assert file.raw.size == size
        assert file.read() == FRAME[:size]


@pytest.mark.parametrize("block", [False, True])
def test_download_of_many_bytes(bench, master, block):
    row = bench.dictionary.icd.telecommands["set_star_config"]
    data = row.encode(row.example())
    with master.sdo[0x2000][row.id].open("wb", size=len(data), block_transfer=block) as file:
        file.write(data)
    assert bench.application.commands == [(row.name, row.decode(data))]


def test_pdo_configuration_by_the_library(bench, master):
    """The library's own order of writing a PDO is one that the slave takes."""
    master.tpdo.read()
    tpdo = master.tpdo[1]
    assert [item.name for item in tpdo.map][:2] == ["Device status.mode", "Device status.error"]
    tpdo.clear()
    tpdo.add_variable("Device status", "boot_count")
    tpdo.trans_type = 1
    tpdo.enabled = True
    tpdo.save()
    bench.application.rows["device_status"] = {"boot_count": 77}
    bench.operational()
    assert bench.frame(0x80) == [(0x1AC, b"\x4d\x00")]


def test_object_dictionary_from_the_node_itself(bench, master):
    """What 1021h gives is enough for a master that knows nothing."""
    od = canopen.objectdictionary.eds.import_from_node(bench.node, master.network)
    assert od is not None
    assert od[0x6020]["exposure"].default == 100


class SlaveThread:
    """The slave on a python-can bus, in a thread that stands for another computer."""

    def __init__(self, bench, channel: str) -> None:
        self._bench = bench
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        slave = self._bench.slave
        self._send(slave.start(time.monotonic()))
        while not self._ended.is_set():
            deadline = slave.next_deadline()
            wait = 0.05 if deadline is None else min(max(deadline - time.monotonic(), 0.0), 0.05)
            message = self._bus.recv(wait)
            now = time.monotonic()
            if message is not None:
                frame = CanFrame(
                    message.arbitration_id,
                    bytes(message.data),
                    extended=message.is_extended_id,
                    remote=message.is_remote_frame,
                )
                self._send(slave.receive(frame, now))
            if deadline is not None and now >= deadline:
                self._send(slave.tick(now))

    def _send(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            self._bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))


@pytest.fixture
def network(new_bench, tmp_path, request):
    eds = tmp_path / "node.eds"
    bench = new_bench(sdo_timeout_s=PATIENCE_S)
    bench.show(FRAME[:60_000])
    eds.write_text(build_eds(bench.dictionary), encoding="ascii")
    network = canopen.Network()
    network.connect(interface="virtual", channel=request.node.name)
    network.lss.RESPONSE_TIMEOUT = PATIENCE_S
    node = network.add_node(canopen.RemoteNode(bench.node, str(eds)))
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    with SlaveThread(bench, request.node.name):
        yield bench, network, node
        network.disconnect()


def test_whole_session_over_a_bus(network):
    bench, _, node = network
    node.nmt.wait_for_heartbeat(timeout=PATIENCE_S)
    assert node.nmt.state == "PRE-OPERATIONAL"
    node.sdo["Producer heartbeat time"].raw = 50
    received = threading.Event()
    node.tpdo.read()
    node.tpdo[3].add_callback(lambda _: received.set())
    reported: list[int] = []
    node.nmt.add_heartbeat_callback(reported.append)
    node.nmt.state = "OPERATIONAL"
    wait_until(lambda: OPERATIONAL in reported)
    assert received.wait(PATIENCE_S)
    with node.sdo["Frame"]["pixels"].open("rb", block_transfer=True) as file:
        assert file.read() == FRAME[:60_000]
    node.network.send_message(0x80, b"\x01")
    wait_until(lambda: any(error.code == 0x8240 for error in node.emcy.log))
    assert [error.register for error in node.emcy.log if error.code == 0x8240] == [0x11]
    assert BOOT_UP not in reported
    node.nmt.state = "RESET"
    wait_until(lambda: BOOT_UP in reported)
    assert bench.slave.node_id == 0x2C


def test_lss_over_a_bus(network):
    bench, network_, _ = network
    lss = network_.lss
    assert lss.send_switch_state_selective(0, 0x53544152, 0x10000, 1)
    assert lss.inquire_node_id() == bench.node
    assert lss.inquire_lss_address(
        lss.CS_INQUIRE_PRODUCT_CODE if hasattr(lss, "CS_INQUIRE_PRODUCT_CODE") else 0x5B
    )
    lss.configure_node_id(0x31)
    lss.send_switch_state_global(lss.WAITING_STATE)
    network_.nmt.send_command(130)
    wait_until(lambda: bench.slave.node_id == 0x31)
