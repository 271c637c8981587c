"""The interface of all star identifiers, and a factory that makes one by name."""

from __future__ import annotations

import importlib
from typing import Any, Protocol, cast, runtime_checkable

from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.options import ALGORITHMS
from starid.identification.solution import Solution


@runtime_checkable
class StarIdentifier(Protocol):
    """A star identifier: detections in, verified attitude out."""

    @property
    def camera(self) -> Camera:
        """The camera of the positions."""
        ...

    @property
    def catalog(self) -> StarCatalog:
        """The catalogue to whose rows `Solution.catalog_index` refers."""
        ...

    def identify(
        self,
        xy_px: Array,
        flux: Array,
        xy_sigma_px: Array | None = None,
        *,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Find the attitude without prior knowledge (lost in space).

        Parameters
        ----------
        xy_px : array (n, 2)
            Positions, pixels.
        flux : array (n,)
            Flux in any linear unit.
        xy_sigma_px : array (n,), (n, 2) or (n, 2, 2), optional
            One-sigma error of each position, per star or per axis, pixels, or its covariance, pixels²; by default estimated.
        observer_velocity : array (3,), optional
            Velocity of the camera relative to the barycentre of the solar system, ICRS, m/s. The attitude is
            then corrected for aberration (`starid.catalog.aberration`). By default it is not.
        """
        ...

    def track(
        self,
        xy_px: Array,
        flux: Array,
        predicted: Attitude | Array,
        xy_sigma_px: Array | None = None,
        *,
        window_px: float | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Find the attitude near a predicted one; invalid, with the reason, if verification fails.

        Parameters
        ----------
        xy_px, flux, xy_sigma_px, observer_velocity
            See `identify`.
        predicted : Attitude or array (4,)
            Predicted attitude at the time of the exposure, or its scalar-last quaternion.
        window_px : float, optional
            Largest distance between a star and its predicted position, pixels.
        """
        ...


def make_identifier(
    algorithm: str = "geometric",
    camera: Camera = DEFAULT_CAMERA,
    catalog: StarCatalog | None = None,
    **options: Any,
) -> StarIdentifier:
    """Make a star identifier by name: "geometric", "lsi" or "rsi".

    Parameters
    ----------
    algorithm : str
        One of `ALGORITHMS`.
    camera : Camera
        The camera that took the images.
    catalog : StarCatalog, optional
        By default `load_catalog()`.
    **options
        Fields of the algorithm's options.

    Raises
    ------
    StaridError
        There is no such algorithm.
    """
    if algorithm not in ALGORITHMS:
        raise StaridError(f"algorithm: must be one of {', '.join(ALGORITHMS)}, not {algorithm!r}")
    found = ALGORITHMS[algorithm]
    factory = getattr(importlib.import_module(found.module), found.name)
    return cast("StarIdentifier", factory(camera, catalog, **options))
