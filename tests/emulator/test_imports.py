"""What the process that answers on the links imports: nothing that is slow to start or large."""

from __future__ import annotations

import subprocess
import sys

FOR_THE_WORKER = ("numba", "scipy", "sklearn", "cv2", "matplotlib", "erfa", "sgp4", "aiohttp", "mcap")


def test_the_links_start_without_the_libraries_of_the_pipeline():
    text = "import sys, starhil.emulator.launch; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert not set(FOR_THE_WORKER) & set(done.stdout.split())
