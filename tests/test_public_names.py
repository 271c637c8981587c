"""The names of `starhil` load nothing until they are used, and a type checker knows them."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import starhil

pytestmark = pytest.mark.long

USER_FILE = """
import math

from starhil import AsyncObcClient, BenchError, Emulator, NackError, ObcClient, Reading, RunOptions, load_profile, load_unit


def pointing_error_deg(obc: ObcClient) -> float:
    obc.command("set_mode", mode="lost_in_space")
    try:
        reading: Reading = obc.read("precise_attitude")
    except NackError as error:
        print(error.code_name)
        return math.nan
    return float(reading.latency_s)


async def run() -> str:
    emulator = Emulator([load_profile("ideal")], RunOptions(control="off"))
    await emulator.start()
    return await emulator.ready()


rows: int = len(list(load_unit("st16").rows)) if issubclass(NackError, BenchError) else 0
"""


def test_importing_starhil_loads_none_of_its_parts():
    text = "import sys, starhil; print(*(name for name in sys.modules if name.startswith(('starhil.', 'starid', 'numpy'))))"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_checkout_without_symbolic_links_says_so(tmp_path):
    folder = tmp_path / "starhil"
    folder.mkdir()
    (folder / "__init__.py").write_text(Path(starhil.__file__).read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "emulator").write_text("../emulator")
    command = [sys.executable, "-c", "import starhil"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert done.stderr.splitlines()[-1].startswith(
        "ImportError: starhil: this checkout was unpacked without its symbolic links"
    )


def test_every_public_name_is_there():
    assert {name for name in starhil.__all__ if getattr(starhil, name) is None} == set()
    assert set(dir(starhil)) == set(starhil.__all__)
    assert starhil.__version__ == version("starhil")
    assert not hasattr(starhil, "no_such_name")


def test_a_users_file_passes_mypy_strict(tmp_path):
    file = tmp_path / "obc.py"
    names = "\n".join(f"starhil.{name}" for name in starhil.__all__)
    file.write_text(f"{USER_FILE}\nimport starhil\n{names}\n")
    wrong = tmp_path / "wrong.py"
    wrong.write_text("from starhil import ObcClient\nObcClient.open(no_such_argument=1)\n")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--config-file",
        "",
        "--follow-imports",
        "silent",
        str(file),
        str(wrong),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1])
    lines = done.stdout.splitlines()
    assert [line for line in lines if "obc.py" in line] == []
    assert any("wrong.py:2: error" in line for line in lines), done.stdout + done.stderr
