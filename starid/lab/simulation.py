"""The thesis's simulator: noise in frames of stars, and sequences of frames that shift and rotate."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.frame_sky import FrameSky, SkyError

PIXEL_DEG: Final = 42.0 / 937.0
"""Width of a pixel, degrees, eq. 5.2: a field of 42° on 937 pixels."""

FAINTEST_MAGNITUDE: Final = 15.0
"""Faint end of the brightness of false stars."""

INTENSITY_UNITS: Final = 255.0
"""Number of steps of an 8-bit intensity."""

SHIFT_PX: Final = 25.0
"""Largest shift of a moved frame per axis, pixels, which is drawn from U(−25, 25)."""

ROTATION_DEG: Final = 2.5
"""Largest rotation of a moved frame, degrees, which is drawn from U(−2.5, 2.5)."""

WANDER_LIMIT_DEG: Final = 69.0
"""Declination at which a wandering boresight is reflected, degrees."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The four kinds of noise of section 5.2.

    Attributes
    ----------
    position_sigma_px, position_mean_px
        Normal noise of each coordinate, pixels of `PIXEL_DEG`.
    brightness_sigma, brightness_mean
        Normal noise of the brightness, in units of the 8-bit intensity.
    false_stars, missing_stars
        Number of false stars, uniform in the circular field and in magnitude; number of stars removed.
    magnitude_range
        Magnitudes that the 255 steps of intensity span, and from which false stars are drawn.
    mean_spread
        Standard deviation with which the means are drawn for every frame (0: as given).
    whole_pixels
        `moved_frames` rounds the positions in moved frames to whole pixels of `PIXEL_DEG`.
    """

    position_sigma_px: float = 0.0
    position_mean_px: float = 0.0
    brightness_sigma: float = 0.0
    brightness_mean: float = 0.0
    false_stars: int = 0
    missing_stars: int = 0
    magnitude_range: tuple[float, float] = (11.5, FAINTEST_MAGNITUDE)
    mean_spread: float = 0.0
    whole_pixels: bool = False

    @property
    def magnitude_per_unit(self) -> float:
        return (self.magnitude_range[1] - self.magnitude_range[0]) / INTENSITY_UNITS

    @classmethod
    def of(cls, kind: str, level: float = 0.0, **others: Any) -> NoiseModel:
        """Make a noise model of one kind.

        Parameters
        ----------
        kind
            "position" or "brightness" with a standard deviation in pixels or intensity units, or "both"; "false" or
            "missing" with a number of stars; "none".
        level
            Standard deviation or number.
        **others
            Other fields.
        """
        if kind in ("false", "missing"):
            others[f"{kind}_stars"] = int(level)
        return cls(
            position_sigma_px=level if kind in ("position", "both") else 0.0,
            brightness_sigma=level if kind in ("brightness", "both") else 0.0,
            **others,
        )


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """A simulated frame and the truth.

    Attributes
    ----------
    observed
        The input of filters and features.
    identity
        Number of the star for each object, −1 for a false star.
    right_ascension_deg, declination_deg, roll_deg
        Boresight and roll, degrees; NaN if the frame is not at a position in the sky.
    shift_deg, rotation_deg
        Motion with which the frame was made, degrees.
    """

    observed: ObservedFrame
    identity: Indices
    right_ascension_deg: float
    declination_deg: float
    roll_deg: float
    shift_deg: Array
    rotation_deg: float

    @property
    def is_star(self) -> Mask:
        """Which objects are true stars."""
        return self.identity >= 0


def add_noise(
    rng: np.random.Generator, brightness: Array, positions: Array, noise: NoiseModel, radius_deg: float
) -> tuple[Array, Array, Indices]:
    """Add noise to a frame; return brightness, positions and star numbers (−1 for false) of its objects.

    A star in the frame stays in the list however far noise moves it, as in the published experiments.

    Parameters
    ----------
    rng
        Random generator.
    brightness, positions
        True stars in the frame: magnitudes (n,), offsets in degrees (n, 2).
    noise
        The noise to add.
    radius_deg
        Radius of the field for false stars, degrees.
    """
    identity = np.arange(brightness.size, dtype=np.int64)
    if noise.missing_stars > 0:
        lost = rng.choice(
            brightness.size, size=min(noise.missing_stars, max(brightness.size - 1, 0)), replace=False
        )
        identity = np.delete(identity, lost)
    mags, places = brightness[identity], positions[identity]
    means = np.array([noise.position_mean_px, noise.position_mean_px, noise.brightness_mean])
    if noise.mean_spread > 0.0:
        means = means + rng.normal(0.0, noise.mean_spread, 3)
    shift = means[:2] + rng.normal(0.0, 1.0, places.shape) * noise.position_sigma_px
    change = means[2] + rng.normal(0.0, 1.0, mags.shape) * noise.brightness_sigma
    places = places + shift * PIXEL_DEG
    mags = mags + change * noise.magnitude_per_unit
    if noise.false_stars > 0:
        r = radius_deg * np.sqrt(rng.uniform(size=noise.false_stars))
        turn = rng.uniform(0.0, 2.0 * math.pi, noise.false_stars)
        places = np.concatenate([places, np.column_stack([r * np.cos(turn), r * np.sin(turn)])])
        mags = np.concatenate([mags, rng.uniform(*noise.magnitude_range, noise.false_stars)])
        identity = np.concatenate([identity, np.full(noise.false_stars, -1, dtype=np.int64)])
    return mags, places, identity


def _random_motion(rng: np.random.Generator) -> tuple[Array, float]:
    """Draw the shift (2,) and rotation of a frame, degrees."""
    return rng.uniform(-SHIFT_PX, SHIFT_PX, 2) * PIXEL_DEG, rng.uniform(-ROTATION_DEG, ROTATION_DEG)


def moved_frames(
    rng: np.random.Generator,
    brightness: Array,
    positions: Array,
    noise: NoiseModel,
    *,
    count: int,
    radius_deg: float,
) -> Iterator[SimulatedFrame]:
    """Frames of the false-star experiments: the first at rest and free of noise, the others moved from it.

    Every frame has its own false stars. The later ones have noise, are moved about the centre (`SHIFT_PX`,
    `ROTATION_DEG`), and lose what leaves the circular field. For the published seven stars and a radius of
    21° there are then 6.6 true stars per frame, as in the published tables.

    Parameters
    ----------
    rng
        Random generator.
    brightness, positions
        Stars of the first frame: magnitudes (n,), offsets in degrees (n, 2).
    noise
        Noise of the later frames, and number of false stars in all frames.
    count
        Number of moved frames, in addition to the first.
    radius_deg
        Radius of the field, degrees.
    """
    clean = NoiseModel(false_stars=noise.false_stars, magnitude_range=noise.magnitude_range)
    mags, places, identity = add_noise(rng, brightness, positions, clean, radius_deg)
    still = np.zeros(2)
    yield SimulatedFrame(ObservedFrame(mags, places), identity, math.nan, math.nan, 0.0, still, 0.0)
    for _ in range(count):
        mags, places, identity = add_noise(rng, brightness, positions, noise, radius_deg)
        shift, turn = _random_motion(rng)
        places = turned(places, turn) + shift
        inside = np.sum(places**2, axis=1) <= radius_deg**2
        if noise.whole_pixels:
            places = np.rint(places / PIXEL_DEG) * PIXEL_DEG
        yield SimulatedFrame(
            ObservedFrame(mags[inside], places[inside]),
            identity[inside],
            math.nan,
            math.nan,
            turn,
            shift,
            turn,
        )


def sky_sequence(
    rng: np.random.Generator,
    sky: FrameSky,
    ra_deg: float,
    dec_deg: float,
    noise: NoiseModel,
    *,
    count: int,
    margin_deg: float = 2.0,
    wander: bool = False,
) -> Iterator[SimulatedFrame]:
    """Moving frames of the flat sky with noise, for the recursive algorithm.

    The stars of each frame are taken from the sky again, so that stars enter as well as leave.

    Parameters
    ----------
    rng
        Random generator.
    sky
        Planar sky.
    ra_deg, dec_deg
        Boresight of the first frame, degrees.
    noise
        Noise of every frame.
    count
        Number of frames.
    margin_deg
        Width of the rim around the field of the features in which objects are visible too, degrees.
    wander
        Move from the previous frame; otherwise, as in the published experiments, from the first one. At a
        declination of `WANDER_LIMIT_DEG` the boresight is reflected, so that frames stay on the grid.
    """
    if sky.geometry != "planar":
        raise SkyError("simulator: the thesis's frames are planar; give a planar sky")
    radius = sky.half_width + margin_deg
    wide = dataclasses.replace(sky, half_width=radius)
    start = np.array([ra_deg, dec_deg, 0.0])
    place = start
    for i in range(count):
        before = place
        if i > 0:
            move = np.append(*_random_motion(rng))
            place = (before if wander else start) + move
            if abs(place[1]) > WANDER_LIMIT_DEG:
                place[1] -= 2.0 * move[1]
        mags, positions, source = wide.stars_in_frame(float(place[0]) % 360.0, float(place[1]))
        brightness, places, identity = add_noise(rng, mags, positions, noise, radius)
        identity = np.where(identity >= 0, source[np.maximum(identity, 0)], -1)
        moved = place - before
        yield SimulatedFrame(
            ObservedFrame(brightness, turned(places, float(place[2]))),
            identity,
            float(place[0]) % 360.0,
            float(place[1]),
            (float(place[2]) + 180.0) % 360.0 - 180.0,
            moved[:2],
            float(moved[2]),
        )


def turned(positions: Array, angle_deg: float) -> Array:
    """Rotate positions (n, 2) counter-clockwise about the centre."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.asarray(positions @ np.array([[c, s], [-s, c]]), dtype=np.float64)
