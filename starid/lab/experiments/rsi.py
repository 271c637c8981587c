"""Recursive identification with the scalable filter: figures 6.33–6.43, E, F and G, tables 6.6–6.9 and H."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from starid.lab.experiments.author_noise import identification_noise
from starid.lab.experiments.comparison import markdown_table
from starid.lab.experiments.experiment import Context, Evaluation, Parameters, Part, Results
from starid.lab.experiments.fsf import track_filter
from starid.lab.experiments.rsi_figures import draw_sequences
from starid.lab.experiments.rsi_trials import (
    BY_EQUATION,
    BY_TABLE,
    FIELDS,
    LSI_ONLY,
    PRINTED,
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
from starid.thesis.rsi import RecursiveIdentification, RsiSettings, region_cells, region_side

SETTLING: Final = 5
"""Number of first frames left out of the statistics, in which false stars cannot be recognised yet."""

_BYTES_PER_CELL: Final = 5
_FIELD_DEG: Final = 40.0
_ERRORS: Final = (
    ("error_mean", "error_mean", 2, "ε_f mean / °"),
    ("error_sigma", "error_sigma", 2, "σ"),
    ("roll_mean", "roll_mean", 2, "ε_θ mean / °"),
    ("roll_sigma", "roll_sigma", 2, "σ"),
    ("psi_mean", "psi_mean", 2, "ε_ψ mean"),
    ("psi_sigma", "psi_sigma", 2, "σ"),
)
"""Columns of tables H.1 and H.2: name of the published value, name of the computed one, decimals, head."""
_UPDATES: Final = (
    ("trigger_percent", "trigger_percent", 1, "triggers / %"),
    ("exceeded_percent", "exceeded_percent", 1, "ε_ψ > τ / %"),
    ("side_mean", "side_mean", 2, "Γ mean / °"),
    ("side_sigma", "side_sigma", 3, "σ"),
    ("region_kB", "region_kB", 2, "kB"),
    ("search_ms", "search_ms_median", 3, "1NN / ms, mean / median"),
    ("lasso_ms", "lasso_ms_median", 3, "LASSO / ms, mean / median"),
)
"""The same of tables 6.7 to 6.9."""
_PUBLISHED: Final = (
    *(name for name, *_ in _ERRORS),
    *("trigger_percent", "exceeded_percent", "side_mean", "side_sigma"),
    *("search_ms", "search_ms_sigma", "lasso_ms", "lasso_ms_sigma"),
)


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
    if v["scale"] == PRINTED:
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
    found = {part.key: statistics(e.results[part.key]["numbers"], SETTLING) for part in e.parts}
    for part in e.parts:
        side = found[part.key]["side_mean"]
        cells = region_cells(side, _FIELD_DEG, part.values["overlap"])
        found[part.key]["region_kB"] = 1e-3 * _BYTES_PER_CELL * cells
    diagonal = [part for part in e.parts if part.values["false_stars"] == part.values["factor"]]
    _write(e, found)
    sides = _sides(e, diagonal, found)
    if not e.context.quick:
        draw_sequences(e, diagonal, SETTLING)
    _compare(e, diagonal, found)
    matrices = [_matrix(e, found, overlap) for overlap in e.parameters["overlaps"]]
    e.note = {
        "matrices": "\n\n".join(matrix for matrix in matrices if matrix),
        "errors": _table("tables H.1 and H.2", _ERRORS, diagonal, found),
        "updates": _table("tables 6.7, 6.8 and 6.9", _UPDATES, diagonal, found),
        "sides": sides,
    }


def _write(e: Evaluation, found: Mapping[str, dict[str, float]]) -> None:
    lines = []
    for part in e.parts:
        v, known = part.values, _published(part.values)
        method = method_of(v["tau"], v["memory"], v["side"])
        published = {f"published_{name}": known.get(name, "") for name in _PUBLISHED}
        lines.append({**v, "method": method, **found[part.key], **published})
    e.write("tables_6_7_6_8_6_9_h_1_h_2.csv", lines)


def _sides(e: Evaluation, parts: Sequence[Part], found: Mapping[str, dict[str, float]]) -> str:
    """Write and tabulate Γ by eq. 6.5 as printed, with the square root, and in table 6.8, for the first RSI method."""
    least = RsiSettings().gamma_min_deg
    tau = min(t for t, *_ in e.parameters["methods"] if t != LSI_ONLY)
    lines, cells = [], []
    for part in parts:
        v, known, s = part.values, _published(part.values), found[part.key]
        if v["overlap"] != e.parameters["overlaps"][0] or v["tau"] != tau or not known:
            continue
        mean, sigma, published = s["mean_distance_deg"], s["sigma_distance_deg"], known["side_mean"]
        printed, root = side_as_printed(mean, sigma, least), region_side(mean, sigma, RsiSettings())
        line = {"factor": v["factor"], "scale": v["scale"], "mu_d_deg": mean, "sigma_d_deg": sigma}
        line |= {"as_printed_deg": printed, "square_root_deg": root, "published_deg": published}
        lines.append(line)
        sides = [f"{side:.2f}" for side in (printed, root, published)]
        label = f"μ = f = {v['factor']:g}, {noise_label(v['scale'])}"
        cells.append([label, f"{mean:.2g}", f"{sigma:.2g}", *sides, f"{published - least:.2f}°"])
    if not lines:
        return ""
    e.write("equation_6_5.csv", lines)
    head = ["Γ / °: noise", "μ_d / °", "σ_d / °", "eq. 6.5 as printed", "Γ_min + √(μ_d·σ_d)", "table 6.8"]
    return markdown_table([*head, "√(μ_d·σ_d) it needs"], cells)


def _pair(theirs: float | None, ours: float, digits: int) -> str:
    """Format the published value and ours in one cell."""
    left = "—" if theirs is None else f"{theirs:.{digits}f}"
    return f"{left} / " + ("—" if math.isnan(ours) else f"{ours:.{digits}f}")


def _table(
    title: str,
    columns: Sequence[tuple[str, str, int, str]],
    parts: Sequence[Part],
    found: Mapping[str, dict[str, float]],
) -> str:
    lines = []
    for part in parts:
        s, theirs = found[part.key], _published(part.values)
        cells = [_pair(theirs.get(name), s[ours], digits) for name, ours, digits, _ in columns]
        lines.append([_label(part.values), *cells])
    return markdown_table([f"{title}: published / ours", *(head for *_, head in columns)], lines)


def _matrix(e: Evaluation, found: Mapping[str, dict[str, float]], overlap: float) -> str | None:
    """Format the mean ε_f of the method with memory in all sets, arranged as in table 6.6."""
    means = {
        (v["false_stars"], v["factor"]): found[part.key]["error_mean"]
        for part in e.parts
        if (v := part.values)["overlap"] == overlap
        and v["memory"]
        and v["scale"] == e.parameters["scales"][0]
    }
    false_stars, factors = sorted({f for f, _ in means}), sorted({m for _, m in means})
    if len(means) != len(false_stars) * len(factors):
        return None
    lines = [(f"f = {f}", *(f"{means[f, m]:.3f}" for m in factors)) for f in false_stars]
    words = f"mean ε_f / °, p = {100 * overlap:g} %, with memory (sets of table 6.6)"
    return markdown_table((words, *(f"μ = {m}" for m in factors)), lines)


def _compare(e: Evaluation, diagonal: Sequence[Part], found: Mapping[str, dict[str, float]]) -> None:
    """Compare the mean ε_f of the sets with μ = f, and the worst of all sets."""
    for part in diagonal:
        v, s = part.values, found[part.key]
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
            set_label(v): found[part.key]["error_mean"]
            for part in e.parts
            if (v := part.values)["overlap"] == overlap and v["memory"] and v["scale"] != PRINTED
        }
        worst = max(means, key=lambda words: means[words])
        quantity = f"greatest mean ε_f of all sets, p = {100 * overlap:g} %: RSI with memory (ours)"
        e.compare(quantity, ours=means[worst], remark=f"{worst}; {len(means)} sets.")
