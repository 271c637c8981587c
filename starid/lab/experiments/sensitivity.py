"""Sensitivity to the parameters κ, λ, Γ_min, K, ε and min_samples, as chapter 7 of the thesis suggests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.database import DatabaseParameters, build_database
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.frame_sky import FrameSky, SkyError
from starid.identification.thesis.fsf import ClusterFilter
from starid.identification.thesis.lasso import LAMBDAS, lasso_path
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.matlab_lasso import matlab_path
from starid.identification.thesis.metrics import Confusion
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.fsf import frames_of_seven, noise_of
from starid.lab.experiments.lsi_trials import OFF, error_of, frames_under_test, share

_OVERLAP: Final = 0.995
_TAU: Final = 0.5
_SHOWN_LAMBDAS: Final = (0.05, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)


def _frames(context: Context) -> Array:
    return frames_under_test(context.rng("frames"), OFF, 40.0 * (1.0 - _OVERLAP), context.parameters["every"])


def _observed(context: Context, sky: FrameSky) -> Iterator[tuple[int, tuple[float, float], FeatureVector]]:
    """Yield number, centre and features of the test frames that contain stars."""
    for i, (ra, dec) in enumerate(_frames(context)):
        try:
            yield i, (ra, dec), sky.features(ra % 360.0, dec)
        except SkyError:
            continue


def _kappa(context: Context, kappa: float) -> Results:
    database = build_database(star_catalog(), DatabaseParameters(overlap=_OVERLAP, kappa=kappa))
    solvers = [LostInSpace(database, solver="matlab"), LostInSpace(database)]
    frames = len(_frames(context))
    errors, counts = np.full((2, frames), np.nan), np.zeros(frames)
    for i, place, features in _observed(context, database.sky):
        counts[i] = features.n
        errors[:, i] = [error_of(lsi.solve(features).mse, *place) for lsi in solvers]
    return {"errors": errors, "stars": counts}


def _lambda(context: Context) -> Results:
    lsi = context.lost_in_space(_OVERLAP)
    errors = np.empty((2, len(_SHOWN_LAMBDAS), len(_frames(context))))
    columns = [int(np.argmin(np.abs(LAMBDAS - value))) for value in _SHOWN_LAMBDAS]
    path = np.empty((LAMBDAS.size, 9))
    for i, (ra, dec), features in _observed(context, context.sky()):
        solution = lsi.solve(features)
        centres = np.array([lsi.database.grid.centre(int(cell)) for cell in solution.cells])
        centres[:, 0] = ra + (centres[:, 0] - ra + 180.0) % 360.0 - 180.0
        for j, solve in enumerate((matlab_path, lasso_path)):
            solve(solution.dictionary, solution.observation, LAMBDAS, path)
            for k, at in enumerate(columns):
                total = path[at].sum()
                weights = path[at] / total if abs(total) > 1e-3 else np.eye(9)[4]
                errors[j, k, i] = math.hypot(*(weights @ centres - (ra, dec)))
    return {"errors": errors}


def _gamma(context: Context, side: float) -> Results:
    lsi = context.lost_in_space(_OVERLAP, "matlab")
    rng = context.rng("gamma")
    errors = np.full(len(_frames(context)), np.nan)
    for i, (ra, dec), features in _observed(context, context.sky()):
        turn = rng.uniform(0.0, 2.0 * math.pi)
        centre = ra + 0.5 * math.cos(turn), dec + 0.5 * math.sin(turn)
        observation = lsi.database.normalise(features)
        cell, distance, _ = lsi.nearest_in_region(observation, *centre, side)
        if cell >= 0:
            errors[i] = error_of(lsi.estimate(observation, cell, distance).mse, ra, dec)
    return {"errors": errors}


def _validity(context: Context) -> Results:
    lsi = context.lost_in_space(_OVERLAP, "matlab")
    numbers = np.empty((2, len(_frames(context))))
    for i, place, features in _observed(context, context.sky()):
        estimate = lsi.solve(features).mse
        numbers[:, i] = error_of(estimate, *place), estimate.error_psi
    return {"errors": numbers[0], "psi": numbers[1]}


def _filter(context: Context, epsilon: float, part: float) -> Results:
    noise = noise_of("both", 1.0, 3)
    first, frames = frames_of_seven(context.rng("filter"), noise, int(context.parameters["frames"]))
    total = Confusion()
    for frame in frames:
        chosen = ClusterFilter(epsilon, part * len(frame.observed))(first.observed, frame.observed)
        total += Confusion.of(chosen.true_now, frame.is_star)
    return {"indicators": np.array([total.precision, total.recall, total.accuracy])}


def compute(context: Context, part: Part) -> Results:
    """Errors, or indicators of the filter, for one value of a parameter."""
    v = part.values
    if "kappa" in v:
        return _kappa(context, float(v["kappa"]))
    if "gamma" in v:
        return _gamma(context, float(v["gamma"]))
    if "epsilon" in v:
        return _filter(context, float(v["epsilon"]), float(v["share"]))
    return _lambda(context) if part.key == "lambda" else _validity(context)


def evaluate(e: Evaluation) -> None:
    """A row for each value of each parameter."""
    p = e.parameters
    lines: list[dict[str, Any]] = []

    def add(parameter: str, value: float, measure: str, author: float, printed: float = math.nan) -> None:
        line = {"parameter": parameter, "value": value, "measure": measure}
        lines.append(line | {"as_the_author_ran_it": author, "as_printed": printed})
        other = None if math.isnan(printed) else printed
        e.compare(f"{parameter} = {value:g}: {measure}", author=author, printed=other, unit="%")

    for kappa in p["kappa"]:
        result = e.results[f"kappa-{kappa:g}"]
        stars = f"share within 0.3°, {np.median(result['stars']):.0f} stars a frame"
        add("κ", kappa, stars, *(share(one, 0.3) for one in result["errors"]))
    for value, author, printed in zip(_SHOWN_LAMBDAS, *e.results["lambda"]["errors"], strict=True):
        add("λ", value, "share within 0.1°", share(author, 0.1), share(printed, 0.1))
    for side in p["gamma"]:
        errors = e.results[f"gamma-{side:g}"]["errors"]
        add("Γ_min", side, "share within 0.3°", share(errors, 0.3))
        add("Γ_min", side, "share beyond 1°", 100.0 * float(np.mean(~(errors <= 1.0))))
    validity = e.results["validity"]
    for factor in p["invalid"]:
        kept = validity["psi"] <= factor * _TAU
        gross = 100.0 * float(np.mean(validity["errors"][kept] > 1.0)) if kept.any() else math.nan
        add("K", factor, "share called invalid", 100.0 * float(np.mean(~kept)))
        add("K", factor, "valid answers beyond 1°", gross)
    for part in e.parts:
        if "epsilon" in part.values:
            epsilon, least = part["epsilon"], part["share"]
            precision, recall, _ = 100.0 * e[part]["indicators"]
            quantity = f"ε = {epsilon:g}, min_samples = {least:g}·n"
            line = {"parameter": quantity, "value": epsilon, "measure": "precision and recall"}
            lines.append(line | {"as_the_author_ran_it": precision, "as_printed": recall})
            e.compare(f"{quantity}: precision, recall", printed=f"{precision:.2f}, {recall:.2f} %")
    e.write("sensitivity.csv", lines)
