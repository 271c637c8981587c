"""Self-calibration from the stars of several images and an approximate field of view.

Each image is identified with the start camera, whose focal length may be off by the tolerance, and the
matches calibrate the camera. With the calibrated camera the catalogue stars in the field are matched again,
which adds stars in the corners, until nothing changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.attitude import Attitude
from starid.camera import Camera
from starid.camera.calibration import (
    DEFAULT_ESTIMATE,
    GROUPS,
    Calibration,
    CalibrationFrame,
    calibrate,
    check_estimate,
)
from starid.catalog import StarCatalog, load_catalog
from starid.catalog.catalog import close_pairs, merge_close_stars
from starid.errors import StaridError
from starid.identification.solution import Solution
from starid.photograph.rough_search import RoughSearch

MODELS: Final[tuple[tuple[str, ...], ...]] = (
    ("focal",),
    ("focal", "k1"),
    ("focal", "centre", "k1"),
    ("focal", "centre", "k1", "k2"),
    DEFAULT_ESTIMATE,
    ("aspect", *DEFAULT_ESTIMATE[1:]),
)
"""Sets of free parameters, from which the default calibration chooses the one that the images justify."""

IMAGE_MODELS: Final[tuple[tuple[str, ...], ...]] = (("focal",), ("focal", "k1"), ("focal", "k1", "k2"))
"""Sets of free parameters for one image, where the centre may be degenerate with the attitude."""

_ROUNDS: Final = 4
_WINDOW_SIGMAS: Final = 5.0
_MIN_WINDOW_PX: Final = 1.0
_SIGMA_FLOOR_PX: Final = 0.02
_MAGNITUDE_MARGIN: Final = 0.3
_BLEND_PX: Final = 2.0
_FIELD_MARGIN: Final = 1.1
"""Radius of the part of the sky searched, in radii of the first estimate of the field."""


class Stars(NamedTuple):
    """Detections in one frame: positions (n, 2) px, fluxes (n,), errors (n,) or (n, 2) px or None."""

    xy_px: Array
    flux: Array
    xy_sigma_px: Array | None = None


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """A calibration and the frames on which it is based.

    Attributes
    ----------
    calibration : Calibration
        Camera, covariance and residuals.
    frame_index : tuple of int
        Frames that were identified and used, in the order of `calibration.attitudes`.
    matches : tuple of ndarray (m, 2), int64
        Detection index and HIP of the matched pairs, for each of these frames.
    unidentified : dict of int to str
        Reason for each frame that could not be identified.
    """

    calibration: Calibration
    frame_index: tuple[int, ...]
    matches: tuple[Indices, ...]
    unidentified: dict[int, str]


def self_calibrate(
    frames: Sequence[Stars],
    camera: Camera,
    catalog: StarCatalog | None = None,
    *,
    fov_tolerance: float = 0.1,
    estimate: Sequence[str] | None = None,
    models: Sequence[tuple[str, ...]] = MODELS,
) -> SelfCalibration:
    """Identify frames and estimate the camera that took them.

    Parameters
    ----------
    frames : sequence of Stars
        Detections in each frame.
    camera : Camera
        Start value: size, model and approximate focal length.
    catalog : StarCatalog, optional
        By default all of Hipparcos at its default epoch.
    fov_tolerance : float
        Relative uncertainty of the start camera's focal length.
    estimate : sequence of str, optional
        Free parameters (see `starid.camera.calibration.GROUPS`); by default the set of `models` with the least
        Bayesian information criterion (BIC).
    models : sequence of tuple of str
        Sets to choose from when `estimate` is not given.

    Raises
    ------
    StaridError
        No frame could be identified, or `calibrate` fails.
    """
    if not frames:
        raise StaridError("calibration: no frames; at least one with stars is needed")
    if estimate is not None:
        check_estimate(estimate)
    sky = load_catalog() if catalog is None else catalog
    search = RoughSearch(camera, sky, fov_tolerance=fov_tolerance)
    solutions: dict[int, Solution] = {}
    unidentified: dict[int, str] = {}
    for index, stars in enumerate(frames):
        solution = search.identify(stars.xy_px, stars.flux)
        if solution.valid:
            solutions[index] = solution
        else:
            unidentified[index] = solution.reason.value
    if not solutions:
        reasons = ", ".join(sorted(set(unidentified.values())))
        raise StaridError(
            f"calibration: none of {len(frames)} frames could be identified ({reasons}); "
            "check the field of view, or take frames with more stars"
        )
    result = calibrate_identified(frames, solutions, camera, sky, estimate=estimate, models=models)
    return dataclasses.replace(result, unidentified=unidentified)


def calibrate_identified(
    frames: Sequence[Stars],
    solutions: Mapping[int, Solution],
    camera: Camera,
    sky: StarCatalog,
    *,
    estimate: Sequence[str] | None = None,
    models: Sequence[tuple[str, ...]] = MODELS,
) -> SelfCalibration:
    """Estimate the camera from frames of which some are identified.

    Parameters
    ----------
    frames : sequence of Stars
        Detections in each frame.
    solutions : mapping of int to Solution
        Valid solutions by frame, at least one. The adjustment starts with the first one's camera, if any.
    camera : Camera
        The camera with which the frames were identified.
    sky : StarCatalog
        The catalogue to whose rows `catalog_index` in the solutions refers.
    estimate, models
        See `self_calibrate`.

    Raises
    ------
    StaridError
        `calibrate` fails.
    """
    indices = tuple(solutions)
    matched: list[CalibrationFrame] = []
    faintest = -np.inf
    for index, solution in solutions.items():
        stars, rows = frames[index], solution.catalog_index
        faintest = max(faintest, float(sky.v[rows].max()))
        matched.append(
            _frame(
                stars,
                _floored_sigma(stars),
                solution.detection_index,
                sky.vectors[rows],
                solution.attitude,
            )
        )
    start = solutions[indices[0]].camera or camera
    _, result = next(_calibrations(matched, start, (_affordable_model(matched, ("focal", "k1")), ("focal",))))
    reach = result.camera.field_radius_rad * _FIELD_MARGIN
    seen = np.unique(
        np.concatenate([sky.in_cone(attitude.boresight, reach) for attitude in result.attitudes])
    )
    seen = seen[sky.v[seen] <= faintest + _MAGNITUDE_MARGIN]
    references = merge_close_stars(sky.subset(seen), _BLEND_PX * camera.pixel_scale_rad)
    matches: tuple[Indices, ...] = ()
    for _ in range(_ROUNDS):
        pairs = [
            _paired(frames[index], result.camera, attitude, references, result.sigma_px)
            for index, attitude in zip(indices, result.attitudes, strict=True)
        ]
        again = [
            _frame(frames[index], _floored_sigma(frames[index]), chosen, references.vectors[rows], attitude)
            for index, attitude, (chosen, rows) in zip(indices, result.attitudes, pairs, strict=True)
        ]
        matches = tuple(np.stack([chosen, references.hip[rows]], axis=1) for chosen, rows in pairs)
        before = result
        start = dataclasses.replace(camera, focal_px=result.camera.focal_px)
        result = _best(again, start, models) if estimate is None else calibrate(again, start, estimate)
        if _maps_equally(before, result):
            break
    return SelfCalibration(result, indices, matches, {})


def _floored_sigma(stars: Stars) -> Array | None:
    """Position errors, with a floor for systematic errors of the detection."""
    if stars.xy_sigma_px is None:
        return None
    floored: Array = np.hypot(stars.xy_sigma_px, _SIGMA_FLOOR_PX)
    return floored


def _frame(
    stars: Stars, sigma: Array | None, rows: Indices, reference: Array, attitude: Attitude
) -> CalibrationFrame:
    return CalibrationFrame(
        xy_px=np.asarray(stars.xy_px)[rows],
        reference=reference,
        sigma_px=None if sigma is None else sigma[rows],
        attitude=attitude,
    )


def _paired(
    stars: Stars, camera: Camera, attitude: Attitude, sky: StarCatalog, sigma_px: float
) -> tuple[Indices, Indices]:
    """Pair detections and catalogue stars that are mutual nearest neighbours in a window; indices (m,)."""
    near = sky.in_cone(attitude.boresight, camera.field_radius_rad * 1.02)
    xy, inside = camera.project(attitude.to_sensor(sky.vectors[near]))
    near, xy = near[inside], xy[inside]
    measured = np.asarray(stars.xy_px, dtype=np.float64)
    window = max(_WINDOW_SIGMAS * sigma_px, _MIN_WINDOW_PX)
    pairs = close_pairs(measured, xy, window)
    pairs = pairs[np.argsort(np.linalg.norm(measured[pairs[:, 0]] - xy[pairs[:, 1]], axis=1), kind="stable")]
    nearest = [np.zeros(len(pairs), dtype=np.bool_) for _ in range(2)]
    for side in range(2):
        nearest[side][np.unique(pairs[:, side], return_index=True)[1]] = True
    chosen, partner = pairs[nearest[0] & nearest[1]].T
    order = np.argsort(chosen)
    return chosen[order], near[partner[order]]


def _unknowns(model: Sequence[str], frames: Sequence[CalibrationFrame]) -> int:
    """Count the unknowns: camera parameters and three angles per frame."""
    return sum(len(GROUPS[name]) for name in model) - ("focal" in model) + 3 * len(frames)


def _affordable_model(frames: Sequence[CalibrationFrame], model: tuple[str, ...]) -> tuple[str, ...]:
    """Return the model, or the focal length alone if there are too few stars for the model."""
    equations = 2 * sum(len(frame.xy_px) for frame in frames)
    return model if equations > 2 * _unknowns(model, frames) else ("focal",)


def _best(
    frames: list[CalibrationFrame], camera: Camera, candidates: Sequence[tuple[str, ...]]
) -> Calibration:
    """Calibrate with each model and keep the one with the lowest Bayesian information criterion.

    Models that fail are skipped; the last error is raised only if all of them fail.
    """
    models = [model for model in candidates if _affordable_model(frames, model) == model] or [("focal",)]
    tried = list(_calibrations(frames, camera, models))
    equations = 2 * sum(len(frame.xy_px) for frame in frames)
    variance = _variance_factor(tried[-1][1], frames)
    costs = [
        _misfit(result, frames, variance) + _unknowns(model, frames) * np.log(equations)
        for model, result in tried
    ]
    return tried[int(np.argmin(costs))][1]


def _calibrations(
    frames: Sequence[CalibrationFrame], camera: Camera, models: Sequence[tuple[str, ...]]
) -> Iterator[tuple[tuple[str, ...], Calibration]]:
    """Calibrate with each model and yield the successes; raise the last error if all fail."""
    last_error: StaridError | None = None
    count = 0
    for model in models:
        try:
            result = calibrate(frames, camera, model)
        except StaridError as error:
            last_error = error
            continue
        count += 1
        yield model, result
    if last_error is not None and count == 0:
        raise last_error


def _variance_factor(result: Calibration, frames: Sequence[CalibrationFrame]) -> float:
    """Mean square of the residuals of the used stars on one axis, in units of their variances."""
    weights = [
        frame.axis_sigmas[used].ravel() ** -2.0 for frame, used in zip(frames, result.used, strict=True)
    ]
    return result.sigma_px**2 * float(np.concatenate(weights).mean())


def _misfit(result: Calibration, frames: Sequence[CalibrationFrame], variance: float) -> float:
    """Sum of bounded squared residuals, in units of `variance` times the variance of each star."""
    total = 0.0
    for residual, frame in zip(result.residual_px, frames, strict=True):
        squares = ((residual / frame.axis_sigmas) ** 2).sum(axis=1) / variance
        total += float(np.minimum(squares, _WINDOW_SIGMAS**2).sum())
    return total


def _maps_equally(first: Calibration, second: Calibration) -> bool:
    """Whether two calibrations map the image to within a thousandth of a pixel of each other."""
    if first.estimated != second.estimated:
        return False
    grid = second.camera.border(9)
    moved = first.camera.project(second.camera.back_project(grid))[0] - grid
    return bool(np.nanmax(np.abs(moved)) < 1e-3)
