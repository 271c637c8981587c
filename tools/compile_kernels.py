"""Compile the kernels of the pipeline, on two processors, before several test processes want them at the same time."""

from __future__ import annotations

import sys

from starhil.emulator.emulation import pipeline_setup
from starhil.emulator.pipeline.frames import Failure
from starhil.emulator.pipeline.pipeline import make_picture
from starhil.emulator.profile import Profile


def main() -> int:
    """Make the pipeline of the default profile and solve a frame with it."""
    made = make_picture(pipeline_setup(Profile()))
    if isinstance(made, Failure):
        print(f"compile_kernels: {made.text}", file=sys.stderr)
        return 1
    print(f"kernels ready after {made[1].seconds:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
