"""Beyond the thesis: LSI and RSI on the sphere, with random attitudes and the stars of a real sensor."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np

from starid.attitude import Attitude, propagate, random_attitude
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    row,
    write_lines,
)
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
    from starid.interface import make_identifier

    identifier: Any = make_identifier(name)
    identifier.warm_up()
    return identifier


def points(
    rng: np.random.Generator, camera: Any, catalog: Any, attitude: Attitude, noise: Mapping[str, Any]
) -> tuple[Any, Any]:
    """Return positions and fluxes of the detected stars, to 6 mag, with noise and false stars."""
    stars = catalog.brighter_than(_LIMIT + 0.8)
    xy, inside = camera.project(attitude.to_sensor(stars.vectors))
    magnitude = stars.v + rng.normal(0.0, 1.0, len(stars)) * noise["magnitude"]
    seen = inside & (magnitude <= _LIMIT)
    xy = xy[seen] + rng.normal(0.0, 1.0, (int(seen.sum()), 2)) * noise["position"]
    false = int(noise["false"])
    xy = np.concatenate([xy, rng.uniform(0.0, camera.width - 1.0, (false, 2))])
    magnitude = np.concatenate([magnitude[seen], rng.uniform(2.0, _LIMIT, false)])
    order = rng.permutation(magnitude.size)
    return xy[order], 10.0 ** (-0.4 * (magnitude[order] - _ZERO_POINT))


def _parts(parameters: Parameters) -> list[Part]:
    return [
        Part(f"{algorithm}-{number}", {"algorithm": algorithm, "noise": noise})
        for algorithm in ("lsi", "rsi")
        for number, noise in enumerate(parameters["noises"])
    ]


def _compute(context: Context, part: Part) -> Results:
    identifier = _identifier(part.values["algorithm"])
    recursive = part.values["algorithm"] == "rsi"
    rng = context.rng(part.key)
    count = int(context.parameters["frames"])
    numbers = np.full((count, len(_COLUMNS)), np.nan)
    attitude = random_attitude(rng)
    # this process may have used the identifier for other parts
    identifier.reset()
    predicted: Attitude | None = None
    for i in range(count):
        attitude = propagate(attitude, np.radians(_SLEW_DEG), 1.0) if recursive else random_attitude(rng)
        xy, flux = points(rng, identifier.camera, identifier.catalog, attitude, part.values["noise"])
        begin = time.perf_counter()
        if recursive and predicted is not None:
            solution = identifier.track(xy, flux, predicted)
        else:
            solution = identifier.identify(xy, flux)
        elapsed = 1e3 * (time.perf_counter() - begin)
        numbers[i, 2] = solution.valid
        numbers[i, 6] = elapsed
        numbers[i, 7] = solution.mode == "tracking"
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


def _rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    rows = []
    for part in _parts(context.parameters):
        found = dict(zip(_COLUMNS, results[part.key]["numbers"].T, strict=True))
        name, label = part.values["algorithm"].upper(), _label(part.values["noise"])
        valid = found["valid"] > 0.0
        errors = found["cross_arcsec"][valid]
        if name == "LSI":
            rows += [
                row(
                    f"one neighbour and LASSO, boresight within {limit:g}°, {label}",
                    ours=share(found["coarse_deg"], limit),
                    unit="%",
                    digits=1,
                )
                for limit in (0.3, 1.0, 2.0)
            ]
        rows.append(
            row(
                f"{name} verified and valid, {label}",
                ours=100.0 * float(valid.mean()),
                unit="%",
                digits=1,
                at_least=98.0 if part.values["noise"]["false"] <= 5 else None,
            )
        )
        wrong = float(np.count_nonzero(errors > _WRONG_ARCSEC))
        rows.append(row(f"{name} valid but wrong, {label}", ours=wrong, digits=0, at_most=0.0))
        if valid.any():
            middle = float(np.median(errors))
            rows.append(row(f"{name} median cross-boresight error, {label}", ours=middle, unit="″"))
        rows.append(
            row(f"{name} median time a frame, {label}", ours=float(np.median(found["ms"])), unit="ms")
        )
        if name == "RSI":
            inside = 100.0 * float(found["tracking"][1:].mean())
            rows.append(row(f"RSI answered from the region, {label}", ours=inside, unit="%", digits=1))
    return rows


_NOTE: Final = """Camera of 42° on 937 pixels, stars to 6 mag, random attitudes (LSI) or a slew of 0.6° per
frame from a random attitude (RSI); positions and fluxes, without images. The features use the stars to 5.1
mag in the inscribed circle; there are 234 095 cells, 0.42° apart over the whole sphere. The thesis's own
answer, from one nearest neighbour and LASSO, is right in few frames: noise of 0.1 mag already carries several
stars across the brightness limit, and each changes all five features. The features are still useful to order
the cells: for each of the best candidates, the stars vote for a roll and are paired, and the attitude is
verified. An attitude that is not verified is invalid; none may be wrong."""


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    lines = [
        {
            "algorithm": part.values["algorithm"],
            "noise": _label(part.values["noise"]),
            **dict(zip(_COLUMNS, numbers, strict=True)),
        }
        for part in _parts(context.parameters)
        for numbers in results[part.key]["numbers"]
    ]
    table = write_lines(context.folder / "frames.csv", lines)
    return Outcome(tuple(_rows(context, results)), (table,), (_NOTE,))


_NOISES: Final = [
    {"magnitude": 0.0, "position": 0.0, "false": 0},
    {"magnitude": 0.1, "position": 0.2, "false": 0},
    {"magnitude": 0.2, "position": 0.2, "false": 0},
    {"magnitude": 0.1, "position": 0.2, "false": 5},
    {"magnitude": 0.1, "position": 0.2, "false": 20},
]

EXPERIMENTS: Final = (
    Experiment(
        "spherical",
        "LSI and RSI on the sphere, on what a real sensor sees",
        _parts,
        _compute,
        _evaluate,
        full={"noises": _NOISES, "frames": 1000},
        quick={"noises": _NOISES[1:2], "frames": 60},
        revision=2,
    ),
)
