"""The `starhil` command: assembles the sub-commands and turns errors into one line and an exit status."""

from __future__ import annotations

import importlib
import sys
from typing import Final

import typer

from emulator.errors import EmulatorError
from hil_tests.errors import BenchError
from protocol.errors import ProtocolError
from starid.errors import StaridError

EXIT_BAD_INPUT: Final = 2
"""Exit status for input that is refused; 1 says that all worked and that the result is not good."""

COMMANDS: Final[dict[str, str]] = {
    "icd": "icd",
    "run": "run",
    "bench": "bench",
    "render": "render",
    "identify": "identify",
    "campaign": "campaign",
    "catalog": "catalog",
    "calibrate": "calibrate",
    "session": "session",
    "conformance": "conformance",
    "hub": "hub",
    "features": "features",
    "database": "database",
    "reproduce": "reproduce",
}
"""Sub-command → module under `emulator.cli`: its `command` function, or its `group` of sub-commands.

These modules import at the top only what is quick; numerics come in inside the function.
"""


def build_app() -> typer.Typer:
    """Assemble the command line from the modules named in `COMMANDS`."""
    app = typer.Typer(
        name="starhil",
        help="Star-sensor emulator for hardware-in-the-loop tests: real sky in, attitude on the bus out.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    for name, module_name in COMMANDS.items():
        module = importlib.import_module(f"emulator.cli.{module_name}")
        if hasattr(module, "group"):
            app.add_typer(module.group, name=name)
        else:
            app.command(name)(module.command)
    return app


def describe_os_error(error: OSError) -> str:
    """One line, `path: reason`, for what the operating system refused and no command has put into its own words."""
    reason = error.strerror or str(error) or type(error).__name__
    paths = [str(path) for path in (error.filename, error.filename2) if path is not None]
    return " ".join(": ".join([" -> ".join(paths), reason] if paths else [reason]).split())


def main() -> None:
    """Run the command line; refused input ends in one line on stderr and exit status 2."""
    try:
        build_app()()
    except (StaridError, ProtocolError, EmulatorError, BenchError) as error:
        print(f"starhil: {error}", file=sys.stderr)
        raise SystemExit(EXIT_BAD_INPUT) from None
    except OSError as error:
        print(f"starhil: {describe_os_error(error)}", file=sys.stderr)
        raise SystemExit(EXIT_BAD_INPUT) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
