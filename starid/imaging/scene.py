"""An image as it is searched: counts, background, and what is known of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices32
from starid.errors import StaridError
from starid.imaging.background import Background


@dataclass(frozen=True)
class DetectionSettings:
    """Known properties of the image, and detection thresholds.

    Attributes
    ----------
    threshold_sigma : float
        Smallest ratio of the smoothed peak to its noise.
    psf_sigma_px : float or None
        Standard deviation of a star's spot, its mean over the image; estimated from the image if None.
    psf_growth : float
        Growth of the spot, relative to that in the centre, up to the middle of an edge; twice as much in the corners.
    gain_e_per_dn : float or None
        Electrons per count; if given, fluxes are in electrons. Otherwise the noise of starlight is estimated from the stars.
    saturation_dn : int or None
        Smallest count of a saturated pixel; if None, the largest value of the image type.
    model_error : float
        Relative error of the model of the spot in a pixel.
    max_stars : int
        Largest number of stars returned, brightest first.
    block_px : int
        Side of the blocks in which the background is estimated.
    follow_trails : bool
        Whether to search for the trails of a rotating sensor.
    blend_px : float
        Stars closer than this are reported as one, at the position where a single spot fits.
    pixel_sigma : float
        Smallest excess over the sky of a lit pixel, in sigmas of the noise.
    min_star_pixels, max_star_pixels : int
        Smallest and largest number of lit pixels of a star; other candidates are rejected.
    """

    threshold_sigma: float = 5.5
    psf_sigma_px: float | None = None
    psf_growth: float = 0.0
    gain_e_per_dn: float | None = None
    saturation_dn: int | None = None
    model_error: float = 0.01
    max_stars: int = 500
    block_px: int = 32
    follow_trails: bool = True
    blend_px: float = 2.0
    pixel_sigma: float = 3.0
    min_star_pixels: int = 1
    max_star_pixels: int = 10000

    def __post_init__(self) -> None:
        ranges = {
            "threshold_sigma": (1.0, 1000.0),
            "psf_sigma_px": (0.3, 12.0),
            "psf_growth": (0.0, 10.0),
            "gain_e_per_dn": (1e-6, 1e9),
            "saturation_dn": (1, 65535),
            "model_error": (0.0, 1.0),
            "max_stars": (1, 5000),
            "block_px": (8, 1024),
            "blend_px": (0.0, 100.0),
            "pixel_sigma": (0.0, 1000.0),
            "min_star_pixels": (0, 1000000),
            "max_star_pixels": (1, 1000000),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise StaridError(f"detection {name}: must be {low:g}…{high:g}, not {value!r}")
            if value is not None and isinstance(low, float):
                object.__setattr__(self, name, float(value))  # kernels are compiled for each type of argument


@dataclass(frozen=True)
class Scene:
    """An image (h, w) with its background, the settings, and the smallest saturated count."""

    counts: GreyImage
    background: Background
    settings: DetectionSettings
    saturation: float

    @property
    def at_rest(self) -> Scene:
        """The scene without a search for trails."""
        return replace(self, settings=replace(self.settings, follow_trails=False))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.counts.shape[1], self.counts.shape[0]

    @property
    def level(self) -> tuple[Array32, float]:
        """Background on the grid of blocks, and the side of a block."""
        return self.background.level, float(self.background.block_px)

    @property
    def grids(self) -> tuple[Array32, Array32, float]:
        """Background and noise on the grid of blocks, and the side of a block."""
        return self.background.level, self.background.noise, float(self.background.block_px)

    def level_of_block(self, peaks: Indices32) -> Array32:
        """Level (n,) of the blocks in which peaks (n, 2) lie."""
        rows, columns = self.background.level.shape
        blocks = peaks // self.background.block_px
        return np.asarray(
            self.background.level[np.minimum(blocks[:, 1], rows - 1), np.minimum(blocks[:, 0], columns - 1)]
        )

    def with_values(self, pixels: Indices32, values: Array | int) -> Scene:
        """Return the scene with other values of some pixels (n, 2)."""
        if not len(pixels):
            return self
        counts = self.counts.copy()
        counts[pixels[:, 1], pixels[:, 0]] = values
        return replace(self, counts=counts)
