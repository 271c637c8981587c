"""Compile the kernels of the pipeline once, before several test processes need them at the same time."""

from __future__ import annotations

import sys

from starhil.emulator.emulation import pipeline_setup
from starhil.emulator.pipeline.messages import Failure
from starhil.emulator.pipeline.pipeline import make_pipeline
from starhil.emulator.profile import load_profile


def main() -> int:
    """Start the pipeline of the default profile, which compiles its kernels."""
    made = make_pipeline(pipeline_setup(load_profile()))
    if isinstance(made, Failure):
        print(f"compile_kernels: {made.text}", file=sys.stderr)
        return 1
    print(f"kernels ready after {made[1].seconds:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
