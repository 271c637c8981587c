"""Frame parameters and catalogue from the options of `features` and `database`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from starid.cli.options import one_of
from starid.errors import StaridError

if TYPE_CHECKING:
    from starid.catalog import Band, StarCatalog
    from starid.thesis.database import DatabaseParameters
    from starid.thesis.frame_sky import Direction

PLANAR_EPOCH: Final = 1991.25
"""Epoch of the catalogue; the published results ignore proper motion."""

SPHERICAL_EPOCH: Final = 2026.0

_WIDEST_FRAME_DEG: Final = 120.0
_PLANAR_FOV_DEG: Final = 40.0
_SPHERICAL_FOV_DEG: Final = 42.0


def frame_parameters(
    geometry: str,
    *,
    fov: float | None,
    kappa: float,
    direction: str,
    band: str,
    full_field: bool,
    overlap_percent: float = 99.0,
) -> DatabaseParameters:
    """Return frame parameters from command-line options."""
    from starid.camera import Camera
    from starid.thesis.database import DatabaseParameters

    side = cast("Direction", one_of("--direction", direction, ("faintest", "brightest")))
    magnitude = cast("Band", one_of("--band", band, ("hp", "v")))
    if not 1.0 < overlap_percent < 100.0:
        raise StaridError(
            f"--overlap {overlap_percent}: must be a percentage between 1 and 100, such as 99.5"
        )
    if fov is not None and not 0.0 < fov <= _WIDEST_FRAME_DEG:
        raise StaridError(
            f"--fov {fov:g}: must be above 0 and at most {_WIDEST_FRAME_DEG:g} degrees, such as 40"
        )
    overlap = overlap_percent / 100.0
    if one_of("--geometry", geometry, ("planar", "spherical")) == "planar":
        width = _PLANAR_FOV_DEG if fov is None else fov
        return DatabaseParameters("planar", overlap, width, kappa, side, magnitude, full_field)
    camera = Camera.from_fov(_SPHERICAL_FOV_DEG if fov is None else fov)
    return DatabaseParameters.for_camera(
        camera, overlap=overlap, kappa=kappa, direction=side, band=magnitude, full_field=full_field
    )


def frame_catalog(geometry: str, epoch: float | None) -> StarCatalog:
    """Load the catalogue at an epoch; the default depends on the geometry."""
    from starid.catalog import load_catalog

    default = PLANAR_EPOCH if geometry == "planar" else SPHERICAL_EPOCH
    return load_catalog(epoch=default if epoch is None else epoch)
