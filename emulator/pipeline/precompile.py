"""Compile the identifier's kernels in a process of their own, while another compiles those of the picture.

Kernels are compiled once after an installation or a change and kept on disk. That takes the better part of a minute on one
processor; with two processes a machine with two takes little more than half of it.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from starhil.emulator.parent_death_signal import end_with_parent
from starid.projection import back_project_kernel


def picture_was_compiled() -> bool:
    """Whether this process had to compile the projection, so that the other kernels are not on the disk either."""
    kernel: Any = back_project_kernel
    return bool(kernel.stats.cache_misses)


def start_helper() -> subprocess.Popen[bytes]:
    """Start the process that compiles the identifier; whoever starts it waits for it."""
    return subprocess.Popen(
        [sys.executable, "-m", "starhil.emulator.pipeline.precompile"], stdin=subprocess.DEVNULL
    )


def main() -> None:
    """Compile the identifier's kernels and leave them in the cache."""
    end_with_parent()
    from starid.geometric.identifier import Identifier

    Identifier().warm_up()


if __name__ == "__main__":
    main()
