"""The geometric identifier: verified triangles of bright stars, over the whole sky, for any camera.

How it finds an attitude that it knows nothing of (`starid.search`), what it believes (`starid.verification`)
and how it polishes (`starid.refinement`) stand in those modules; here they are put together for a camera and
a catalogue.
"""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starid import index_file
from starid.answer import Answer
from starid.attitude import Attitude
from starid.cache import cache_dir
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.pattern_index import (
    INDEX_VERSION,
    IndexArrays,
    IndexSettings,
    build_arrays,
    field_solid_angle,
    seen_stars,
)
from starid.search import identify_kernel
from starid.settings import (
    ACCEPTED,
    FIELD_PX,
    LARGEST_SIGMA,
    LOG_CHANCE,
    LOG_CHANCE_TRACKING,
    MAGNITUDE_GATE,
    MAX_TRIANGLES,
    NOISY,
    PX_PER_RAD,
    SCALE_TOLERANCE,
    SEARCH_TOLERANCE,
    SETTING_COUNT,
    SIGMAS_KNOWN,
    TEST_WINDOW,
    TOO_FEW,
    WINDOW,
)
from starid.solution import Mode, Reason, Solution
from starid.tracking import track_kernel

STARS_PER_FIELD: Final = 200
"""Catalogue stars a field, on the average, that the default limiting magnitude aims at."""

BRIGHTEST_LIMIT: Final = 6.0
FAINTEST_LIMIT: Final = 9.0
BLEND_PX: Final = 2.0
TOLERANCE_PX: Final = 4.0
WINDOW_PX: Final = 12.0
TEST_WINDOW_PX: Final = 10.0
TRACKING_WINDOW_PX: Final = 20.0
_REASONS: Final = {TOO_FEW: Reason.TOO_FEW_STARS, NOISY: Reason.RESIDUAL}


def default_limiting_magnitude(catalog: StarCatalog, field_area_sr: float) -> float:
    """V to which a field holds `STARS_PER_FIELD` on the average, in steps of ¼, within 6…9."""
    wanted = STARS_PER_FIELD * 4.0 * math.pi / field_area_sr
    row = min(int(wanted), len(catalog)) - 1
    limit = math.ceil(4.0 * float(catalog.v[row])) / 4.0
    return min(max(limit, BRIGHTEST_LIMIT), FAINTEST_LIMIT)


def pixels_per_radian(camera: Camera) -> float:
    """Least pixels per radian anywhere in the field: the smaller singular value of the projection."""
    steps = np.linspace(0.0, 1.0, 9)
    grid = np.stack(np.meshgrid(steps * (camera.width - 1), steps * (camera.height - 1)), axis=-1).reshape(
        -1, 2
    )
    directions = camera.back_project(grid)
    directions = directions[np.isfinite(directions[:, 0])]
    values = np.linalg.svd(camera.jacobian(directions), compute_uv=False)
    return float(values[:, 1].min())


@dataclass(frozen=True)
class Effort:
    """How the search is bounded.

    Attributes
    ----------
    tolerance_px : float
        Largest error of a triangle's side, pixels.
    window_px : float
        First matching window, pixels.
    test_window_px : float
        Window in which a candidate attitude is tested, pixels.
    magnitude_gate : float
        Largest deviation of a star's magnitude from what its flux says.
    max_triangles : int
        Triangles of detections looked up before giving up.
    max_false_probability : float
        Largest bound on the probability of a false answer that is accepted, lost in space.
    max_false_probability_tracking : float
        The same near a predicted attitude.
    """

    tolerance_px: float = TOLERANCE_PX
    window_px: float = WINDOW_PX
    test_window_px: float = TEST_WINDOW_PX
    magnitude_gate: float = 1.5
    max_triangles: int = 3000
    max_false_probability: float = 1e-5
    max_false_probability_tracking: float = 1e-5


class Identifier:
    """Star identification for one camera against one catalogue.

    Parameters
    ----------
    camera : Camera
        What the detections were taken with.
    catalog : StarCatalog, optional
        Default: the whole of Hipparcos at its default epoch.
    limiting_magnitude : float, optional
        Faintest V in the index; by default what gives some 200 stars a field, at least 6.
    fov_tolerance : float
        Relative uncertainty of the focal length, 0 where it is calibrated.
    blend_px : float
        Stars closer than this are seen as one.
    effort : Effort
        Bounds of the search.
    cache : bool or path
        Keep the index on disk: in the cache folder, in a folder given, or not at all.
    """

    def __init__(
        self,
        camera: Camera = DEFAULT_CAMERA,
        catalog: StarCatalog | None = None,
        *,
        limiting_magnitude: float | None = None,
        fov_tolerance: float = 0.0,
        blend_px: float = BLEND_PX,
        effort: Effort | None = None,
        cache: bool | str | Path = True,
    ) -> None:
        if not 0.0 <= fov_tolerance <= 0.3:
            raise StaridError(f"identifier fov_tolerance: {fov_tolerance} given, 0…0.3 needed")
        self._camera = camera
        self._catalog = load_catalog() if catalog is None else catalog
        self._effort = effort or Effort()
        area = field_solid_angle(camera)
        limit = (
            default_limiting_magnitude(self._catalog, area)
            if limiting_magnitude is None
            else limiting_magnitude
        )
        least = pixels_per_radian(camera)
        self._settings_of_index = index_settings(
            camera,
            limit,
            blend_px / least,
            self._effort.window_px / least,
            area,
            len(self._catalog.brighter_than(limit)),
        )
        stars = seen_stars(self._catalog, limit, blend_px / least)
        self._rows = self._catalog.index_of(stars.hip).astype(np.int64)
        self._hip = stars.hip
        self._index = self._load(stars, cache)
        self._kernel_settings = np.zeros(SETTING_COUNT)
        self._kernel_settings[SEARCH_TOLERANCE] = self._effort.tolerance_px / least
        self._kernel_settings[MAGNITUDE_GATE] = self._effort.magnitude_gate
        self._kernel_settings[MAX_TRIANGLES] = self._effort.max_triangles
        self._kernel_settings[SCALE_TOLERANCE] = fov_tolerance
        self._kernel_settings[WINDOW] = self._effort.window_px
        self._kernel_settings[TEST_WINDOW] = self._effort.test_window_px / least
        self._kernel_settings[LARGEST_SIGMA] = 0.3 * self._effort.window_px
        self._kernel_settings[LOG_CHANCE] = math.log(self._effort.max_false_probability)
        self._kernel_settings[LOG_CHANCE_TRACKING] = math.log(self._effort.max_false_probability_tracking)
        self._kernel_settings[PX_PER_RAD] = least
        self._kernel_settings[FIELD_PX] = camera.width * camera.height
        self._settings_with_errors = self._kernel_settings.copy()
        self._settings_with_errors[SIGMAS_KNOWN] = 1.0

    def _load(self, stars: StarCatalog, cache: bool | str | Path) -> IndexArrays:
        settings = self._settings_of_index
        key = hashlib.sha256(repr((INDEX_VERSION, stars.identity, astuple(settings))).encode()).hexdigest()[
            :16
        ]
        if cache is False:
            return index_file.unpack(index_file.pack(build_arrays(stars, settings), key), key)
        folder = cache_dir() if cache is True else Path(cache)
        path = folder / f"index-{key}.bin"
        return index_file.load(path, key) or index_file.store(path, build_arrays(stars, settings), key)

    @property
    def camera(self) -> Camera:
        """The camera that the positions belong to."""
        return self._camera

    @property
    def catalog(self) -> StarCatalog:
        """The catalogue that `Solution.catalog_index` counts in."""
        return self._catalog

    def identify(self, xy_px: ArrayLike, flux: ArrayLike, xy_sigma_px: ArrayLike | None = None) -> Solution:
        """Lost in space: attitude without any knowledge of it.

        Parameters
        ----------
        xy_px : array (n, 2)
            Positions, pixels.
        flux : array (n,)
            Brightness in any linear unit.
        xy_sigma_px : array (n,) or (n, 2), optional
            One-sigma error of each position, the same on both axes or along x and y, pixels; estimated from
            the residuals when not given.

        Raises
        ------
        StaridError
            The arrays do not fit each other, or hold values that are not finite.
        """
        begin = time.perf_counter()
        xy, brightness, sigmas = _checked(xy_px, flux, xy_sigma_px)
        answer = identify_kernel(
            self._index,
            self._camera.params,
            xy,
            brightness,
            sigmas,
            self._kernel_settings if xy_sigma_px is None else self._settings_with_errors,
        )
        return self._solution(answer, "lost_in_space", begin)

    def track(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        predicted: Attitude | ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        window_px: float | None = None,
    ) -> Solution:
        """Attitude near a predicted one; invalid, with the reason, where it does not hold.

        Parameters
        ----------
        xy_px, flux, xy_sigma_px
            As in `identify`.
        predicted : Attitude or array (4,)
            Attitude expected at the time of the exposure, or its scalar-last quaternion.
        window_px : float, optional
            Largest distance of a star from where the prediction puts it, pixels (`TRACKING_WINDOW_PX`).

        Raises
        ------
        StaridError
            The arrays do not fit each other, or hold values that are not finite.
        """
        begin = time.perf_counter()
        xy, brightness, sigmas = _checked(xy_px, flux, xy_sigma_px)
        window = TRACKING_WINDOW_PX if window_px is None else window_px
        if not 0.0 < window < math.inf:
            raise StaridError(f"tracking window_px: {window} given, a positive number of pixels needed")
        attitude = predicted if isinstance(predicted, Attitude) else Attitude.from_quaternion(predicted)
        answer = track_kernel(
            self._index, self._camera.params, xy, brightness, sigmas,
            self._kernel_settings if xy_sigma_px is None else self._settings_with_errors, attitude.matrix, window / self._kernel_settings[PX_PER_RAD],
        )  # fmt: skip
        return self._solution(answer, "tracking", begin)

    def warm_up(self) -> None:
        """Compile, or load, the kernels, so that the first real frame is not late."""
        xy = self._camera.border(2)[:6]
        self.identify(xy, np.ones(6))
        self.track(xy, np.ones(6), Attitude.identity())

    def _solution(self, answer: Answer, mode: Mode, begin: float) -> Solution:
        if answer.status != ACCEPTED:
            lost = Reason.NO_MATCH if mode == "lost_in_space" else Reason.PREDICTION_LOST
            reason = _REASONS.get(answer.status, lost)
            return Solution.invalid(reason, mode=mode, elapsed=time.perf_counter() - begin)
        rms, sigma, log_false, _, _, _ = answer.numbers.tolist()
        return Solution(
            valid=True,
            reason=Reason.OK,
            quaternion_xyzw=answer.quaternion,
            detection_index=answer.pairs[0],
            catalog_index=self._rows[answer.pairs[1]],
            hip=self._hip[answer.pairs[1]],
            covariance=answer.covariance,
            rms_px=rms,
            sigma_px=sigma,
            probability_false=math.exp(log_false),
            mode=mode,
            elapsed=time.perf_counter() - begin,
        )


def index_settings(
    camera: Camera, limit: float, blend_rad: float, window_rad: float, area: float, stars: int
) -> IndexSettings:
    """Settings of the index that suits a camera."""
    diagonal = 2.0 * camera.field_radius_rad
    width = math.sqrt(area)
    spacing = math.sqrt(4.0 * math.pi / max(stars, 1))
    cell = max(window_rad, 0.7 * spacing)
    return IndexSettings(
        limiting_magnitude=limit,
        blend_rad=blend_rad,
        window_rad=window_rad,
        field_area_sr=area,
        longest_side_rad=min(0.95 * width, 0.9 * diagonal),
        shortest_side_rad=0.12 * width,
        quota=10,
        cells_per_edge=max(int(0.5 * math.pi / cell), 1),
        side_bins=72,
    )


def _checked(
    xy_px: ArrayLike, flux: ArrayLike, xy_sigma_px: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Own, contiguous copies of the input, or a one-line error."""
    xy = np.array(xy_px, dtype=np.float64, order="C")
    brightness = np.array(flux, dtype=np.float64, order="C")
    if xy.size == 0:
        xy = xy.reshape(-1, 2)
    n = xy.shape[0]
    if xy.ndim != 2 or xy.shape[1] != 2 or brightness.shape != (n,):
        raise StaridError(
            f"detections: positions {xy.shape} and flux {brightness.shape} given, (n, 2) and (n,) needed"
        )
    sigmas = np.ones((n, 2))
    if xy_sigma_px is not None:
        given = np.asarray(xy_sigma_px, dtype=np.float64)
        if given.shape not in {(n,), (n, 2)}:
            raise StaridError(
                f"detections: errors {given.shape} given for {n} positions, (n,) or (n, 2) needed"
            )
        sigmas[:] = given if given.ndim == 2 else given[:, None]
        if not (np.isfinite(sigmas).all() and (sigmas > 0.0).all()):
            raise StaridError("detections: every position error must be finite and positive")
    if not (np.isfinite(xy).all() and np.isfinite(brightness).all()):
        raise StaridError("detections: positions and flux must be finite numbers")
    return xy, brightness, sigmas


__all__ = ["Attitude", "Effort", "Identifier", "default_limiting_magnitude"]
