"""`starid annotate`: an image with its stars marked and named."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starid.cli.identify import ANY_FIELD, TIME_LIMIT_S
from starid.cli.identify import command as identify
from starid.cli.options import AsJson
from starid.cli.output import output_help


def command(
    image: Annotated[Path, typer.Argument(help="PNG, TIFF, JPEG or BMP, 8 or 16 bits, grey or colour.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help=output_help("Image to write: .png, .tiff, .jpg or .bmp."))
    ],
    profile: Annotated[
        str | None, typer.Option(help="Device or camera profile with the camera, instead of --fov.")
    ] = None,
    fov: Annotated[
        str,
        typer.Option(metavar="DEGREES|auto", help="Rough horizontal field of view, edge to edge, degrees."),
    ] = ANY_FIELD,
    time_limit: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="Give up after this time; 0 for no limit.")
    ] = TIME_LIMIT_S,
    as_json: AsJson = False,
) -> None:
    """Identify the stars in a photograph of any camera and write it with the stars circled and the bright ones named.

    This is `starid identify -o` without the options that matter for the attitude only. The exit status is
    1 if the stars cannot be identified; detections are then marked as unidentified.
    """
    identify(
        image,
        profile=profile,
        fov=None if profile else fov,
        time_limit=time_limit,
        allow_colour=True,
        output=output,
        as_json=as_json,
    )
