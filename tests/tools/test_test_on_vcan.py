"""The tests on a real vcan0 run in the first guest that boots; where none does, the reasons are kept, and CI fails."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
GUEST = """
import os, sys
machine = sys.argv[sys.argv.index("--machine") + 1]
if machine not in os.environ["BOOTS"].split():
    print(f"{machine}: ptrace set fp regs failed\\n", file=sys.stderr)
    sys.exit(69)
print("ran in", machine)
sys.exit(int(os.environ.get("STATUS", "0")))
"""
SETTING = "REQUIRE_VCAN0"  # a test states it if it is about it
NO_GUEST = "no guest: uml: uml: ptrace set fp regs failed; qemu: qemu: ptrace set fp regs failed"


@pytest.fixture
def run(tmp_path):
    """Run the script in a folder of its own, where the guests of certain machines boot."""
    for name in ("tools", "tests", "bin", "reports"):
        (tmp_path / name).mkdir()
    shutil.copy(ROOT / "tools" / "test_on_vcan", tmp_path / "tools")
    (tmp_path / "tests" / "test_bus.py").write_text("from conftest import needs_vcan0\n")
    (tmp_path / "tools" / "vcan_guest.py").write_text(GUEST)
    (tmp_path / "bin" / "python").symlink_to(sys.executable)
    scripts = {
        "tools/install_test_packages": 'exit "$PACKAGES"',
        "bin/ip": "exit 1",
    }
    for name, body in scripts.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body}\n")
        (tmp_path / name).chmod(0o755)

    def run(boots: str, packages: int = 0, **more: str) -> tuple[int, str]:
        environment = {
            **{name: value for name, value in os.environ.items() if name != SETTING},
            "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
            "BOOTS": boots,
            "PACKAGES": str(packages),
            "REPORTS": str(tmp_path / "reports"),
            **more,
        }
        command = [tmp_path / "tools" / "test_on_vcan", tmp_path / "bin" / "python"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout.splitlines()[-1]

    return run


@pytest.mark.parametrize(("boots", "said"), [("uml qemu", "ran in uml"), ("qemu", "ran in qemu")])
def test_the_first_guest_that_boots_is_taken(run, boots, said):
    assert run(boots) == (0, said)


def test_the_status_is_that_of_the_tests(run):
    assert run("uml qemu", STATUS="5") == (5, "ran in uml")


def test_where_no_guest_boots_the_reasons_are_kept(run, tmp_path):
    status, said = run("")
    assert (status, said) == (0, f"real-vcan0 tier SKIPPED (tests marked socketcan did not run): {NO_GUEST}")
    assert (tmp_path / "reports" / "vcan0.reason").read_text() == f"{NO_GUEST}\n"


@pytest.mark.parametrize(("packages", "status"), [(0, 1), (69, 0)], ids=["installed", "not available"])
def test_a_guest_that_has_to_boot_is_a_failure_where_its_packages_are_installed(run, packages, status):
    assert run("", packages, REQUIRE_VCAN0="yes")[0] == status
