"""`starhil replay`: replay a recorded run and compare."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.options import OrbitChoice, Settings, absolute_unit, as_toml, names_of, with_orbit
from starhil.emulator.cli.output import compiles, writing
from starhil.emulator.errors import EmulatorError
from starid.cli.options import AsJson
from starid.cli.output import Column, output_help, prepare_output, print_table


def _columns() -> Sequence[Column]:
    from starhil.emulator.links.traffic import short

    return (
        ("link", lambda item: item.link),
        ("row", lambda item: item.row),
        ("field", lambda item: item.field),
        ("messages that differ", lambda item: f"{item.differ} of {item.messages}"),
        (
            "largest difference",
            lambda item: "" if item.largest is None else f"{short(item.largest)} {item.unit}".rstrip(),
        ),
        ("first at, s", lambda item: f"{item.first_s:.3f}"),
        ("recorded", lambda item: short(item.recorded)),
        ("now", lambda item: short(item.now)),
    )


@compiles
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
    csv_file: Annotated[
        Path | None,
        typer.Option("--csv", help=output_help("CSV file of the fields that differ, as in the table.")),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Replay a recorded run on the stepped clock and compare everything that the device sends and measures.

    A recording contains its profile; --set and --orbit change it, or the one given by --profile. If messages differ, a
    table lists their fields: in how many messages, by how much, and when first. The exit status is 0 if all bytes are
    identical, 1 if anything differs or is missing, and 2 if the recording cannot be played.
    """
    import asyncio

    from starhil.emulator.launch.replay import replay
    from starhil.emulator.launch.replay_fields import as_csv
    from starhil.emulator.links.table import LINKS
    from starhil.emulator.profile import load_profile
    from starid.storage.files import write_atomically

    settings = with_orbit(overrides, orbit)
    for setting in settings:
        key = setting.partition("=")[0].strip()
        if key.startswith(("run.", "links.")) and key != "run.algorithm":
            raise EmulatorError(
                f"--set {setting}: a replay has `links` and `run`, except the algorithm, as recorded"
            )
    if csv_file is not None:
        prepare_output(csv_file, "--csv", folder.glob("*"))
    named = None if unit is None else absolute_unit(unit)
    if named is not None:
        settings = [*settings, f"unit={as_toml(named)}"]
    changed = None if profile is None else load_profile(profile, settings)
    report = asyncio.run(replay(folder, changed, named, settings))
    if csv_file is not None:
        with writing(csv_file):
            write_atomically(csv_file, lambda file: file.write_text(as_csv(report.fields), encoding="utf-8"))
    if as_json:
        print(json.dumps(dataclasses.asdict(report), default=bytes.hex))
    else:
        for link, count in report.sent.items():
            print(f"{link}: {count} {'bytes' if LINKS[link].carries is bytes else 'frames'} sent")
        print(f"{report.entries} entries played: {'; '.join(report.differences) or 'identical'}")
        if report.fields:
            print_table(_columns(), report.fields)
    return 1 if report.differences else 0
