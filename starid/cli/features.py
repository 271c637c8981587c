"""`starid features`: the feature vector of a patch of the sky."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Final

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
from starid.errors import StaridError

_KEYS: Final = ("n", "A", "r", "sigma_A", "sigma_r", "theta")


def command(
    ra_corner: Annotated[
        float | None,
        typer.Option(help="Right ascension of the lower-left corner of the patch, degrees (planar)."),
    ] = None,
    dec_corner: Annotated[
        float | None,
        typer.Option(help="Declination of the lower-left corner of the patch, degrees (planar)."),
    ] = None,
    ra: Annotated[
        float | None, typer.Option(help="Right ascension of the centre of the patch, degrees.")
    ] = None,
    dec: Annotated[
        float | None, typer.Option(help="Declination of the centre of the patch, degrees.")
    ] = None,
    kappa: Kappa = None,
    direction: KeptStars = None,
    geometry: Geometry = "planar",
    fov: Fov = None,
    band: MagnitudeBand = None,
    full_field: FullField = False,
    epoch: Epoch = None,
    as_json: AsJson = False,
) -> None:
    """Print the feature vector (n, A, r, sigma_A, sigma_r) and polar angle theta (°) of a patch of the sky."""
    from starid.identification.thesis.database import sky_of

    parameters = frame_parameters(
        geometry, fov=fov, kappa=kappa, direction=direction, band=band, full_field=full_field
    )
    half = 0.5 * parameters.fov_deg
    if (
        ra_corner is not None
        and dec_corner is not None
        and ra is None
        and dec is None
        and geometry == "planar"
    ):
        centre = (ra_corner + half, dec_corner + half)
    elif ra is not None and dec is not None and ra_corner is None and dec_corner is None:
        centre = (ra, dec)
    else:
        raise StaridError(
            "features: give --ra and --dec of the centre, or (planar) --ra-corner and --dec-corner"
        )
    if not -360.0 <= centre[0] <= 360.0:
        raise StaridError(
            f"features: right ascension of the frame's centre must be −360° to 360°, not {centre[0]:g}°"
        )
    if not -90.0 <= centre[1] <= 90.0:
        raise StaridError(
            f"features: declination of the frame's centre must be −90° to 90°, not {centre[1]}°"
        )
    vector = sky_of(frame_catalog(geometry, epoch), parameters).features(centre[0] % 360.0, centre[1])
    values = (vector.n, vector.A, vector.r, vector.sigma_A, vector.sigma_r, vector.theta_deg)
    if as_json:
        result = {key: round(value, 6) for key, value in zip(_KEYS, values, strict=True)}
        sys.stdout.write(json.dumps(result) + "\n")
        return
    unit = "px" if geometry == "spherical" else "°"
    sys.stdout.write(
        f"n        {vector.n}\nA        {vector.A:.2f} mag\nr        {vector.r:.2f} {unit}\n"
        f"sigma_A  {vector.sigma_A:.2f} mag\nsigma_r  {vector.sigma_r:.2f} {unit}\ntheta    {vector.theta_deg:.2f}°\n"
    )
