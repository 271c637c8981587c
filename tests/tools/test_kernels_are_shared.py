"""No test waits for a compilation because it sets another home."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from starid.storage.cache import cache_dir

SHOW = [sys.executable, "-c", "from starid.storage.cache import cache_dir; print(cache_dir())"]


@pytest.mark.process
def test_a_process_with_another_home_uses_the_kernels_of_this_run(tmp_path):
    home = {name: str(tmp_path) for name in ("HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME")}
    done = subprocess.run(SHOW, env={**os.environ, **home}, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(cache_dir())


def test_a_process_without_the_folder_of_the_kernels_is_not_started(monkeypatch):
    with pytest.raises(AssertionError, match="STARHIL_CACHE_DIR"):
        subprocess.run(SHOW, env={"PATH": os.environ["PATH"]}, check=True)
    monkeypatch.delenv("STARHIL_CACHE_DIR")
    with pytest.raises(AssertionError, match="STARHIL_CACHE_DIR"):
        subprocess.run(SHOW, check=True)
