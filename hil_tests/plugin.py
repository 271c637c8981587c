"""Pytest plugin: fixtures for a star sensor on a serial line or a CAN bus, emulated or real.

In a test::

    def test_it_tracks(starhil_serial):
        starhil_serial.command("set_mode", mode="lost_in_space")
        starhil_serial.wait_for("precise_attitude", lambda reading: reading["valid"], within_s=20)

Without options, an emulator process is started once per module and ended after it. With `--starhil-serial DEV`
or `--starhil-can CHANNEL`, the same tests run against a connected unit. The time-out of a reply is
`--starhil-timeout` seconds; a test that needs another one passes `timeout_s`.

pytest loads this module in every run, so the bench is imported only when a fixture is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from starhil.hil_tests.client import ObcClient
    from starhil.hil_tests.emulator_process import EmulatorProcess


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options that name a unit or the profile of the emulator."""
    group = parser.getgroup("starhil", "star sensor under test")
    group.addoption("--starhil-serial", metavar="DEV", help="serial port of a unit, instead of an emulator")
    group.addoption("--starhil-can", metavar="CHANNEL", help="CAN channel of a unit, instead of an emulator")
    group.addoption(
        "--starhil-dialect",
        metavar="a|b|c",
        help="format of serial replies, for a unit that has several (default b)",
    )
    group.addoption(
        "--starhil-unit",
        default=None,
        metavar="UNIT",
        help="name or folder of the unit's definition (default: the profile's, or cubestar)",
    )
    group.addoption("--starhil-profile", metavar="PROFILE", help="profile of the emulator")
    group.addoption(
        "--starhil-seed", default=1, type=int, metavar="N", help="seed of the emulator (default 1)"
    )
    group.addoption(
        "--starhil-timeout", default=10.0, type=float, metavar="S", help="time-out of a reply (default 10 s)"
    )


@pytest.fixture(scope="module")
def starhil_emulator(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[EmulatorProcess]:
    """Start an emulator on a pty and on a CAN bus (vcan0, or else a private hub).

    `.ready` has the fields of its ready line. It is ended with SIGTERM after the last test of the module; an
    exit status other than 0 is an error.
    """
    from starhil.hil_tests.emulator_process import EmulatorProcess, emulator_command
    from starhil.hil_tests.private_can_bus import private_can_bus

    folder: Path = tmp_path_factory.mktemp("starhil")
    with private_can_bus() as channel:
        command = emulator_command(
            profile=request.config.getoption("--starhil-profile"),
            unit=request.config.getoption("--starhil-unit"),
            serial="auto",
            can=channel,
            dialect=request.config.getoption("--starhil-dialect"),
            seed=request.config.getoption("--starhil-seed"),
            state_dir=folder / "state",
            truth_log=folder / "truth.csv",
        )
        with EmulatorProcess(command) as emulator:
            yield emulator


def _client(request: pytest.FixtureRequest, link: str) -> ObcClient:
    from starhil.hil_tests.client import ObcClient

    spec, unit = request.config.getoption(f"--starhil-{link}"), request.config.getoption("--starhil-unit")
    if spec is None:
        emulator: EmulatorProcess = request.getfixturevalue("starhil_emulator")
        spec, unit = emulator.ready.get(link), emulator.unit
        if spec is None:
            pytest.fail(f"unit {unit} has no {link} link")
    timeout_s = request.config.getoption("--starhil-timeout")
    common = {"unit": unit or "cubestar", "timeout_s": timeout_s}
    if link == "can":
        return ObcClient.open(can=spec, **common)
    return ObcClient.open(serial=spec, dialect=request.config.getoption("--starhil-dialect"), **common)


@pytest.fixture
def starhil_serial(request: pytest.FixtureRequest) -> Iterator[ObcClient]:
    """Return an OBC client on the serial line of the unit or emulator."""
    with _client(request, "serial") as client:
        yield client


@pytest.fixture
def starhil_can(request: pytest.FixtureRequest) -> Iterator[ObcClient]:
    """Return an OBC client on the CAN bus of the unit or emulator."""
    with _client(request, "can") as client:
        yield client
