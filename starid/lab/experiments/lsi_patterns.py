"""Does ε_ψ reveal a bad answer? Patterns 6.20–6.27 and B, errors against thresholds 6.28–6.30 and C."""

from __future__ import annotations

import itertools
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.lab.experiments.experiment import Evaluation
from starid.lab.experiments.figures import Curve
from starid.lab.experiments.lsi_trials import GRID_LABELS, OFF, ON, count_label

_CASES: Final = {
    "none": "no noise",
    **{f"root-both-{n}": f"μ = {n}" for n in (1, 2, 3)},
    **{f"{kind}-{n}": count_label(n, kind) for kind in ("false", "missing") for n in (1, 2, 3)},
}
_GROUPS: Final = {"root-both": "noise", "false": "false stars", "missing": "missing stars"}
_TRIALS: Final = slice(559, 600)
_PLOT_FLOOR: Final = 1e-6
_STEP: Final = 0.01


def add_patterns(e: Evaluation) -> None:
    """Add rows, figures and tables, if all cases were computed."""
    if not all(f"{case}-{grid}" in e.results for case in _CASES for grid in (ON, OFF)):
        return
    for grid in (ON, OFF):
        _draw_patterns(e, grid)
    for quantity, symbol, name in (("f", "ε_f", "figures_6_28_to_6_30"), ("theta", "ε_θ", "figures_c")):
        _draw_thresholds(e, quantity, symbol, name)
    _compare(e)


def _draw_patterns(e: Evaluation, grid: str) -> None:
    trials = np.arange(_TRIALS.start + 1, _TRIALS.stop + 1)
    errors = {"f_author_mse": "ε_f / °", "theta_author_mse": "ε_θ / °"}
    curves = (
        (
            f"{title}: {words}",
            Curve(
                trials,
                1.0 + np.log10(np.maximum(e.results[f"{case}-{grid}"][key][_TRIALS], _PLOT_FLOOR)),
                style,
                label,
            ),
        )
        for (case, title), (name, words) in itertools.product(_CASES.items(), errors.items())
        for key, style, label in ((name, "-", "error"), ("psi_author", "--", "ε_ψ"))
    )
    title = f"LSI (MSE) as the author ran it, trials 560 to 600, frames {GRID_LABELS[grid]}"
    axes = {"xlabel": "trial", "ylabel": "1 + log₁₀ ε"}
    look = {"columns": 2, "width": 9.5, "height": 15.0, "sharex": True, "legend": "upper right"}
    e.draw(f"figures_6_20_to_6_27_and_b_{grid}.png", curves, axes=axes, title=title, **look)


def _below_thresholds(errors: Array, psi: Array, thresholds: Array) -> dict[str, Array]:
    """Mean and standard deviation of the errors with ε_ψ below each threshold; NaN if there are none."""
    order = np.argsort(psi)
    counts = np.searchsorted(psi[order], thresholds)
    sums = np.concatenate([[0.0], np.cumsum(errors[order])])
    squares = np.concatenate([[0.0], np.cumsum(errors[order] ** 2)])
    with np.errstate(invalid="ignore"):
        mean = np.where(counts > 0, sums[counts], np.nan) / np.maximum(counts, 1)
        spread = np.sqrt(np.maximum(squares[counts] / np.maximum(counts, 1) - mean**2, 0.0))
    return {"mean": mean, "deviation": spread}


def _draw_thresholds(e: Evaluation, quantity: str, symbol: str, name: str) -> None:
    """Write and draw the errors of the frames with ε_ψ below each threshold."""
    thresholds = np.arange(_STEP, 2.0 + 0.5 * _STEP, _STEP)
    columns: dict[str, Any] = {"threshold_psi": thresholds}
    curves: list[tuple[str, Curve]] = []
    for (group, title), grid in itertools.product(_GROUPS.items(), (ON, OFF)):
        for case in ("none", *(case for case in _CASES if case.startswith(group))):
            result = e.results[f"{case}-{grid}"]
            found = _below_thresholds(result[f"{quantity}_author_mse"], result["psi_author"], thresholds)
            for what, values in found.items():
                columns[f"{case}_{grid}_{what}_deg"] = values
                curve = Curve(thresholds, values, "-", _CASES[case])
                curves.append((f"{what} of {symbol} / °: {title}, {GRID_LABELS[grid]}", curve))
    look = {"columns": 4, "width": 14.0, "height": 8.5, "sharex": True, "legend": "best"}
    e.draw(f"{name}.png", curves, axes={"xlabel": "threshold of ε_ψ"}, **look)
    e.write(f"{name}.csv", columns)


def _compare(e: Evaluation) -> None:
    """Compare the errors below a threshold of ε_ψ, and the correlation of ε_ψ and ε_f."""
    from scipy.stats import spearmanr

    clean = e.results[f"none-{ON}"]
    e.compare(
        "figure 6.28: mean ε_f of the frames with ε_ψ < 1, no noise, on the grid",
        author=clean["f_author_mse"][clean["psi_author"] < 1.0].mean(),
        printed=clean["f_mse"][clean["psi_mse"] < 1.0].mean(),
    )
    for case, grid in itertools.product(("none", "root-both-1", "false-1", "missing-1"), (ON, OFF)):
        result = e.results[f"{case}-{grid}"]
        kept = result["f_author_mse"][result["psi_author"] < 1.0]
        beyond = (
            f"; of these {100.0 * float(np.mean(kept > 1.0)):.1f} % are more than 1° off" if kept.size else ""
        )
        share = 100.0 * kept.size / result["psi_author"].size
        e.compare(
            f"rank correlation of ε_ψ and ε_f, {_CASES[case]}, {GRID_LABELS[grid]}",
            author=float(spearmanr(result["psi_author"], result["f_author_mse"]).statistic),
            printed=float(spearmanr(result["psi_mse"], result["f_mse"]).statistic),
            remark=f"As the author ran it, ε_ψ < 1 in {share:.0f} % of the frames{beyond}.",
        )
