"""Tables 6.7–6.9, H.1 and H.2 and ours; rows and paragraphs of the report on the recursive algorithm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from starid.lab.experiments.author_noise import IDENTIFICATION_ROOT
from starid.lab.experiments.comparison import improvement, shown
from starid.lab.experiments.experiment import Context, Part, Results, Row, write_lines
from starid.lab.experiments.published import printed_of
from starid.lab.experiments.rsi_parts import (
    BY_TABLE,
    LSI_ONLY,
    PRINTED,
    SETTLING,
    method_of,
    noise_label,
    rsi_parts,
    set_label,
    statistics,
)
from starid.lab.experiments.rsi_readings import side_as_printed
from starid.thesis.rsi import RsiSettings, region_cells, region_side

_TARGET_DEG: Final = {0.995: 0.18, 0.9975: 0.13}
_BYTES_PER_CELL: Final = 5
_FIELD_DEG: Final = 40.0
_GAMMA_MIN_DEG: Final = RsiSettings().gamma_min_deg
_NAMES: Final = (
    *("error_mean", "error_sigma", "roll_mean", "roll_sigma", "psi_mean", "psi_sigma"),
    *("trigger_percent", "exceeded_percent", "side_mean", "side_sigma"),
    *("search_ms", "search_ms_sigma", "lasso_ms", "lasso_ms_sigma"),
)
_UPDATE_COLUMNS: Final = (
    ("trigger_percent", "trigger_percent", 1),
    ("exceeded_percent", "exceeded_percent", 1),
    ("side_mean", "side_mean", 2),
    ("side_sigma", "side_sigma", 3),
    ("region_kB", "region_kB", 2),
    ("search_ms", "search_ms_median", 3),
    ("lasso_ms", "lasso_ms_median", 3),
)
"""Columns of tables 6.7 to 6.9: name of the published value, name of the computed one, decimals."""
_FILE: Final = "tables_6_7_6_8_6_9_h_1_h_2.csv"


def _published(values: Mapping[str, Any]) -> dict[str, float]:
    """Published values for a set with μ = f; empty if the tables have no such row."""
    unknown = values["false_stars"] != values["factor"] or values["memory"] or values["side"] == BY_TABLE
    return {} if unknown else printed_of(values)


def _region_kilobytes(values: Mapping[str, Any], side_deg: float) -> float:
    return 1e-3 * _BYTES_PER_CELL * region_cells(side_deg, _FIELD_DEG, values["overlap"])


def rsi_tables(context: Context, results: Mapping[str, Results]) -> list[str]:
    """Write two CSV files: all sets and methods, and the interpretations of eq. 6.5."""
    lines = []
    for part in rsi_parts(context.parameters):
        v, measured = part.values, statistics(results[part.key])
        published = {f"published_{name}": _published(v).get(name, "") for name in _NAMES}
        size = _region_kilobytes(v, measured["side_mean"])
        lines.append({**v, "method": method_of(v), **measured, "region_kB": size, **published})
    files = [write_lines(context.folder / _FILE, lines)]
    readings = _readings(context, results)
    if readings:
        files.append(write_lines(context.folder / "equation_6_5.csv", readings))
    return files


def _readings(context: Context, results: Mapping[str, Results]) -> list[dict[str, float]]:
    """Side Γ as printed, with the square root, and in table 6.8; μ_d and σ_d; for the first RSI method."""
    parameters = context.parameters
    tau = min(t for t, *_ in parameters["methods"] if t != LSI_ONLY)
    lines = []
    for part in _diagonal(rsi_parts(parameters)):
        v, published = part.values, _published(part.values)
        if v["overlap"] != parameters["overlaps"][0] or v["tau"] != tau or not published:
            continue
        s = statistics(results[part.key])
        mean, sigma = s["mean_distance_deg"], s["sigma_distance_deg"]
        line = {"factor": v["factor"], "scale": v["scale"], "mu_d_deg": mean, "sigma_d_deg": sigma}
        line["as_printed_deg"] = side_as_printed(mean, sigma, _GAMMA_MIN_DEG)
        line["square_root_deg"] = region_side(mean, sigma, RsiSettings())
        lines.append(line | {"published_deg": published["side_mean"]})
    return lines


def _diagonal(parts: Iterable[Part]) -> list[Part]:
    return [part for part in parts if part.values["false_stars"] == part.values["factor"]]


def _wide(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    text = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    return "\n".join(text + ["| " + " | ".join(line) + " |" for line in lines])


def _pair(theirs: float | None, ours: float, digits: int) -> str:
    """Format the published value and ours in one cell."""
    left = "—" if theirs is None else f"{theirs:.{digits}f}"
    return f"{left} / " + ("—" if math.isnan(ours) else f"{ours:.{digits}f}")


def _error_table(context: Context, results: Mapping[str, Results]) -> str:
    lines = []
    for part in _diagonal(rsi_parts(context.parameters)):
        s, theirs = statistics(results[part.key]), _published(part.values)
        cells = [_pair(theirs.get(name), s[name], 2) for name in _NAMES[:6]]
        lines.append((f"{set_label(part.values)}: {method_of(part.values)}", *cells))
    head = ("tables H.1 and H.2: published / ours", "ε_f mean / °", "σ", "ε_θ mean / °", "σ", "ε_ψ mean", "σ")
    return _wide(head, lines)


def _update_table(context: Context, results: Mapping[str, Results]) -> str:
    lines = []
    for part in _diagonal(rsi_parts(context.parameters)):
        v, s, theirs = part.values, statistics(results[part.key]), _published(part.values)
        s["region_kB"] = _region_kilobytes(v, s["side_mean"])
        cells = [_pair(theirs.get(name), s[ours], digits) for name, ours, digits in _UPDATE_COLUMNS]
        lines.append((f"{set_label(v)}: {method_of(v)}", *cells))
    head = (
        "tables 6.7, 6.8 and 6.9: published / ours",
        "triggers / %",
        "ε_ψ > τ / %",
        "Γ mean / °",
        "σ",
        "kB",
    )
    return _wide((*head, "1NN / ms, mean / median", "LASSO / ms, mean / median"), lines)


def _matrix(context: Context, results: Mapping[str, Results], overlap: float) -> str | None:
    """Format the mean ε_f of the method with memory in all sets, arranged as in table 6.6."""
    found = {
        (p.values["false_stars"], p.values["factor"]): statistics(results[p.key])["error_mean"]
        for p in rsi_parts(context.parameters)
        if p.values["overlap"] == overlap
        and p.values["memory"]
        and p.values["scale"] == context.parameters["scales"][0]
    }
    false_stars, factors = sorted({f for f, _ in found}), sorted({m for _, m in found})
    if len(found) != len(false_stars) * len(factors):
        return None
    lines = [(f"f = {f}", *(f"{found[f, m]:.3f}" for m in factors)) for f in false_stars]
    words = f"mean ε_f / °, p = {100 * overlap:g} %, with memory (sets of table 6.6)"
    return _wide((words, *(f"μ = {m}" for m in factors)), lines)


def rsi_rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    """Rows with the mean ε_f of the sets with μ = f, the worst of all sets, and the published means."""
    rows = []
    parts = rsi_parts(context.parameters)
    for part in _diagonal(parts):
        v, s = part.values, statistics(results[part.key])
        quantity = f"mean ε_f, {set_label(v)}: {method_of(v)}"
        remark = (
            f"Median {s['error_median']:.3f}°, {s['gross_percent']:.1f} % beyond 1°; ε_θ {s['roll_median']:.1f}° "
            f"in the median; invalid {s['invalid_percent']:.1f} %."
        )
        ours, published = s["error_mean"], printed_of(v)["error_mean"]
        if v["memory"]:
            made = improvement(
                quantity, published=published, ours=ours, larger=False, unit="°", digits=3, remark=remark
            )
        else:
            known = published if v["side"] != BY_TABLE else None
            made = shown(quantity, published=known, ours=ours, unit="°", digits=3, remark=remark)
        rows.append(made)
    for overlap in context.parameters["overlaps"]:
        chosen = [
            p
            for p in parts
            if p.values["overlap"] == overlap and p.values["memory"] and p.values["scale"] != PRINTED
        ]
        means = {set_label(p.values): statistics(results[p.key])["error_mean"] for p in chosen}
        worst = max(means, key=lambda words: means[words])
        rows.append(
            improvement(
                f"greatest mean ε_f of all {len(means)} sets, p = {100 * overlap:g} %: RSI with memory (ours)",
                ours=means[worst],
                published=_TARGET_DEG[overlap],
                larger=False,
                unit="°",
                digits=3,
                remark=worst,
            )
        )
    return rows


_SETTING_NOTE: Final = f"""Sequences of frames of the flat sky, starting at the published frame. From one
frame to the next the boresight moves by U(−25, 25) px per axis and the frame rotates by U(−2.5°, 2.5°). Stars
enter and leave. The filter is the scalable one; the thesis's own filter is used in the experiment
`rsi-as-printed`. Objects are visible two degrees beyond the field of the features, so that a star is known
before it enters. The first {SETTLING} frames, in which false stars cannot be recognised yet, are left out of
the statistics. "Noise {IDENTIFICATION_ROOT:g}·√μ" is the noise to which the published accuracy corresponds. All
methods process the same frames."""

_MEMORY_NOTE: Final = """**Why the mean is large, and what helps.** Half of the answers as printed are within
a few hundredths of a degree; the mean is dominated by rare gross errors. In frames with few stars a
neighbouring cell of the region fits better than the true one, and the next region is then off centre. And if
the answer from the region exceeds τ, a distant one of millions of cells often has a smaller ε_ψ. The
published means cannot be compared: a standard deviation of 0.18° over a thousand frames leaves no room for a
gross error, but off the grid the whole-database search makes them in a few per cent of the frames. "With
memory" is our addition, not part of the algorithm as printed: the last 15 answers, carried forward with the
measured camera motion, vote, and two agree within half a degree. The answer with most votes is taken, and the
median is the centre of the next region."""

_TRIGGER_NOTE: Final = """**Fewer triggers.** The exact LASSO has a much smaller ε_ψ than the published one
(0.05 to 0.1 instead of 0.4 to 0.5), so the same τ is exceeded less often, and the search takes less time. The
tables give medians of our times; the experiment `lsi-run-time` measures the search alone."""


def rsi_notes(context: Context, results: Mapping[str, Results]) -> list[str]:
    """Paragraphs and wide tables for the report."""
    notes = [_SETTING_NOTE, _MEMORY_NOTE]
    for overlap in context.parameters["overlaps"]:
        matrix = _matrix(context, results, overlap)
        if matrix is not None:
            notes.append(matrix)
    notes += [_TRIGGER_NOTE, _error_table(context, results), _update_table(context, results)]
    readings = _readings(context, results)
    if readings:
        head = (
            "Γ / °: noise",
            "μ_d / °",
            "σ_d / °",
            "eq. 6.5 as printed",
            "Γ_min + √(μ_d·σ_d)",
            "table 6.8",
            "√(μ_d·σ_d) it needs",
        )
        lines = []
        for m, scale, mean, sigma, *sides in (line.values() for line in readings):
            cells = [f"{mean:.2g}", f"{sigma:.2g}", *(f"{side:.2f}" for side in sides)]
            lines.append(
                (f"μ = f = {m:g}, {noise_label(scale)}", *cells, f"{sides[-1] - _GAMMA_MIN_DEG:.2f}°")
            )
        notes += [_REGION_NOTE, _wide(head, lines)]
    return notes


_REGION_NOTE: Final = """**Table 6.8 cannot come from eq. 6.5.** As printed, with 110, the equation is Γ_min +
(μ_d·σ_d)^−0.02: about 6° without noise, falling as noise grows, while the table has 3.96° growing to 4.95°.
With "1·10" for "110" it is Γ_min + √(μ_d·σ_d), and the table would need residuals of 2 to 3 degrees, a
hundred times the thesis's own μ_d. The published sides are 2° + √(1.96² + 0.54·μ²) to 0.06°; the text
mentions no such term. The region here follows the second interpretation, about 2°; the runs "Γ of table 6.8"
repeat the sets with the published sides to show the difference. The printed sizes in kB are a tenth of what
the sides imply: 6 300 kB (25 200 kB) times Γ² over the 360° × 180° of the sky."""
