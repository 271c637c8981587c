"""LSI with noise: precision curves 6.6–6.8 and identification rates 6.9–6.11, on and off the grid."""

from __future__ import annotations

import itertools
import math
from typing import Any, Final

import numpy as np

from starid.lab.experiments.author_noise import identification_noise
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.figures import Curve, Panel, curves_of, precision, precision_axes
from starid.lab.experiments.lsi_patterns import add_patterns
from starid.lab.experiments.lsi_trials import GRID_LABELS, OFF, ON, count_label, share, solve_frames
from starid.lab.simulation import NoiseModel

IDENTIFIED_DEG: Final = 0.283
"""A frame counts as identified when its boresight is within 16.98′, section 6.1.2.3."""

_OVERLAP: Final = 0.995
_LEVELS: Final = (1.0, 2.0, 3.0)
_UNIT_RANGE: Final = (11.5, 12.5)
"""Interpretation (i): the 255 steps of intensity span one magnitude."""
_KINDS: Final = {
    "position": ("position noise", "positional noise / px"),
    "brightness": ("brightness noise", "brightness noise / intensity units"),
    "both": ("position and brightness noise", "both"),
}
"""Kind of noise → its name in a quantity, and in a figure."""
_CASES: Final = (
    *(("both", level, ON, limit) for level in _LEVELS for limit in (0.3, 0.2, 0.1, 0.013)),
    *((kind, level, ON, IDENTIFIED_DEG) for kind in ("position", "brightness") for level in (0.0, 3.0)),
    *(("both", level, OFF, limit) for level in _LEVELS for limit in (0.3, 0.1)),
    *((kind, n, grid, 1.0) for grid in (ON, OFF) for kind in ("false", "missing") for n in (1, 2, 3)),
)
"""Kind and level of the noise, test frames, and limit of ε_f of the shares that are compared."""
_METHODS: Final = {"author_mse": "as the author ran it", "mse": "as printed", "fine": "sub-cell (ours)"}
_RATES: Final = (
    (9, "position", "σ of positional noise / px"),
    (10, "brightness", "σ of brightness noise / intensity units"),
    (11, "false", "false stars"),
)


def compute(context: Context, part: Part) -> Results:
    """Errors of the test frames with one kind and level of noise, or with false or missing stars."""
    values = part.values
    kind, level = values.get("kind"), values.get("level", 0.0)

    def noise(rng: np.random.Generator) -> NoiseModel:
        mean = float(rng.normal()) if values.get("mean") else 0.0
        if values.get("root"):
            return identification_noise(level, str(kind))
        moved, dimmed = (mean * (kind in (one, "both")) for one in ("position", "brightness"))
        scale = {"magnitude_range": _UNIT_RANGE} if values.get("six") else {}
        return NoiseModel.of(str(kind), level, position_mean_px=moved, brightness_mean=dimmed, **scale)

    return solve_frames(
        context,
        _OVERLAP,
        values["grid"],
        rng=context.rng(part.key),
        noise=None if kind is None else noise,
        every=context.parameters["every"],
        with_angle=bool(values.get("six")),
    )


def _key(kind: str, level: float, grid: str, head: str = "", tail: str = "") -> str:
    """Key of a part; without noise, the variants of the noise are the same."""
    return f"{head}{kind}-{level:g}{tail}-{grid}" if level else f"none-{grid}"


def _noise_figure(e: Evaluation, grid: str, quantity: str, reading: str) -> None:
    """Draw figure 6.6 (ε_f) or 6.7 (ε_θ): a row for each kind of noise, with two scales."""
    author = reading == "author"
    head, name = ("root-", f"{quantity}_author_mse") if author else ("", f"{quantity}_mse")
    number, symbol, limits = (6, "ε_f", (1.0, 0.05)) if quantity == "f" else (7, "ε_θ", (1.0, 10.0))
    tails = {"": ", μ = 0"} if author else {"": ", μ = 0", "-mean": ", μ drawn"}
    noises = itertools.product(tails.items(), _LEVELS)
    cases = [
        ("no noise", "", 0.0),
        *((f"σ = {level:g}{words}", tail, level) for (tail, words), level in noises),
    ]
    curves = (
        (
            f"{label} up to {limit:g}°",
            precision(
                e.results[_key(kind, level, grid, head, tail)][name], limit, words, "--" if tail else "-"
            ),
        )
        for (kind, (_, label)), limit, (words, tail, level) in itertools.product(
            _KINDS.items(), limits, cases
        )
    )
    axes, title = precision_axes(f"{symbol} (MSE)"), "As the author ran it" if author else "As printed"
    look = {"columns": 2, "width": 8.5, "height": 9.0, "legend": "lower right"}
    title += f", frames {GRID_LABELS[grid]}"
    e.draw(f"figure_6_{number}_{grid}_{reading}.png", curves, axes=axes, title=title, **look)


def _false_figure(e: Evaluation) -> None:
    curves = (
        (
            f"{kind} stars, {GRID_LABELS[grid]}",
            precision(e.results[key]["f_mse"], 1.0, count_label(count, kind) if count else "no noise"),
        )
        for grid, kind, count in itertools.product((ON, OFF), ("false", "missing"), range(4))
        if (key := _key(kind, count, grid)) in e.results
    )
    look = {"columns": 2, "width": 8.5, "height": 6.6, "sharey": True, "legend": "center right"}
    e.draw("figure_6_8.png", curves, axes=precision_axes("ε_f (MSE)"), **look)


def _rate_figures(e: Evaluation) -> None:
    """Write and draw figures 6.9 to 6.11, with the published rates as crosses."""
    for number, kind, label in _RATES:
        if f"{kind}-1-{ON}" not in e.results:
            continue
        root = "root-" if kind in _KINDS else ""
        lines = [
            {
                "level": level,
                "grid": grid,
                "method": method,
                "rate_percent": share(e.results[key][f"f_{method}"], IDENTIFIED_DEG),
            }
            for grid, method, level in itertools.product((ON, OFF), _METHODS, range(4))
            if (key := _key(kind, level, grid, root if method == "author_mse" else "")) in e.results
        ]
        e.write(f"figure_6_{number}.csv", lines)
        curves = curves_of(
            lines,
            "level",
            "rate_percent",
            lambda line: f"{_METHODS[line['method']]}, {GRID_LABELS[line['grid']]}",
        )
        published = [
            (level, e.published(_quantity(case, level, ON, limit)))
            for case, level, _, limit in _CASES
            if case == kind and limit == IDENTIFIED_DEG
        ]
        if published:
            mark = {"ms": 8, "color": "red"}
            levels, rates = zip(*published, strict=True)
            curves.append(Curve(levels, rates, "x", "published (on the grid)", mark))
        words = f"identification rate (ε_f ≤ {IDENTIFIED_DEG}°) / %"
        axes = {"xlabel": label, "ylabel": words, "xticks": range(4)}
        shown = [Panel("", curves, axes)]
        e.draw(f"figure_6_{number}.png", shown, width=6.0, height=4.0, legend="best")


def _quantity(kind: str, level: float, grid: str, limit: float) -> str:
    words = f"{_KINDS[kind][0]}, σ = {level:g}" if kind in _KINDS else count_label(int(level), kind)
    return f"{words}, {GRID_LABELS[grid]}: share with ε_f ≤ {limit:g}°"


def _compare(e: Evaluation) -> None:
    """Compare the share within a limit, for each variant that was computed."""
    for kind, level, grid, limit in _CASES:
        printed = e.results.get(_key(kind, level, grid))
        author = e.results.get(_key(kind, level, grid, "root-"), None if kind in _KINDS else printed)
        if author is None and printed is None:
            continue
        angle = e.results.get(f"six-{kind}-{level:g}-{grid}")
        e.compare(
            _quantity(kind, level, grid, limit),
            unit="%",
            author=author and share(author["f_author_mse"], limit),
            printed=printed and share(printed["f_mse"], limit),
            ours=printed and share(printed["f_fine"], limit),
            trials=e.results[f"none-{ON}"]["f_mse"].size,
            remark="" if angle is None else f"Interpretation (i): {share(angle['f_six'], limit):.2f} %.",
        )


def _write(e: Evaluation) -> None:
    table: dict[str, list[Any]] = {"case": list(e.results)}
    results = e.results.values()
    for method in ("author_mse", "author_1se", "mse", "1se", "fine"):
        for limit in (0.002, 0.008, 0.013, 0.1, 0.2, 0.283, 0.3, 1.0):
            table[f"f_{method}_within_{limit:g}_deg_percent"] = [
                share(r[f"f_{method}"], limit) for r in results
            ]
    table["theta_mse_within_1_deg_percent"] = [share(r["theta_mse"], 1.0) for r in results]
    table["psi_mse_median"] = [float(np.median(r["psi_mse"])) for r in results]
    e.write("shares.csv", table)


def evaluate(e: Evaluation) -> None:
    """Shares within limits, the figures, and what ε_ψ says of the error."""
    _compare(e)
    if f"both-3-mean-{ON}" in e.results:
        for case in itertools.product((ON, OFF), ("f", "theta"), ("author", "printed")):
            _noise_figure(e, *case)
    _false_figure(e)
    _rate_figures(e)
    add_patterns(e)
    _write(e)
    database, sky = e.context.database(_OVERLAP), e.context.sky()
    counts = [sky.features(ra % 360.0, dec).n for ra, dec in e.results[f"none-{ON}"]["frames"]]
    unit, stars = NoiseModel().magnitude_per_unit, float(np.median(counts))
    shift = float(database.scale[1] * unit) / math.sqrt(stars)
    e.note = {"unit": unit, "stars": stars, "shift": shift, "step": float(database.scale[0])}
