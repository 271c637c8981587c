"""The thesis's simulator: noise in frames of stars, and sequences of frames that shift and turn, all from one seed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arrays import Array, Indices, Mask
from starid.thesis.false_stars import ObservedFrame
from starid.thesis.frame_sky import FrameSky, SkyError

PIXEL_DEG: Final = 42.0 / 937.0
"""Width of a pixel in degrees, eq. 5.2: a field of 42° on 937 pixels."""

FAINTEST_MAGNITUDE: Final = 15.0
"""Faint end of the brightness of false stars."""

INTENSITY_UNITS: Final = 255.0
"""Steps of an 8-bit intensity."""

SHIFT_PX: Final = 25.0
"""Greatest shift of a moved frame per axis, pixels; it is drawn from U(−25, 25)."""

ROTATION_DEG: Final = 2.5
"""Greatest turn of a moved frame, degrees; it is drawn from U(−2.5, 2.5)."""

WANDER_LIMIT_DEG: Final = 69.0
"""Declination at which a wandering boresight is turned back, degrees."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The four kinds of noise of section 5.2.

    Attributes
    ----------
    position_sigma_px, position_mean_px
        Normal noise of each coordinate, pixels of `PIXEL_DEG`.
    brightness_sigma, brightness_mean
        Normal noise of the brightness in units of the 8-bit intensity.
    false_stars, missing_stars
        Number of false stars added, uniform over the circular field and the range of magnitudes, and of true stars
        taken away.
    magnitude_range
        Magnitudes that the 255 steps of intensity span; false stars are drawn from it.
    mean_spread
        Standard deviation that the means are drawn with for every frame (0: as given).
    """

    position_sigma_px: float = 0.0
    position_mean_px: float = 0.0
    brightness_sigma: float = 0.0
    brightness_mean: float = 0.0
    false_stars: int = 0
    missing_stars: int = 0
    magnitude_range: tuple[float, float] = (11.5, FAINTEST_MAGNITUDE)
    mean_spread: float = 0.0

    @property
    def magnitude_per_unit(self) -> float:
        """Magnitudes that one unit of intensity stands for."""
        return (self.magnitude_range[1] - self.magnitude_range[0]) / INTENSITY_UNITS

    @classmethod
    def factor(
        cls,
        noise: float,
        false_stars: int = 0,
        *,
        position: bool = True,
        brightness: bool = True,
        magnitude_range: tuple[float, float] = (11.5, FAINTEST_MAGNITUDE),
    ) -> NoiseModel:
        """Noise factor μ_j and number of false stars f_i: the same number of pixels and of intensity units."""
        return cls(
            position_sigma_px=noise if position else 0.0,
            brightness_sigma=noise if brightness else 0.0,
            false_stars=false_stars,
            magnitude_range=magnitude_range,
        )


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """A frame with its truth.

    Attributes
    ----------
    observed
        What the filters and the features see.
    identity
        For each object the number of its star, −1 for a false star.
    right_ascension_deg, declination_deg, roll_deg
        Boresight and the angle by which the frame is turned, degrees; NaN where a frame has no place in the sky.
    shift_deg, rotation_deg
        Motion that the frame was made with, degrees.
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
    """Noise of a frame: brightness, positions and identity (star's number, −1 for a false star) of its objects.

    A star that is in the frame stays in the list however far noise moves it, as in the published experiments.

    Parameters
    ----------
    rng
        Source of chance.
    brightness, positions
        True stars of the frame: magnitudes (n,), offsets in degrees (n, 2).
    noise
        What to add.
    radius_deg
        Radius of the field in which false stars fall, degrees.
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
    """Shift (2,) and turn of a frame, degrees."""
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
    """Frames of the false-star experiments: the first one still and clean of noise, the others moved from it.

    Every frame has its own false stars. The later ones get noise, are moved about the centre (`SHIFT_PX`,
    `ROTATION_DEG`), and lose what leaves the circular field. With the
    published seven stars and a radius of 21° this makes 6.6 true stars a frame, as the published tables have it.

    Parameters
    ----------
    rng
        Source of chance.
    brightness, positions
        Stars of the first frame: magnitudes (n,), offsets in degrees (n, 2).
    noise
        Noise of the later frames and number of false stars of all.
    count
        Number of moved frames; one more is made.
    radius_deg
        Radius of the field.
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
    """Frames of the flat sky in motion, for the recursive algorithm; every one has its noise.

    The stars are drawn again from the sky for each frame, so that stars enter as well as leave.

    Parameters
    ----------
    rng
        Source of chance.
    sky
        Planar sky.
    ra_deg, dec_deg
        Boresight of the first frame, degrees.
    noise
        Noise of every frame.
    count
        Number of frames.
    margin_deg
        Width of the rim beyond the field of the features in which objects are seen too, so that a star about to
        enter that field is known by then.
    wander
        Move from the frame before; otherwise, as in the published experiments, from the first frame. At a declination
        of `WANDER_LIMIT_DEG` the boresight is turned back, so that frames stay on the grid.
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
    """Positions (n, 2) turned counter-clockwise about the centre."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.asarray(positions @ np.array([[c, s], [-s, c]]), dtype=np.float64)
