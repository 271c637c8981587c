"""An emulator, an OBC and can-utils on a kernel vcan0 (if need be, in a guest)."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import subprocess
import threading
import time
import tty
from pathlib import Path

import can
import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.rig.emulator_process import emulator_command
from tests.candump import parse_candump, read_candump
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES, needs_vcan0
from tests.process.test_conformance import conform
from tests.process.test_sessions import starhil
from tests.waiting import PATIENCE_S, wait_until

pytestmark = [pytest.mark.process, pytest.mark.socketcan, needs_vcan0]

CASES = {
    "can.frames": "telemetry other-device standard remote two-at-once askers eight-segmented",
    "can.segments": "swapped two-hosts",
    "can.bursts": "block holes one-by-one",
    "canopen.error-control": "guarding",
    "canopen.sdo-block": "upload-big download-gap",
}
"""Cases of conformance about IDs, remote frames, bursts, order and loss of frames.

What the unit does with frames that have arrived is the same on every bus: the other cases run on the hub.
"""

SPEED = 0.25
"""Simulation time per second: the guest has one slow processor, and time-outs are rules that stay."""


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    """An emulator on vcan0."""
    state = tmp_path_factory.mktemp("state")
    command = emulator_command(
        profile="ideal",
        serial="off",
        can="auto",
        seed=1,
        settings=["truth.attitude.roll_deg=30", *NO_IMAGES],
        state_dir=state,
        extra=["--canopen", "44", "--clock", f"scaled:{SPEED}"],
    )
    with EmulatorThread(command) as emulator:
        yield emulator


@pytest.fixture
def obc(unit):
    """An OBC on vcan0."""
    with ObcClient.open(can="vcan0", timeout_s=PATIENCE_S) as client:
        yield client


@pytest.fixture
def dump():
    """A candump process.

    Call it to get what it has seen since, heartbeats of the CANopen node left out.
    """
    process = subprocess.Popen(
        [shutil.which("candump"), "-L", "vcan0"], stdout=subprocess.PIPE, text=True, bufsize=1
    )
    lines: list[str] = []
    reader = threading.Thread(target=lambda: lines.extend(process.stdout), daemon=True)
    reader.start()
    while not lines:  # candump listens once it has seen a frame; those of 11 bits are left out below
        cansend("7FE#")
        time.sleep(0.05)

    def _frames() -> list[str]:
        frames = [parse_candump(line)[1] for line in list(lines)]
        return [str(frame) for frame in frames if frame.extended]

    def _seen(count: int) -> list[str]:
        wait_until(lambda: len(_frames()) >= count)
        return _frames()

    yield _seen
    process.terminate()
    process.wait()
    reader.join()
    process.stdout.close()


def cansend(frame: str, interface: str = "vcan0") -> None:
    subprocess.run([shutil.which("cansend"), interface, frame], check=True)


def test_auto_takes_the_kernel_bus(unit):
    assert unit.ready["can"] in ("vcan0", "socketcan:vcan0")


def test_raw_commands_by_can_utils_are_answered(unit, dump):
    cansend("04800104#")
    seen = dump(2)
    assert seen[0] == "04800104#"
    assert seen[1].startswith("05800401#53")
    cansend("01600104#4D")
    cansend("01670104#")
    assert dump(6)[2:] == ["01600104#4D", "03600401#03", "01670104#", "02670401#"]


def test_a_segmented_command_and_a_segmented_reply(unit, dump):
    for frame in ("07000104#0001020304050601", "07000104#0708090A0B00"):
        cansend(frame)
    seen = dump(3)
    assert seen[2] == "03000401#01"
    cansend("04D30104#")
    reply = dump(4 + 8)[4:]
    assert [frame[:9] for frame in reply] == ["08D30401#"] * 8
    assert [frame[-2:] for frame in reply] == [f"{left:02X}" for left in range(7, -1, -1)]
    assert sum(len(frame[9:]) // 2 - 1 for frame in reply) == 54


def test_candump_and_the_bench_log_the_same_frames(unit, dump, tmp_path):
    script = tmp_path / "short.toml"
    script.write_text(
        "[defaults]\ntimeout_s = 10.0\n"
        "[[step]]\nread = 'identification'\nrepeat = 20\nevery_s = 0\n[[step]]\nread = 'precise_attitude'\n"
    )
    done = starhil("session", script, "--can", "auto", "--log", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    logged = [str(frame) for _, frame in read_candump(tmp_path / "can.log") if frame.extended]
    assert len(logged) == 2 * 20 + 1 + 8
    assert dump(len(logged)) == logged


def test_commands_are_answered_while_cangen_floods_the_bus(obc):
    flood = subprocess.Popen([shutil.which("cangen"), "vcan0", "-g", "5", "-e", "-I", "i", "-L", "8"])
    try:
        for _ in range(50):
            assert len(obc.telemetry("star_tracker", timeout_s=PATIENCE_S)) > 20
    finally:
        flood.terminate()
        flood.wait()
    # identifiers count up from 0: a long flood reaches those from the device to the OBC, of a type that no reply has
    assert [fault for fault in obc.faults if "type 0 is not a reply" not in fault.detail] == []
    assert not obc.stray_replies


def test_the_kernel_sends_periodic_requests_and_each_is_answered(obc):
    obc.command("clear_counters")
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        request = can.Message(arbitration_id=0x04800204, is_extended_id=True)
        task = bus.send_periodic(request, 0.02)
        replies = 0
        deadline = time.monotonic() + PATIENCE_S
        while replies < 25 and time.monotonic() < deadline:
            message = bus.recv(1.0)
            replies += message is not None and message.arbitration_id == 0x05800402
        task.stop()
    assert type(task).__name__ == "CyclicSendTask"
    assert replies == 25
    assert obc.telemetry("communication_status")["telemetry_count"] >= 26


def test_conformance_cases_about_frames_pass_on_the_kernel_bus(unit):
    cases = [f"{area}.{name}" for area, names in CASES.items() for name in names.split()]
    outcomes = conform(*cases, "--intrusive", "--can", "vcan0", "--canopen", "44", "--speed", str(SPEED))
    assert {item["status"] for item in outcomes} == {"passed"}
    assert sorted(item["id"] for item in outcomes) == sorted(cases)


@contextlib.contextmanager
def pty_pair():
    """Two ttys, joined crosswise."""
    ends = [os.openpty() for _ in range(2)]
    for master, slave in ends:
        tty.setraw(slave)
        os.set_blocking(master, False)
    stopping = threading.Event()

    def copy():
        masters = [master for master, _ in ends]
        while not stopping.is_set():
            for source in select.select(masters, [], [], 0.05)[0]:
                os.write(masters[1 - masters.index(source)], os.read(source, 4096))

    thread = threading.Thread(target=copy, daemon=True)
    thread.start()
    try:
        yield tuple(os.ttyname(slave) for _, slave in ends)
    finally:
        stopping.set()
        thread.join()
        for pair in ends:
            for descriptor in pair:
                os.close(descriptor)


def test_an_slcan_adapter_on_a_tty(tmp_path):
    with pty_pair() as (kernel_end, device_end):
        command = emulator_command(
            serial="off", can=f"slcan:{device_end}", state_dir=tmp_path / "state", settings=NO_IMAGES
        )
        with EmulatorThread(command):
            daemon = subprocess.Popen([shutil.which("slcand"), "-F", "-S", "115200", kernel_end, "slcan0"])
            try:
                wait_until(Path("/sys/class/net/slcan0").exists)
                subprocess.run([shutil.which("ip"), "link", "set", "slcan0", "up"], check=True)
                with ObcClient.open(can="slcan0", timeout_s=PATIENCE_S) as obc:
                    assert obc.telemetry("identification")["interface_version"] == 1
                    assert len(obc.telemetry("precise_attitude")) > 10
            finally:
                daemon.terminate()
                daemon.wait()
