"""`starhil truth`: true and measured attitudes in standard files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.output import writing
from starhil.emulator.errors import EmulatorError
from starid.cli.output import output_help

group = typer.Typer(help="Convert true and measured attitudes to standard files.", no_args_is_help=True)


@group.callback()
def _about() -> None:
    """Keep `convert` a sub-command, although it is the only one."""


@group.command()
def convert(
    source: Annotated[
        Path, typer.Argument(help="Truth log, or any file that `truth.path` may name.", show_default=False)
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help=output_help(
                "File to write: a SPICE meta-kernel (.tm, with .bc, .tsc and .tls beside it), or an AEM (any other suffix)."
            ),
        ),
    ],
    measured: Annotated[
        bool,
        typer.Option("--measured", help="Convert the measured attitudes of a truth log, not the true ones."),
    ] = False,
    date: Annotated[
        str | None,
        typer.Option(
            help="Date of time zero in UTC, e.g. 2026-01-01T00:00:00Z. Default: the file's; of a truth log, by the device's clock."
        ),
    ] = None,
    sensor: Annotated[str, typer.Option(help="Name of the sensor's frame in an AEM.")] = "INSTRUMENT_A",
    structure: Annotated[
        int,
        typer.Option(
            max=-1000, help="SPICE's number of the sensor; that of the spacecraft is a thousandth of it."
        ),
    ] = -999_000,
) -> None:
    """Write attitudes as a CCSDS AEM or a SPICE CK."""
    from starhil.emulator.truth.ccsds_file import write_aem
    from starhil.emulator.truth.csv_file import read_log
    from starhil.emulator.truth.file import read_truth_file
    from starhil.emulator.truth.spice_file import write_kernels
    from starid.catalog.earth import unix_time
    from starid.storage.files import write_atomically

    truth = read_log(source, measured=measured) if measured else read_truth_file(source)
    if truth.start_unix_s is None and date is None:
        truth = replace(truth, start_unix_s=read_log(source, measured=measured).start_unix_s)
    if date is not None:
        try:
            truth = replace(truth, start_unix_s=unix_time(date))
        except ValueError as error:
            raise EmulatorError(f"--date {date}: {error}") from None
    with writing(output, (source,)):
        if output.suffix == ".tm":
            write_kernels(truth, output, structure)
        else:
            text = write_aem(truth, sensor)
            write_atomically(output, lambda temporary: temporary.write_text(text, encoding="ascii"))
