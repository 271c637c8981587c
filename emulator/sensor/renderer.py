"""Renders exposures of the sky, with the truth of what they show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.fixed_pattern import make_fixed_pattern
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.noise import digitize
from starhil.emulator.sensor.overexposure import Afterimage, spill
from starhil.emulator.sensor.particle_hits import add_protons
from starhil.emulator.sensor.psf import MAX_RADIUS_SIGMA, add_spots, path_rule
from starhil.emulator.sensor.rolling_shutter import at_row_times
from starhil.emulator.sensor.sky.area_light import AreaLight, Backdrop
from starhil.emulator.sensor.sky.ephemeris import Observer
from starhil.emulator.sensor.sky.light import AreaPainter
from starhil.emulator.sensor.sky.objects import PointSource, SkyObjects
from starhil.emulator.sensor.sky.satellites import Satellites
from starhil.emulator.sensor.sky.stars import SkyStars
from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices, Indices32, Mask
from starid.arithmetic.elementary import acos, cos, square
from starid.arithmetic.matrices import length, lengths, product
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.catalog.photometry import flux_ratio

__all__ = ["Frame", "Renderer", "SensorModel", "StarTruth", "render"]

_MAX_RATE_RAD_S: Final = 20.0
_VISIBLE_SHARE: Final = 0.5
_OBJECT_STREAM: Final = 2
_FLOOD_WELLS: Final = 10.0
"""Full wells of electrons in every pixel when light passes the baffle."""

_GLARE_SHARE: Final = 0.05
"""Glare below which none is drawn, as a share of the read noise."""

_LEAST_GHOST_E: Final = 1.0
"""Electrons below which no ghost is drawn."""

_CONE_MARGIN_RAD: Final = math.radians(1.0)


@dataclass(frozen=True)
class StarTruth:
    """Catalogue stars in an image, including companions beyond the limiting magnitude, brightest first."""

    hip: Indices32
    """Hipparcos numbers, (n,), int32."""
    catalog_index: Indices
    """Rows of the renderer's catalogue, (n,), int64."""
    xy_px: Array
    """Position at mid-exposure, pixels, (n, 2)."""
    electrons: Array
    """Mean electrons of the star in the exposure, (n,)."""
    magnitude: Array
    """V magnitude, (n,)."""
    visible: Mask
    """False for hidden or omitted stars, (n,) of bool."""


@dataclass(frozen=True)
class ObjectTruth:
    """Other objects in an image."""

    false_xy_px: Array
    """Positions of the false stars, the fixed ones first, (n, 2)."""
    planet_xy_px: Array
    """Positions of the planets in the order of `SkyObjects.planets`, (m, 2); NaN outside the image."""
    cosmic_rays_px: Array
    """x, y of both ends of each track, (k, 4)."""
    satellites_px: Array
    """x, y of both ends of the trail of each satellite, (s, 4); also of those that touch the image only with their spot."""
    covered_share: float
    """Fraction of the image that receives less than half of the sky's light."""


@dataclass(frozen=True)
class Frame:
    """One exposure and its truth."""

    image: GreyImage
    """Counts, (h, w), uint8 or uint16."""
    stars: StarTruth
    attitude: Attitude
    rate_rad_s: tuple[float, float, float]
    """Body rate during the exposure, sensor frame."""
    exposure_s: float
    seed: int
    frame_index: int
    objects: ObjectTruth | None = None
    """Other objects in the image, if the sky has any."""


def _disturbed(
    path: Array, electrons: Array, objects: SkyObjects, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Displace paths (n, 6) of stars and change their electrons (n,) by the noise of the sky objects."""
    if objects.star_position_noise_px > 0.0:
        path = path.copy()
        path[:, :2] += objects.star_position_noise_px * rng.normal(size=(len(path), 2))
    if objects.star_magnitude_noise > 0.0:
        electrons = electrons * flux_ratio(objects.star_magnitude_noise * rng.normal(size=len(path)))
    return path, electrons


def _ghosts(camera: Camera, path: Array, electrons: Array, share: float) -> tuple[Array, Array]:
    """Return paths (m, 6) and electrons (m,) of the ghosts of stars, mirrored through the axis of the lens."""
    bright = electrons * share > _LEAST_GHOST_E
    ghosts = -path[bright]
    ghosts[:, :2] += 2.0 * np.array(camera.centre_px)
    return ghosts, share * electrons[bright]


def frame_without_truth(image: GreyImage, frame_index: int) -> Frame:
    """Return the frame of an image (h, w) that was not rendered: it has no stars, and its attitude is the identity."""
    none = np.zeros(0)
    stars = StarTruth(
        none.astype(np.int32), none.astype(np.int64), np.zeros((0, 2)), none, none, none.astype(np.bool_)
    )
    return Frame(image, stars, Attitude.identity(), (0.0, 0.0, 0.0), 0.0, 0, frame_index)


class Renderer:
    """Renders exposures for one camera, catalogue and sensor, and caches what they share.

    An image depends only on the arguments and on (seed, frame_index); on earlier images only by an afterimage. `objects` are the default of
    all exposures.
    """

    def __init__(
        self,
        camera: Camera,
        catalog: StarCatalog,
        sensor: SensorModel | None = None,
        seed: int = 0,
        objects: SkyObjects | None = None,
    ) -> None:
        self.camera = camera
        self.catalog = catalog
        self.sensor = SensorModel() if sensor is None else sensor
        self.seed = _whole_number("seed", seed)
        self.objects = objects
        self._painter = AreaPainter(camera, self.sensor.zero_magnitude_e_s, self.sensor.psf_sigma_px)
        self._stars = SkyStars(catalog, self.sensor, camera.pixel_scale_rad, seed)
        self._cos_cone = cos(min(camera.field_radius_rad + _CONE_MARGIN_RAD, math.pi))
        self._pattern = make_fixed_pattern(self.sensor, camera.height, camera.width, camera)
        self._sky_e_s = np.float32(self.sensor.sky_e_s(camera.pixel_scale_rad))
        self._still = np.empty((camera.height, camera.width), dtype=np.float32)
        self._still_conditions = (math.nan, math.nan)
        self._optics = camera
        """The camera at the temperature of the frame."""
        self._work = np.zeros_like(self._still)

    def with_sensor(self, sensor: SensorModel) -> Renderer:
        """Return a renderer with another sensor; this one if the sensor is equal."""
        if sensor == self.sensor:
            return self
        return Renderer(self.camera, self.catalog, sensor, self.seed, self.objects)

    def render(
        self,
        attitude: Attitude,
        rate_rad_s: npt.ArrayLike = (0.0, 0.0, 0.0),
        frame_index: int = 0,
        *,
        exposure_s: float | None = None,
        temperature_c: float | None = None,
        objects: SkyObjects | None = None,
        observer: Observer | None = None,
        satellites: Satellites | None = None,
        afterimage: Afterimage | None = None,
        begin_s: float = 0.0,
    ) -> Frame:
        """Render one exposure at the attitude of its middle and a constant body rate (3,), sensor frame, rad/s.

        The number of the frame determines the noise, together with the seed. Exposure, seconds, temperature of
        detector and lens, °C, and sky objects are by default those of the sensor and the renderer. The place and
        motion of an observer give the stars parallax and aberration. An afterimage adds the charge that earlier exposures left
        in traps, and keeps what this one leaves, which begins at `begin_s`.
        """
        given = {"exposure_s": exposure_s, "temperature_c": temperature_c}
        sensor = self.sensor.with_(**{name: value for name, value in given.items() if value is not None})
        exposure, temperature = sensor.exposure_s, sensor.temperature_c
        rate = _rate(rate_rad_s)
        index = _whole_number("frame_index", frame_index)
        others = self.objects if objects is None else objects
        self._optics = sensor.camera_at(self.camera, temperature)
        drift = sensor.boresight_drift_rad(temperature)  # of the optics against the mounting
        optical_axis = attitude.rotated(drift) if np.any(drift) else attitude
        area = None
        if others is not None and others.has_extended_objects:
            area = self._painter.paint(others, optical_axis)
        mean = self._mean_without_stars(exposure, temperature, area)
        self._pattern.telegraph.add(mean, index, exposure * sensor.dark_factor(temperature))
        planets = () if others is None else others.planets
        vectors, flux_e_s = self._stars.shown(others, observer)
        path, sources, inside = self._paths(
            vectors, flux_e_s > 0.0, optical_axis, rate, exposure, observer, planets
        )
        count = int(np.count_nonzero(sources < len(self._stars)))
        magnitudes = [planets[number - len(self._stars)].magnitude for number in sources[count:]]
        planets_e = [self.sensor.electrons(magnitude, exposure) for magnitude in magnitudes]
        electrons = np.concatenate([flux_e_s[sources[:count]] * exposure, planets_e])
        drawn, lit, centred = electrons, path, np.flatnonzero(inside[:count])
        object_truth = None
        if others is not None:
            drawn = electrons.copy()
            drawn[centred[: others.missing_stars]] = 0.0
            if area is not None:
                drawn *= area.seen_at(path[:, :2])
            planet_xy = np.full((len(planets), 2), np.nan)
            shown = count + np.flatnonzero(inside[count:])
            planet_xy[sources[shown] - len(self._stars)] = path[shown, :2]
            rng = np.random.default_rng((self.seed, index, _OBJECT_STREAM))
            false_xy = self._add_false_stars(mean, others, rng, exposure)
            lit, drawn = _disturbed(path, drawn, others, rng)
            if others.ghost_share > 0.0:
                self._add_light(mean, *_ghosts(self._optics, lit, drawn, others.ghost_share))
            satellites_px = self._add_satellites(mean, satellites, optical_axis, rate, exposure, area)
            particles = int(rng.poisson(others.cosmic_rays_s * exposure))
            tracks = add_protons(mean, particles, rng, sensor.epi_um, sensor.pixel_um)
            covered = area.covered_share if area else 0.0
            object_truth = ObjectTruth(false_xy, planet_xy, tracks, satellites_px, covered)
        self._add_light(mean, lit, drawn)
        if sensor.blooming > 0.0:
            spill(mean, sensor.full_well_e, sensor.blooming)
        if afterimage is not None:
            afterimage.expose(mean, begin_s, begin_s + exposure)
        image = digitize(mean, self.sensor.digitizer, self.seed, index)
        rows = self._stars.rows[sources[centred]]
        stars = StarTruth(
            self.catalog.hip[rows],
            rows.astype(np.int64),
            path[centred, :2].copy(),
            electrons[centred],
            self.catalog.v[rows].astype(np.float64),
            drawn[centred] > _VISIBLE_SHARE * electrons[centred],
        )
        rates = (float(rate[0]), float(rate[1]), float(rate[2]))
        return Frame(image, stars, attitude, rates, exposure, self.seed, index, object_truth)

    def _add_false_stars(
        self,
        mean: Array32,
        objects: SkyObjects,
        rng: np.random.Generator,
        exposure_s: float,
    ) -> Array:
        """Add false stars at random positions; return the positions (n, 2)."""
        if not objects.false_stars + objects.fixed_false_stars:
            return np.zeros((0, 2))
        fixed = np.random.default_rng((self.seed, _OBJECT_STREAM))
        size = np.array([self.camera.width, self.camera.height])
        low, high = objects.false_star_magnitudes
        numbers = ((objects.fixed_false_stars, fixed), (objects.false_stars, rng))
        xy = np.concatenate([source.uniform(-0.5, size - 0.5, (count, 2)) for count, source in numbers])
        magnitudes = np.concatenate([source.uniform(low, high, count) for count, source in numbers])
        path = np.zeros((len(xy), 6))
        path[:, :2] = xy
        self._add_light(mean, path, self.sensor.electrons(0.0, exposure_s) * flux_ratio(magnitudes))
        return xy

    def _add_satellites(
        self,
        mean: Array32,
        satellites: Satellites | None,
        attitude: Attitude,
        rate: Array,
        exposure_s: float,
        area: AreaLight | None,
    ) -> Array:
        """Add the trails of satellites to the limiting magnitude; return both ends of each (n, 4), pixels."""
        if satellites is None:
            return np.zeros((0, 4))
        crossing = satellites.crossing(attitude.boresight, self._cosine_of_cone(rate, exposure_s), exposure_s)
        bright = crossing.magnitudes <= self.sensor.limiting_magnitude
        begin, middle, end = crossing.directions[:, bright]
        path, _, touching = self._path_of((begin, middle, end), attitude, rate, exposure_s)
        path, magnitudes = path[touching], crossing.magnitudes[bright][touching]
        electrons = self.sensor.electrons(0.0, exposure_s) * flux_ratio(magnitudes)
        if area is not None:
            electrons = electrons * area.seen_at(path[:, :2])
        self._add_light(mean, path, electrons)
        centre, half, bend = path[:, :2], path[:, 2:4], path[:, 4:6]
        return np.column_stack([centre - half + bend, centre + half + bend])

    def trails(self, frame: Frame) -> Array:
        """Return the displacements (n, 2) of a frame's stars during its exposure, pixels."""
        icrs = self.catalog.vectors[frame.stars.catalog_index]
        half = 0.5 * frame.exposure_s * np.array(frame.rate_rad_s)
        start, _ = self.camera.project(frame.attitude.rotated(-half).to_sensor(icrs))
        end, _ = self.camera.project(frame.attitude.rotated(half).to_sensor(icrs))
        return end - start

    def _mean_without_stars(self, exposure_s: float, temperature_c: float, area: AreaLight | None) -> Array32:
        """Return the mean electrons (h, w) of sky, dark current and extended objects, in a buffer that is reused."""
        if self._still_conditions != (exposure_s, temperature_c):
            factor = np.float32(self.sensor.dark_factor(temperature_c))
            np.multiply(self._pattern.sensitivity, self._sky_e_s, out=self._still)
            self._still += self._pattern.dark_e_s if factor == 1.0 else self._pattern.dark_e_s * factor
            self._still *= np.float32(exposure_s)
            self._still_conditions = (exposure_s, temperature_c)
        if area is None:
            np.copyto(self._work, self._still)
        elif area.flooded:
            self._work.fill(_FLOOD_WELLS * self.sensor.full_well_e)
        else:
            least_e = _GLARE_SHARE * self.sensor.read_noise_e
            sensitivity = self._pattern.sensitivity
            backdrop = Backdrop(self._still, sensitivity, float(self._sky_e_s), exposure_s, least_e)
            area.draw(self._work, backdrop)
        return self._work

    def _paths(
        self,
        vectors: Array,
        shine: Mask,
        attitude: Attitude,
        rate: Array,
        exposure_s: float,
        observer: Observer | None,
        planets: tuple[PointSource, ...],
    ) -> tuple[Array, Indices, Mask]:
        """Return paths (n, 6), numbers and centre-inside mask of the stars and planets whose light may reach the image.

        The stars are in directions `vectors` (k, 3), those that `shine`. A path is the parabola through the projections at the start,
        middle and end of the exposure. The numbers of planets follow those of the stars.
        """
        cosine = self._cosine_of_cone(rate, exposure_s)
        near = np.flatnonzero((product(vectors, attitude.boresight) >= cosine) & shine)
        icrs = self._stars.apparent(vectors, near, observer)
        if planets:
            vectors = np.array([planet.direction for planet in planets])
            icrs = np.concatenate([icrs, vectors])
            near = np.concatenate([near, len(self._stars) + np.arange(len(planets))])
        path, inside, touching = self._path_of((icrs, icrs, icrs), attitude, rate, exposure_s)
        return path[touching], near[touching], inside[touching]

    def _cosine_of_cone(self, rate: Array, exposure_s: float) -> float:
        """Return the cosine of the angle from the boresight within which stars can reach the image during an exposure."""
        readout_s = self.camera.height * self.sensor.row_time_s
        sweep = length(rate) * (exposure_s + readout_s)
        return cos(min(acos(self._cos_cone) + sweep, math.pi))

    def _path_of(
        self,
        icrs: tuple[Array, Array, Array],
        attitude: Attitude,
        rate: Array,
        exposure_s: float,
    ) -> tuple[Array, Mask, Mask]:
        """Return paths (n, 6), and masks of those centred inside and touching the image.

        They are those of directions (n, 3) at begin, middle and end of the exposure.
        """
        camera, row_time_s = self._optics, self.sensor.row_time_s

        def positions(icrs: Array, turn: Array) -> tuple[Array, Mask]:
            seen = (attitude.rotated(turn) if np.any(turn) else attitude).to_sensor(icrs)
            return camera.project(at_row_times(seen, camera, rate, row_time_s))

        half = 0.5 * exposure_s * rate
        middle, inside = positions(icrs[1], np.zeros(3))
        path = np.zeros((len(middle), 6))
        path[:, :2] = middle
        if np.any(rate) or icrs[0] is not icrs[2]:
            start, _ = positions(icrs[0], -half)
            end, _ = positions(icrs[2], half)
            path[:, 2:4] = 0.5 * (end - start)
            path[:, 4:6] = 0.5 * (end + start) - middle
        reach = 1.0 + MAX_RADIUS_SIGMA * self.sensor.psf_sigma_px * (1.0 + 2.0 * self.sensor.psf_growth)
        span = np.abs(path[:, 2:4]) + np.abs(path[:, 4:6]) + reach
        size = np.array([self.camera.width, self.camera.height])
        touching = np.all((middle > -span) & (middle < size + span), axis=1)
        touching &= np.all(np.isfinite(path), axis=1)
        return path, inside & touching, touching

    def _add_light(
        self,
        mean: Array32,
        path: Array,
        electrons: Array,
    ) -> None:
        """Add stars to the mean electrons, each with the spot width of its position."""
        base = self.sensor.psf_sigma_px
        half = 0.5 * np.array([self.camera.width, self.camera.height])
        off_axis = (path[:, :2] + 0.5 - half) / half
        width = base * (1.0 + self.sensor.psf_growth * np.sum(square(off_axis), axis=1))
        sigma = np.column_stack([width, width])
        longest = 2.0 * float(np.max(lengths(path[:, 2:4]), initial=0.0))
        nodes, weights = path_rule(longest, base)
        add_spots(mean, self._pattern.sensitivity, path, electrons, sigma, nodes, weights)


def render(
    camera: Camera,
    catalog: StarCatalog,
    attitude: Attitude,
    sensor: SensorModel | None = None,
    *,
    rate_rad_s: npt.ArrayLike = (0.0, 0.0, 0.0),
    seed: int = 0,
    frame_index: int = 0,
    objects: SkyObjects | None = None,
) -> Frame:
    """Render a single exposure; for a series use one `Renderer`, which caches what they share."""
    return Renderer(camera, catalog, sensor, seed, objects).render(attitude, rate_rad_s, frame_index)


def _whole_number(name: str, value: int) -> int:
    """Check a seed or an index."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < 2**63:
        raise EmulatorError(f"{name}: must be a whole number from 0, not {value!r}")
    return int(value)


def _rate(value: npt.ArrayLike) -> Array:
    rate = np.asarray(value, dtype=np.float64)
    if rate.shape != (3,) or not np.all(np.isfinite(rate)) or length(rate) > _MAX_RATE_RAD_S:
        raise EmulatorError(
            f"body rate: must be three numbers of at most {_MAX_RATE_RAD_S} rad/s, not {value!r}"
        )
    return rate
