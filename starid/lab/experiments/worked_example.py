"""The worked example of section 5.1, number by number."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from starid.identification.thesis.database import (
    THESIS_KAPPA,
    DatabaseParameters,
    FeatureDatabase,
    build_database,
)
from starid.identification.thesis.lasso import LAMBDAS
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.matlab_lasso import matlab_path
from starid.identification.thesis.metrics import boresight_error
from starid.identification.thesis.subcell import SubcellSearch
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.figures import Curve, Panel
from starid.lab.experiments.lsi_trials import HALF_FRAME_DEG

_CORNER: Final = (95.0, -85.0)
_COLUMNS: Final = ("n", "A", "r", "sigma_A", "sigma_r")
_NEAREST: Final = 735
_CELLS: Final = (509, 510, 511, 734, 735, 736, 959, 960, 961)
_THETAS: Final = "polar angles θ of the dictionary"
_LABELS: Final = {"mse": "MSE", "one_se": "1SE"}
_OVERLAP, _WIDER_OVERLAP = 0.96, 0.98

_LAMBDA: Final = {"mse": 1.00, "one_se": 1.40}
"""The λ of eq. 2.34 whose weights are nearest to the printed ones."""
_TURN: Final = 3.6
"""Degrees of polar angle per unit of the normalised scale."""


def _author_database(overlap: float, brightest: float) -> FeatureDatabase:
    """Planar database with magnitudes relative to the brightest star of the catalogue.

    These are the weights of the thesis's frame object, a − min(a). The normalised features differ only in r,
    by hundredths of a degree before normalisation. The mean brightness A is larger by −min(a).
    """
    stars = star_catalog()
    parameters = DatabaseParameters(overlap=overlap, kappa=THESIS_KAPPA - brightest)
    return build_database(replace(stars, hp=stars.hp - brightest), parameters)


def _author() -> Results:
    """The author's version: weights relative to the brightest star, six features, MATLAB's `lasso`."""
    least = float(star_catalog().hp.min())
    database, wider = (_author_database(overlap, least) for overlap in (_OVERLAP, _WIDER_OVERLAP))
    centre = np.array(_CORNER) + HALF_FRAME_DEG
    features = database.sky.features(float(centre[0]), float(centre[1]))
    cells = [database.exact_features(cell - 1) for cell in _CELLS]
    columns = [[*database.normalise(cell), cell.theta_deg / _TURN] for cell in cells]
    dictionary = np.ascontiguousarray(np.array(columns).T)
    observation = np.array([*database.normalise(features), features.theta_deg / _TURN])
    path = np.empty((LAMBDAS.size, len(_CELLS)))
    matlab_path(dictionary, observation, LAMBDAS, path)
    centres = np.array([database.grid.centre(cell - 1) for cell in _CELLS])
    units = np.array([*(1.0 / database.scale), _TURN])
    zero = np.array([*database.minimum, 0.0])
    brightness = np.array([0.0, least, 0.0, 0.0, 0.0])
    nearest, _ = LostInSpace(database).nearest(database.normalise(features), theta_rad=features.theta_rad)
    results: Results = {
        "features": features.vector + brightness,
        "theta": np.array(features.theta_deg),
        "normalised": wider.normalise(features),
        "nearest": np.array(nearest),
        "dictionary": np.array([cell.vector + brightness for cell in cells]),
        "thetas": np.array([cell.theta_deg for cell in cells]),
    }
    for kind, penalty in _LAMBDA.items():
        omega = path[int(np.argmin(np.abs(LAMBDAS - penalty)))]
        rebuilt = dictionary @ omega * units + zero
        results[f"omega_{kind}"] = omega / omega.sum()
        results[f"boresight_{kind}"] = omega / omega.sum() @ centres
        results[f"rebuilt_{kind}"] = rebuilt + np.array([*brightness, 0.0])
        error = np.linalg.norm(rebuilt - np.array([*features.vector, features.theta_deg]))
        results[f"epsilon_{kind}"] = np.array(error)
    return {f"author_{name}": value for name, value in results.items()}


def compute(context: Context, part: Part) -> Results:
    """The example as printed, by the sub-cell search, and as the author ran it (`author_…`)."""
    del part
    lsi = context.lost_in_space(_OVERLAP)
    centre = np.array(_CORNER) + HALF_FRAME_DEG
    features = context.sky().features(float(centre[0]), float(centre[1]))
    observation = lsi.database.normalise(features)
    nearest, distance = lsi.nearest(observation)
    solution = lsi.estimate(observation, _NEAREST - 1, float("nan"))
    cells = [lsi.database.exact_features(int(cell)) for cell in solution.cells]
    fine = SubcellSearch(lsi).solve(features)
    results: Results = {
        "features": features.vector,
        "theta": np.array(features.theta_deg),
        "normalised": solution.observation,
        "nearest": np.array(nearest),
        "distance": np.array(distance),
        "distances": np.linalg.norm([lsi.database.normalise(cell) - observation for cell in cells], axis=1),
        "cells": solution.cells,
        "dictionary": np.array([cell.vector for cell in cells]),
        "thetas": np.array([cell.theta_deg for cell in cells]),
        "centres": np.array([lsi.database.grid.centre(int(cell)) for cell in solution.cells]),
        "fine": np.array([fine.right_ascension_deg, fine.declination_deg]),
    }
    for name, estimate in (("mse", solution.mse), ("one_se", solution.one_se)):
        results[f"omega_{name}"] = estimate.omega / estimate.omega.sum()
        results[f"lambda_{name}"] = np.array(estimate.penalty)
        results[f"boresight_{name}"] = np.array([estimate.right_ascension_deg, estimate.declination_deg])
        results[f"psi_{name}"] = np.array(estimate.error_psi)
    return {**results, **_author()}


def _compare_estimate(e: Evaluation, result: Results, kind: str) -> None:
    word = _LABELS[kind]
    author, printed, ours = (
        result[name] - HALF_FRAME_DEG for name in (f"author_boresight_{kind}", f"boresight_{kind}", "fine")
    )
    errors = [float(boresight_error(corner[0], corner[1], *_CORNER)) for corner in (author, printed, ours)]
    e.compare(
        f"ω ({word}) of the nine cells",
        author=result[f"author_omega_{kind}"],
        printed=result[f"omega_{kind}"],
        remark=f"λ = {_LAMBDA[kind]:.2f} as the author ran it; as printed {float(result[f'lambda_{kind}']):.2f}.",
    )
    e.compare(
        f"reconstructed features ψ̃ ({word}): n, A, r, σ_A, σ_r, θ", author=result[f"author_rebuilt_{kind}"]
    )
    e.compare(
        f"error of the reconstruction ε_ψ ({word}), in the features' own units",
        author=result[f"author_epsilon_{kind}"],
        remark=f"On the normalised scale, as printed, {float(result[f'psi_{kind}']):.3f}.",
    )
    e.compare(f"corner of the estimated frame ({word}), α, δ", author=author, printed=printed)
    error = f"error of the estimate ε_f ({word})"
    e.compare(error, author=errors[0], printed=errors[1], ours=errors[2])
    e.compare(f"{error}, sub-cell search of the whole database", ours=errors[2])


def evaluate(e: Evaluation) -> None:
    """All numbers of the section, the dictionary, and figure 5.1."""
    result = e.results["example"]
    vectors, author = result["dictionary"], result["author_dictionary"]
    for quantity, name in (
        ("feature vector (n, A, r, σ_A, σ_r)", "features"),
        ("polar angle θ", "theta"),
        ("normalised feature vector, eq. 5.1", "normalised"),
    ):
        e.compare(quantity, author=result[f"author_{name}"], printed=result[name])
    e.compare(
        "nearest database vector (counted from 1)",
        author=[int(result["author_nearest"]) + 1],
        printed=[int(result["nearest"]) + 1],
        remark=f"As the author ran it with the polar angle as a sixth feature. In five features ours is at distance "
        f"{float(result['distance']):.2f}, {_NEAREST} at {result['distances'][4]:.2f}; by the printed vectors others are nearer too. "
        "The rows below continue from 735, as the thesis does.",
    )
    e.compare("cells of the dictionary", printed=result["cells"] + 1)
    for cell, one, other in zip(_CELLS, author, vectors, strict=True):
        e.compare(f"dictionary vector {cell}", author=one, printed=other)
    e.compare(_THETAS, author=result["author_thetas"], printed=result["thetas"])
    for kind in _LABELS:
        _compare_estimate(e, result, kind)
    published = [e.published(f"dictionary vector {cell}") for cell in _CELLS]
    table: dict[str, Any] = {"cell": result["cells"] + 1}
    for head, features, thetas in (
        ("", vectors, result["thetas"]),
        ("published_", published, e.published(_THETAS)),
    ):
        names = (f"{head}{name}" for name in _COLUMNS)
        table |= dict(zip(names, zip(*features, strict=True), strict=True)) | {f"{head}theta_deg": thetas}
    for kind, word in _LABELS.items():
        table |= {name: result[name] for name in (f"author_omega_{kind}", f"omega_{kind}")}
        table[f"published_omega_{kind}"] = e.published(f"ω ({word}) of the nine cells")
    e.write("dictionary.csv", table)
    _draw(e, result)


def _draw(e: Evaluation, result: Results) -> None:
    """Draw figure 5.1: corners of the nine cells with their weights, of the observation and of the estimate."""
    corners = result["centres"] - HALF_FRAME_DEG
    weights = result["author_omega_mse"]
    cells = (
        Curve([x], [y], "o", f"{cell + 1}: ω = {weight:.2f}", {"ms": 4.0 + 20.0 * abs(weight)})
        for (x, y), cell, weight in zip(corners, result["cells"], weights, strict=True)
    )
    estimate = result["author_boresight_mse"] - HALF_FRAME_DEG
    points = (("r+", "observation", _CORNER), ("kx", "estimate (MSE)", estimate))
    marks = (
        Curve([x], [y], "", label, {"marker": style[1], "color": style[0], "ms": 12})
        for style, label, (x, y) in points
    )
    settings = {"xlabel": "α of the lower-left corner / °", "ylabel": "δ of the lower-left corner / °"}
    e.draw("figure_5_1.png", [Panel("", [*cells, *marks], settings)], width=7.5, height=5.4, legend="best")
