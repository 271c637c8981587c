"""The cache of compiled kernels: kept while the sources are the same, renewed when a callee changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from starid.jit import source_stamp

CALLER = """
from other_kernels.inner import FACTOR, scaled
from starid.jit import compiled


@compiled
def outer(x: float) -> float:
    return scaled(x) + FACTOR


print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""

INNER = """
from starid.jit import compiled

FACTOR = {factor}


@compiled
def scaled(x: float) -> float:
    return {slope} * x
"""


def run(folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", "import other_kernels.outer"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def test_a_changed_callee_in_another_module_is_noticed(tmp_path: Path) -> None:
    package = tmp_path / "other_kernels"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "outer.py").write_text(CALLER)
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=2.0))
    assert run(tmp_path) == ["2.5", "0"]
    assert run(tmp_path) == ["2.5", "1"], "the second process loads the machine code"
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=3.0))
    assert run(tmp_path) == ["3.5", "0"], "the old code is not run"


def test_stamps_follow_imports_only() -> None:
    assert source_stamp("starid.projection") == source_stamp("starid.projection")
    assert source_stamp("starid.projection") != source_stamp("starid.jit")
