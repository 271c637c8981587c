"""The command line of the product; `main` is its entry."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C while it is still being imported ends it without a traceback."""
    try:
        if sys.argv[1:2] == ["run"] and "--help" not in sys.argv:
            from starhil.emulator.pipeline.worker_process import start_ahead

            start_ahead()  # it takes longest: it imports and warms up while this process does the rest
        from starhil.emulator.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
