"""Options of `features` and `database` for a patch of the sky, and its parameters and catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final, TypeAlias, cast

import typer

from starid.cli.options import one_of
from starid.errors import StaridError

if TYPE_CHECKING:
    from starid.catalog import Band, StarCatalog
    from starid.identification.thesis.database import DatabaseParameters
    from starid.identification.thesis.frame_sky import Direction

Geometry: TypeAlias = Annotated[
    str,
    typer.Option(
        help="planar (degrees in the flat RA–Dec plane, as in the thesis) or spherical (pixels of a real camera)."
    ),
]
Fov: TypeAlias = Annotated[
    float | None,
    typer.Option(help="Width of a sky patch, degrees; default: 40 planar (as published), 42 spherical."),
]
Kappa: TypeAlias = Annotated[
    float | None, typer.Option(help="Magnitude limit κ; default: 11.5 planar, 5.0 spherical.")
]
KeptStars: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--direction",
        help="Stars kept: faintest (magnitude ≥ κ, as in the thesis) or brightest (magnitude ≤ κ); default: faintest planar, "
        "brightest spherical.",
    ),
]
MagnitudeBand: TypeAlias = Annotated[
    str | None, typer.Option("--band", help="Magnitude band: hp or v; default: hp planar, v spherical.")
]
FullField: TypeAlias = Annotated[
    bool,
    typer.Option("--full-field", help="Square patches instead of circular ones; not roll-invariant."),
]
Epoch: TypeAlias = Annotated[
    float | None,
    typer.Option(help="Epoch of the positions, Julian year; default: 1991.25 planar, 2026 spherical."),
]

PLANAR_EPOCH: Final = 1991.25
"""Epoch of the catalogue; the published results ignore proper motion."""

SPHERICAL_EPOCH: Final = 2026.0

_WIDEST_FRAME_DEG: Final = 120.0
_PLANAR_FOV_DEG: Final = 40.0


def frame_parameters(
    geometry: str,
    *,
    fov: float | None,
    kappa: float | None,
    direction: str | None,
    band: str | None,
    full_field: bool,
    overlap_percent: float = 99.0,
) -> DatabaseParameters:
    """Return frame parameters from command-line options; None stands for the default of the geometry."""
    from starid.camera import Camera
    from starid.identification.thesis.database import DatabaseParameters

    planar = one_of("--geometry", geometry, ("planar", "spherical")) == "planar"
    limit = (11.5 if planar else 5.0) if kappa is None else kappa
    kept = direction or ("faintest" if planar else "brightest")
    side = cast("Direction", one_of("--direction", kept, ("faintest", "brightest")))
    magnitude = cast("Band", one_of("--band", band or ("hp" if planar else "v"), ("hp", "v")))
    if not 1.0 < overlap_percent < 100.0:
        raise StaridError(
            f"--overlap {overlap_percent}: must be a percentage between 1 and 100, such as 99.5"
        )
    if fov is not None and not 0.0 < fov <= _WIDEST_FRAME_DEG:
        raise StaridError(
            f"--fov {fov:g}: must be above 0 and at most {_WIDEST_FRAME_DEG:g} degrees, such as 40"
        )
    overlap = overlap_percent / 100.0
    if planar:
        width = _PLANAR_FOV_DEG if fov is None else fov
        return DatabaseParameters("planar", overlap, width, limit, side, magnitude, full_field)
    camera = Camera.from_fov() if fov is None else Camera.from_fov(fov)
    return DatabaseParameters.for_camera(
        camera, overlap=overlap, kappa=limit, direction=side, band=magnitude, full_field=full_field
    )


def frame_catalog(geometry: str, epoch: float | None) -> StarCatalog:
    """Load the catalogue at an epoch; the default depends on the geometry."""
    from starid.catalog import load_catalog

    default = PLANAR_EPOCH if geometry == "planar" else SPHERICAL_EPOCH
    return load_catalog(epoch=default if epoch is None else epoch)
