"""The command `starid`; `main` is its entry point."""

from __future__ import annotations

import sys

from starid.errors import StaridError
from starid.storage.working_folder import check_working_folder


def main() -> None:
    """Run the command line; Ctrl-C during imports ends it without a traceback."""
    if sys.maxsize < 2**32:
        raise SystemExit("starid: needs a 64-bit system: x86-64 or arm64")
    try:
        check_working_folder()
    except StaridError as error:
        raise SystemExit(f"starid: {error}") from None
    try:
        from starid.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
