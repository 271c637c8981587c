"""The command line of the product; `main` is its entry."""

from __future__ import annotations


def main() -> None:
    """Run the command line; Ctrl-C while it is still being imported ends it without a traceback."""
    try:
        from emulator.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
