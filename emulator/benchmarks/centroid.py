"""Centroid accuracy on rendered images of the real sky, compared with the Cramér–Rao bound.

The bound is computed for each star from its true position and electrons, the true spot and trail, and the true
variance of every pixel: shot noise of star, sky and dark current, read noise, rounding, and the spread of pixel
sensitivity, which a single image cannot distinguish from light. Saturated pixels carry no information. Flux is
treated as unknown, the sky as known.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.sensor.renderer import Frame, Renderer, SensorModel
from starid.arithmetic.arrays import Array
from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.centroid import star_model
from starid.imaging.detection import Detections, detect

EDGES_V: Final = (-2.0, 2.0, 3.0, 4.0, 4.5, 5.0, 5.5, 6.0)
"""Limits of the magnitude bins."""

DEFAULT_RATES_DEG_S: Final = (0.0, 0.5, 1.0, 2.0)
_ISOLATED_PX: Final = 12.0
_MATCH_PX: Final = 3.0
_EDGE_PX: Final = 12.0
_BRIGHTEST_COMPLETE: Final = 0.5


@dataclass(frozen=True)
class CentroidRow:
    """Accuracy in one magnitude bin at one rate."""

    rate_deg_s: float
    """Body rate across the boresight."""
    v_low: float
    v_high: float
    """Limits of the bin."""
    stars: int
    """Isolated stars in the bin, in all frames."""
    detected_pct: float
    """Percentage of them that were detected."""
    rms_px: float
    """Error per axis, root mean square."""
    bound_px: float
    """Cramér–Rao bound per axis, root mean square over the same stars."""
    ratio: float
    predicted_px: float
    """Error predicted by the detection, root mean square."""
    normalised_squared_error: float
    """Mean of (error / predicted)² per axis; 1 if the prediction is calibrated."""
    bias_px: float
    """Length of the mean error vector."""


def cramer_rao_px(
    xy_px: Array,
    electrons: float,
    sigma_px: float,
    trail_px: tuple[float, float],
    background_variance_e2: float,
    sensor: SensorModel,
    background_e: float,
) -> tuple[float, float]:
    """Return the Cramér–Rao bound of the position (2,) of a star, as standard deviations along x and y in pixels.

    The star has a spot of standard deviation `sigma_px` and a trail along x and y. The variance of a pixel without
    its light is in electrons², the mean in electrons.
    """
    reach = math.ceil(6.0 * sigma_px + 0.5 * math.hypot(*trail_px)) + 2
    left, top = round(xy_px[0]) - reach, round(xy_px[1]) - reach
    side = 2 * reach + 1
    model = np.empty((3, side * side))
    shape = (sigma_px, *trail_px)
    star_model(xy_px[0], xy_px[1], shape, (left, top, side, side), model, np.empty((5, max(side, 11))))
    light = electrons * model[0]
    variance = background_variance_e2 + light + (sensor.prnu * light) ** 2
    full = min(sensor.full_well_e, (sensor.max_dn - sensor.offset_dn) * sensor.gain_e_per_dn)
    weight = np.where(light + background_e < full, 1.0 / variance, 0.0)
    slopes = np.stack([electrons * model[1], electrons * model[2], model[0]])
    information = (slopes * weight) @ slopes.T
    bound = np.linalg.inv(information)
    return math.sqrt(bound[0, 0]), math.sqrt(bound[1, 1])


def measure_centroids(
    rates_deg_s: Sequence[float] = DEFAULT_RATES_DEG_S,
    frames: int = 30,
    seed: int = 1,
    sensor: SensorModel | None = None,
    progress: Callable[[str], None] = lambda _text: None,
) -> list[CentroidRow]:
    """Measure the accuracy of centroids in frames of random attitude, by rate and magnitude; bins without stars are omitted.

    The body turns about an axis across the boresight, with a random direction in every frame.
    """
    if frames < 1 or not rates_deg_s:
        raise EmulatorError(
            f"bench centroid: frames and rates must be at least one each, not {frames} and {len(rates_deg_s)}"
        )
    sensor = SensorModel() if sensor is None else sensor
    renderer = Renderer(Camera.from_fov(), load_catalog(), sensor, seed)
    rows: list[CentroidRow] = []
    for rate in rates_deg_s:
        progress(f"{rate:g} °/s: {frames} frames")
        table = np.concatenate([_one_frame(renderer, rate, index, seed) for index in range(frames)])
        rows += _rows(rate, table)
    return rows


def _one_frame(renderer: Renderer, rate_deg_s: float, index: int, seed: int) -> Array:
    """Return isolated stars (n, 9): V, detected, error x, y, predicted x, y, bound x, y, unused."""
    rng = np.random.default_rng((seed, index, round(1000 * rate_deg_s)))
    attitude = random_attitude(rng)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    rate = math.radians(rate_deg_s) * np.array([math.cos(angle), math.sin(angle), 0.0])
    frame = renderer.render(attitude, rate, index)
    found = detect(frame.image, renderer.sensor.detection_settings())
    return _compare(renderer, frame, found)


def _compare(renderer: Renderer, frame: Frame, detections: Detections) -> Array:
    """Match every isolated star with its detection and its bound."""
    sensor, camera = renderer.sensor, renderer.camera
    truth = frame.stars.xy_px
    gaps = np.linalg.norm(truth[:, None, :] - truth[None, :, :], axis=2)
    np.fill_diagonal(gaps, np.inf)
    inner = np.all((truth > _EDGE_PX) & (truth < [camera.width - _EDGE_PX, camera.height - _EDGE_PX]), axis=1)
    trails = renderer.trails(frame)
    lonely = gaps.min(axis=1, initial=np.inf) > _ISOLATED_PX + np.hypot(trails[:, 0], trails[:, 1])
    still_e = frame.exposure_s * (sensor.sky_e_s(camera.pixel_scale_rad) + sensor.dark_e_s)
    variance = still_e + sensor.read_noise_e**2 + sensor.gain_e_per_dn**2 / 12.0
    rows = []
    for k in np.flatnonzero(inner & lonely):
        bound = cramer_rao_px(
            truth[k],
            float(frame.stars.electrons[k]),
            sensor.psf_sigma_px,
            (float(trails[k, 0]), float(trails[k, 1])),
            variance,
            sensor,
            still_e,
        )
        off = detections.xy_px - truth[k]
        distance = np.hypot(off[:, 0], off[:, 1])
        near = int(np.argmin(distance)) if len(detections) else -1
        seen = near >= 0 and distance[near] < _MATCH_PX
        error = off[near] if seen else np.full(2, np.nan)
        predicted = detections.xy_sigma_px[near] if seen else np.full(2, np.nan)
        rows.append([float(frame.stars.magnitude[k]), float(seen), *error, *predicted, *bound])
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


def _rows(rate: float, table: Array) -> list[CentroidRow]:
    """Summarise the stars at one rate by magnitude."""
    rows = []
    for low, high in itertools.pairwise(EDGES_V):
        stars_in_bin = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        detected = stars_in_bin[stars_in_bin[:, 1] > 0.0]
        if len(detected) == 0:
            continue
        error, predicted, bound = detected[:, 2:4], detected[:, 4:6], detected[:, 6:8]
        rms, least = _rms(error), _rms(bound)
        rows.append(
            CentroidRow(
                rate_deg_s=rate,
                v_low=low,
                v_high=high,
                stars=len(stars_in_bin),
                detected_pct=100.0 * len(detected) / len(stars_in_bin),
                rms_px=rms,
                bound_px=least,
                ratio=rms / least,
                predicted_px=_rms(predicted),
                normalised_squared_error=float(np.mean((error / predicted) ** 2)),
                bias_px=float(np.hypot(*error.mean(axis=0))),
            )
        )
    return rows


def _rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def plot_centroids(rows: Sequence[CentroidRow], path: Path) -> None:
    """Plot error and bound against magnitude, one panel per rate, to an image or PDF file."""
    from starid.storage.plots import figure, save

    rates = sorted({row.rate_deg_s for row in rows})
    plot, panels = figure(1, len(rates), width=3.4 * len(rates) + 0.8, sharey=True, squeeze=False)
    for panel, rate in zip(panels[0], rates, strict=True):
        at_rate = [row for row in rows if row.rate_deg_s == rate]
        middle = [0.5 * (max(row.v_low, _BRIGHTEST_COMPLETE) + row.v_high) for row in at_rate]
        for name, style, size, label in (
            ("bound_px", "k-", 0, "Cramér–Rao bound"),
            ("rms_px", "o", 6, "measured error"),
            ("predicted_px", "_", 14, "error stated"),
        ):
            panel.semilogy(
                middle, [getattr(row, name) for row in at_rate], style, ms=size, mew=2, label=label
            )
        panel.set_title(f"{rate:g} °/s")
        panel.set_xlabel("V magnitude")
    panels[0, 0].set_ylabel("error per axis, px (root mean square)")
    panels[0, 0].legend(loc="upper left")
    with explained(f"{path}: the plot cannot be written", errors=(OSError, ValueError)):
        save(plot, path)
