"""What `starid` and `starhil` share as commands: sub-commands, and errors as one line with an exit status.

A program is a table of sub-commands, each a module with a function `command` or a `group` of sub-commands. Only the
module of the sub-command that was given is imported (all of them for the help), and these modules import slow
packages inside their functions. An error of the program or of the system, or a
missing optional dependency, ends the program with one line on stderr.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import itertools
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Final, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from starid.cli.output import show_every_character
from starid.errors import StaridError, plain

EXIT_BAD_INPUT: Final = 2
"""Exit status for invalid input; 1 means that the command was carried out with a negative result."""

EXIT_INTERRUPTED: Final = 130
"""Exit status after Ctrl-C, as in shells."""

USAGE_ERROR: Final[type[Exception]] = typer.BadParameter.__mro__[1]
"""Base class of errors about options; which library defines it depends on typer's version."""

EXTRAS: Final = {
    **dict.fromkeys(("fpdf", "joblib", "markdown_it", "matplotlib", "sklearn"), "lab"),
    "mcap": "mcap",
}
"""Package → extra of the installation that brings it."""


_PYTHON_NUMBERS: Final = "starhil.python_numbers"


def _only_python_reads(word: str) -> bool:
    """Return whether an argument is a number with underscores or non-ASCII digits."""
    try:
        float(word)
    except ValueError:
        return False
    return "_" in word or not word.isascii()


OMITTED_VALUE: Final = "auto"
"""Value of an option whose metavar is in brackets (`[HOST:PORT]`) if it is given without one; typer does not support this."""


class _PlainHelp:
    """Help that shows flags without a type, positional arguments in capitals, and paragraphs without the lines of their source."""

    def __init__(self, *arguments: Any, help: str | None = None, **options: Any) -> None:  # noqa: A002 (the name is typer's)
        text = re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.cleandoc(help or ""))
        super().__init__(*arguments, help=text, **options)  # type: ignore[call-arg]

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, each with its metavar for the help."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
            elif param.param_type_name == "argument" and param.metavar is None:
                param.metavar = param.name.rstrip("_").upper()
        return params


class Group(_PlainHelp, TyperGroup):
    """A group of commands."""


class FiniteCommand(_PlainHelp, TyperCommand):
    """A command that rejects infinite numbers, NaN and numbers in Python notation (`1_0`)."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with omitted values of options added."""
        words = [word.rpartition("=")[2] for word in args]
        ctx.meta[_PYTHON_NUMBERS] = {float(word): word for word in words if _only_python_reads(word)}
        optional = {
            name
            for param in self.params
            if param.param_type_name == "option" and (param.metavar or "").startswith("[")
            for name in param.opts
        }
        whole = []
        for argument, after in itertools.pairwise([*args, "--"]):
            whole.append(argument)
            if argument in optional and after.startswith("-"):
                whole.append(OMITTED_VALUE)
        return super().parse_args(ctx, whole)

    def invoke(self, ctx: Any) -> Any:
        """Call the command with its options.

        Raises
        ------
        typer.BadParameter
            A number is not finite, or in Python notation.
        """
        python_numbers = ctx.meta[_PYTHON_NUMBERS]
        params: list[Any] = list(self.params)
        for param in params:
            value = ctx.params.get(param.name)
            values = value if isinstance(value, (list, tuple)) else (value,)
            numbers = [each for each in values if isinstance(each, (int, float))]
            if not all(math.isfinite(each) for each in numbers):
                raise typer.BadParameter("must be finite", ctx=ctx, param=param)
            if word := next((python_numbers[each] for each in numbers if each in python_numbers), None):
                raise typer.BadParameter(f"{word!r} is not a number", ctx=ctx, param=param)
        return super().invoke(ctx)


def _print_version(context: typer.Context, value: bool) -> None:
    if value:
        print(f"{context.info_name} {importlib.metadata.version('starhil')}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Options before the sub-command."""


def build_app(program: str, about: str, modules: Mapping[str, str], words: Sequence[str]) -> typer.Typer:
    """Assemble a command line.

    Parameters
    ----------
    program, about
        Name and one sentence for the help.
    modules
        Sub-command → module.
    words
        Arguments of the program; if they begin with a sub-command, only this one is imported.
    """
    app = typer.Typer(
        name=program,
        cls=Group,
        help=about,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    for name in [word for word in words[:1] if word in modules] or modules:
        module = importlib.import_module(modules[name])
        if hasattr(module, "group"):
            for each in module.group.registered_commands:
                each.cls = FiniteCommand
            app.add_typer(module.group, name=name, cls=Group)
        else:
            app.command(name, cls=FiniteCommand)(module.command)
    return app


def words_to_complete() -> list[str]:
    """Return the arguments that a shell asks to complete, as typer's scripts for bash, zsh and fish hand them over."""
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
    return line.split()[1:]


def describe_os_error(error: OSError) -> str:
    """Return one line, `path: reason`, for an error that was not handled by a command."""
    reason = error.strerror or str(error) or type(error).__name__
    paths = [str(path) for path in (error.filename, error.filename2) if path is not None]
    return " ".join(": ".join([" -> ".join(paths), reason] if paths else [reason]).split())


def describe_usage_error(error: Any, program: str) -> str:
    """Return one line, `command: problem (see … --help)`, for an invalid option or argument."""
    path = "" if error.ctx is None else str(error.ctx.command_path)
    command = path.removeprefix(program).strip()
    what, value, why = str(error.format_message()).partition("': ")
    message = " ".join(f"{plain(what)}{value}{plain(why)}".split()).rstrip(".")
    full_command = f"{program} {command}".strip()
    return f"{f'{command}: ' if command else ''}{message} (see {full_command} --help)"


def run(
    program: str,
    build: Callable[[Sequence[str]], typer.Typer],
    words: Sequence[str],
    errors: tuple[type[Exception], ...] = (StaridError,),
) -> NoReturn:
    """Run a command line and exit; invalid input ends with one line on stderr and exit status 2.

    Parameters
    ----------
    program
        Name of the program.
    build
        Makes the command line for the given arguments.
    words
        Arguments of the program.
    errors
        Errors whose text is one line for the user, or that have several such lines as `problems`.
    """
    show_every_character()
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in (
        "",
        "0",
    ):  # a kernel in Python takes minutes for an image
        exit_for_bad_input(
            program, "NUMBA_DISABLE_JIT is set: images are only made and solved by compiled kernels; unset it"
        )
    try:
        status = build(words or words_to_complete())(
            args=list(words), prog_name=program, standalone_mode=False
        )
    except errors as error:
        exit_for_bad_input(program, *getattr(error, "problems", (str(error),)))
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        if package not in EXTRAS:
            raise
        extra = f"pip install 'starhil[{EXTRAS[package]}]'"
        exit_for_bad_input(program, f"{package} is not installed; run: {extra}")
    except OSError as error:
        exit_for_bad_input(program, describe_os_error(error))
    except MemoryError as error:
        exit_for_bad_input(program, f"not enough memory: {error}" if str(error) else "not enough memory")
    except (KeyboardInterrupt, typer.Abort):
        raise SystemExit(EXIT_INTERRUPTED) from None
    except USAGE_ERROR as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # the help has been printed already
            raise SystemExit(EXIT_BAD_INPUT) from None
        exit_for_bad_input(program, describe_usage_error(error, program))
    raise SystemExit(status if isinstance(status, int) else 0)


def exit_for_bad_input(program: str, *problems: str) -> NoReturn:
    """Print a line for each problem on stderr, with the characters escaped that could control a terminal, and exit."""
    for problem in problems:
        line = " ".join(problem.split())
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
        print(f"{program}: {shown}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_INPUT) from None
