"""The attitude from few stars near a predicted attitude whose error is known.

Lost in space, four stars are needed to know that the attitude is not chance. A tracker knows more: where each star will be to a
pixel, and how bright. A detection near such a place, as bright as expected, is hardly chance, even if it stands only three sigmas
out of the noise. The prediction and the stars are combined by weighted least squares, so even two close stars do not leave the
roll open.

The bound on the probability of a false answer is ``Π λᵢ / k!``: k detections lie near places by chance. λᵢ is the mean number of
detections like the one of star i in the gates of all places of stars of its brightness: local maxima of noise; if the prediction is
wrong, other stars, as many as the catalogue has in the field; and whatever else the image shows around the places, such as the edge of
a body, counted in the image itself.

The stars must also be able to contradict the prediction, which a motion that nobody expected makes wrong by more than its covariance
states. An error e passes the test of the difference d of the prediction from the attitude of the stars alone,
``dᵀ (C + S)⁻¹ d ≤ g`` with the covariances C and S of both, and leaves an error ``K e`` in the answer, where ``K = S (C + S)⁻¹``. Few
stars close together leave such an error unnoticed only about the axis through them. The risk is therefore, as in the integrity
monitoring of satellite navigation, the share of predictions that are wrong times the probability that an error about a random axis
passes, and is then too large in the answer.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask, elementwise
from starid.arithmetic.elementary import exp, log, log10, square
from starid.arithmetic.matrices import carried, dot, eigenvectors, inverse, product, root
from starid.attitude import Attitude
from starid.camera import Camera
from starid.camera.position_errors import camera_jacobian, error_matrices, rotation_jacobian
from starid.catalog import StarCatalog
from starid.catalog.aberration import aberrated
from starid.identification.error_risk import combined_freedom, flagged, normal_above, normal_density
from starid.identification.geometric.refinement import PRIOR_FREEDOM
from starid.identification.solution import Reason, Solution
from starid.imaging.detection import Detections

MIN_STARS: Final = 2
"""Least number of stars."""

GATE: Final = 13.8
"""Largest squared distance of a star from its place over its variance: 0.1 % of true stars have more (χ², 2 degrees of freedom)."""

MAGNITUDE_GATE: Final = 1.0
"""Largest difference from the expected magnitude, besides three sigmas of the flux: colours of stars, and their variability."""

_TWO_PI_TO_3_2: Final = 2.0 * math.pi * math.sqrt(2.0 * math.pi)

_SINGULAR: Final = 1e12
"""Condition from which stars do not determine all three axes."""

_MAX_CONTRADICTION: Final = 16.27
"""Largest squared difference of prediction and stars over its variance (χ², 3 degrees of freedom): 0.1 % of good predictions have more."""

WRONG_PREDICTIONS: Final = 1e-3
"""Assumed share of predictions that are wrong by more than their covariance states: at 1 Hz, one in a quarter of an hour."""

_MAX_CHI2: Final = (13.8, 18.5, 22.5, 26.1, 29.6, 32.9, 36.1, 39.3, 42.3, 45.3)
"""Quantiles of χ² with 2, 4, 6 … degrees of freedom that 0.1 % exceed."""


_STEPS: Final = tuple(0.3 + 0.03 * step for step in range(41))
"""Angles at which the bound on unnoticed errors is evaluated, over the angle that leaves the largest error."""


class Prediction(NamedTuple):
    """A predicted attitude.

    Attributes
    ----------
    attitude : Attitude
    covariance : ndarray (3, 3)
        Covariance of its error, rad², sensor frame.
    freedom : float
        Degrees of freedom from which the scale of the covariance was estimated.
    """

    attitude: Attitude
    covariance: Array
    freedom: float


def noise_peaks(ratio: Array, sigma_px: float) -> Array:
    """Mean number of local maxima per pixel above `ratio` sigmas in white noise smoothed by a Gaussian.

    Adler (1981), theorem 6.3.1: ``|Λ|^½ (2π)^(−3/2) u exp(−u²/2)``, where ``Λ = 1/(2σ²)`` is the variance of the slopes.
    """
    return np.asarray(
        ratio * elementwise(exp, -0.5 * square(ratio)) / (_TWO_PI_TO_3_2 * 2.0 * square(sigma_px))
    )


def expected_places(
    camera: Camera, stars: StarCatalog, predicted: Attitude, observer_velocity: Array | None = None
) -> tuple[Indices, Array]:
    """Return the rows (m,) of the stars that a predicted attitude shows, and their places (m, 2), pixels."""
    near = stars.in_cone(predicted.boresight, camera.field_radius_rad)
    icrs = stars.vectors[near]
    if observer_velocity is not None:
        icrs = aberrated(icrs, observer_velocity)
    xy, inside = camera.project(predicted.to_sensor(icrs))
    return near[inside].astype(np.int64), xy[inside]


def solve_with_prediction(
    camera: Camera,
    stars: StarCatalog,
    detections: Detections,
    prediction: Prediction,
    zero_point: float,
    max_false_probability: float,
    largest_error_deg: float,
    *,
    wrong_predictions: float = WRONG_PREDICTIONS,
    rivals: Array | None = None,
    searched: Mask | None = None,
    observer_velocity: Array | None = None,
    camera_covariance: Array | None = None,
) -> Solution:
    """Find the attitude from the stars near their predicted places.

    Parameters
    ----------
    camera : Camera
        The camera of the positions.
    stars : StarCatalog
        Stars that may be seen.
    detections : Detections
        Detections near these places, also faint ones; see `starid.imaging.star_windows.detect_near`.
    prediction : Prediction
        The predicted attitude.
    zero_point : float
        V of a star that yields a flux of one, for a star of solar colour.
    max_false_probability : float
        Largest bound on the probability of a false answer.
    largest_error_deg : float
        Largest error of an answer, degrees; see `starid.identification.error_risk.flagged`.
    wrong_predictions : float
        Share of predictions that are assumed to be wrong by more than their covariance states.
    rivals : ndarray (n,), optional
        Detections like each, per square pixel, around all places; see `starid.imaging.star_windows.Windows`.
    searched : ndarray (m,) bool, optional
        Whether anything can be found at each place that `expected_places` returns; by default at each.
    observer_velocity : ndarray (3,), optional
        See `starid.identification.star_identifier.StarIdentifier.identify`.
    camera_covariance : ndarray (9, 9), optional
        Covariance of the camera's parameters.

    Returns
    -------
    Solution
        Its covariance is that of prediction and stars together. `catalog_index` refers to `stars`.
    """
    invalid = Solution.invalid(Reason.PREDICTION_LOST, mode="tracking")
    predicted, covariance, _ = prediction
    rows, places = expected_places(camera, stars, predicted, observer_velocity)
    if len(detections) < MIN_STARS or len(rows) < MIN_STARS:
        return Solution.invalid(Reason.TOO_FEW_STARS, mode="tracking")
    directions = camera.back_project(places)
    slopes = rotation_jacobian(camera.params, directions)
    errors = error_matrices(detections.position_errors)
    off = detections.xy_px[None, :, :] - places[:, None, :]
    camera_covariance = np.zeros((9, 9)) if camera_covariance is None else camera_covariance
    by_camera = camera_jacobian(camera.params, directions)
    spread = carried(slopes, covariance) + carried(by_camera, camera_covariance)
    gates = spread[:, None] + errors[None, :]
    distance2 = _squares(off, inverse(gates))
    with np.errstate(divide="ignore", invalid="ignore"):
        fainter = zero_point - 2.5 * elementwise(log10, detections.flux)[None, :] - stars.v[rows][:, None]
    blur = 1.0857 * detections.flux_sigma / detections.flux
    fits = (distance2 <= GATE) & (np.abs(fainter) <= MAGNITUDE_GATE + 3.0 * blur[None, :])
    pairs = _assigned(distance2 + np.where(fits, 0.0, np.inf))
    while len(pairs) >= MIN_STARS:
        place, row = pairs.T
        weights = inverse(gates[place, row] - carried(slopes[place], covariance))
        turn, gain, information = _combined(slopes[place], off[place, row], weights, covariance)
        residual = off[place, row] - product(slopes[place], turn)
        each = _squares(residual, weights)
        chi2 = float(each.sum() + dot(turn, product(inverse(covariance), turn)))
        if chi2 <= _MAX_CHI2[min(len(pairs), len(_MAX_CHI2)) - 1] + 2.0 * max(len(pairs) - len(_MAX_CHI2), 0):
            break
        pairs = np.delete(pairs, int(np.argmax(each)), axis=0)
    else:
        return invalid
    if _contradicted(turn, information, covariance):
        return invalid
    gate = gates[place, row]
    area = math.pi * GATE * np.sqrt(gate[:, 0, 0] * gate[:, 1, 1] - gate[:, 0, 1] * gate[:, 1, 0])
    ratio = np.maximum(detections.flux[row] / detections.flux_sigma[row], 1.0)
    magnitude = stars.v[rows]
    alike = np.abs(magnitude[place, None] - magnitude[None, :]) <= MAGNITUDE_GATE + 3.0 * blur[row, None]
    windows = (alike if searched is None else alike & searched).sum(axis=1)
    density = alike.sum(axis=1) / (camera.width * camera.height)
    by_chance = windows * (noise_peaks(ratio, detections.psf_sigma_px) + density)
    if rivals is not None:
        by_chance = by_chance + rivals[row]
    log_false = math.fsum(log(each / (k + 1.0)) for k, each in enumerate((area * by_chance).tolist()))
    if log_false > log(max_false_probability):
        return invalid
    # errors of the camera displace neighbouring stars alike, so they are not averaged
    from_camera = np.sum(product(gain, by_camera[place]), axis=0)
    rest = np.eye(3) - np.sum(product(gain, slopes[place]), axis=0)
    noise, carried_on = np.sum(carried(gain, errors[row]), axis=0), carried(rest, covariance)
    freedom = combined_freedom((noise, PRIOR_FREEDOM), (carried_on, prediction.freedom))
    solution = Solution(
        valid=True,
        reason=Reason.OK,
        quaternion_xyzw=predicted.rotated(turn).quaternion_xyzw,
        detection_index=row,
        catalog_index=rows[place],
        hip=stars.hip[rows[place]],
        covariance=noise + carried_on + carried(from_camera, camera_covariance),
        freedom=freedom,
        rms_px=math.sqrt(float(np.mean(np.sum(square(residual), axis=1)))),
        sigma_px=math.sqrt(float(np.mean(errors[row, 0, 0] + errors[row, 1, 1])) / 2.0),
        probability_false=exp(min(log_false, 0.0)),
        mode="tracking",
    )
    unnoticed = unnoticed_share(information, covariance, math.radians(largest_error_deg))
    return flagged(solution, largest_error_deg, wrong_predictions * unnoticed)


def _assigned(cost: Array) -> Indices:
    """Pairs (k, 2) of rows and columns of finite cost, cheapest first, each row and column once."""
    pairs: list[tuple[int, int]] = []
    left = cost.copy()
    while left.size and np.isfinite(left.min()):
        i, j = divmod(int(np.argmin(left)), left.shape[1])
        pairs.append((i, j))
        left[i, :] = np.inf
        left[:, j] = np.inf
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _combined(slopes: Array, off: Array, weights: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Return the weighted mean of prediction and stars, a rotation (3,), the gains (n, 3, 2), and the stars' information (3, 3)."""
    weighted = product(slopes.transpose(0, 2, 1), weights)
    information = np.sum(product(weighted, slopes), axis=0)
    gain = product(inverse(inverse(covariance) + information), weighted)
    return np.sum(product(gain, off[:, :, None])[:, :, 0], axis=0), gain, np.asarray(information)


def _squares(offsets: Array, weights: Array) -> Array:
    """Return xᵀ W x for vectors (…, 2) and matrices (…, 2, 2)."""
    x, y = offsets[..., 0], offsets[..., 1]
    mixed = weights[..., 0, 1] + weights[..., 1, 0]
    return np.asarray(square(x) * weights[..., 0, 0] + x * y * mixed + square(y) * weights[..., 1, 1])


def _contradicted(turn: Array, information: Array, covariance: Array) -> bool:
    """Whether stars and prediction contradict each other, or the stars leave an axis open."""
    axes, _ = eigenvectors(information)
    if not axes[2] <= _SINGULAR * axes[0]:
        return True
    stars = inverse(information)
    alone = product(product(stars, inverse(covariance) + information), turn)
    return bool(dot(alone, product(inverse(covariance + stars), alone)) > _MAX_CONTRADICTION)


def unnoticed_share(information: Array, covariance: Array, limit_rad: float) -> float:
    """Return a bound on the share of wrong predictions that cause an error above a limit, unnoticed.

    The error of a prediction is a rotation by an angle r about a random axis; the bound holds for each r. The axis u about which
    least is noticed for an error about axis i is that of S aᵢ. Of the ellipsoid of errors that pass, the section perpendicular to u is
    ``π E[(g − (m + z)²)₊] √(det(C + S)/v)``, where ``v = uᵀ (C + S) u``, ``m = r/√v`` and z is a standard normal deviate: the noise
    shifts the section, which leaves its area as it is, and shortens its distance. The share of the axes within it is this section over
    2πr². What is left in the answer, ``(K u)ᵢ r``, has noise of the covariance P of the answer, which is independent of the test.

    Parameters
    ----------
    information : ndarray (3, 3)
        Inverse of the covariance S of the attitude of the stars alone, rad⁻², sensor frame.
    covariance : ndarray (3, 3)
        Covariance C of the prediction, rad², sensor frame.
    limit_rad : float
        The limit, radians.
    """
    stars, answer = inverse(information), inverse(inverse(covariance) + information)
    both = covariance + stars
    weights, determinant = inverse(both), float(np.prod(square(np.diag(root(both)))))
    share = 0.0
    for axis in range(3):
        towards = stars[:, axis] / math.sqrt(dot(stars[:, axis], stars[:, axis]))
        variance = dot(towards, product(both, towards))
        left = abs(dot(stars[axis], product(weights, towards)))
        sigma = math.sqrt(float(answer[axis, axis]))
        for step in _STEPS:
            angle = step * limit_rad / left
            section = _mean_excess(angle / math.sqrt(variance)) * math.sqrt(determinant / variance)
            within = min(1.0, section / (2.0 * square(angle)))
            share = max(share, within * normal_above(limit_rad * (1.0 - step) / sigma))
    return share


def _mean_excess(m: float) -> float:
    """Mean of ``(g − (m + z)²)₊`` over a standard normal deviate z."""
    g = _MAX_CONTRADICTION
    low, high = -math.sqrt(g) - m, math.sqrt(g) - m
    inside = normal_above(low) - normal_above(high)
    return (g - 1.0 - m * m) * inside - low * normal_density(high) + high * normal_density(low)
