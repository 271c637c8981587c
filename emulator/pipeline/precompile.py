"""Compilation of the star identifier's kernels in a second process, in parallel with the pipeline's kernels.

Kernels are compiled once after an installation or a change, and cached on disk. This takes most of a minute on one
processor, and little more than half of that with two processes on two processors.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from starhil.emulator.parent_death_signal import end_with_parent
from starid.projection import back_project_kernel


def kernel_cache_was_cold() -> bool:
    """Return whether this process had to compile the projection; the other kernels are then missing too."""
    kernel: Any = back_project_kernel
    return bool(kernel.stats.cache_misses)


def start_helper() -> subprocess.Popen[bytes]:
    """Start the process that compiles the star identifier; the caller must wait for it."""
    return subprocess.Popen(
        [sys.executable, "-m", "starhil.emulator.pipeline.precompile"], stdin=subprocess.DEVNULL
    )


def main() -> None:
    """Compile the star identifier's kernels into the cache."""
    end_with_parent()
    from starid.geometric.identifier import Identifier

    Identifier().warm_up()


if __name__ == "__main__":
    main()
