"""Options and arguments that several commands of `starhil` share."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from starhil.protocol.files.bundled import Kind, bundled, bundled_units, find_unit
from starid.cli.options import one_of
from starid.cli.output import output_help


def names_of(kind: Kind) -> Callable[[str], list[str]]:
    """Return a function that completes the names of what ships with the package."""
    return lambda incomplete: [name for name in bundled(kind) if name.startswith(incomplete)]


def list_option(*kinds: Kind) -> Any:
    """Return an option that lists what ships with the package, by name with a description, and exits."""

    def show(asked: bool) -> None:
        if not asked:
            return
        for kind in kinds:
            print(f"{kind}s:")
            found = bundled(kind)
            width = max(map(len, found))
            for name, path in found.items():
                print(f"  {name:<{width}}  {_description(path.read_text(encoding='utf-8'))}")
        raise typer.Exit

    what = " and ".join(f"{kind}s" for kind in kinds)
    return typer.Option("--list", help=f"List the bundled {what} and exit.", callback=show, is_eager=True)


def _description(text: str) -> str:
    """Return the title of a TOML file, or the first sentence of the comment at its beginning."""
    comment = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.lstrip("# "))
    return " ".join(comment).partition(". ")[0].rstrip(".") or str(tomllib.loads(text)["title"])


ProfileArgument: TypeAlias = Annotated[
    str | None,
    typer.Argument(
        help="Device profile: a name or a TOML file.",
        show_default="cubestar",
        autocompletion=names_of("profile"),
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a key of the profile: section.key=value. Repeatable."),
]
OrbitChoice: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--orbit",
        help="Orbit with date, Sun, Moon, Earth, aberration, radiation and temperature: leo, or a TOML file with sections of a profile.",
        show_default="the profile's; most have none",
        autocompletion=names_of("orbit"),
    ),
]
SerialDialect: TypeAlias = Annotated[
    str | None,
    typer.Option("--dialect", help="Format of serial replies, if the unit has several: a, b (default) or c."),
]
DeviceAddress: TypeAlias = Annotated[int, typer.Option("--device-address", help="CAN address of the device.")]
_UNIT = "Interface of the device: name of a bundled unit, or a folder of TOML files."
Unit: TypeAlias = Annotated[str, typer.Option("--unit", help=_UNIT, autocompletion=names_of("unit"))]
UnitChoice: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--unit", help=_UNIT + " Default: the profile's (cubestar).", autocompletion=names_of("unit")
    ),
]
Seed: TypeAlias = Annotated[int, typer.Option("--seed", min=0, help="Random seed.")]
Jobs: TypeAlias = Annotated[int, typer.Option("--jobs", min=1, help="Number of processes.")]


def with_orbit(settings: list[str] | None, orbit: str | None) -> list[str]:
    """Return the settings of a profile with those of `--orbit`."""
    return [*([] if orbit is None else [f"orbit={orbit}"]), *(settings or ())]


def absolute_unit(unit: str) -> str:
    """Return a unit from the command line, a folder as an absolute path; a profile would resolve it differently."""
    return unit if unit in bundled_units() else str(find_unit(unit).absolute())


def as_toml(value: str | float) -> str:
    """Return a value in TOML, for `--set`."""
    if isinstance(value, (int, float)):
        return str(value)
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


DIALECTS = ("a", "b", "c")


def checked_dialect(dialect: str | None) -> str | None:
    """Return the value of `--dialect`, which must be one of `DIALECTS` if it is given."""
    return None if dialect is None else one_of("--dialect", dialect, DIALECTS)


@dataclass(frozen=True)
class BenchOptions:
    """A device on its links, which the bench tests, or the emulator that it starts for this."""

    unit: UnitChoice = None
    serial: Annotated[
        str | None, typer.Option(help="Serial port: /dev/…, socket://HOST:PORT, auto with --start, or off.")
    ] = None
    can: Annotated[
        str | None,
        typer.Option(
            help="CAN channel: vcan0, socketcand:127.0.0.1:29536/vcan0, …, auto with --start, or off."
        ),
    ] = None
    dialect: SerialDialect = None
    host_address: Annotated[int, typer.Option(help="CAN address of the OBC.")] = 1
    device_address: DeviceAddress = 4
    start: Annotated[bool, typer.Option("--start", help="Start the emulator for this run.")] = False
    profile: Annotated[
        str | None,
        typer.Option(
            help="With --start: device profile, instead of the session's or cubestar.",
            autocompletion=names_of("profile"),
        ),
    ] = None
    junit: Annotated[Path | None, typer.Option(help=output_help("Write a JUnit XML file."))] = None
    view: Annotated[
        str | None,
        typer.Option(
            metavar="[ADDRESS]",
            help="Show the results on a console as they arrive. ADDRESS is on the ready line of `starhil run --view`; "
            "default with --start: the started emulator's console.",
        ),
    ] = None
