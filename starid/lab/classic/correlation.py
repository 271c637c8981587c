"""CA, the correlation approach.

H. Yoon, Y. Lim, H. Bang, "New Star-Pattern Identification Using a Correlation Approach for Spacecraft Attitude
Determination", Journal of Spacecraft and Rockets 48(1), 182–186, 2011. No published rate was found.

An image is made of each pivot star: the pivot is its centre, its nearest neighbour lies on the horizontal axis, and
every star is a Gaussian whose width follows from the errors of its position. The image of an observed pivot is
correlated with those of the guide stars, and that of the greatest correlation is the pivot.

own choice: the correlation is evaluated in closed form, not on pixels by Fourier transforms. The integral of the
product of two Gaussians of the same width is a Gaussian of their distance, √2 times as wide.
own choice: a width of 0.015 of the pattern radius, of which an error of the aligned neighbour takes the most; pattern
radius and buffer as in `starid.lab.classic.grid`. Brightness gives no weight. The greatest correlation must be worth
at least three coincident stars besides the aligned one.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.grid import BUFFER_SHARE, RADIUS_SHARE
from starid.lab.classic.neighbours import aligned_neighbours, nearest_beyond, neighbour_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

Patterns = tuple[Indices32, Array32, NDArray[np.uint16]]

WIDTH_SHARE: Final = 0.015
"""Standard deviation of a star's Gaussian as a share of the pattern radius."""

MIN_COINCIDENT: Final = 3.0


@compiled_ieee
def _images(patterns: Patterns, buffer: float) -> Array32:
    """Chords and azimuths (m, 2) of the neighbours of all stars, turned; NaN without a neighbour to align with."""
    start, polar, _ = patterns
    images = polar.copy()
    for star in range(start.shape[0] - 1):
        image = images[start[star] : start[star + 1]]
        aligned = nearest_beyond(image, image.shape[0], buffer)
        image[:, 1] -= image[aligned, 1] if aligned >= 0 else np.nan
    return images


@inner
def correlation(image: Array, count: int, other: Array32, width: float) -> float:
    """Correlation of two images, in units of that of one star with itself; both in order of distance."""
    total, first = 0.0, 0
    reach = 6.0 * width
    for i in range(count):
        while first < other.shape[0] and other[first, 0] < image[i, 0] - reach:
            first += 1
        j = first
        while j < other.shape[0] and other[j, 0] <= image[i, 0] + reach:
            apart, turn = image[i, 0] - other[j, 0], image[i, 1] - other[j, 1]
            turns = turn / math.tau
            least_arc = 4.0 * (turns - math.floor(turns + 0.5))  # an arc is at least 2/π of its angle
            sides = image[i, 0] * other[j, 0]
            if apart * apart + sides * least_arc * least_arc < reach * reach:  # few: the others need no sine
                arc = 2.0 * np.sin(0.5 * turn)
                square = apart * apart + sides * arc * arc
                if square < reach * reach:
                    total += np.exp(-square / (4.0 * width * width))
            j += 1
    return total


@compiled_ieee
def _correlate(start: Indices32, images: Array32, directions: Array, radius: float, buffer: float) -> Indices:
    """Find the guide star of each observed star; −1 without a clear winner."""
    n = directions.shape[0]
    image, rows = np.empty((n, 2)), np.empty(n, dtype=np.int64)
    matched = np.full(n, -1, dtype=np.int64)
    for pivot in range(n):
        count, aligned = aligned_neighbours(directions, pivot, radius, buffer, image, rows)
        if aligned < 0:
            continue
        image[:count, 1] -= image[aligned, 1]
        most = 0.0
        for star in range(start.shape[0] - 1):
            value = correlation(image, count, images[start[star] : start[star + 1]], WIDTH_SHARE * radius)
            if value > most:
                most, matched[pivot] = value, star
        if most < MIN_COINCIDENT + 1.0:
            matched[pivot] = -1
    return matched


class CorrelationIdentifier(ClassicIdentifier):
    """The correlation approach behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self._radius
        patterns = neighbour_table(self.guide.vectors, self._radius)
        self.start, self.images = patterns[0], _images(patterns, self._buffer)
        return (self.start, self.images)

    def _match(self, observed: Observed) -> Indices:
        matched = _correlate(self.start, self.images, observed.directions, self._radius, self._buffer)
        rows = np.flatnonzero(matched >= 0)
        return np.column_stack([rows, matched[rows]])
