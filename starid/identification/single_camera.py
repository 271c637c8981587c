"""Base class of the star identifiers: one camera, one catalogue, checked detections, and the time taken."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.identification.solution import Solution

FARTHEST_PX: Final = 1e9
"""Largest coordinate accepted: no image is that large, and squares of positions must not overflow."""


def _numbers(values: ArrayLike, name: str) -> Array:
    """Make a contiguous copy of an array of numbers."""
    try:
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise StaridError(f"detections: {name} must be an array of numbers ({error})") from error


def _magnitudes(xy: Array, brightness: Array) -> tuple[float, float]:
    """Return the root of the sum of squares of each array: infinite or NaN if a value is, or if squares overflow."""
    positions = xy.ravel()
    with np.errstate(over="ignore"):
        return math.sqrt(np.sum(square(positions))), math.sqrt(np.sum(square(brightness)))


def _is_finite(array: Array, magnitude: float) -> bool:
    """Whether all values are finite; fast unless their squares overflow."""
    return math.isfinite(magnitude) or bool(np.isfinite(array).all())


def checked_detections(
    xy_px: ArrayLike, flux: ArrayLike, xy_sigma_px: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """Check detections; return contiguous positions (n, 2), flux (n,) and errors (n, 3), by default ones.

    The errors are as in `CheckedDetections`.

    Raises
    ------
    StaridError
        The shapes of the arrays disagree, a value is not finite, or a position is beyond `FARTHEST_PX`.
    """
    xy, brightness = _numbers(xy_px, "positions"), _numbers(flux, "flux")
    if xy.shape == (0,):
        xy = xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2 or brightness.shape != (len(xy),):
        raise StaridError(
            f"detections: shapes of positions and flux must be (n, 2) and (n,), not {xy.shape} and {brightness.shape}"
        )
    extent, light = _magnitudes(xy, brightness)
    if not (_is_finite(xy, extent) and _is_finite(brightness, light)):
        raise StaridError("detections: positions and flux must be finite numbers")
    if extent > FARTHEST_PX and float(np.abs(xy).max()) > FARTHEST_PX:
        raise StaridError(f"detections: every position must lie within ±{FARTHEST_PX:g} pixels")
    sigmas = np.ones((len(xy), 3))
    sigmas[:, 2] = 0.0
    if xy_sigma_px is not None:
        errors = _numbers(xy_sigma_px, "position errors")
        if errors.shape not in {(len(xy),), xy.shape, (len(xy), 2, 2)}:
            raise StaridError(
                f"detections: shape of the errors of {len(xy)} positions must be (n,), (n, 2) or (n, 2, 2), not {errors.shape}"
            )
        if errors.ndim == 3:
            sigmas[:] = _principal_axes(errors)
        else:
            sigmas[:, :2] = errors if errors.ndim == 2 else errors[:, None]
        if not (np.isfinite(sigmas).all() and (sigmas[:, :2] > 0.0).all()):
            raise StaridError("detections: every position error must be finite and positive")
    return xy, brightness, sigmas


def _principal_axes(covariance: Array) -> Array:
    """Return errors (n, 3), as in `CheckedDetections`, of covariances (n, 2, 2); NaN if one is not positive definite.

    With square roots and divisions alone, so they are equal on every processor.
    """
    xx, yy, xy = covariance[:, 0, 0], covariance[:, 1, 1], 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    length = np.sqrt(half * half + xy * xy)
    sense = np.where(half >= 0.0, 1.0, -1.0)
    with np.errstate(invalid="ignore"):
        first, second = np.sqrt(middle + sense * length), np.sqrt(middle - sense * length)
        slope = np.where(length > 0.0, sense * xy / (length + np.abs(half)), 0.0)
    return np.column_stack([first, second, slope])


class CheckedDetections(NamedTuple):
    """The checked detections of one image.

    Attributes
    ----------
    xy : ndarray (n, 2)
        Positions, pixels.
    flux : ndarray (n,)
        Flux in any linear unit.
    sigmas : ndarray (n, 3)
        One-sigma errors of the positions along two perpendicular axes, pixels, and the slope dy/dx of the first; ones along
        x and y if none were given.
    sigmas_known : bool
        Whether errors were given.
    observer_velocity : array (3,), optional
        See `starid.identification.star_identifier.StarIdentifier.identify`.
    """

    xy: Array
    flux: Array
    sigmas: Array
    sigmas_known: bool
    observer_velocity: ArrayLike | None

    @property
    def given_sigmas(self) -> Array | None:
        """The errors as given to an identifier, (n, 2) or (n, 2, 2); None if none were given."""
        if not self.sigmas_known:
            return None
        slope = self.sigmas[:, 2]
        if not slope.any():
            return np.ascontiguousarray(self.sigmas[:, :2])
        first, second = square(self.sigmas[:, :2].T) / (1.0 + slope * slope)
        xx, yy, xy = first + second * square(slope), first * square(slope) + second, (first - second) * slope
        return np.asarray(np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2))

    @classmethod
    def of(
        cls,
        xy_px: ArrayLike,
        flux: ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> CheckedDetections:
        """Check detections with `starid.identification.single_camera.checked_detections`."""
        checked = checked_detections(xy_px, flux, xy_sigma_px)
        return cls(*checked, xy_sigma_px is not None, observer_velocity)


class SingleCameraIdentifier(ABC):
    """A star identifier for one camera and one catalogue (see `starid.identification.star_identifier.StarIdentifier`).

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
