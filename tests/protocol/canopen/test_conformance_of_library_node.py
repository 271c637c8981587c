"""The conformance cases against `canopen.LocalNode`: they must find the faults that it is known to have."""

from __future__ import annotations

from collections import deque

import canopen
import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.unit import load_unit

pytestmark = pytest.mark.long

NODE = 0x2C


class LibraryNodeBus(canopen.Network):
    """The `canopen` library's own local node at the other end, without a bus and without its threads."""

    def __init__(self, od) -> None:
        super().__init__()
        self._frames: deque[CanFrame] = deque()
        self._now = 0.0
        self.add_node(canopen.LocalNode(NODE, od)).nmt.send_command(0)

    def send_message(self, can_id, data, remote=False):
        self._frames.append(CanFrame(can_id, bytes(data), extended=False, remote=remote))

    def send_periodic(self, can_id, data, _period, remote=False):
        """Its heartbeat is a thread of python-can, which there is none of here: one frame stands for it."""
        self.send_message(can_id, data, remote)
        return _NoTask()

    def now(self) -> float:
        return self._now

    def send(self, frame: CanFrame) -> None:
        if frame.remote:
            return
        try:
            self.notify(frame.id, bytearray(frame.data), self._now)
        except Exception:  # noqa: BLE001 (the library's notifier thread logs what a listener raises, and goes on)
            return

    def receive(self, timeout_s: float) -> CanFrame | None:
        if self._frames:
            return self._frames.popleft()
        self._now += timeout_s
        return None


class _NoTask:
    def stop(self) -> None:
        pass

    def update(self, data: bytes) -> None:
        pass


LIBRARY_FAULTS = {
    "no boot-up on its own": {"nmt.boot-up", "nmt.reset-states"},
    "resets leave it in INITIALISING": {"nmt.reset-communication", "store.save"},
    "SDO answered in STOPPED": {"sdo.stopped", "nmt.sdo-states"},
    "no TPDO scheduling": {"tpdo.cyclic", "design.write-event", "tpdo.event-timer", "tpdo.gate"},
    "PDO buffers apart from the object dictionary": {"rpdo.event", "rpdo.synchronous"},
    "no block transfer": {"sdo-block.upload", "sdo-block.download", "sdo-block.upload-big"},
    "no LSS slave": {"lss.selective", "lss.fastscan"},
    "no node guarding": {"error-control.guarding", "error-control.life-guarding"},
    "no heartbeat consumer": {"error-control.consumer", "error-control.behaviour"},
    "EMCY apart from 1001h and 1003h": {"emcy.history-write"},
    "1000h:1 answered": {"od.no-sub-index"},
    "1010h takes anything": {"store.signature"},
    "a 29-bit identifier answered": {"sdo.extended"},
    "limits not checked": {"od.value-high", "od.value-low"},
    "no time-out of transfers": {"sdo.time-out"},
}
"""What is known of `canopen.LocalNode` → cases that must find it."""


@pytest.fixture(scope="module")
def library_outcomes(run_conformance, read_eds):
    eds = build_eds(DeviceDictionary(load_unit()))
    return run_conformance(LibraryNodeBus(read_eds(eds)), eds)


@pytest.mark.parametrize("fault", LIBRARY_FAULTS)
def test_known_faults_of_the_library_node_are_found(library_outcomes, fault):
    assert {f"canopen.{name}" for name in LIBRARY_FAULTS[fault]} <= library_outcomes["failed"]


@pytest.mark.parametrize(
    "name",
    ["sdo.expedited-upload", "sdo.expedited-download", "od.write-only", "od.length-low", "od.identity"],
)
def test_what_the_library_node_does_right_passes(library_outcomes, name):
    assert f"canopen.{name}" in library_outcomes["passed"]
