"""The command `starid`; `main` is its entry point."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C during imports ends it without a traceback."""
    if sys.maxsize < 2**32:
        raise SystemExit("starid: needs a 64-bit system: x86-64 or arm64")
    try:
        from starid.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
