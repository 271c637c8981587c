"""The star identifiers by name, and their options: plain values, which a program can read and check without loading a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias

from starid.errors import StaridError

Solver = Literal["exact", "matlab", "sklearn"]

WIDEST_TOLERANCE: Final = 0.3
"""Largest relative uncertainty of a focal length."""

REGION_DEG: Final = 2.0
"""Least side of a region of search, degrees."""

LARGEST_ERROR_DEG: Final = 0.1
"""Largest error across or about the boresight that an attitude may have, degrees."""

UNLIMITED_DEG: Final = 180.0
"""The same where any error may remain."""

_TAU_REFINED: Final = 1.0
_TAU_ALONE: Final = 0.5


@dataclass(frozen=True)
class GeometricOptions:
    """Settings of a geometric identifier.

    Attributes
    ----------
    limiting_magnitude
        Faintest V in the index; by default some 200 stars per field, at least V 6.
    fov_tolerance
        Relative uncertainty of the focal length, 0 for a calibrated camera. If not 0, solutions refine it.
    blend_px
        Stars closer than this are merged, pixels.
    largest_error_deg
        Largest error across or about the boresight, degrees: an attitude is invalid if, by its own uncertainty, a larger one is
        likelier than 1e-4 (`starid.identification.error_risk`).
    cache
        Whether the index is kept in the cache folder, or the folder to keep it in.
    """

    limiting_magnitude: float | None = None
    fov_tolerance: float = 0.0
    blend_px: float = 2.0
    largest_error_deg: float = LARGEST_ERROR_DEG
    cache: bool | str | Path = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.fov_tolerance <= WIDEST_TOLERANCE:
            raise StaridError(
                f"identifier fov_tolerance: must be 0…{WIDEST_TOLERANCE:g}, not {self.fov_tolerance}"
            )
        _check_largest_error(self.largest_error_deg)


def _check_largest_error(degrees: float) -> None:
    if not 0.0 < degrees <= UNLIMITED_DEG:
        raise StaridError(
            f"identifier largest_error_deg: must be above 0 and at most {UNLIMITED_DEG:g}, not {degrees}"
        )


@dataclass(frozen=True)
class LsiOptions:
    """Settings of an LSI identifier.

    Attributes
    ----------
    refinement
        Refine and verify the attitude with matched stars. Otherwise it is that of the features alone, to about a degree
        and with the uncertainty of simulated fields (`starid.identification.thesis.feature_error`).
    tau
        Threshold τ on ε_ψ, beyond which the answer from a region of search is not good enough. By default the two of
        the thesis: 1 with refinement, which verifies what it lets pass, and 0.5 without.
    invalid_factor
        Factor K: features with ε_ψ > K·τ give no attitude.
    feature_limit
        Brightness limit κ: faintest magnitude of the stars in the features; default: for ten stars per field, but
        not fainter than `detected_limit`.
    detected_limit
        Magnitude at which the sensor finds 90 % of the stars; a device measures it on its own images. By default all
        stars within the brightness limit are found.
    magnitude_sigma
        One-sigma error of a magnitude at that limit; a device measures it too.
    colour_term
        The sensor's magnitude is V − colour_term·(B−V − 0.65).
    overlap
        Overlap ratio of the database.
    neighbours
        Largest number of neighbours tried by the refinement for each feature vector, nearest first.
    zero_point
        Magnitude of unit flux, if it is known. Otherwise it is learned: each answer determines it, and for
        the next frame that value is tried first, and then guesses from the frame.
    limiting_magnitude
        Faintest V of the verification (see `Identifier`).
    largest_error_deg
        As for a geometric identifier; for refined attitudes only.
    database
        Feature database to use instead of the cached one.
    cache
        Keep the database and the index in the cache folder.
    divided
        If the whole field has no answer, search nine circles of half its width (section 7.2 of the thesis): for a field
        that a body covers in part. Needs a second database, and the refinement.
    solver
        Solver of nearest neighbour and LASSO: "exact", "matlab" or "sklearn" (see `LostInSpace`).
    """

    refinement: bool = True
    tau: float | None = None
    invalid_factor: float = 10.0
    feature_limit: float | None = None
    detected_limit: float | None = None
    magnitude_sigma: float = 0.1
    colour_term: float = 0.0
    overlap: float = 0.99
    neighbours: int = 10_000
    zero_point: float | None = None
    limiting_magnitude: float | None = None
    largest_error_deg: float = LARGEST_ERROR_DEG
    database: str | Path | None = None
    cache: bool = True
    divided: bool = False
    solver: Solver = "exact"

    def __post_init__(self) -> None:
        _check_largest_error(self.largest_error_deg)
        if self.neighbours < 1:
            raise StaridError(f"lsi neighbours: must be at least 1, not {self.neighbours}")
        if not (self.threshold > 0.0 and self.invalid_factor > 0.0):
            raise StaridError(
                f"lsi tau, invalid_factor: must be positive, not {self.tau}, {self.invalid_factor}"
            )
        if self.divided and not self.refinement:
            raise StaridError(
                "lsi divided: needs refinement = true, because only matched stars tell which circle is right"
            )

    @property
    def threshold(self) -> float:
        """The threshold τ on ε_ψ, as given or the default."""
        if self.tau is not None:
            return self.tau
        return _TAU_REFINED if self.refinement else _TAU_ALONE

    @property
    def largest_error_psi(self) -> float:
        """The largest ε_ψ of features that give an attitude, K·τ."""
        return self.invalid_factor * self.threshold


@dataclass(frozen=True)
class RsiOptions(LsiOptions):
    """Settings of an RSI identifier, in addition to those of an LSI identifier.

    Attributes
    ----------
    gamma_min_deg
        Smallest side of the search region, degrees.
    gamma_scale
        Factor by which the side grows with the errors of the motion.
    filter_false_stars
        Follow the detections from frame to frame, and use only true stars for the features.
    position_sigma_px
        One-sigma error of a position per axis, pixels, as assumed by the filter.
    """

    gamma_min_deg: float = REGION_DEG
    gamma_scale: float = 1.0
    filter_false_stars: bool = True
    position_sigma_px: float = 0.5


Options: TypeAlias = GeometricOptions | LsiOptions


class Algorithm(NamedTuple):
    """Where the class of an algorithm is, and the class of its options.

    Attributes
    ----------
    module, name
        Module, which is imported on first use because it has kernels, and name of the class.
    options
        Class of the options.
    """

    module: str
    name: str
    options: type[Options]


ALGORITHMS: Final = {
    "geometric": Algorithm("starid.identification.geometric.identifier", "Identifier", GeometricOptions),
    "lsi": Algorithm("starid.identification.thesis.lsi_identifier", "LsiIdentifier", LsiOptions),
    "rsi": Algorithm("starid.identification.thesis.rsi_identifier", "RsiIdentifier", RsiOptions),
}
"""The algorithms by name."""
