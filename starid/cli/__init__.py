"""The command `starid`; `main` is its entry point."""

from __future__ import annotations


def main() -> None:
    """Run the command line; Ctrl-C during imports ends it without a traceback."""
    try:
        from starid.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
