"""`starhil fmu`: the star tracker as a Functional Mock-up Unit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from starhil.emulator.cli.options import OrbitChoice, ProfileArgument, with_orbit
from starhil.emulator.cli.output import writing
from starid.cli.options import one_of
from starid.cli.output import output_help

if TYPE_CHECKING:
    from starhil.emulator.cli.fmu.variables import Fmi

group = typer.Typer(help="Export the star tracker as a Functional Mock-up Unit (FMU).", no_args_is_help=True)


@group.command()
def export(
    profile: ProfileArgument = None,
    output: Annotated[Path, typer.Option("--output", "-o", help=output_help("The FMU."))] = Path(
        "startracker.fmu"
    ),
    orbit: OrbitChoice = None,
    fmi: Annotated[str, typer.Option(help="Version of FMI: 3 or 2, which older tools read.")] = "3",
) -> None:
    """Export an FMU for co-simulation, with its binary (Linux x86-64) and its source; this needs a C compiler.

    Where it is simulated, `starhil` must be installed: the FMU starts it.
    """
    from starhil.emulator.cli.fmu.export import export_fmu
    from starhil.emulator.profile import DEFAULT_PROFILE, load_profile
    from starhil.hil_tests.rig.emulator_process import installed_command

    one_of("--fmi", fmi, ("2", "3"))
    name = profile or DEFAULT_PROFILE
    load_profile(name, with_orbit(None, orbit))
    where, around = (
        str(Path(each).absolute()) if each.endswith(".toml") else each for each in (name, orbit or "")
    )
    with writing(output, map(Path, (name, orbit or ""))):
        export_fmu(output, where, around, installed_command(), cast("Fmi", fmi))


@group.command(hidden=True)
def serve() -> None:
    """Run the emulator of an FMU, whose packets are on standard input."""
    from starhil.emulator.cli.fmu.process import serve

    serve()
