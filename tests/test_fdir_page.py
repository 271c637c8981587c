"""The examples of docs/fdir.md run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.telemetry_faults import EFFECTS, TelemetryFault
from tests.process.conftest import NO_IMAGES
from tests.test_docs import DOCS, blocks
from tests.waiting import PATIENCE_S

PAGE = "fdir.md"


def example(name):
    """The block that begins with its file name."""
    (block,) = [each for each in blocks(PAGE) if each.text.startswith(f"# {name}\n")]
    return block.text


@pytest.mark.process
def test_the_pytest_matrix_passes(tmp_path):
    text, count = re.subn(r"settings=\[", f"\\g<0>*{NO_IMAGES}, ", example("test_fdir.py"))
    assert count == 1
    (tmp_path / "test_fdir.py").write_text(text)
    command = ["-m", "pytest", "-q", "-p", "no:cacheprovider", f"--rootdir={tmp_path}", "test_fdir.py"]
    done = subprocess.run(
        [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert "6 passed" in done.stdout, done.stdout + done.stderr


def test_the_scenario_is_one(tmp_path):
    path = tmp_path / "reset.toml"
    path.write_text(example("reset.toml"))
    (event,) = load_scenario(str(path)).at
    assert event.fault.phase == "mid_frame"


def test_the_matrix_shows_every_effect():
    (heading,) = re.findall(r"## The matrix\n(.*?)\n## ", page(), re.DOTALL)
    missing = [name for name in EFFECTS if f"{name} = " not in heading]
    assert missing == []
    assert set(EFFECTS) < set(TelemetryFault.model_fields)


def page():
    return (DOCS / PAGE).read_text(encoding="utf-8")
