"""Light and shadow over areas of an image, and how they are drawn.

Everything is computed for each pixel, some rows at a time, which then stay in the processor's cache. Pixels see only additions,
multiplications, divisions and square roots, which are exact to the last bit on every processor; NumPy's own `exp` and
`arccos` are not, and neither are its products of matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from starid.arithmetic.arrays import Array, Array32
from starid.arithmetic.elementary import square

_BLOCK_PIXELS: Final = 1 << 15
"""Pixels that are computed together: some planes of them fit the processor's cache."""

Image: TypeAlias = Array32

Box: TypeAlias = tuple[int, int, int, int]
"""First row and the one after the last, and so the columns, of part of an image."""


@dataclass(frozen=True)
class Backdrop:
    """An exposure without bodies."""

    still: Image
    """Mean electrons of sky and dark current, (h, w), float32."""
    sensitivity: Image
    """Relative signal of each pixel, (h, w), float32."""
    sky_e_s: float
    """Light of the sky, electrons/s in a pixel of mean sensitivity."""
    exposure_s: float
    min_glare_e: float = 0.0
    """Glare of fewer electrons everywhere is left out."""


@dataclass(frozen=True)
class Glare:
    """Light of one source that the lens scatters, electrons/s in a pixel of mean sensitivity."""

    direction: Array
    """Unit vector (3,) to the source, sensor frame."""
    strength: float
    soft: float
    """The glare is strength/(c² + soft²), or its power 3/2, at the chord c of the angle to the source."""
    nearest: float
    """Smallest chord in the image."""
    cube: bool
    """Whether it falls with the cube of the angle."""

    @property
    def peak_e_s(self) -> float:
        """Upper limit of the glare in the image, electrons/s."""
        chord2 = square(self.nearest) + square(self.soft)
        return self.strength / (chord2 * math.sqrt(chord2) if self.cube else chord2)

    def add_to(self, light: Image, directions: Image) -> None:
        """Add it to the light (h, w) of pixels in directions (3, h, w), in place."""
        chord2 = scalar_products(directions, -2.0 * self.direction)
        chord2 += np.float32(2.0 + square(self.soft))
        if self.cube:
            chord2 *= np.sqrt(chord2)
        light += np.float32(self.strength) / chord2


@dataclass(frozen=True)
class Patch:
    """Light and shadow in part of an image."""

    box: Box
    light: Image
    """Electrons/s in a pixel of mean sensitivity, (h', w'), float32."""
    passed: Image
    """Fraction of the light from behind that is visible, 0…1, (h', w'), float32."""
    hides_glare: bool = True
    """Whether it is in front of the light scattered in the lens too."""

    def seen_at(self, xy_px: Array) -> Array:
        """Return the transmission (n,) of the pixels nearest to positions (n, 2); 1 outside the box."""
        top, bottom, left, right = self.box
        column, row = np.rint(xy_px).astype(np.int64).T
        inside = (top <= row) & (row < bottom) & (left <= column) & (column < right)
        transmission = np.ones(len(xy_px))
        transmission[inside] = self.passed[row[inside] - top, column[inside] - left]
        return transmission

    def cover(self, mean: Image, backdrop: Backdrop) -> None:
        """Put it in front of the mean electrons (h, w), in place."""
        top, bottom, left, right = self.box
        for rows in row_blocks(top, bottom, right - left):
            own = slice(rows.start - top, rows.stop - top)
            part = rows, slice(left, right)
            behind, passed = mean[part], self.passed[own]
            sensed = backdrop.sensitivity[part] * np.float32(backdrop.exposure_s)
            sky = sensed * np.float32(backdrop.sky_e_s)
            if self.hides_glare:
                dark = backdrop.still[part] - sky
                behind -= dark
                behind *= passed
                behind += dark
            else:
                behind -= sky * (np.float32(1.0) - passed)
            behind += sensed * self.light[own]
            np.maximum(behind, np.float32(0.0), out=behind)


@dataclass(frozen=True)
class AreaLight:
    """Light of extended objects, and the fraction of the sky's light that passes them."""

    size: tuple[int, int]
    glare: tuple[Glare, ...] = ()
    directions: Image | None = None
    """Unit vectors (3, h, w) of the pixels, sensor frame, if there is glare."""
    patches: tuple[Patch, ...] = ()
    """What is in front of sky and glare, each in front of those before it."""
    flooded: bool = False
    """Light passes the baffle and saturates the image; the rest is then empty."""

    def seen_at(self, xy_px: Array) -> Array:
        """Return the transmission (n,) at positions (n, 2); outside the image that of its edge."""
        transmission = np.full(len(xy_px), 0.0 if self.flooded else 1.0)
        nearest = np.clip(xy_px, 0.0, np.array(self.size) - 1.0)
        for patch in self.patches:
            transmission *= patch.seen_at(nearest)
        return transmission

    @property
    def covered_share(self) -> float:
        """Fraction of the image that receives less than half of the sky's light."""
        if not self.patches:
            return float(self.flooded)
        passed = np.full(self.size[::-1], 0.0 if self.flooded else 1.0, dtype=np.float32)
        for patch in self.patches:
            top, bottom, left, right = patch.box
            passed[top:bottom, left:right] *= patch.passed
        return float(np.count_nonzero(passed < 0.5) / passed.size)

    def draw(self, mean: Image, backdrop: Backdrop) -> None:
        """Fill the mean electrons (h, w) with the backdrop, and all light and shadow."""
        np.copyto(mean, backdrop.still)
        peak_e = backdrop.exposure_s * math.fsum(glare.peak_e_s for glare in self.glare)
        if self.directions is not None and peak_e > backdrop.min_glare_e:
            for rows in row_blocks(0, *mean.shape):
                light = np.zeros_like(mean[rows])
                for glare in self.glare:
                    glare.add_to(light, self.directions[:, rows])
                light *= np.float32(backdrop.exposure_s)
                light *= backdrop.sensitivity[rows]
                mean[rows] += light
        for patch in self.patches:
            patch.cover(mean, backdrop)


def row_blocks(top: int, bottom: int, width: int) -> Iterator[slice]:
    """Divide rows into blocks of some `_BLOCK_PIXELS` pixels."""
    step = max(_BLOCK_PIXELS // width, 1)
    for begin in range(top, bottom, step):
        yield slice(begin, min(begin + step, bottom))


def scalar_products(directions: Image, vector: Array) -> Image:
    """Scalar products (h, w) of directions (3, h, w) and a vector (3,), by a sum in fixed order."""
    a, b, c = vector.tolist()
    product: Image = directions[0] * np.float32(a)
    product += directions[1] * np.float32(b)
    product += directions[2] * np.float32(c)
    return product
