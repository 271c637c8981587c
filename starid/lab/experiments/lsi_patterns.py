"""Does ε_ψ reveal a bad answer? Patterns 6.20–6.27 and B, errors against thresholds 6.28–6.30 and C."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.arrays import Array
from starid.lab.experiments.comparison import Readings, agreement, same, shown
from starid.lab.experiments.experiment import Context, Results, Row, write_csv
from starid.lab.experiments.lsi_trials import GRID_LABELS, OFF, ON, count_label
from starid.plots import colours, figure, save

_CASES: Final = {
    "none": "no noise",
    **{f"root-both-{n}": f"μ = {n}" for n in (1, 2, 3)},
    **{f"{kind}-{n}": count_label(n, kind) for kind in ("false", "missing") for n in (1, 2, 3)},
}
_GROUPS: Final = (("root-both", "noise"), ("false", "false stars"), ("missing", "missing stars"))
_TRIALS: Final = slice(559, 600)
_LEAST: Final = 1e-6
_STEP: Final = 0.01


def complete(results: Mapping[str, Results]) -> bool:
    """Whether all cases were computed, on and off the grid."""
    return all(f"{case}-{grid}" in results for case in _CASES for grid in (ON, OFF))


def _logarithm(errors: Array) -> Array:
    return np.asarray(1.0 + np.log10(np.maximum(errors, _LEAST)), dtype=np.float64)


def _patterns(context: Context, results: Mapping[str, Results], grid: str) -> str:
    fig, axes = figure(len(_CASES), 2, width=9.5, height=15.0, sharex=True)
    for i, (case, title) in enumerate(_CASES.items()):
        result = results[f"{case}-{grid}"]
        trials = np.arange(_TRIALS.start + 1, _TRIALS.stop + 1)
        for j, (name, symbol) in enumerate((("f_author_mse", "ε_f / °"), ("theta_author_mse", "ε_θ / °"))):
            axes[i, j].plot(trials, _logarithm(result[name][_TRIALS]), "r-", label=symbol)
            axes[i, j].plot(trials, _logarithm(result["psi_author"][_TRIALS]), "b--", label="ε_ψ")
            axes[i, j].set_title(title)
            axes[i, j].set_ylabel("1 + log₁₀ ε")
    for j in range(2):
        axes[0, j].legend(loc="upper right")
        axes[-1, j].set_xlabel("trial")
    fig.suptitle(f"LSI (MSE) as the author ran it, trials 560 to 600, frames {GRID_LABELS[grid]}")
    return save(fig, context.folder / f"figures_6_20_to_6_27_and_b_{grid}.png")


def _below_thresholds(errors: Array, psi: Array, thresholds: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the errors with ε_ψ below each threshold; NaN if there are none."""
    order = np.argsort(psi)
    counts = np.searchsorted(psi[order], thresholds)
    sums = np.concatenate([[0.0], np.cumsum(errors[order])])
    squares = np.concatenate([[0.0], np.cumsum(errors[order] ** 2)])
    with np.errstate(invalid="ignore"):
        mean = np.where(counts > 0, sums[counts], np.nan) / np.maximum(counts, 1)
        spread = np.sqrt(np.maximum(squares[counts] / np.maximum(counts, 1) - mean**2, 0.0))
    return np.asarray(mean), np.asarray(spread)


def _thresholds(context: Context, results: Mapping[str, Results], quantity: str) -> list[str]:
    thresholds = np.arange(_STEP, 2.0 + 0.5 * _STEP, _STEP)
    columns: dict[str, Any] = {"threshold_psi": thresholds}
    symbol = "ε_f" if quantity == "f" else "ε_θ"
    fig, axes = figure(3, 4, width=12.0, height=8.5, sharex=True)
    for i, (group, title) in enumerate(_GROUPS):
        keys = ["none", *(case for case in _CASES if case.startswith(group))]
        for g, grid in enumerate((ON, OFF)):
            for case, colour in zip(keys, ["black", *colours(3)], strict=True):
                result = results[f"{case}-{grid}"]
                pair = _below_thresholds(result[f"{quantity}_author_mse"], result["psi_author"], thresholds)
                for k, (values, name) in enumerate(zip(pair, ("mean", "deviation"), strict=True)):
                    axis = axes[i, 2 * g + k]
                    axis.plot(thresholds, values, color=colour, label=_CASES[case])
                    axis.set_title(f"{title}, {GRID_LABELS[grid]}")
                    axis.set_ylabel(f"{name} of {symbol} / °")
                    columns[f"{case}_{grid}_{name}_deg"] = values
        axes[i, 0].legend()
    for axis in axes[-1]:
        axis.set_xlabel("threshold of ε_ψ")
    name = "figures_6_28_to_6_30" if quantity == "f" else "figures_c"
    return [save(fig, context.folder / f"{name}.png"), write_csv(context.folder / f"{name}.csv", columns)]


def pattern_files(context: Context, results: Mapping[str, Results]) -> list[str]:
    """Draw the patterns and the errors against thresholds; return the names of the files."""
    files = [_patterns(context, results, grid) for grid in (ON, OFF)]
    for quantity in ("f", "theta"):
        files += _thresholds(context, results, quantity)
    return files


def pattern_rows(results: Mapping[str, Results]) -> list[Row]:
    """Rows on the correlation of ε_ψ and ε_f, and on the errors below a threshold of ε_ψ."""
    from scipy.stats import spearmanr

    clean = results[f"none-{ON}"]
    below = clean["psi_author"] < 1.0
    exact = clean["psi_mse"] < 1.0
    rows = [
        agreement(
            "figure 6.28: mean ε_f of the frames with ε_ψ < 1, no noise, on the grid",
            published=0.1,
            tolerance=(0.05, "half of the digit of “approximately 0.1”, 0.05°"),
            author=float(clean["f_author_mse"][below].mean()),
            printed=float(clean["f_mse"][exact].mean()),
            unit="°",
            digits=3,
        )
    ]
    for case in ("none", "root-both-1", "false-1", "missing-1"):
        for grid in (ON, OFF):
            result = results[f"{case}-{grid}"]
            rank: Readings = {
                "author": float(spearmanr(result["psi_author"], result["f_author_mse"]).statistic),
                "printed": float(spearmanr(result["psi_mse"], result["f_mse"]).statistic),
            }
            kept = result["f_author_mse"][result["psi_author"] < 1.0]
            beyond = (
                f"; of these {100.0 * float(np.mean(kept > 1.0)):.1f} % are more than 1° off"
                if kept.size
                else ""
            )
            quantity = f"rank correlation of ε_ψ and ε_f, {_CASES[case]}, {GRID_LABELS[grid]}"
            remark = f"As the author ran it, ε_ψ < 1 in {100.0 * kept.size / below.size:.0f} % of the frames{beyond}."
            if grid == OFF:
                rows.append(shown(quantity, **rank, remark=remark))
                continue
            rows.append(
                same(
                    quantity,
                    published="positive",
                    author=f"{rank['author']:.2f}",
                    printed=f"{rank['printed']:.2f}",
                    matches=[rank["author"] > 0.0],
                    target="> 0",
                    remark=remark,
                )
            )
    return rows
