"""What the star identifiers of this package share: one camera, one catalogue, checked detections, and the time taken."""

from __future__ import annotations

import dataclasses
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import ArrayLike

from starid.arrays import Array
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.solution import Solution
from starid.solver_input import checked_detections


@dataclass(frozen=True, slots=True)
class Measured:
    """The checked detections of one image.

    Attributes
    ----------
    xy : ndarray (n, 2)
        Positions, pixels.
    flux : ndarray (n,)
        Brightness in any linear unit.
    sigmas : ndarray (n, 2)
        One-sigma errors of the positions, pixels; ones where none were given.
    sigmas_known : bool
        Whether they were given.
    observer_velocity : array (3,), optional
        As in `starid.interface.StarIdentifier.identify`.
    """

    xy: Array
    flux: Array
    sigmas: Array
    sigmas_known: bool
    observer_velocity: ArrayLike | None

    @property
    def given_sigmas(self) -> Array | None:
        """The errors, None where none were given."""
        return self.sigmas if self.sigmas_known else None

    @classmethod
    def of(
        cls,
        xy_px: ArrayLike,
        flux: ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> Measured:
        """Check detections as `starid.solver_input.checked_detections` does."""
        checked = checked_detections(xy_px, flux, xy_sigma_px)
        return cls(*checked, xy_sigma_px is not None, observer_velocity)


class SingleCameraIdentifier(ABC):
    """A star identifier for one camera and one catalogue, as `starid.interface.StarIdentifier` describes it.

    A solver derives from this class and finds attitudes in `_identify` and `_track`.
    """

    def __init__(self, camera: Camera, catalog: StarCatalog | None) -> None:
        self._camera = camera
        self._catalog = load_catalog() if catalog is None else catalog

    @property
    def camera(self) -> Camera:
        """The camera that the positions belong to."""
        return self._camera

    @property
    def catalog(self) -> StarCatalog:
        """The catalogue whose rows `Solution.catalog_index` refers to."""
        return self._catalog

    def identify(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Find the attitude without any prior knowledge (lost in space).

        Parameters
        ----------
        xy_px, flux, xy_sigma_px, observer_velocity
            As in `starid.interface.StarIdentifier.identify`.

        Raises
        ------
        StaridError
            The shapes of the arrays disagree, or a value is not finite.
        """
        begin = time.perf_counter()
        solution = self._identify(Measured.of(xy_px, flux, xy_sigma_px, observer_velocity))
        return dataclasses.replace(solution, elapsed=time.perf_counter() - begin)

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
        """Find the attitude near a predicted one; invalid, with the reason, where verification fails.

        Parameters
        ----------
        xy_px, flux, predicted, xy_sigma_px, window_px, observer_velocity
            As in `starid.interface.StarIdentifier.track`.

        Raises
        ------
        StaridError
            As in `identify`, or the window is not positive.
        """
        return near(xy_px, flux, predicted, xy_sigma_px, window_px, observer_velocity, self._track)

    @abstractmethod
    def _identify(self, measured: Measured) -> Solution:
        """Return the attitude found lost in space; its time is not used."""

    @abstractmethod
    def _track(self, measured: Measured, predicted: Attitude, window_px: float | None) -> Solution:
        """Return the attitude found near a predicted one; its time is not used."""


def near(
    xy_px: ArrayLike,
    flux: ArrayLike,
    attitude: Attitude | ArrayLike,
    xy_sigma_px: ArrayLike | None,
    window_px: float | None,
    observer_velocity: ArrayLike | None,
    find: Callable[[Measured, Attitude, float | None], Solution],
) -> Solution:
    """Check detections, attitude and window, find the attitude near the one given, and take the time."""
    begin = time.perf_counter()
    measured = Measured.of(xy_px, flux, xy_sigma_px, observer_velocity)
    if window_px is not None and not 0.0 < window_px < math.inf:
        raise StaridError(f"tracking window_px: must be a positive number of pixels, not {window_px}")
    known = attitude if isinstance(attitude, Attitude) else Attitude.from_quaternion(attitude)
    return dataclasses.replace(find(measured, known, window_px), elapsed=time.perf_counter() - begin)
