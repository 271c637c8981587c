"""Compilation of half of the kernels in a second process, in parallel with the pipeline.

Kernels are compiled once after an installation or a change, and cached on disk. The second process compiles those
of the star identifier, and first the kernel that the pipeline needs last.
"""

from __future__ import annotations

import gc
import subprocess
import sys
from typing import Any

from starhil.emulator.parent_death_signal import end_with_parent
from starid.projection import back_project_kernel


def kernel_cache_was_cold() -> bool:
    """Return whether this process had to compile the projection; the other kernels are then missing too."""
    kernel: Any = back_project_kernel
    return bool(kernel.compilations)


def start_helper() -> subprocess.Popen[bytes]:
    """Start the process that compiles the star identifier; the caller must wait for it."""
    return subprocess.Popen(
        [sys.executable, "-m", "starhil.emulator.pipeline.precompile"], stdin=subprocess.DEVNULL
    )


def main() -> None:
    """Compile kernels into the cache."""
    end_with_parent()
    gc.disable()  # compiling makes many objects and little garbage: collecting it takes an eighth of the time
    from starid.geometric.identifier import Identifier
    from starid.imaging import pairs

    pairs.warm_up()
    Identifier().warm_up()


if __name__ == "__main__":
    main()
