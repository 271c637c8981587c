"""Recursive identification with the scalable filter: figures 6.33–6.43, E, F and G, tables 6.6–6.9 and H."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from starid.identification.thesis.rsi import RecursiveIdentification, RsiSettings, region_cells, region_side
from starid.lab.experiments.author_noise import identification_noise
from starid.lab.experiments.experiment import Context, Evaluation, Parameters, Part, Results
from starid.lab.experiments.figures import Curve, Panel, precision, precision_axes
from starid.lab.experiments.fsf import track_filter
from starid.lab.experiments.rsi_trials import (
    BY_EQUATION,
    BY_TABLE,
    FIELDS,
    LSI_ONLY,
    PRINTED_SCALE,
    START,
    measured_step,
    method_of,
    noise_label,
    set_label,
    side_as_printed,
    statistics,
)
from starid.lab.experiments.tables import RECURSION
from starid.lab.simulation import NoiseModel, sky_sequence

SETTLING: Final = 5
"""Number of first frames left out of the statistics, in which false stars cannot be recognised yet."""

_BYTES_PER_CELL: Final = 5
_FIELD_DEG: Final = 40.0
_PUBLISHED: Final = tuple(name for name in RECURSION[0.995, 0, 0.5] if name != "region_kB")
_PLOTTED_FRAMES: Final = 40
_PLOT_FLOOR: Final = 1e-4


def parts(parameters: Parameters) -> list[Part]:
    """List all runs: sets with μ = f, as in the tables, and the other sets with memory only.

    The side of table 6.8 is tried only at the first scale of the noise.
    """
    names = ("overlap", "false_stars", "factor", "tau", "memory", "side", "scale")
    return [
        Part(
            f"p{100 * p:g}-f{f}-m{m}-t{tau:g}-n{memory}-{side}-x{scale:g}",
            dict(zip(names, (p, f, m, tau, memory, side, scale), strict=True)),
        )
        for p in parameters["overlaps"]
        for f, m in parameters["sets"]
        for tau, memory, side in parameters["methods"]
        for scale in parameters["scales"]
        if (scale == parameters["scales"][0] or (m > 0 and side == BY_EQUATION)) and (f == m or memory)
    ]


def compute(context: Context, part: Part) -> Results:
    """Measurements of the frames of a sequence, (fields, n)."""
    v = part.values
    lsi = context.lost_in_space(v["overlap"])
    noise = identification_noise(v["factor"], false_stars=v["false_stars"])
    if v["scale"] == PRINTED_SCALE:
        noise = NoiseModel.of("both", v["factor"], false_stars=v["false_stars"])
    if v["tau"] == LSI_ONLY:
        settings = RsiSettings(tau=1.0, gamma_lsi_deg=1e-9)
    elif v["side"] == BY_TABLE:
        side = RECURSION[v["overlap"], v["factor"], v["tau"]]["side_mean"]
        settings = RsiSettings(tau=v["tau"], gamma_min_deg=side, gamma_scale=0.0)
    else:
        settings = RsiSettings(tau=v["tau"], memory=v["memory"])
    track = track_filter(noise, 0.002, 0.005, max_rotation_deg=4.0, max_shift_deg=4.0)
    recursion = RecursiveIdentification(lsi, track, settings)
    count = int(context.parameters["frames"])
    numbers = np.full((len(FIELDS), count), math.nan)
    rng = context.rng("frames", v["false_stars"], v["factor"], int(100 * v["scale"]))
    for i, frame in enumerate(sky_sequence(rng, lsi.database.sky, *START, noise, count=count, wander=True)):
        numbers[:, i] = measured_step(recursion.step(frame.observed), frame)
    return {"numbers": numbers}


def _published(values: Mapping[str, Any]) -> dict[str, float]:
    """Published values for a set with μ = f; empty if the tables have no such row."""
    if values["false_stars"] != values["factor"] or values["memory"] or values["side"] == BY_TABLE:
        return {}
    return RECURSION.get((values["overlap"], values["factor"], values["tau"]), {})


def _label(values: Mapping[str, Any]) -> str:
    return f"{set_label(values)}: {method_of(values['tau'], values['memory'], values['side'])}"


def evaluate(e: Evaluation) -> None:
    """The tables beside ours, the figures, and the mean errors with memory against the published ones."""
    figures = {part.key: statistics(e[part]["numbers"], SETTLING) for part in e.parts}
    lines = []
    for part in e.parts:
        v, known = part.values, _published(part.values)
        cells = region_cells(figures[part.key]["side_mean"], _FIELD_DEG, v["overlap"])
        figures[part.key]["region_kB"] = 1e-3 * _BYTES_PER_CELL * cells
        published = {f"published_{name}": known.get(name, "") for name in _PUBLISHED}
        method = method_of(v["tau"], v["memory"], v["side"])
        lines.append({**v, "method": method, **figures[part.key], **published})
    e.write("tables_6_7_6_8_6_9_h_1_h_2.csv", lines)
    diagonal = [part for part in e.parts if part["false_stars"] == part["factor"]]
    _write_sides(e, diagonal, figures)
    if not e.context.quick:
        _draw(e, diagonal)
    _compare(e, diagonal, figures)


def _write_sides(e: Evaluation, parts: Sequence[Part], figures: Mapping[str, dict[str, float]]) -> None:
    """Write Γ by eq. 6.5 as printed, with the square root, and in table 6.8, for the first RSI method."""
    settings = RsiSettings()
    tau = min(t for t, *_ in e.parameters["methods"] if t != LSI_ONLY)
    lines = []
    for part in parts:
        v, published, s = part.values, _published(part.values), figures[part.key]
        if v["overlap"] != e.parameters["overlaps"][0] or v["tau"] != tau or not published:
            continue
        distances = s["mean_distance_deg"], s["sigma_distance_deg"]
        line = {"factor": v["factor"], "scale": v["scale"]}
        line |= dict(zip(("mu_d_deg", "sigma_d_deg"), distances, strict=True))
        line["as_printed_deg"] = side_as_printed(*distances, settings.gamma_min_deg)
        line["square_root_deg"] = region_side(*distances, settings)
        lines.append(line | {"published_deg": published["side_mean"]})
    if lines:
        e.write("equation_6_5.csv", lines)


def _compare(e: Evaluation, diagonal: Sequence[Part], figures: Mapping[str, dict[str, float]]) -> None:
    """Compare the mean ε_f of the sets with μ = f, and the worst of all sets."""
    for part in diagonal:
        v, s = part.values, figures[part.key]
        published = RECURSION[v["overlap"], v["factor"], v["tau"]]["error_mean"]
        e.compare(
            f"mean ε_f, {_label(v)}",
            text=published if v["memory"] or v["side"] != BY_TABLE else None,
            unit="°",
            digits=3,
            check="less" if v["memory"] else "",
            ours=s["error_mean"],
            remark=f"Median {s['error_median']:.3f}°, {s['gross_percent']:.1f} % beyond 1°; ε_θ {s['roll_median']:.1f}° "
            f"in the median; invalid {s['invalid_percent']:.1f} %.",
        )
    for overlap in e.parameters["overlaps"]:
        means = {
            set_label(v): figures[part.key]["error_mean"]
            for part in e.parts
            if (v := part.values)["overlap"] == overlap and v["memory"] and v["scale"] != PRINTED_SCALE
        }
        worst = max(means, key=lambda words: means[words])
        quantity = f"greatest mean ε_f of all sets, p = {100 * overlap:g} %: RSI with memory (ours)"
        e.compare(quantity, ours=means[worst], remark=f"{worst}; {len(means)} sets.")


def _draw(e: Evaluation, parts: Sequence[Part]) -> None:
    """Draw all figures from the runs with μ = f; precision without the first `SETTLING` frames."""
    parts = [part for part in parts if part["side"] != BY_TABLE]
    for scale, overlap in itertools.product(e.parameters["scales"], e.parameters["overlaps"]):
        curves = (
            (
                _set(part),
                precision(
                    e[part]["numbers"][0, SETTLING:],
                    1.0,
                    method_of(part["tau"], part["memory"]),
                ),
            )
            for part in parts
            # runs without noise belong to every scale
            if (part["scale"] == scale or part["factor"] == 0) and part["overlap"] == overlap
        )
        title = f"Figures 6.37 to 6.41 and F: p = {100 * overlap:g} %, {noise_label(scale)}"
        name = f"figures_6_37_to_6_41_and_f_p{100 * overlap:g}_x{scale:g}.png"
        look = {"columns": 2, "width": 9.0, "height": 7.0, "sharey": True, "legend": "lower right"}
        e.draw(name, curves, axes=precision_axes("ε_f"), title=title, **look)
    scale, overlap = e.parameters["scales"][0], e.parameters["overlaps"][-1]
    chosen = {"scale": scale, "overlap": overlap, "memory": 0}
    _draw_frames(
        e, [part for part in parts if chosen.items() <= part.values.items() and part["tau"] != LSI_ONLY]
    )


def _set(part: Part) -> str:
    return f"μ = f = {part['factor']}"


def _draw_frames(e: Evaluation, parts: Sequence[Part]) -> None:
    """Draw frame by frame ε_ψ and ε_f (figures 6.33 to 6.36, E), and run times (6.42, 6.43, G)."""
    frames = np.arange(1, _PLOTTED_FRAMES + 1)
    errors, times = [], []
    for part in parts:
        numbers = dict(zip(FIELDS, e[part]["numbers"][:, :_PLOTTED_FRAMES], strict=True))
        tau, words = part["tau"], f"{_set(part)}, τ = {part['tau']:g}"
        error, psi = (1.0 + np.log10(np.maximum(numbers[name], _PLOT_FLOOR)) for name in ("error", "psi"))
        hit = numbers["triggered"] > 0.0
        curves = [
            Curve(frames, error, "-", "1 + log₁₀ ε_f"),
            Curve(frames, psi, "--", "1 + log₁₀ ε_ψ"),
            Curve(frames, np.full(_PLOTTED_FRAMES, 1.0 + np.log10(tau)), ":", "τ"),
            Curve(frames[hit], psi[hit], "v", "update triggered"),
        ]
        errors.append(Panel(words, curves, {"xlabel": "frame"}))
        left = [Curve(frames, numbers[name], "-", f"{name} / °") for name in ("error", "side")]
        right = [
            Curve(frames, numbers["search_ms"], "b--", "1NN / ms (right)"),
            Curve(frames, numbers["lasso_ms"], "k:", "LASSO / ms (right)"),
        ]
        settings = {"xlabel": "frame", "ylim": (0.0, 4.0)}
        times.append(Panel(words, left, settings, right=right, right_limit=1.0))
    taus = len({part["tau"] for part in parts})
    size = {"columns": taus, "width": 10.0, "height": 2.2 * len(parts) / taus, "sharex": True}
    legend = {"legend": "outside lower center", "legend_columns": 4}
    percent = f"p = {100 * e.parameters['overlaps'][-1]:g} %"
    for name, number, shown, options in (
        ("figures_6_33_to_6_36_and_e.png", "6.33 to 6.36 and E", errors, {"sharey": True}),
        ("figures_6_42_6_43_and_g.png", "6.42, 6.43 and G", times, {}),
    ):
        e.draw(name, shown, title=f"Figures {number}: {percent}", **size, **legend, **options)
