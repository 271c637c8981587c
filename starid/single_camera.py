"""Base class of the star identifiers: one camera, one catalogue, checked detections, and the time taken."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from numpy.typing import ArrayLike

from starid.arrays import Array
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.solution import Solution
from starid.solver_input import checked_detections


class CheckedDetections(NamedTuple):
    """The checked detections of one image.

    Attributes
    ----------
    xy : ndarray (n, 2)
        Positions, pixels.
    flux : ndarray (n,)
        Flux in any linear unit.
    sigmas : ndarray (n, 2)
        One-sigma errors of the positions, pixels; ones if none were given.
    sigmas_known : bool
        Whether errors were given.
    observer_velocity : array (3,), optional
        See `starid.interface.StarIdentifier.identify`.
    """

    xy: Array
    flux: Array
    sigmas: Array
    sigmas_known: bool
    observer_velocity: ArrayLike | None

    @property
    def given_sigmas(self) -> Array | None:
        """The errors, or None if none were given."""
        return self.sigmas if self.sigmas_known else None

    @classmethod
    def of(
        cls,
        xy_px: ArrayLike,
        flux: ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> CheckedDetections:
        """Check detections with `starid.solver_input.checked_detections`."""
        checked = checked_detections(xy_px, flux, xy_sigma_px)
        return cls(*checked, xy_sigma_px is not None, observer_velocity)


class SingleCameraIdentifier(ABC):
    """A star identifier for one camera and one catalogue (see `starid.interface.StarIdentifier`).

    Subclasses implement `_identify` and `_track`.
    """

    def __init__(self, camera: Camera, catalog: StarCatalog | None) -> None:
        self._camera = camera
        self._catalog = load_catalog() if catalog is None else catalog

    @property
    def camera(self) -> Camera:
        """The camera of the positions."""
        return self._camera

    @property
    def catalog(self) -> StarCatalog:
        """The catalogue to whose rows `Solution.catalog_index` refers."""
        return self._catalog

    def identify(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Find the attitude without prior knowledge, see `StarIdentifier.identify`.

        Raises
        ------
        StaridError
            The shapes of the arrays disagree, or a value is not finite.
        """
        begin = time.perf_counter()
        solution = self._identify(CheckedDetections.of(xy_px, flux, xy_sigma_px, observer_velocity))
        return solution.timed(begin)

    def track(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        predicted: Attitude | ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        window_px: float | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Find the attitude near a predicted one, see `StarIdentifier.track`.

        Raises
        ------
        StaridError
            See `identify`; also, the window is not positive.
        """
        return near(xy_px, flux, predicted, xy_sigma_px, window_px, observer_velocity, self._track)

    @abstractmethod
    def _identify(self, measured: CheckedDetections) -> Solution:
        """Find the attitude lost in space; `elapsed` of the result is ignored."""

    @abstractmethod
    def _track(self, measured: CheckedDetections, predicted: Attitude, window_px: float | None) -> Solution:
        """Find the attitude near a predicted one; `elapsed` of the result is ignored."""


def near(
    xy_px: ArrayLike,
    flux: ArrayLike,
    attitude: Attitude | ArrayLike,
    xy_sigma_px: ArrayLike | None,
    window_px: float | None,
    observer_velocity: ArrayLike | None,
    find: Callable[[CheckedDetections, Attitude, float | None], Solution],
) -> Solution:
    """Check the input, call `find` with it, and time the call."""
    begin = time.perf_counter()
    measured = CheckedDetections.of(xy_px, flux, xy_sigma_px, observer_velocity)
    if window_px is not None and not 0.0 < window_px < math.inf:
        raise StaridError(f"tracking window_px: must be a positive number of pixels, not {window_px}")
    known = attitude if isinstance(attitude, Attitude) else Attitude.from_quaternion(attitude)
    return find(measured, known, window_px).timed(begin)
