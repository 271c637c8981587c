"""Settings of the identification kernels."""

from __future__ import annotations

from typing import Final, Protocol

from starid.arithmetic.arrays import record_type


class Settings(Protocol):
    """Settings of one call, a record of `SETTINGS`.

    Attributes
    ----------
    search_tolerance : float
        Largest error of a triangle's side, radians.
    magnitude_gate : float
        Largest difference between a star's catalogue magnitude and the magnitude from its flux.
    max_triangles : int
        Largest number of triangles of detections looked up.
    scale_tolerance : float
        Relative error of the focal length; 0 if it is known.
    window : float
        First matching window, pixels.
    test_window : float
        Window of the sequential test, radians.
    largest_sigma : float
        Largest centroid noise accepted, pixels per axis.
    log_chance, log_chance_tracking : float
        Logarithm of the largest probability of a false answer, lost in space and near a predicted attitude.
    px_per_rad : float
        Lowest scale in the field, pixels per radian.
    sigmas_known : int
        Not 0 if the caller provides position errors.
    field_px : int
        Number of pixels in the field.
    part_stars : int
        Number of detections, brightest first, that form triangles in each part of the field; 0 for none.
    beta_x, beta_y, beta_z : float
        Velocity of the observer over the speed of light, ICRS; zeros if aberration is not corrected.
    """

    search_tolerance: float
    magnitude_gate: float
    max_triangles: int
    scale_tolerance: float
    window: float
    test_window: float
    largest_sigma: float
    log_chance: float
    log_chance_tracking: float
    px_per_rad: float
    sigmas_known: int
    field_px: int
    part_stars: int
    beta_x: float
    beta_y: float
    beta_z: float


SETTINGS: Final = record_type(Settings)

NOTHING: Final = 0
ACCEPTED: Final = 1
TOO_FEW: Final = 2
