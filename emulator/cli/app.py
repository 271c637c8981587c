"""The `starhil` command: assembles the sub-commands and turns errors into one line and an exit status."""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import sys
from typing import Annotated, Any, Final, NoReturn

import typer
from typer.core import TyperCommand

from starhil.emulator.cli.output import show_every_character
from starhil.emulator.errors import EmulatorError
from starhil.emulator.validation_messages import plain
from starhil.hil_tests.errors import BenchError
from starhil.protocol.errors import ProtocolError
from starid.errors import StaridError

EXIT_BAD_INPUT: Final = 2
"""Exit status for input that is refused; 1 says that all worked and that the result is not good."""

EXIT_INTERRUPTED: Final = 130
"""Exit status after Ctrl-C, as of shells."""

USAGE_ERROR: Final[type[Exception]] = typer.BadParameter.__mro__[1]
"""What a refused option or argument raises; which library it is of depends on the version of typer."""

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
    "cache": "cache",
}
"""Sub-command → module under `starhil.emulator.cli`: its `command` function, or its `group` of sub-commands.

These modules import at the top only what is quick; numerics come in inside the function.
"""


def _print_version(value: bool) -> None:
    if value:
        print(f"starhil {importlib.metadata.version('starhil')}")
        raise typer.Exit


class FiniteCommand(TyperCommand):
    """A command none of whose options is infinite or no number at all: nan lies within every bound."""

    def invoke(self, ctx: Any) -> Any:
        """Call the command with its options.

        Raises
        ------
        typer.BadParameter
            An option is not finite.
        """
        params: list[Any] = list(self.params)
        for param in params:
            value = ctx.params.get(param.name)
            values = value if isinstance(value, (list, tuple)) else (value,)
            if not all(math.isfinite(each) for each in values if isinstance(each, float)):
                raise typer.BadParameter("must be finite", ctx=ctx, param=param)
        return super().invoke(ctx)


def build_app() -> typer.Typer:
    """Assemble the command line from the modules named in `COMMANDS`."""
    app = typer.Typer(
        name="starhil",
        help="Star-sensor emulator for hardware-in-the-loop tests: real sky in, attitude on the bus out.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    for name, module_name in COMMANDS.items():
        module = importlib.import_module(f"starhil.emulator.cli.{module_name}")
        if hasattr(module, "group"):
            for each in module.group.registered_commands:
                each.cls = FiniteCommand
            app.add_typer(module.group, name=name)
        else:
            app.command(name, cls=FiniteCommand)(module.command)
    return app


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Options of the command itself."""


def describe_os_error(error: OSError) -> str:
    """One line, `path: reason`, for what the operating system refused and no command has put into its own words."""
    reason = error.strerror or str(error) or type(error).__name__
    paths = [str(path) for path in (error.filename, error.filename2) if path is not None]
    return " ".join(": ".join([" -> ".join(paths), reason] if paths else [reason]).split())


def describe_refusal(error: Any) -> str:
    """One line, `command: what is wrong; see its --help`, for an option or argument that was refused."""
    path = "" if error.ctx is None else str(error.ctx.command_path)
    command = path.removeprefix("starhil").strip()
    what, value, why = str(error.format_message()).partition("': ")
    said = " ".join(f"{plain(what)}{value}{plain(why)}".split()).rstrip(".")
    help_of = f"starhil {command}".strip()
    return f"{f'{command}: ' if command else ''}{said} (see {help_of} --help)"


def main() -> None:
    """Run the command line; refused input ends in one line on stderr and exit status 2."""
    show_every_character()
    try:
        status = build_app()(prog_name="starhil", standalone_mode=False)
    except (StaridError, ProtocolError, EmulatorError, BenchError) as error:
        refuse(str(error))
    except OSError as error:
        refuse(describe_os_error(error))
    except MemoryError as error:
        refuse(f"not enough memory: {error}" if str(error) else "not enough memory")
    except (KeyboardInterrupt, typer.Abort):
        raise SystemExit(EXIT_INTERRUPTED) from None
    except USAGE_ERROR as error:
        if (
            type(error).__name__ == "NoArgsIsHelpError"
        ):  # its message is the help, which is on the screen already
            raise SystemExit(EXIT_BAD_INPUT) from None
        refuse(describe_refusal(error))
    raise SystemExit(status if isinstance(status, int) else 0)


def refuse(why: str) -> NoReturn:
    """End for bad input: one line on stderr."""
    print(f"starhil: {' '.join(why.split())}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_INPUT) from None
