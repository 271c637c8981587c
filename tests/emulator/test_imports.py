"""What the process that answers on the links imports: nothing that is slow to start or large."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import starhil

pytestmark = pytest.mark.process

FOR_THE_WORKER = {"numba", "scipy", "sklearn", "cv2", "matplotlib", "erfa", "sgp4", "aiohttp", "mcap"}


PROFILES = sorted(
    path.stem for path in (Path(starhil.__file__).parent / "configs" / "profiles").glob("*.toml")
)


def test_links_profiles_and_a_unit_without_images_do_without_the_libraries_of_the_pipeline() -> None:
    """In one process, which prints after each step what has been imported."""
    text = f"""import sys
def found(step):
    print(step, *{FOR_THE_WORKER} & sys.modules.keys())
import starhil.emulator.launch
found("launch")
from starhil.emulator.profile import load_profile
for name in {PROFILES}:
    load_profile(name)
    found(name)
from starhil.emulator.profile.pipeline_setup import make_pipeline
make_pipeline(load_profile("ideal", ["run.worker=error_model"]), None, repeatable=False, previews=False)
found("error_model")"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["launch", *PROFILES, "error_model"]


def test_the_pipeline_starts_without_the_libraries_of_the_links_and_kernels_without_linear_algebra() -> None:
    """Numba looks for `scipy.linalg` when the first kernel is called."""
    text = """import sys
import starhil.emulator.sensor.pipeline.pipeline
from starhil.emulator.sensor.pipeline.worker import call_first_kernel
print(*sys.modules)
call_first_kernel()
from starid.identification.geometric.identifier import Identifier
Identifier().warm_up()
assert "scipy.linalg" not in sys.modules
import scipy.linalg
call_first_kernel()
assert sys.modules["scipy.linalg"] is scipy.linalg"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not {"asyncio", "ssl", "pydantic", "typer", "can", "canopen", "construct"} & set(
        done.stdout.split()
    )


def test_the_process_of_an_fmu_starts_without_the_definition() -> None:
    text = "import sys, starhil.emulator.cli.fmu.process; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert not {"numpy", "pydantic", "asyncio", "starhil.protocol.icd"} & set(done.stdout.split())
