"""A flight computer in QEMU reads the star tracker over its UART: tools/obc, run by tools/obc_in_qemu.py."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.emulator.emulator_thread import EmulatorThread

pytestmark = pytest.mark.process

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
import obc_in_qemu  # noqa: E402

LISTING = [TOOLS / "install_test_packages", "--list", "obc"]
MISSING = subprocess.run(LISTING, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
if MISSING:
    pytest.skip(f"Debian packages missing: {MISSING}", allow_module_level=True)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return obc_in_qemu.build(tmp_path_factory.mktemp("obc"))


@pytest.mark.parametrize("link", ["pty", "theirs"])
def test_the_flight_computer_reads_valid_attitudes_that_agree_with_the_truth(
    program: Path, tmp_path: Path, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(obc_in_qemu, "EmulatorProcess", EmulatorThread)
    status, report, _ = obc_in_qemu.run(program, link, "real", tmp_path)
    assert status == 0, report
    assert len(re.findall(r"^frame ", report, re.MULTILINE)) == 25
    assert "valid 25 wrong 0 " in report
    assert obc_in_qemu.largest_error_arcsec(report, tmp_path / "truth.csv") < obc_in_qemu.AGREES_ARCSEC


def test_a_flight_computer_without_a_star_tracker_ends_with_status_1(tmp_path: Path) -> None:
    program = obc_in_qemu.build(tmp_path, "-DLIMIT_MS=4000u")
    machine = obc_in_qemu.start_machine(program, "null", ("-icount", "shift=10,sleep=off"))
    status, report, _ = obc_in_qemu.end(machine)
    assert status == 1
    assert "valid 0 wrong 0 " in report
