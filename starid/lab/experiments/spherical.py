"""Beyond the thesis: LSI and RSI on the sphere, with random attitudes and the stars of a real sensor."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np

from starid.attitude import Attitude, propagate, random_attitude
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.lsi_trials import share

_WRONG_ARCSEC: Final = 300.0
_LIMIT: Final = 6.0
_ZERO_POINT: Final = 20.3
_SLEW_DEG: Final = (0.3, 0.5, 0.2)
_COLUMNS: Final = (
    "coarse_deg",
    "coarse_roll_deg",
    "valid",
    "cross_arcsec",
    "roll_arcsec",
    "tried",
    "ms",
    "tracking",
)


@lru_cache(maxsize=2)
def _identifier(name: str) -> Any:
    from starid.identification.star_identifier import make_identifier

    identifier: Any = make_identifier(name, zero_point=_ZERO_POINT, detected_limit=_LIMIT)
    identifier.warm_up()
    return identifier


def points(
    rng: np.random.Generator, camera: Any, catalog: Any, attitude: Attitude, noise: Mapping[str, Any]
) -> tuple[Any, Any]:
    """Return positions and fluxes of the detected stars, to 6 mag, with noise and false stars."""
    stars = catalog.brighter_than(_LIMIT + 0.8)
    xy, inside = camera.project(attitude.to_sensor(stars.vectors))
    magnitude = stars.v + rng.normal(0.0, 1.0, len(stars)) * noise["magnitude"]
    is_detected = inside & (magnitude <= _LIMIT)
    xy = xy[is_detected] + rng.normal(0.0, 1.0, (int(is_detected.sum()), 2)) * noise["position"]
    false = int(noise["false"])
    xy = np.concatenate([xy, rng.uniform(0.0, camera.width - 1.0, (false, 2))])
    magnitude = np.concatenate([magnitude[is_detected], rng.uniform(2.0, _LIMIT, false)])
    order = rng.permutation(magnitude.size)
    return xy[order], 10.0 ** (-0.4 * (magnitude[order] - _ZERO_POINT))


def compute(context: Context, part: Part) -> Results:
    """Errors, times and modes of the frames, (n, 8), in the order of `_COLUMNS`."""
    identifier = _identifier(part["algorithm"])
    recursive = part["algorithm"] == "rsi"
    rng = context.rng(part.key)
    count = int(context.parameters["frames"])
    numbers = np.full((count, len(_COLUMNS)), np.nan)
    attitude = random_attitude(rng)
    # this process may have used the identifier for other parts
    identifier.reset()
    predicted: Attitude | None = None
    for i in range(count):
        attitude = propagate(attitude, np.radians(_SLEW_DEG), 1.0) if recursive else random_attitude(rng)
        xy, flux = points(rng, identifier.camera, identifier.catalog, attitude, part["noise"])
        begin = time.perf_counter()
        solution = (
            identifier.track(xy, flux, predicted)
            if recursive and predicted is not None
            else identifier.identify(xy, flux)
        )
        elapsed = 1e3 * (time.perf_counter() - begin)
        numbers[i, 2], numbers[i, 6], numbers[i, 7] = solution.valid, elapsed, solution.mode == "tracking"
        predicted = solution.attitude if solution.valid else None
        if solution.valid:
            error = solution.attitude.error_to(attitude)
            numbers[i, 3:5] = error.cross_boresight_arcsec, error.roll_arcsec
        if not recursive:
            report = identifier.last_report
            numbers[i, 5] = report.tried
            if report.coarse is not None:
                error = report.coarse.error_to(attitude)
                numbers[i, :2] = error.cross_boresight_arcsec / 3600.0, error.roll_arcsec / 3600.0
    return {"numbers": numbers}


def _label(noise: Mapping[str, Any]) -> str:
    return f"σ {noise['magnitude']:g} mag, {noise['position']:g} px, {noise['false']} false stars"


def evaluate(e: Evaluation) -> None:
    """Shares, errors and times of each algorithm and noise; none may be valid and wrong."""
    lines = []
    for part in e.parts:
        numbers, noise = e[part]["numbers"], part["noise"]
        name, label = part["algorithm"].upper(), _label(noise)
        head = {"algorithm": part["algorithm"], "noise": label}
        lines += [head | dict(zip(_COLUMNS, frame, strict=True)) for frame in numbers]
        columns = dict(zip(_COLUMNS, numbers.T, strict=True))
        valid = columns["valid"] > 0.0
        errors = columns["cross_arcsec"][valid]
        for limit in (0.3, 1.0, 2.0) if name == "LSI" else ():
            quantity = f"one neighbour and LASSO, boresight within {limit:g}°, {label}"
            e.compare(quantity, ours=share(columns["coarse_deg"], limit), unit="%", digits=1)
        bound = "≥ 98" if noise["false"] <= 5 else ""
        right = 100.0 * float(valid.mean())
        e.compare(f"{name} verified and valid, {label}", ours=right, unit="%", digits=1, check=bound)
        wrong = float(np.count_nonzero(errors > _WRONG_ARCSEC))
        e.compare(f"{name} valid but wrong, {label}", ours=wrong, digits=0, check="≤ 0")
        if valid.any():
            middle = float(np.median(errors))
            e.compare(f"{name} median cross-boresight error, {label}", ours=middle, unit="″")
        e.compare(f"{name} median time a frame, {label}", ours=float(np.median(columns["ms"])), unit="ms")
        if name == "RSI":
            inside = 100.0 * float(columns["tracking"][1:].mean())
            e.compare(f"RSI answered from the region, {label}", ours=inside, unit="%", digits=1)
    e.write("frames.csv", lines)
