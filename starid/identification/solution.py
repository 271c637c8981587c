"""The result of an identification: attitude, matched stars, uncertainty and validity."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.attitude import ARCSEC_PER_RAD, Attitude
from starid.errors import StaridError

if TYPE_CHECKING:  # the process that answers the bus loads no kernels
    from starid.camera import Camera

Mode = Literal["lost_in_space", "tracking"]
Five = tuple[float, float, float, float, float]

_NO_INDEX: Final = np.empty(0, dtype=np.int64)
_NO_HIP: Final = np.empty(0, dtype=np.int32)


class Reason(StrEnum):
    """Why a solution is invalid; `OK` if it is valid."""

    OK = "ok"
    TOO_FEW_STARS = "too_few_stars"
    NO_MATCH = "no_match"
    AMBIGUOUS = "ambiguous"
    RESIDUAL = "residual"
    PREDICTION_LOST = "prediction_lost"
    UNCERTAIN = "uncertain"
    BAD_INPUT = "bad_input"


Search = Literal["lsi", "rsi"]


@dataclass(frozen=True, slots=True)
class FeatureReport:
    """How an algorithm of the thesis found, or did not find, the attitude of one image.

    Attributes
    ----------
    search : {"lsi", "rsi"}
        Where the answer was found: in the whole database, or in the region of search.
    triggered : bool
        The region gave no answer that was good enough, so the whole database was searched (algorithm 3, line 12).
    error_psi : float
        Error ε_ψ of the reconstructed features, normalised units; NaN if there were too few stars.
    cell : int
        Cell of the nearest neighbour, numbered from 0; −1 if there were too few stars.
    weights : int
        Number of cells of the dictionary with a weight other than zero.
    observed, of_cell : tuple of 5 floats
        Normalised features of the image and of the cell.
    region_deg : float
        Side of the region of search, degrees; 0 if there was none.
    region_at_deg : tuple of 2 floats
        Right ascension and declination of its centre, degrees.
    stars : int
        Number of detections used.
    removed_index : tuple of int
        Rows of the detections that the false-star filter removed.
    rotation_deg, translation_deg : float
        Motion of the sky since the previous image: rotation about the boresight, and angle by which the boresight moved; 0
        if unknown.
    refined : bool
        The attitude was refined and verified with matched stars; otherwise it is that of the features alone.
    """

    search: Search
    triggered: bool = False
    error_psi: float = math.nan
    cell: int = -1
    weights: int = 0
    observed: Five = (0.0,) * 5
    of_cell: Five = (0.0,) * 5
    region_deg: float = 0.0
    region_at_deg: tuple[float, float] = (0.0, 0.0)
    stars: int = 0
    removed_index: tuple[int, ...] = ()
    rotation_deg: float = 0.0
    translation_deg: float = 0.0
    refined: bool = False

    @property
    def removed(self) -> int:
        """Number of detections that the false-star filter removed."""
        return len(self.removed_index)


def _nan(*shape: int) -> Array:
    return np.full(shape, math.nan)


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of identifying one set of detections.

    Attributes
    ----------
    valid : bool
        Whether the attitude passed verification. If False, no other field may be used for control.
    reason : Reason
        `ok`, or why there is no attitude.
    quaternion_xyzw : ndarray (4,)
        Scalar-last quaternion that rotates ICRS into the sensor frame; NaN if invalid.
    detection_index, catalog_index : ndarray (m,) int64
        Matched pairs: row of the detections, row of the identifier's `StarCatalog` (the brightest
        member of a group of unresolved catalogue stars).
    hip : ndarray (m,) int32
        Hipparcos numbers of the matched catalogue stars.
    covariance : ndarray (3, 3)
        Covariance of the rotation vector e in the sensor frame, rad²: attitude = ``truth.rotated(e)``.
    freedom : float
        Degrees of freedom from which the scale of the covariance was estimated; NaN if it was not estimated from residuals.
    rms_px : float
        Root mean square distance between matched detections and their predicted positions, pixels.
    sigma_px : float
        Centroid noise per axis on which the covariance is based, pixels: estimated, or from the errors given.
    probability_false : float
        Upper bound on the probability that an agreement this good occurs by chance anywhere in the search.
    elapsed : float
        Time taken, seconds.
    mode : {"lost_in_space", "tracking"}
        The mode in which it was found.
    rate_rad_s : ndarray (3,) or None
        Body rate in the sensor frame, if estimated by a tracker.
    features : FeatureReport or None
        How an algorithm of the thesis worked; None for the others.
    camera : Camera or None
        The camera refined with the matched stars, if the field of view was uncertain.
    """

    valid: bool
    reason: Reason
    quaternion_xyzw: Array = field(default_factory=lambda: _nan(4))
    detection_index: Indices = field(default_factory=_NO_INDEX.copy)
    catalog_index: Indices = field(default_factory=_NO_INDEX.copy)
    hip: Indices32 = field(default_factory=_NO_HIP.copy)
    covariance: Array = field(default_factory=lambda: _nan(3, 3))
    freedom: float = math.nan
    rms_px: float = math.nan
    sigma_px: float = math.nan
    probability_false: float = 1.0
    elapsed: float = 0.0
    mode: Mode = "lost_in_space"
    rate_rad_s: Array | None = None
    camera: Camera | None = None
    features: FeatureReport | None = None

    def __post_init__(self) -> None:
        if self.valid != (self.reason is Reason.OK):
            raise StaridError(f"solution: valid is {self.valid} but the reason is {self.reason.value!r}")

    @classmethod
    def invalid(cls, reason: Reason, *, mode: Mode = "lost_in_space", elapsed: float = 0.0) -> Self:
        """Return an invalid solution with its reason."""
        return cls(valid=False, reason=reason, mode=mode, elapsed=elapsed)

    def timed(self, begin: float) -> Self:
        """Return a copy whose `elapsed` is the time since `begin` (from `time.perf_counter`).

        `dataclasses.replace` would pass every field through the constructor again, which takes a tenth of the
        time of an easy identification.
        """
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__, elapsed=time.perf_counter() - begin)
        return copy

    def __repr__(self) -> str:
        """Return what it says in a few lines, for a notebook."""
        if not self.valid:
            return f"no attitude: {self.reason.value} ({self.mode}, {1e3 * self.elapsed:.1f} ms)"
        attitude = self.attitude
        return (
            f"RA {attitude.ra_deg:.5f}°, Dec {attitude.dec_deg:.5f}°, roll {attitude.roll_deg:.4f}°\n"
            f"quaternion ICRS→sensor, x y z w: {' '.join(f'{part:.9f}' for part in self.quaternion_xyzw)}\n"
            f"1σ {self.cross_boresight_sigma_arcsec:.2f}″ across and {self.roll_sigma_arcsec:.2f}″ about the boresight\n"
            f"{self.star_count} stars matched, rms {self.rms_px:.3f} px; {self.mode}, {1e3 * self.elapsed:.1f} ms\n"
            f"false with a probability below {max(self.probability_false, 1e-300):.1g}"
        )

    @cached_property
    def attitude(self) -> Attitude:
        """The attitude of a valid solution.

        Raises
        ------
        StaridError
            The solution is invalid.
        """
        if not self.valid:
            raise StaridError(f"solution: no attitude, because it is invalid ({self.reason.value})")
        return Attitude(self.quaternion_xyzw)

    @property
    def matches(self) -> Indices:
        """Matched pairs (m, 2): row of the detections, Hipparcos number."""
        return np.column_stack([self.detection_index, self.hip.astype(np.int64)])

    @property
    def star_count(self) -> int:
        """Number of matched stars."""
        return int(self.detection_index.size)

    @property
    def cross_boresight_sigma_arcsec(self) -> float:
        """One-sigma error of the boresight per axis, arcseconds."""
        return math.sqrt(0.5 * float(self.covariance[0, 0] + self.covariance[1, 1])) * ARCSEC_PER_RAD

    @property
    def roll_sigma_arcsec(self) -> float:
        """One-sigma error of the roll, arcseconds."""
        return math.sqrt(float(self.covariance[2, 2])) * ARCSEC_PER_RAD
