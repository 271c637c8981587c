"""LSI with noise: precision curves 6.6–6.8 and identification rates 6.9–6.11, on and off the grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.thesis.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    row,
    write_csv,
)
from starid.thesis.experiments.lsi_patterns import complete, pattern_files, pattern_rows
from starid.thesis.experiments.lsi_trials import OFF, ON, share, solve_frames
from starid.thesis.experiments.plots import colours, figure, precision_curve, save
from starid.thesis.simulation import NoiseModel

IDENTIFIED_DEG: Final = 0.283
"""A frame counts as identified when its boresight is within 16.98′, section 6.1.2.3."""

_OVERLAP: Final = 0.995
_KINDS: Final = ("position", "brightness", "both")
_LEVELS: Final = (1.0, 2.0, 3.0)
_EQUIVALENT: Final = 0.17
"""Share of the printed noise that the published camera motions belong to, figure 6.18."""
_GRID_WORDS: Final = {ON: "on the grid", OFF: "off the grid"}
_KIND_WORDS: Final = {
    "position": "positional noise / px",
    "brightness": "brightness noise / intensity units",
    "both": "both",
}
_PUBLISHED_03: Final = {1.0: 99.94, 2.0: 99.59, 3.0: 99.18}
_PUBLISHED_FINE: Final = {
    0.2: {1.0: 91.89, 2.0: 91.59, 3.0: 90.65},
    0.1: {1.0: 71.19, 2.0: 70.66, 3.0: 70.08},
    0.013: {1.0: 35.57, 2.0: 24.40, 3.0: 18.99},
}
_FLOOR_03: Final = {
    ON: {1.0: 88.0, 2.0: 65.0, 3.0: 45.0},
    OFF: {1.0: 74.0, 2.0: 52.0, 3.0: 37.0},
}
_EQUIVALENT_FLOOR: Final = {ON: 97.0, OFF: 80.0}
_RATES: Final = {"position": {0.0: 99.99, 3.0: 99.41}, "brightness": {0.0: 99.99, 3.0: 97.99}}

_NOTE: Final = """p = 99.5 %, the MSE solution. Position noise is normal with σ in pixels of 42°/937 per axis, brightness noise with σ in
units of an 8-bit intensity, of which 255 span the magnitudes 11.5 … 15; "μ drawn" adds a mean, drawn for each frame from
N(0, 1). False stars are uniform in the circular field and in magnitude, 11.5 … 15; missing stars are drawn from the true
ones. The features are those of the noisy list: a star stays in the list even when noise moves it across the rim, as it
must have in the thesis (otherwise n changes, and the figures fall to those with false and missing stars).

**The published figures with noise are not reached.** With position and brightness noise of σ = 3 the thesis has 99.2 % of
the frames within 0.3°, ours has about half. Brightness noise does most of it: one unit is {unit:.4f} mag, which over {stars:.0f} stars moves A
by {shift:.2f} on the normalised scale 0 … 100, as far as a neighbouring cell is. But even position noise alone, whose unit the
thesis gives (eq. 5.2), leaves fewer frames than the thesis has with both. With both noises
**× 0.17** the published figures nearly come out (rows below). It is the share that the thesis's camera motions ask for, too: a μ_d of at
most 0.0419° (figure 6.18) is less than one pixel, at a noise of "5 px". That the printed σ was applied cannot be held."""

_TEXT_NOTE: Final = """The thesis's sentence on 0.2°, 0.1° and 0.013° with noise is read as: for each of these limits, the shares at σ = 1, 2, 3. Read as
printed (one σ for each triple), the share at σ = 3 would fall from 99.2 % within 0.3° to 36 % within 0.2°, and rise with
the limit getting smaller."""

_FALSE_NOTE: Final = """A false or missing star changes n by one, which on the normalised scale is {step:.2f}, and A and σ_A besides; the nearest
neighbour is then another region of the sky. One star of the median {stars:.0f} a frame is enough: this, not noise, is what
breaks the LSI algorithm, on the grid and off it, and why the thesis puts a filter before it."""


def _parts(parameters: Parameters) -> list[Part]:
    cases: list[tuple[str, dict[str, Any]]] = [("none", {})]
    cases += [
        (f"{kind}-{level:g}{'-mean' if spread else ''}", {"kind": kind, "level": level, "spread": spread})
        for kind in _KINDS
        for level in _LEVELS
        for spread in (0.0, 1.0)
    ]
    cases += [
        (f"{kind}-{count}", {"kind": kind, "level": count})
        for kind in ("false", "missing")
        for count in (1, 2, 3)
    ]
    cases += [(f"scaled-{level:g}", {"kind": "scaled", "level": level, "spread": 0.0}) for level in _LEVELS]
    wanted = parameters["cases"]
    return [
        Part(f"{key}-{grid}", {**values, "grid": grid})
        for key, values in cases
        if not wanted or key in wanted
        for grid in (ON, OFF)
    ]


def _work(context: Context, part: Part) -> Results:
    values = part.values
    kind, level = values.get("kind"), values.get("level", 0.0)

    def noise(rng: np.random.Generator) -> NoiseModel:
        if kind in ("false", "missing"):
            return NoiseModel(
                false_stars=int(level) if kind == "false" else 0,
                missing_stars=int(level) if kind == "missing" else 0,
            )
        mean = float(rng.normal()) if values["spread"] else 0.0
        moved = _EQUIVALENT if kind == "scaled" else float(kind in ("position", "both"))
        dimmed = _EQUIVALENT if kind == "scaled" else float(kind in ("brightness", "both"))
        return NoiseModel(
            position_sigma_px=level * moved,
            position_mean_px=mean * moved,
            brightness_sigma=level * dimmed,
            brightness_mean=mean * dimmed,
        )

    return solve_frames(
        context,
        _OVERLAP,
        values["grid"],
        rng=context.rng(part.key),
        noise=None if kind is None else noise,
        every=context.parameters["every"],
    )


def _noise_figure(context: Context, results: Mapping[str, Results], grid: str, quantity: str) -> str | None:
    if f"both-3-mean-{grid}" not in results or f"position-1-{grid}" not in results:
        return None
    limits = (1.0, 0.05) if quantity == "f" else (1.0, 10.0)
    fig, axes = figure(3, 2, width=8.5, height=9.0)
    curves = [("none", "no noise")]
    for i, kind in enumerate(_KINDS):
        cases = curves + [
            (f"{kind}-{level:g}{tail}", f"σ = {level:g}{words}")
            for tail, words in (("", ", μ = 0"), ("-mean", ", μ drawn"))
            for level in _LEVELS
        ]
        for j, limit in enumerate(limits):
            for (key, label), colour in zip(cases, ["black", *colours(6)], strict=True):
                errors = results[f"{key}-{grid}"][f"{quantity}_mse"]
                precision_curve(
                    axes[i, j], errors, limit, color=colour, label=label, ls="--" if "mean" in key else "-"
                )
            axes[i, j].set_title(f"{_KIND_WORDS[kind]}, {_GRID_WORDS[grid]}")
            axes[i, j].set_xlabel(f"threshold of ε_{'f' if quantity == 'f' else 'θ'} (MSE) / °")
        axes[i, 0].legend(loc="lower right")
    number = 6 if quantity == "f" else 7
    return save(fig, context.folder / f"figure_6_{number}_{grid}.png")


def _false_figure(context: Context, results: Mapping[str, Results]) -> str:
    fig, axes = figure(2, 2, width=8.5, height=6.6, sharey=True)
    for i, grid in enumerate((ON, OFF)):
        for j, kind in enumerate(("false", "missing")):
            for count, colour in zip(range(4), ["black", *colours(3)], strict=True):
                key = f"{kind}-{count}-{grid}" if count else f"none-{grid}"
                if key in results:
                    label = f"{count} {kind} star{'s' if count > 1 else ''}" if count else "no noise"
                    precision_curve(axes[i, j], results[key]["f_mse"], 1.0, color=colour, label=label)
            axes[i, j].set_title(f"{kind} stars, {_GRID_WORDS[grid]}")
            axes[i, j].set_xlabel("threshold of ε_f (MSE) / °")
            axes[i, j].legend(loc="center right")
    return save(fig, context.folder / "figure_6_8.png")


def _rate_figures(context: Context, results: Mapping[str, Results]) -> list[str]:
    files = []
    cases = (
        (9, "position", "σ of positional noise / px"),
        (10, "brightness", "σ of brightness noise / intensity units"),
        (11, "false", "false stars"),
    )
    for number, kind, label in cases:
        if f"{kind}-1-{ON}" not in results:
            continue
        columns: dict[str, list[Any]] = {"level": [], "grid": [], "method": [], "rate_percent": []}
        fig, axis = figure(width=6.0, height=4.0)
        for grid, style in ((ON, "-"), (OFF, "--")):
            for method, word, colour in (("mse", "LSI (MSE)", "C0"), ("fine", "sub-cell (ours)", "C2")):
                keys = {level: f"{kind}-{level}-{grid}" if level else f"none-{grid}" for level in range(4)}
                rates = {
                    level: share(results[key][f"f_{method}"], IDENTIFIED_DEG)
                    for level, key in keys.items()
                    if key in results
                }
                axis.plot(
                    list(rates),
                    list(rates.values()),
                    style,
                    marker="o",
                    color=colour,
                    label=f"{word}, {_GRID_WORDS[grid]}",
                )
                for level, rate in rates.items():
                    for name, value in zip(columns, (level, grid, method, rate), strict=True):
                        columns[name].append(value)
        published = _RATES.get(kind)
        if published:
            axis.plot(list(published), list(published.values()), "rx", ms=8, label="published (on the grid)")
        axis.set(xlabel=label, ylabel=f"identification rate (ε_f ≤ {IDENTIFIED_DEG}°) / %", xticks=range(4))
        axis.set_ylim((0, 102) if kind == "false" else (min(50.0, min(columns["rate_percent"]) - 3.0), 101))
        axis.legend()
        files.append(save(fig, context.folder / f"figure_6_{number}.png"))
        name = f"figure_6_{number}.csv"
        write_csv(context.folder / name, columns)
        files.append(name)
    return files


def _noise_rows(results: Mapping[str, Results], grid: str) -> list[Row]:
    rows = []
    on = grid == ON
    away = (
        "" if on else "The published value is the on-grid one; without noise too ours is lower off the grid."
    )
    for level in _LEVELS:
        key = f"both-{level:g}-{grid}"
        if key not in results:
            continue
        errors = results[key]["f_mse"]
        rows.append(
            row(
                f"position and brightness noise, σ = {level:g}, {_GRID_WORDS[grid]}: share with ε_f ≤ 0.3°",
                published=_PUBLISHED_03[level],
                ours=share(errors, 0.3),
                unit="%",
                at_least=_FLOOR_03[grid][level],
                remark="Not reached, see above; the target is what this noise leaves of ours.",
            )
        )
        rows += [
            row(
                f"the same: share with ε_f ≤ {limit:g}°",
                published=published[level],
                ours=share(errors, limit),
                unit="%",
                remark=away,
            )
            for limit, published in _PUBLISHED_FINE.items()
        ]
    for level in _LEVELS:
        key = f"scaled-{level:g}-{grid}"
        if key in results:
            rows += [
                row(
                    f"both noises × {_EQUIVALENT:g}, “σ = {level:g}”, {_GRID_WORDS[grid]}: share with ε_f ≤ {limit:g}°",
                    published=published,
                    ours=share(results[key]["f_mse"], limit),
                    unit="%",
                    at_least=_EQUIVALENT_FLOOR[grid] if limit == 0.3 else None,
                )
                for limit, published in ((0.3, _PUBLISHED_03[level]), (0.1, _PUBLISHED_FINE[0.1][level]))
            ]
    for kind, rates in _RATES.items():
        for level, published_rate in rates.items():
            key = f"{kind}-{level:g}-{grid}" if level else f"none-{grid}"
            if key in results:
                rows.append(
                    row(
                        f"identification rate, {kind} noise σ = {level:g}, {_GRID_WORDS[grid]}",
                        published=published_rate,
                        ours=share(results[key]["f_mse"], IDENTIFIED_DEG),
                        unit="%",
                        at_least=None if level else (99.9 if on else 83.0),
                        remark="Not reached, see above." if level and on else away,
                    )
                )
    return rows


def _object_rows(results: Mapping[str, Results], grid: str) -> list[Row]:
    rows = []
    for kind, words, most in (("false", "below 20 %", 20.0), ("missing", "below 50 %", 50.0)):
        for count in (1, 2, 3):
            key = f"{kind}-{count}-{grid}"
            if key in results:
                value = share(results[key]["f_mse"], 1.0)
                rows.append(
                    row(
                        f"{count} {kind} star{'s' if count > 1 else ''}, {_GRID_WORDS[grid]}: share with ε_f ≤ 1°",
                        published=words if count == 1 else "less",
                        ours=value,
                        unit="%",
                        remark="" if count > 1 or value < most else "Ours holds better than the thesis's.",
                    )
                )
    return rows


def _finish(context: Context, results: Mapping[str, Results]) -> Outcome:
    rows: list[Row] = []
    files: list[str] = []
    for grid in (ON, OFF):
        rows += _noise_rows(results, grid)
    for grid in (ON, OFF):
        rows += _object_rows(results, grid)
    for quantity in ("f", "theta"):
        for grid in (ON, OFF):
            name = _noise_figure(context, results, grid, quantity)
            if name is not None:
                files.append(name)
    files.append(_false_figure(context, results))
    files += _rate_figures(context, results)
    if complete(results):
        files += pattern_files(context, results)
        rows += pattern_rows(results)
    limits = (0.002, 0.008, 0.013, 0.1, 0.2, 0.283, 0.3, 1.0)
    table: dict[str, list[Any]] = {"case": list(results)}
    for method in ("mse", "1se", "fine"):
        for limit in limits:
            table[f"f_{method}_within_{limit:g}_deg_percent"] = [
                share(result[f"f_{method}"], limit) for result in results.values()
            ]
    table["theta_mse_within_1_deg_percent"] = [share(r["theta_mse"], 1.0) for r in results.values()]
    table["psi_mse_median"] = [float(np.median(r["psi_mse"])) for r in results.values()]
    write_csv(context.folder / "shares.csv", table)
    files.append("shares.csv")
    database = context.database(_OVERLAP)
    unit = database.scale[1] * NoiseModel().magnitude_per_unit
    counts = [context.sky().features(ra % 360.0, dec).n for ra, dec in results[f"none-{ON}"]["frames"]]
    stars = float(np.median(counts))
    note = _NOTE.format(
        unit=NoiseModel().magnitude_per_unit, stars=stars, shift=float(unit) / math.sqrt(stars)
    )
    false = _FALSE_NOTE.format(step=float(database.scale[0]), stars=stars)
    return Outcome(tuple(rows), tuple(files), (note, _TEXT_NOTE, false))


EXPERIMENTS: Final = (
    Experiment(
        "lsi-noise",
        "LSI with noise, false and missing stars: figures 6.6–6.11, 6.20–6.30, B, C",
        _parts,
        _work,
        _finish,
        full={"cases": [], "every": 1},
        quick={"cases": ["none", "both-1", "both-3", "scaled-3", "false-1", "missing-1"], "every": 4},
    ),
)
