"""EDS files of others: one line says what is wrong with them."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.emulator.cli.command_line import run_command_line

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("garbage", "not a valid EDS: File contains no section headers"),
        ("[a]\n[a]\n", "not a valid EDS: While reading from"),
        ("[1000]\n", "not a valid EDS: No option 'ParameterName'"),
        ("[a]\nb" + " " * 50_000 + "c\n", "not a valid EDS: a line has more than 1000 characters"),
    ],
    ids=["no section", "section twice", "no name", "long line"],
)
def test_an_eds_that_is_none_is_rejected_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "unit.eds"
    path.write_text(text)
    begin_s = time.process_time()
    status, outcomes, errors = run_command_line(
        "conformance", "--can", "virtual:eds", "--canopen", "44", "--eds", str(path)
    )
    assert time.process_time() - begin_s < 5.0
    assert (status, outcomes) == (2, ""), "no case has been run"
    assert message in errors
    assert errors.count("\n") == 1
    assert "starhil-eds-" not in errors  # the name of a copy


def test_an_eds_that_never_ends_is_not_read() -> None:
    ended = run_command_line("conformance", "--can", "virtual:eds", "--canopen", "44", "--eds", "/dev/zero")
    assert ended == (2, "", "starhil: /dev/zero: the EDS cannot be read: not a regular file\n")


@pytest.mark.parametrize("text", ["", "[DeviceInfo]\nVendorName=x\n"])
def test_an_eds_without_objects_is_rejected(tmp_path: Path, text: str) -> None:
    """Nothing was checked, and all cases passed."""
    path = tmp_path / "unit.eds"
    path.write_text(text)
    status, outcomes, errors = run_command_line(
        "conformance", "--can", "virtual:eds", "--canopen", "44", "--eds", str(path)
    )
    assert (status, outcomes) == (2, "")
    assert errors.endswith(f"starhil: {path}: not a valid EDS: lacks object 1000h, which every node has\n")
