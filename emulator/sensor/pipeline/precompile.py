"""Compilation of half of the kernels in a second process, in parallel with the pipeline.

Kernels are compiled once after an installation or a change, and cached on disk. The second process compiles those
of the star identifier, and first the one that splits pairs: meanwhile the pipeline compiles the projection, which both
need.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys

from starhil.emulator.simulation.parent_death_signal import end_with_parent
from starid.kernels.kernel_cache import nothing_compiled


def start_helper() -> subprocess.Popen[bytes] | None:
    """Start the process that compiles the star identifier, unless the cache has kernels; the caller must wait for it.

    It is called before the first kernel, which would be found in the cache.
    """
    import starid.kernels.jit  # noqa: F401 (which chooses the folder of kernels)

    if not nothing_compiled():
        return None
    module = "starhil.emulator.sensor.pipeline.precompile"
    return subprocess.Popen(  # noqa: S603
        [sys.executable, "-P", "-m", module, str(os.getpid())], stdin=subprocess.DEVNULL
    )


def main() -> None:
    """Compile kernels into the cache."""
    end_with_parent(int(sys.argv[1]))
    gc.disable()  # compiling makes many objects and little garbage: collecting it takes an eighth of the time
    from starid.identification.geometric.identifier import Identifier
    from starid.imaging import pairs

    pairs.warm_up()
    Identifier().warm_up()


if __name__ == "__main__":
    main()
