"""Sensitivity to the parameters κ, λ, Γ_min, K, ε and min_samples, as chapter 7 of the thesis suggests."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.lab.experiments.comparison import shown
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    parts_of,
    star_catalog,
    write_csv,
)
from starid.lab.experiments.fsf import frames_of_seven, noise_of
from starid.lab.experiments.lsi_trials import OFF, frames_under_test, share
from starid.plots import figure, save
from starid.thesis.database import DatabaseParameters, build_database
from starid.thesis.frame_sky import SkyError
from starid.thesis.fsf import ClusterFilter
from starid.thesis.lasso import LAMBDAS, lasso_path
from starid.thesis.lsi import LostInSpace
from starid.thesis.matlab_lasso import matlab_path
from starid.thesis.metrics import Confusion, boresight_error

_OVERLAP: Final = 0.995
_TAU: Final = 0.5
_SHOWN_LAMBDAS: Final = (0.05, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)

_NOTE: Final = """One parameter is varied at a time, the others are as in the thesis; the frames are those of
figure 6.1, moved off the grid. **κ** sets the number of stars: with more stars the features are smoother and
positions more alike. **λ** is fixed instead of chosen for the least error; as the author ran it, a larger one
mixes in more of the neighbours. **Γ_min**: the side of the search region about a position that is 0.5° off.
**K**: how many answers of LSI K·τ would make invalid, and how many of the others are more than 1° off. **ε,
min_samples**: precision and recall of the filter on the seven stars with three false ones, at noise factor 1.
The overlap p has a separate experiment, `lsi-accuracy`."""


def _parts(parameters: Parameters) -> list[Part]:
    return [
        *parts_of("kappa-{kappa:g}", kappa=parameters["kappa"]),
        Part("lambda"),
        *parts_of("gamma-{gamma:g}", gamma=parameters["gamma"]),
        Part("validity"),
        *parts_of(
            "epsilon-{epsilon:g}-share-{share:g}", epsilon=parameters["epsilon"], share=parameters["share"]
        ),
    ]


def _frames(context: Context) -> Any:
    return frames_under_test(context.rng("frames"), OFF, 40.0 * (1.0 - _OVERLAP), context.parameters["every"])


def _kappa(context: Context, kappa: float) -> Results:
    database = build_database(star_catalog(), DatabaseParameters(overlap=_OVERLAP, kappa=kappa))
    solvers = [LostInSpace(database, solver="matlab"), LostInSpace(database)]
    frames = _frames(context)
    errors, counts = np.full((2, len(frames)), np.nan), np.zeros(len(frames))
    for i, (ra, dec) in enumerate(frames):
        try:
            features = database.sky.features(ra % 360.0, dec)
        except SkyError:
            continue
        counts[i] = features.n
        for j, lsi in enumerate(solvers):
            estimate = lsi.solve(features).mse
            errors[j, i] = boresight_error(estimate.right_ascension_deg, estimate.declination_deg, ra, dec)
    return {"errors": errors, "stars": counts}


def _lambda(context: Context) -> Results:
    lsi = context.lost_in_space(_OVERLAP)
    frames = _frames(context)
    errors = np.empty((2, len(_SHOWN_LAMBDAS), len(frames)))
    chosen = [int(np.argmin(np.abs(LAMBDAS - value))) for value in _SHOWN_LAMBDAS]
    path = np.empty((LAMBDAS.size, 9))
    for i, (ra, dec) in enumerate(frames):
        solution = lsi.solve(context.sky().features(ra % 360.0, dec))
        centres = np.array([lsi.database.grid.centre(int(cell)) for cell in solution.cells])
        centres[:, 0] = ra + (centres[:, 0] - ra + 180.0) % 360.0 - 180.0
        for j, solve in enumerate((matlab_path, lasso_path)):
            solve(solution.dictionary, solution.observation, LAMBDAS, path)
            for k, at in enumerate(chosen):
                total = path[at].sum()
                weights = path[at] / total if abs(total) > 1e-3 else np.eye(9)[4]
                errors[j, k, i] = math.hypot(*(weights @ centres - (ra, dec)))
    return {"errors": errors}


def _gamma(context: Context, side: float) -> Results:
    lsi = context.lost_in_space(_OVERLAP, "matlab")
    rng = context.rng("gamma")
    frames = _frames(context)
    errors = np.full(len(frames), np.nan)
    for i, (ra, dec) in enumerate(frames):
        turn = rng.uniform(0.0, 2.0 * math.pi)
        centre = ra + 0.5 * math.cos(turn), dec + 0.5 * math.sin(turn)
        observation = lsi.database.normalise(context.sky().features(ra % 360.0, dec))
        cell, distance, _ = lsi.nearest_in_region(observation, *centre, side)
        if cell >= 0:
            estimate = lsi.estimate(observation, cell, distance).mse
            errors[i] = boresight_error(estimate.right_ascension_deg, estimate.declination_deg, ra, dec)
    return {"errors": errors}


def _validity(context: Context) -> Results:
    lsi = context.lost_in_space(_OVERLAP, "matlab")
    frames = _frames(context)
    found = np.empty((2, len(frames)))
    for i, (ra, dec) in enumerate(frames):
        estimate = lsi.solve(context.sky().features(ra % 360.0, dec)).mse
        error = boresight_error(estimate.right_ascension_deg, estimate.declination_deg, ra, dec)
        found[:, i] = error, estimate.error_psi
    return {"errors": found[0], "psi": found[1]}


def _filter(context: Context, epsilon: float, part: float) -> Results:
    noise = noise_of("both", 1.0, 3)
    first, frames = frames_of_seven(context.rng("filter"), noise, int(context.parameters["frames"]))
    total = Confusion()
    for frame in frames:
        chosen = ClusterFilter(epsilon, part * len(frame.observed))(first.observed, frame.observed)
        total += Confusion.of(chosen.true_now, frame.is_star)
    return {"indicators": np.array([total.precision, total.recall, total.accuracy])}


def _compute(context: Context, part: Part) -> Results:
    v = part.values
    if "kappa" in v:
        return _kappa(context, float(v["kappa"]))
    if "gamma" in v:
        return _gamma(context, float(v["gamma"]))
    if "epsilon" in v:
        return _filter(context, float(v["epsilon"]), float(v["share"]))
    return _lambda(context) if part.key == "lambda" else _validity(context)


def _line(
    lines: list[tuple[str, float, str, float, float]],
    parameter: str,
    value: float,
    measure: str,
    author: float,
    printed: float = math.nan,
) -> Row:
    """Make a row of the report and add it to the table."""
    lines.append((parameter, value, measure, author, printed))
    return shown(
        f"{parameter} = {value:g}: {measure}",
        author=author,
        printed=None if math.isnan(printed) else printed,
        unit="%",
    )


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    lines: list[tuple[str, float, str, float, float]] = []
    rows: list[Row] = []
    for kappa in context.parameters["kappa"]:
        result = results[f"kappa-{kappa:g}"]
        stars = f"share within 0.3°, {np.median(result['stars']):.0f} stars a frame"
        rows.append(_line(lines, "κ", kappa, stars, *(share(one, 0.3) for one in result["errors"])))
    author, printed = results["lambda"]["errors"]
    rows += [
        _line(lines, "λ", value, "share within 0.1°", share(author[k], 0.1), share(printed[k], 0.1))
        for k, value in enumerate(_SHOWN_LAMBDAS)
    ]
    for side in context.parameters["gamma"]:
        errors = results[f"gamma-{side:g}"]["errors"]
        rows.append(_line(lines, "Γ_min", side, "share within 0.3°", share(errors, 0.3)))
        rows.append(_line(lines, "Γ_min", side, "share beyond 1°", 100.0 * float(np.mean(~(errors <= 1.0)))))
    validity = results["validity"]
    for factor in context.parameters["invalid"]:
        kept = validity["psi"] <= factor * _TAU
        gross = 100.0 * float(np.mean(validity["errors"][kept] > 1.0)) if kept.any() else math.nan
        rows.append(_line(lines, "K", factor, "share called invalid", 100.0 * float(np.mean(~kept))))
        rows.append(_line(lines, "K", factor, "valid answers beyond 1°", gross))
    for epsilon in context.parameters["epsilon"]:
        for part in context.parameters["share"]:
            precision, recall, _ = results[f"epsilon-{epsilon:g}-share-{part:g}"]["indicators"]
            quantity = f"ε = {epsilon:g}, min_samples = {part:g}·n"
            lines.append((quantity, epsilon, "precision and recall", 100.0 * precision, 100.0 * recall))
            rows.append(
                shown(
                    f"{quantity}: precision, recall",
                    printed=f"{100.0 * precision:.2f}, {100.0 * recall:.2f} %",
                )
            )
    names = ("parameter", "value", "measure", "as_the_author_ran_it", "as_printed")
    columns = dict(zip(names, zip(*lines, strict=True), strict=True))
    table = write_csv(context.folder / "sensitivity.csv", columns)
    return Outcome(tuple(rows), (table, _draw(context, results)), (_NOTE,))


def _draw(context: Context, results: Mapping[str, Results]) -> str:
    fig, axes = figure(2, 2, width=9.0, height=7.0)
    parameters = context.parameters
    kappa = [results[f"kappa-{value:g}"]["errors"] for value in parameters["kappa"]]
    errors = results["lambda"]["errors"]
    for j, words in enumerate(("as the author ran it", "as printed")):
        axes[0, 0].plot(parameters["kappa"], [share(one[j], 0.3) for one in kappa], "o-", label=words)
        axes[0, 1].plot(_SHOWN_LAMBDAS, [share(one, 0.1) for one in errors[j]], "o-", label=words)
    sides = [results[f"gamma-{value:g}"]["errors"] for value in parameters["gamma"]]
    axes[1, 0].plot(parameters["gamma"], [share(one, 0.3) for one in sides], "o-", label="within 0.3°")
    for epsilon in parameters["epsilon"]:
        found = [results[f"epsilon-{epsilon:g}-share-{part:g}"]["indicators"] for part in parameters["share"]]
        axes[1, 1].plot(
            parameters["share"], [100.0 * one[2] for one in found], "o-", label=f"ε = {epsilon:g}"
        )
    axes[0, 0].set(xlabel="κ / mag", ylabel="share within 0.3° / %")
    axes[0, 1].set(xlabel="λ", ylabel="share within 0.1° / %")
    axes[1, 0].set(xlabel="Γ / °", ylabel="share / %")
    axes[1, 1].set(xlabel="min_samples / n", ylabel="accuracy of the filter / %")
    for axis in axes.ravel():
        axis.legend()
    return save(fig, context.folder / "sensitivity.png")


EXPERIMENTS: Final = (
    Experiment(
        "sensitivity",
        "Sensitivity to κ, λ, Γ_min, K, ε and min_samples: what chapter 7 asks for",
        _parts,
        _compute,
        _evaluate,
        full={
            "kappa": [10.0, 10.5, 11.0, 11.5, 12.0],
            "gamma": [1.0, 2.0, 3.0, 3.96, 4.95, 8.0, 16.0],
            "invalid": [1.0, 2.0, 5.0, 10.0, 20.0],
            "epsilon": [0.1, 0.2, 0.4, 0.8, 1.6],
            "share": [0.25, 0.5, 0.75, 1.0],
            "every": 4,
            "frames": 150,
        },
        quick=None,
    ),
)
