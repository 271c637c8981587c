"""Emulator processes for the tests of this folder."""

from __future__ import annotations

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from starhil.protocol.transports.can import kernel_can_is_up
from tests.emulator.emulator_thread import EmulatorThread
from tests.waiting import PATIENCE_S

FAST_BAUD = 921600
NO_IMAGES = ("run.worker=error_model", "camera.distortion=[]")
"""Settings of an emulator whose images do not matter: it starts without numba, in a quarter of the processor time."""
NO_IMAGES_TABLES = '[run]\nworker = "error_model"\n[camera]\ndistortion = []\n'
"""The same as tables of a profile."""
NO_IMAGES_OPTIONS = tuple(word for setting in NO_IMAGES for word in ("--set", setting))

needs_vcan0 = pytest.mark.skipif(
    not kernel_can_is_up("vcan0"),
    reason="no vcan0 here; tools/test_on_vcan runs this in a guest that has one",
)


@pytest.fixture
def emulators_in_threads(monkeypatch):
    """Let the commands that start an emulator, run in the process of the tests, start it there in a thread."""
    for module in ("session.session_run", "conformance.conformance_run"):
        monkeypatch.setattr(f"starhil.hil_tests.{module}.EmulatorProcess", EmulatorThread)


@pytest.fixture(scope="session")
def bus():
    """A CAN bus: vcan0 or a hub."""
    with private_can_bus() as channel:
        yield channel


@pytest.fixture(scope="session")
def running_emulator(bus, tmp_path_factory):
    """An emulator of an accurate sensor on a pty at 921600 baud and on the bus."""
    folder = tmp_path_factory.mktemp("emulator")
    command = emulator_command(
        profile="ideal",
        serial="auto",
        can=bus,
        seed=1,
        settings=[f"links.serial.baud={FAST_BAUD}"],
        state_dir=folder / "state",
        truth_log=folder / "truth.csv",
    )
    with EmulatorProcess(command) as process:
        yield process


@pytest.fixture(scope="module")
def emulator(running_emulator):
    """The emulator after a reset with the parameters of its profile, whatever other modules have set and saved.

    It ends in standby: in another mode it would render images while other modules run.
    """
    with ObcClient.open(can=running_emulator.ready["can"], timeout_s=PATIENCE_S) as client:
        for command in ("default_parameters", "save_parameters", "reset"):
            client.command(command)
        client.wait_for(
            "device_status", lambda reading: reading["reset_cause"] == "command", within_s=PATIENCE_S
        )
        client.wait_for("device_status", lambda reading: reading["mode"] == "standby", within_s=PATIENCE_S)
    yield running_emulator
    with ObcClient.open(can=running_emulator.ready["can"], timeout_s=PATIENCE_S) as client:
        client.command("set_mode", mode="standby")


@pytest.fixture(scope="session")
def sagitta(tmp_path_factory):
    """An emulated Sagitta on a pty."""
    command = emulator_command(
        profile="ideal",
        unit="sagitta",
        seed=1,
        settings=NO_IMAGES,
        state_dir=tmp_path_factory.mktemp("sagitta"),
    )
    with EmulatorThread(command) as emulator:
        yield emulator


@pytest.fixture
def serial_obc(emulator):
    """An OBC on the serial line."""
    with ObcClient.open(serial=emulator.ready["serial"], timeout_s=PATIENCE_S) as client:
        yield client


@pytest.fixture
def can_obc(emulator):
    """An OBC on the CAN bus."""
    with ObcClient.open(can=emulator.ready["can"], timeout_s=PATIENCE_S) as client:
        yield client
