"""`starid database`: build and inspect feature databases."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Annotated, TextIO

import typer

from starid.cli.frame_options import (
    Epoch,
    Fov,
    FullField,
    Geometry,
    Kappa,
    KeptStars,
    MagnitudeBand,
    frame_catalog,
    frame_parameters,
)
from starid.cli.options import AsJson
from starid.cli.output import output_help, prepare_output, progress_shown, report_stream

group = typer.Typer(
    help="Build or inspect databases of the LSI and RSI algorithms: feature vectors of overlapping patches of the sky.",
    no_args_is_help=True,
)


@group.command("build")
def build(
    overlap: Annotated[
        float, typer.Option(help="Overlap of neighbouring sky patches in percent, such as 99.5.")
    ],
    geometry: Geometry = "planar",
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help=output_help("File to write; without it, the database is built and discarded."),
        ),
    ] = None,
    kappa: Kappa = None,
    direction: KeptStars = None,
    band: MagnitudeBand = None,
    fov: Fov = None,
    full_field: FullField = False,
    epoch: Epoch = None,
    as_json: AsJson = False,
) -> None:
    """Build a feature database."""
    from starid.identification.thesis.database import build_database
    from starid.identification.thesis.database_file import save_database

    if output is not None:
        prepare_output(output, "-o")
    parameters = frame_parameters(
        geometry,
        fov=fov,
        kappa=kappa,
        direction=direction,
        band=band,
        full_field=full_field,
        overlap_percent=overlap,
    )
    catalog = frame_catalog(geometry, epoch)
    start = time.perf_counter()
    with progress_shown("frames") as show:
        database = build_database(catalog, parameters, progress=show)
    seconds = time.perf_counter() - start
    result: dict[str, object] = {
        "cells": database.cells,
        "bytes_features": database.bytes_features,
        "seconds": round(seconds, 3),
    }
    if output is not None:
        result["bytes_file"] = save_database(database, output)
        result["file"] = str(output)
    _print(result, as_json=as_json, to=report_stream(output))


@group.command("info")
def info(file: Annotated[Path, typer.Argument(help="Database file.")], as_json: AsJson = False) -> None:
    """Verify a database file and show the parameters it was built with."""
    from starid.identification.thesis.database_file import load_database

    database = load_database(file)
    _print(
        {
            "file": str(file),
            "cells": database.cells,
            "bytes_features": database.bytes_features,
            "stars": int(database.sky.stars.shape[0]),
            "catalog": database.catalog_identity,
            **dataclasses.asdict(database.parameters),
            "minimum": database.minimum.tolist(),
            "maximum": database.maximum.tolist(),
        },
        as_json=as_json,
        to=sys.stdout,
    )


def _print(values: dict[str, object], *, as_json: bool, to: TextIO) -> None:
    if as_json:
        to.write(json.dumps(values) + "\n")
        return
    width = max(len(key) for key in values)
    to.writelines(f"{key:<{width}}  {value}\n" for key, value in values.items())
