"""The table at the end of `make test` shows each tier, also one of which no test ran, and each reason."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]

REPORT = """<testsuites><testsuite>
<testcase name="a"/><testcase name="b"/>
<testcase name="c"><failure message="wrong"/></testcase>
<testcase name="d"><skipped message="no tshark"/></testcase>
<testcase name="e"><skipped message="no tshark"/></testcase>
<testcase name="f"><skipped message="no java"/></testcase>
</testsuite></testsuites>"""


def printed(folder: Path) -> list[str]:
    command = [sys.executable, ROOT / "tools" / "tier_table.py", folder]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [" ".join(line.split()) for line in done.stdout.splitlines()]


def test_run_and_skipped_tests_are_counted_and_reasons_are_listed(tmp_path):
    (tmp_path / "processes.reason").write_text("ended without a report\n")
    (tmp_path / "processes.xml").write_text(REPORT)
    assert printed(tmp_path) == ["tier run skipped why", "processes 3 3 2 x no tshark", "1 x no java"]


def test_a_tier_that_did_not_run_is_in_the_table(tmp_path):
    (tmp_path / "vcan0.reason").write_text("no guest: uml: ptrace set fp regs failed, errno = 14\n")
    (tmp_path / "wire.xml").write_text("<testsuites/>")
    assert printed(tmp_path) == [
        "tier run skipped why",
        "vcan0 none all no guest: uml: ptrace set fp regs failed, errno = 14",
        "wire 0 0",
    ]
