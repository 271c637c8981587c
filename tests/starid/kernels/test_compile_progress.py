"""Progress of compiling: what a process will compile is known without importing a kernel."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from starid.identification.options import ALGORITHMS
from starid.kernels import compile_progress
from starid.kernels.compile_progress import CompileProgress, kernels_of

pytestmark = pytest.mark.long

PIPELINE = "starhil.emulator.sensor.pipeline.pipeline"
LOADED = """
import importlib, inspect, sys
from numba.extending import is_jitted
for name in sys.argv[1:]:
    importlib.import_module(name)
for module in [*sys.modules.values()]:
    for item in [*vars(module).values()]:
        if is_jitted(item) and inspect.getsource(item.py_func).startswith("@compiled"):
            print(item.py_func.__module__.rpartition(".")[2] + "." + item.py_func.__name__)
"""


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_kernels_are_those_that_the_modules_have_once_they_are_loaded(algorithm: str) -> None:
    modules = [PIPELINE, ALGORITHMS[algorithm].module]
    run = subprocess.run([sys.executable, "-c", LOADED, *modules], capture_output=True, text=True, check=True)
    assert kernels_of(modules) == set(run.stdout.split())
    assert len(kernels_of(modules)) > 50


def test_the_kernels_in_the_cache_are_counted_each_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_progress, "kernel_folder", lambda _key: tmp_path)
    progress = CompileProgress([PIPELINE])
    assert progress.compiled() == 0
    for name in ("gone.kernel", *sorted(progress.kernels)[:3], "other.kernel"):
        folder = tmp_path / f"package_{name}"
        folder.mkdir()
        (folder / f"{name}-12.py311.nbi").touch()
        (folder / f"{name}-12.py311.1.nbc").touch()
    assert progress.compiled() == 3
