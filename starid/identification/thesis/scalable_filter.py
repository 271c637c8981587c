"""A false-star filter for hundreds of objects per frame: stars move together, and what does not is false.

Objects are followed from frame to frame in coordinates that move with the stars. Transient objects (radiation
hits, glints) are not seen again; stationary ones (hot pixels) stay behind when the stars move on; drifting
ones (debris, other satellites) leave the gate. If the motion is so slow that stationary and drifting objects
stay within the gate, they are recognised by their scatter about their position among the stars. The cost is a
few operations per pair of objects, not the fourth power of their number.

Figures beside constants are of fields as in `tests/starid/identification/thesis/test_false_stars.py`, but of 60 stars in the sky among
200 false ones, and, for a slow sensor, of a rotation by 0.05° a frame.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import length, lengths, product
from starid.attitude.wahba import solve_wahba
from starid.identification.thesis.cme import rigid_fit
from starid.identification.thesis.false_stars import FilterError, FilterResult, ObservedFrame
from starid.identification.thesis.frame_grid import Geometry
from starid.identification.thesis.frame_motion import MAX_VOTERS, find_motion, nearest_objects

MAX_OBJECTS: Final = 2000
"""Largest number of objects in a frame."""

_REFITS: Final = 3
"""Rounds of matching and fitting. One round finds 85 % of the stars among 200 false ones, two or more find 98 %."""

_MIN_OBJECTS: Final = 2
"""Number of objects that determine a motion of the plane or a rotation."""

_SCATTER_FRAMES: Final = 3
"""Number of sightings that a drift can contradict: position and velocity fit two. With 6, 88 instead of 90 % of what is called a
star is one if false stars stay and the sensor is slow."""

_MIN_SPREAD: Final = 0.5
"""Least Σ(t − t̄)², frames²: three successive sightings have 1.9, but after 10⁷ frames its terms no longer have the digits."""

_SUMS: Final = 13
"""Number of the sums of `_Tracks`."""

_FADING: Final = 0.95
"""Weight of each frame beside the next, in which errors of the motion have added up: 20 frames count. From 0.9 to 1, at most 1 % more
or fewer of the slow false stars are recognised."""

_MOTION_NOISE: Final = 0.05
"""Variance that a motion adds to each position, in units of that of a sighting: it is fitted to some 20 objects."""

_TRIM: Final = 2.2
"""Largest distance of a pair from which the motion is fitted, in medians: of true stars, 4 % are farther (Rayleigh)."""

_LEAST_DEPTH: Final = 1e-3
"""Depth at which a direction behind the camera is put, so that its position is far outside the image."""


@dataclass(frozen=True, slots=True)
class TrackFilterSettings:
    """Properties of the sensor and its motion, and thresholds of the filter.

    Attributes
    ----------
    position_sigma_deg
        One-sigma error of a position per axis, degrees.
    brightness_sigma
        One-sigma error of a magnitude.
    max_rotation_deg, max_shift_deg
        Largest rotation and shift from one frame to the next, degrees.
    gate
        Largest distance of an object from the expected position of a star, in sigmas.
    evidence
        How much better, in squared sigmas, "fixed on the sensor" must explain an object than "star" to be
        accepted; twice as much for "drifting".
    history
        Number of frames for which a star may be missing before it is forgotten.
    confirm
        Number of sightings that make an object a true star, once that many frames have been seen. Two are
        enough if all false stars are transient and positions are accurate; slow false stars need three.
    geometry
        "planar": a motion shifts and rotates positions, as in the plane of the thesis. "spherical": it rotates the
        directions whose gnomonic positions they are, by which stars far from the centre move farther.
    """

    position_sigma_deg: float = 0.02
    brightness_sigma: float = 0.2
    max_rotation_deg: float = 10.0
    max_shift_deg: float = 8.0
    gate: float = 3.8
    evidence: float = 9.0
    history: int = 4
    confirm: int = 3
    geometry: Geometry = "planar"

    def __post_init__(self) -> None:
        if not (self.position_sigma_deg > 0.0 and self.brightness_sigma > 0.0 and self.gate > 0.0):
            raise FilterError("filter: the errors of position and brightness and the gate must be positive")
        if self.history < 1 or self.confirm < _MIN_OBJECTS:
            raise FilterError("filter: history must be at least 1 and confirm at least 2")


@dataclass(frozen=True, eq=False)
class TrackResult:
    """The result of the filter for one frame.

    Attributes
    ----------
    true_now
        Which objects are true stars, (n,). In the first frame nothing is known, so all are False.
    track
        Track number of each object, (n,), the same for a star in every frame.
    motion
        Motion of the stars since the previous frame, or None: cosine, sine, shift x, shift y (degrees) in the planar
        geometry, a rotation matrix (3, 3) in the spherical one.
    """

    true_now: Mask
    track: Indices
    motion: Array | None


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Tracked objects: current position and magnitude, and sums over their observations for the scatter.

    `sums` (n, 13) has, with fading weights, Σ1, Σt, Σt², then Σx, Σy, Σz, Σ(x² + y² + z²), Σt·x, Σt·y, Σt·z in
    coordinates that move with the stars, and Σu, Σv, Σ(u² + v²) in sensor coordinates.
    """

    number: Indices
    position: Array
    variance: Array
    brightness: Array
    sightings: Indices
    missed: Indices
    sums: Array

    def __len__(self) -> int:
        return int(self.number.size)

    def kept(self, mask: Mask) -> _Tracks:
        return _Tracks(*(getattr(self, name)[mask] for name in _COLUMNS))

    def joined(self, other: _Tracks) -> _Tracks:
        return _Tracks(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in _COLUMNS))


_COLUMNS: Final = tuple(field.name for field in dataclasses.fields(_Tracks))


class TrackFilter:
    """The scalable filter: pass frames in sequence to `update`, or call it to compare two frames.

    Parameters
    ----------
    settings
        Properties of the sensor and its motion, and thresholds.
    """

    def __init__(self, settings: TrackFilterSettings | None = None) -> None:
        self.settings = settings or TrackFilterSettings()
        self._motions: _Motions = _Sphere() if self.settings.geometry == "spherical" else _Plane()
        self.reset()

    def reset(self) -> None:
        """Forget all tracks, for example after a gap in the frames."""
        self._last_frame: ObservedFrame | None = None
        self._last_result: TrackResult | None = None
        self._next_number = 0
        self._frame = 0
        self._anchor = self._motions.still
        self._last_motion = self._motions.still
        self._tracks = self._new_tracks(np.empty((0, 2)), np.empty(0))
        self._suspect = np.empty(0, dtype=np.bool_)

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two frames; earlier frames are taken into account if the first is the one seen last."""
        if before is not self._last_frame or self._last_result is None:
            self.reset()
            self._last_result = self.update(before)
        first = self._last_result.track
        second = self.update(now)
        self._last_frame, self._last_result = now, second
        place = {int(number): i for i, number in enumerate(first)}
        pairs = [(place.get(int(second.track[j])), int(j)) for j in np.flatnonzero(second.true_now)]
        found = [pair for pair in pairs if pair[0] is not None]
        matches = np.array(found, dtype=np.int64).reshape(-1, 2)
        true_before = np.zeros(len(before), dtype=np.bool_)
        true_before[matches[:, 0]] = True
        return FilterResult(true_before, second.true_now, matches)

    def update(self, frame: ObservedFrame) -> TrackResult:
        """Follow the objects of the next frame.

        Raises
        ------
        FilterError
            The frame has more than `MAX_OBJECTS` objects.
        """
        if len(frame) > MAX_OBJECTS:
            raise FilterError(
                f"filter: {len(frame)} objects in a frame, at most {MAX_OBJECTS}; raise the detection threshold"
            )
        self._frame += 1
        positions = np.ascontiguousarray(frame.positions, dtype=np.float64)
        brightness = np.ascontiguousarray(frame.brightness, dtype=np.float64)
        motion = self._find_motion(positions, brightness)
        if motion is None:
            fresh = self._new_tracks(positions, brightness)
            self._tracks = self._tracks.joined(fresh) if len(frame) < _MIN_OBJECTS else fresh
            self._suspect = np.zeros(len(self._tracks), dtype=np.bool_)
            return TrackResult(np.zeros(len(frame), dtype=np.bool_), fresh.number, None)
        partner, motion = self._associate(positions, brightness, motion)
        self._last_motion = motion
        self._anchor = self._motions.composed(motion, self._anchor)
        self._update_tracks(positions, brightness, partner, motion)
        wandering = self._fixed_or_drifting()
        genuine = (self._tracks.sightings >= min(self.settings.confirm, self._frame)) & ~wandering
        true_now = np.zeros(len(frame), dtype=np.bool_)
        number = np.full(len(frame), -1, dtype=np.int64)
        matched = np.flatnonzero(partner >= 0)
        true_now[partner[matched]] = genuine[matched]
        number[partner[matched]] = self._tracks.number[matched]
        new = number < 0
        fresh = self._new_tracks(positions[new], brightness[new])
        number[new] = fresh.number
        tracks = self._tracks
        keep = (tracks.missed == 0) | ((tracks.missed < self.settings.history) & (tracks.sightings > 1))
        self._tracks = tracks.kept(keep).joined(fresh)
        self._suspect = np.concatenate([wandering[keep], np.zeros(len(fresh), dtype=np.bool_)])
        return TrackResult(true_now, number, motion)

    def _new_tracks(self, positions: Array, brightness: Array) -> _Tracks:
        n = brightness.size
        number = np.arange(self._next_number, self._next_number + n, dtype=np.int64)
        self._next_number += n
        tracks = _Tracks(
            number,
            positions.copy(),
            np.full(n, square(self.settings.position_sigma_deg)),
            brightness.copy(),
            np.ones(n, dtype=np.int64),
            np.zeros(n, dtype=np.int64),
            np.zeros((n, _SUMS)),
        )
        self._add_to_sums(tracks.sums, np.arange(n), positions)
        return tracks

    def _add_to_sums(self, sums: Array, which: Indices, positions: Array) -> None:
        x, y, z = self._motions.moved_back(positions, self._anchor).T
        u, v = positions.T
        t = np.full(x.size, float(self._frame))
        square = x * x + y * y + z * z
        terms = [np.ones_like(t), t, t * t, x, y, z, square, t * x, t * y, t * z, u, v, u * u + v * v]
        sums[which] += np.column_stack(terms)

    def _find_motion(self, positions: Array, brightness: Array) -> Array | None:
        """Find the motion since the previous frame from established bright objects; None if none fits."""
        tracks, settings = self._tracks, self.settings
        if len(tracks) < _MIN_OBJECTS or brightness.size < _MIN_OBJECTS:
            return None
        voters = np.lexsort((tracks.brightness, -np.minimum(tracks.sightings, 2)))[:MAX_VOTERS]
        brightest = np.argsort(brightness, kind="stable")[:MAX_VOTERS]
        start_motion, change = self._motions.start(self._last_motion)
        score = find_motion(
            self._motions.moved(tracks.position[voters], start_motion),
            tracks.brightness[voters],
            positions[brightest],
            brightness[brightest],
            settings.position_sigma_deg,
            settings.brightness_sigma,
            math.radians(settings.max_rotation_deg),
            settings.max_shift_deg,
            change,
        )
        if score < _MIN_OBJECTS:
            return None
        return self._motions.composed(self._motions.of_plane(change), start_motion)

    def _associate(self, positions: Array, brightness: Array, motion: Array) -> tuple[Indices, Array]:
        """Match tracks and objects; return the object of each track, or −1, and the refined motion."""
        tracks, settings = self._tracks, self.settings
        partner = np.empty(len(tracks), dtype=np.int64)
        trusted = (tracks.sightings > 1) & ~self._suspect
        error = np.zeros(len(tracks))
        for turn in range(_REFITS):
            predicted = self._motions.moved(tracks.position, motion)
            variance = tracks.variance + square(settings.position_sigma_deg)
            nearest_objects(
                positions,
                brightness,
                predicted,
                tracks.brightness,
                variance + error,
                settings.brightness_sigma,
                square(settings.gate),
                partner,
            )
            is_paired = partner >= 0
            if np.count_nonzero(is_paired & trusted) > _MIN_OBJECTS:
                is_paired &= trusted
            objects = positions[np.maximum(partner, 0)]
            if turn > 0 and is_paired.any():
                distance = lengths(objects - predicted) / np.sqrt(variance)
                near = is_paired & (distance <= _TRIM * max(float(np.median(distance[is_paired])), 1.0))
                is_paired = near if np.count_nonzero(near) > _MIN_OBJECTS else is_paired
            fitted = self._motions.fit(tracks.position, objects, is_paired)
            if fitted is not None:
                motion = fitted
                arm = np.sum(square(tracks.position - tracks.position[is_paired].mean(axis=0)), axis=1)
                share = 1.0 / np.count_nonzero(is_paired) + arm / max(float(arm[is_paired].sum()), 1e-12)
                error = square(settings.position_sigma_deg) * np.minimum(share, 1.0)
        return partner, motion

    def _update_tracks(self, positions: Array, brightness: Array, partner: Indices, motion: Array) -> None:
        """Move all tracks with the stars and update the matched ones."""
        old, sigma2 = self._tracks, square(self.settings.position_sigma_deg)
        which = np.flatnonzero(partner >= 0)
        objects = partner[which]
        position = self._motions.moved(old.position, motion)
        variance = old.variance + _MOTION_NOISE * sigma2
        gain = variance[which] / (variance[which] + sigma2)
        position[which] += gain[:, None] * (positions[objects] - position[which])
        variance[which] *= 1.0 - gain
        magnitude = old.brightness.copy()
        magnitude[which] += (brightness[objects] - magnitude[which]) / (old.sightings[which] + 1.0)
        sightings, missed = old.sightings.copy(), old.missed + 1
        sightings[which] += 1
        missed[which] = 0
        sums = _FADING * old.sums
        self._add_to_sums(sums, which, positions[objects])
        self._tracks = _Tracks(old.number, position, variance, magnitude, sightings, missed, sums)

    def _fixed_or_drifting(self) -> Mask:
        """Whether each track is better explained as fixed on the sensor or drifting than as a star.

        Each of the three explanations has a sum of squared residuals; their differences, in units of the
        usual variance, are tested. Subtracting the median removes an error of the motion.
        """
        tracks = self._tracks
        result = np.zeros(len(tracks), dtype=np.bool_)
        old = np.flatnonzero(tracks.sightings >= _SCATTER_FRAMES)
        if old.size <= _MIN_OBJECTS:
            return result
        n, t, tt, x, y, z, xx, tx, ty, tz, u, v, uu = tracks.sums[old].T
        as_star = np.maximum(xx - (x * x + y * y + z * z) / n, 0.0)
        as_fixed = np.maximum(uu - (u * u + v * v) / n, 0.0)
        usual = max(square(self.settings.position_sigma_deg), float(np.median(as_star / (2.0 * n))))
        spread = np.maximum(tt - t * t / n, _MIN_SPREAD)
        velocity = np.column_stack([tx - t * x / n, ty - t * y / n, tz - t * z / n]) / spread[:, None]
        velocity -= np.median(velocity, axis=0)
        drift = np.sum(square(velocity), axis=1) * spread / usual
        drift /= max(1.0, float(np.median(drift)))
        limit = self.settings.evidence
        result[old] = ((as_star - as_fixed) / usual > limit) | (drift > 2.0 * limit)
        return result


class _Motions(Protocol):
    """How positions move from frame to frame; a motion is an array."""

    still: Array

    def start(self, last: Array) -> tuple[Array, Array]:
        """From the last motion: one by which to move the objects first, and a guess of the rest near the centre, (4,)."""
        ...

    def of_plane(self, motion: Array) -> Array:
        """The motion whose effect near the centre is a cosine, a sine and a shift in degrees, (4,)."""
        ...

    def moved(self, positions: Array, motion: Array) -> Array:
        """Positions (n, 2), degrees, after a motion."""
        ...

    def moved_back(self, positions: Array, motion: Array) -> Array:
        """Coordinates (n, 3), degrees, in which objects that have taken part in the motion are at rest."""
        ...

    def composed(self, second: Array, first: Array) -> Array:
        """`first` followed by `second`."""
        ...

    def fit(self, before: Array, now: Array, chosen: Mask) -> Array | None:
        """The motion of the chosen objects by least squares; None if there are fewer than two."""
        ...


class _Plane:
    """Rigid motions of the plane: cosine, sine, shift x, shift y (degrees)."""

    still = np.array([1.0, 0.0, 0.0, 0.0])

    def start(self, last: Array) -> tuple[Array, Array]:
        return self.still, last.copy()

    def of_plane(self, motion: Array) -> Array:
        return motion

    def moved(self, positions: Array, motion: Array) -> Array:
        c, s, x, y = motion
        return np.column_stack(
            [c * positions[:, 0] - s * positions[:, 1] + x, s * positions[:, 0] + c * positions[:, 1] + y]
        )

    def moved_back(self, positions: Array, motion: Array) -> Array:
        c, s, x, y = motion
        u, v = positions[:, 0] - x, positions[:, 1] - y
        return np.column_stack([c * u + s * v, c * v - s * u, np.zeros(len(u))])

    def composed(self, second: Array, first: Array) -> Array:
        c, s = second[0] * first[0] - second[1] * first[1], second[1] * first[0] + second[0] * first[1]
        x = second[0] * first[2] - second[1] * first[3] + second[2]
        y = second[1] * first[2] + second[0] * first[3] + second[3]
        return np.array([c, s, x, y])

    def fit(self, before: Array, now: Array, chosen: Mask) -> Array | None:
        motion = np.empty(4)
        return motion if rigid_fit(before, now, chosen, motion) else None


class _Sphere:
    """Rotations of directions, (3, 3); positions are gnomonic, degrees."""

    still = np.identity(3)

    def start(self, last: Array) -> tuple[Array, Array]:
        return last, np.array([1.0, 0.0, 0.0, 0.0])

    def of_plane(self, motion: Array) -> Array:
        c, s, x, y = motion
        centre = rays(np.array([[x, y]]))[0]
        centre /= length(centre)
        right = np.array([1.0, 0.0, 0.0]) - centre[0] * centre
        right /= length(right)
        tilt = np.column_stack([right, np.cross(centre, right), centre])
        return np.asarray(
            product(tilt, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])), dtype=np.float64
        )

    def moved(self, positions: Array, motion: Array) -> Array:
        turned = product(rays(positions), motion.T)
        return np.degrees(turned[:, :2] / np.maximum(turned[:, 2:], _LEAST_DEPTH))

    def moved_back(self, positions: Array, motion: Array) -> Array:
        directions = rays(positions)
        directions /= lengths(directions)[:, None]
        return np.degrees(product(directions, motion))

    def composed(self, second: Array, first: Array) -> Array:
        return np.asarray(product(second, first), dtype=np.float64)

    def fit(self, before: Array, now: Array, chosen: Mask) -> Array | None:
        if np.count_nonzero(chosen) < _MIN_OBJECTS:
            return None
        return solve_wahba(rays(now[chosen]), rays(before[chosen])).matrix


def rays(positions_deg: Array) -> Array:
    """Directions (n, 3) of gnomonic positions in degrees, not of unit length."""
    return np.column_stack([np.radians(positions_deg), np.ones(len(positions_deg))])
