"""`starhil replay`: replay a recorded run and compare."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.options import OrbitChoice, Settings, absolute_unit, as_toml, names_of, with_orbit
from starid.cli.options import AsJson


def command(
    folder: Annotated[Path, typer.Argument(help="Folder written by `starhil run --record`.")],
    profile: Annotated[
        str | None,
        typer.Option(
            help="Device profile, a name or a TOML file, instead of the one in the recording; its tables `links` and `run`, except the "
            "algorithm, stay as recorded.",
            autocompletion=names_of("profile"),
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            "--unit",
            help="Unit, a name or a folder, instead of the one that the recording or the profile names. A recorded unit with a "
            "Python file is only replayed if you name it.",
            autocompletion=names_of("unit"),
        ),
    ] = None,
    orbit: OrbitChoice = None,
    overrides: Settings = None,
    as_json: AsJson = False,
) -> int:
    """Replay a recorded run on the stepped clock and compare everything that the device sends and measures.

    A recording contains its profile. The exit status is 0 if all bytes are identical, 1 if anything differs or is missing,
    and 2 if the recording cannot be played.
    """
    import asyncio

    from starhil.emulator.errors import EmulatorError
    from starhil.emulator.launch.replay import replay
    from starhil.emulator.links.table import LINKS
    from starhil.emulator.profile import load_profile

    settings = with_orbit(overrides, orbit)
    if settings and profile is None:
        raise EmulatorError("--set and --orbit: change the profile given by --profile; give both")
    named = None if unit is None else absolute_unit(unit)
    if named is not None:
        settings = [*settings, f"unit={as_toml(named)}"]
    changed = None if profile is None else load_profile(profile, settings)
    report = asyncio.run(replay(folder, changed, named))
    if as_json:
        print(json.dumps(dataclasses.asdict(report)))
    else:
        for link, count in report.sent.items():
            print(f"{link}: {count} {'bytes' if LINKS[link].carries is bytes else 'frames'} sent")
        print(f"{report.entries} entries played: {'; '.join(report.differences) or 'identical'}")
    return 1 if report.differences else 0
