"""The frame object of the thesis: five features and an angle of the stars in a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import atan2, cos, sin
from starid.errors import StaridError
from starid.kernels.jit import compiled, inner_checked

FEATURE_COUNT: Final = 5
"""Number of components of a feature vector; the polar angle is separate."""

SUM_COUNT: Final = 8
"""Length of the accumulator of `add_star`."""


class FeatureError(StaridError):
    """Stars from which no feature vector can be computed."""


@dataclass(frozen=True, slots=True)
class FeatureVector:
    """The feature vector of one frame: the database vector τ and the observation vector ψ of eq. 2.10.

    Attributes
    ----------
    n
        Number of stars in the frame, eq. 2.2.
    A
        Mean brightness in magnitudes, eq. 2.3.
    r
        Distance of the frame object from the centre of the frame, in the unit of the offsets, eq. 2.4.
    sigma_A
        Standard deviation of the brightness in magnitudes (0 for a single star).
    sigma_r
        Standard deviation of the stars' distances from the centre (0 for a single star).
    theta_rad
        Polar angle of the frame object from the +x axis towards +y, −π … π.
    x, y
        The frame object itself, in the unit of the offsets.
    """

    n: int
    A: float
    r: float
    sigma_A: float  # noqa: N815 - the thesis's symbol
    sigma_r: float
    theta_rad: float
    x: float
    y: float

    @property
    def theta_deg(self) -> float:
        """Polar angle in degrees, −180 … 180."""
        return math.degrees(self.theta_rad)

    @property
    def vector(self) -> Array:
        """The five features n, A, r, σ_A, σ_r, (5,)."""
        return np.array([self.n, self.A, self.r, self.sigma_A, self.sigma_r], dtype=np.float64)


@inner_checked
def clear_sums(sums: Array) -> None:
    """Clear the accumulator of one frame, (8,)."""
    for i in range(SUM_COUNT):
        sums[i] = 0.0


@inner_checked
def add_star(sums: Array, brightness: float, x: float, y: float, pivot: float) -> None:
    """Add a star to the accumulator; `pivot`, a brightness near the mean, avoids cancellation."""
    q = x * x + y * y
    da = brightness - pivot
    sums[0] += 1.0
    sums[1] += da
    sums[2] += da * da
    sums[3] += brightness * x
    sums[4] += brightness * y
    sums[5] += math.sqrt(q)
    sums[6] += q
    sums[7] += brightness


@inner_checked
def finish_features(sums: Array, pivot: float, out: Array) -> float:
    """Convert an accumulator to the five features in `out`; return the polar angle in radians.

    The frame object is X = Σ a·x / Σ a and Y = Σ a·y / Σ a; eq. 2.5 is printed with a division by n, but the
    published numbers were computed with the weighted mean. The deviations are σ_A, eq. 2.6, about the mean
    brightness μ_A, eq. 2.7, and σ_r, eq. 2.8, about the mean distance μ_r, eq. 2.9: square roots of the
    variances over n − 1 (the thesis prints the variances over n). An accumulator without stars gives zeros.
    """
    n = sums[0]
    if n < 1.0:
        for i in range(FEATURE_COUNT):
            out[i] = 0.0
        return 0.0
    mean_difference = sums[1] / n
    total = sums[7]
    x = 0.0
    y = 0.0
    if total != 0.0:
        x = sums[3] / total
        y = sums[4] / total
    out[0] = n
    out[1] = pivot + mean_difference
    out[2] = math.sqrt(x * x + y * y)
    out[3] = 0.0
    out[4] = 0.0
    if n > 1.0:
        out[3] = math.sqrt(max(sums[2] - n * mean_difference * mean_difference, 0.0) / (n - 1.0))
        out[4] = math.sqrt(max(sums[6] - sums[5] * sums[5] / n, 0.0) / (n - 1.0))
    return atan2(y, x)


@compiled
def frame_features(brightness: Array, x: Array, y: Array, out: Array) -> float:
    """Write the features of a list of stars to `out` (5,); return the polar angle in radians."""
    sums = np.zeros(SUM_COUNT)
    pivot = brightness[0] if brightness.size > 0 else 0.0
    for i in range(brightness.size):
        add_star(sums, brightness[i], x[i], y[i], pivot)
    return finish_features(sums, pivot, out)


def extract_features(
    brightness: Array, offsets: Array, *, half_width: float | None = None, full_field: bool = False
) -> FeatureVector:
    """Compute the feature vector of the stars in one frame (function F_ψ of algorithm 1).

    The published worked example, eq. 5.1, has the frame with lower-left corner (95°, −85°): 26 stars,
    A = 11.96, r = 2.95, σ_A = 0.37, σ_r = 5.35.

    Parameters
    ----------
    brightness
        Magnitudes of the stars, (n,).
    offsets
        Positions relative to the centre of the frame, (n, 2), in degrees (flat plane) or pixels.
    half_width
        Half-width of the frame in the unit of the offsets; stars outside are ignored. None uses all stars.
    full_field
        Use the whole square instead of the inscribed circle. The features of a square depend on roll.

    Raises
    ------
    FeatureError
        No star is in the frame, a value is not finite, or the shapes disagree.
    """
    a = np.ascontiguousarray(brightness, dtype=np.float64)
    xy = np.ascontiguousarray(offsets, dtype=np.float64)
    if a.ndim != 1 or xy.shape != (a.size, 2):
        raise FeatureError(
            f"features: {a.shape} brightness values for offsets {xy.shape}; give (n,) and (n, 2)"
        )
    if not (np.isfinite(a).all() and np.isfinite(xy).all()):
        raise FeatureError(
            "features: the brightness or position of a star is not finite; remove such stars first"
        )
    x, y = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
    if half_width is not None:
        keep = (
            np.maximum(abs(x), abs(y)) <= half_width
            if full_field
            else x * x + y * y <= half_width * half_width
        )
        a, x, y = a[keep], x[keep], y[keep]
    if a.size == 0:
        raise FeatureError("features: no star in the frame; check the pointing and the brightness limit")
    out = np.empty(FEATURE_COUNT)
    return feature_vector(out, float(frame_features(a, x, y, out)))


def feature_vector(numbers: Array, theta_rad: float) -> FeatureVector:
    """Make a feature vector from the output of `finish_features`."""
    n, mean, r, sigma_a, sigma_r = numbers.tolist()
    x, y = r * cos(theta_rad), r * sin(theta_rad)
    return FeatureVector(int(n), mean, r, sigma_a, sigma_r, theta_rad, x, y)
