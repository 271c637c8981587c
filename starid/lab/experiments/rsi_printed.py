"""The recursive algorithm of the thesis: tables 6.7, 6.8, H.1 and H.2, and sequences with the thesis's filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.false_stars import FalseStarFilter, FilterResult
from starid.identification.thesis.features import extract_features
from starid.identification.thesis.fsf import ClusterFilter
from starid.identification.thesis.matlab_filter import MatlabFilter
from starid.identification.thesis.metrics import rotation_error
from starid.identification.thesis.rsi import RecursiveIdentification, RsiSettings
from starid.lab.experiments.author_noise import identification_noise
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.lsi_trials import OFF, error_of, frames_under_test, stars_of
from starid.lab.experiments.rsi_trials import (
    LSI_ONLY,
    START,
    measured_step,
    method_of,
    side_as_printed,
    statistics,
)
from starid.lab.experiments.tables import RECURSION
from starid.lab.simulation import PIXEL_DEG, NoiseModel, SimulatedFrame, sky_sequence, turned

_MARGIN_DEG: Final = 1.6
_SIDE_DEG: Final = 4.0
_ROLL_DEG: Final = 2.5
_UNFILTERED: Final = 1
"""Number of first frames that are not filtered."""
_TAUS: Final = (LSI_ONLY, 0.5, 1.0)
_EXCEEDED_PSI: Final = 0.5
"""Table 6.7 has the same share of frames "with ε_ψ > τ" for both τ: that of τ = 0.5."""
_BYTES_PER_CELL: Final = 5
_TABLES: Final = {0.995: "H.1", 0.9975: "H.2"}


def _replayed(results: Iterable[FilterResult]) -> FalseStarFilter:
    """Replay filter results, because several methods process the same frames."""
    left = iter(results)
    return lambda _before, _now: next(left)


def _settings(reading: str, tau: float) -> RsiSettings:
    """Settings of a variant and a threshold; for LSI only, no region is ever small enough."""
    author, lsi = reading == "author", tau == LSI_ONLY
    return RsiSettings(
        tau=1.0 if lsi else tau,
        gamma_min_deg=_SIDE_DEG if author else RsiSettings().gamma_min_deg,
        gamma_scale=0.0 if author else 1.0,
        gamma_lsi_deg=1e-9 if lsi else RsiSettings().gamma_lsi_deg,
        motion_model="rigid" if reading == "rigid" else "affine",
    )


def compute(context: Context, part: Part) -> Results:
    """Errors of single frames for the tables, or the measurements of sequences."""
    return _trials(context, part) if "overlap" in part.values else _sequences(context, part)


def _trials(context: Context, part: Part) -> Results:
    """ε_f, ε_θ and ε_ψ of frames off the grid, from the region and from the whole database, (2, 3, n)."""
    lsi = context.lost_in_space(part["overlap"], "matlab")
    rng, noise = context.rng(part.key), identification_noise(part["factor"])
    frames = frames_under_test(rng, OFF, lsi.database.grid.step_deg, context.parameters["every"])
    numbers = np.empty((2, 3, len(frames)))
    stars = stars_of(context.sky(), frames, rng, lambda _: noise)
    for i, ((ra, dec), (brightness, positions)) in enumerate(zip(frames, stars, strict=True)):
        roll = float(rng.uniform(-_ROLL_DEG, _ROLL_DEG))
        features = extract_features(brightness, turned(positions, roll))
        observation = lsi.database.normalise(features)
        cell, distance, _ = lsi.nearest_in_region(observation, ra, dec, _SIDE_DEG)
        estimates = lsi.estimate(observation, cell, distance).mse, lsi.solve(features).mse
        for j, estimate in enumerate(estimates):
            turn = rotation_error(math.degrees(features.theta_rad - estimate.theta_rad), roll)
            numbers[j, :, i] = error_of(estimate, ra, dec), float(turn), estimate.error_psi
    return {"numbers": numbers}


def _answers(numbers: Array, tau: float) -> Array:
    """ε_f, ε_θ and ε_ψ of the answers of a method, (3, n), from those of the region and the whole database."""
    region, whole = numbers
    if tau == LSI_ONLY:
        return np.asarray(whole, dtype=np.float64)
    searched = (region[2] > tau) & (whole[2] < region[2])
    return np.asarray(np.where(searched, whole, region), dtype=np.float64)


def _distances(frames: Sequence[SimulatedFrame], results: Sequence[FilterResult]) -> Array:
    """μ_d and σ_d of the matches, and from all survivors to their nearest neighbours, degrees, (n, 4).

    The nearest neighbours are those of the "min" in eq. 3.11.
    """
    from scipy.spatial import cKDTree

    distances = np.full((len(results), 4), math.nan)
    for i, (before, now, result) in enumerate(zip(frames[:-1], frames[1:], results, strict=True)):
        first, second = before.observed.positions, now.observed.positions
        motion = matched_motion(before.observed, now.observed, result.matches, model="affine")
        if motion is None:
            continue
        away, _ = cKDTree(second[result.true_now]).query(motion.apply(first[result.true_before]))
        distances[i] = motion.mean_distance_deg, motion.sigma_distance_deg, away.mean(), away.std(ddof=1)
    return distances


def _sequences(context: Context, part: Part) -> Results:
    """Distances of the filter, and measurements (fields, n) of each database, reading and threshold."""
    m, author = part["factor"], part["reading"] == "author"
    noise = identification_noise(m, false_stars=m) if author else NoiseModel.of("both", m, false_stars=m)
    rng, count = context.rng(part.key), int(context.parameters["frames"])
    made = sky_sequence(rng, context.sky(), *START, noise, count=count, margin_deg=_MARGIN_DEG)
    frames = list(made)
    cluster = MatlabFilter(PIXEL_DEG, loses_unequal=False) if author else ClusterFilter()
    results = [cluster(before.observed, now.observed) for before, now in itertools.pairwise(frames)]
    results_by_name: Results = {"distances": _distances(frames, results)}
    readings = ("author",) if author else ("printed", "rigid")
    for overlap, reading, tau in itertools.product(context.parameters["overlaps"], readings, _TAUS):
        lsi = context.lost_in_space(overlap, "matlab" if author else "exact")
        recursion = RecursiveIdentification(lsi, _replayed(results), _settings(reading, tau))
        numbers = [measured_step(recursion.step(frame.observed), frame) for frame in frames]
        results_by_name[f"{reading}-p{100 * overlap:g}-t{tau:g}"] = np.array(numbers).T
    return results_by_name


def _compare_errors(e: Evaluation, overlap: float, m: int, tau: float) -> None:
    """Compare a line of tables H.1 and H.2: means and deviations."""
    found = _answers(e.results[f"table-p{overlap:g}-m{m}"]["numbers"], tau)
    measured: dict[str, Any] = {}
    for (name, unit), values in zip((("error", "°"), ("roll", "°"), ("psi", "")), found, strict=True):
        remark = f"Median {np.median(values):.2f}{unit}."
        measured[f"{name}_mean"] = {"author": values.mean(), "remark": remark}
        measured[f"{name}_sigma"] = values.std()
    table = f"table {_TABLES[overlap]}"
    where = f"{table}, μ = f = {m}, {method_of(tau)}"
    e.compare_line("H", table, where, RECURSION[overlap, m, tau], measured)


def _compare_updates(e: Evaluation, overlap: float, m: int, tau: float) -> None:
    """Compare a line of table 6.7: shares of frames."""
    psi = e.results[f"table-p{overlap:g}-m{m}"]["numbers"][0, 2]
    limits = {"trigger_percent": tau, "exceeded_percent": _EXCEEDED_PSI}
    measured = {name: 100.0 * float(np.mean(psi > limit)) for name, limit in limits.items()}
    where = f"table 6.7, p = {100 * overlap:g} %, μ = f = {m}, {method_of(tau)}"
    e.compare_line("6.7", str(overlap), where, RECURSION[overlap, m, tau], measured)


def _compare_sides(e: Evaluation, overlap: float, m: int, tau: float) -> None:
    """Compare a line of table 6.8: side, deviation and size of the region."""
    least, published = RsiSettings().gamma_min_deg, RECURSION[overlap, m, tau]
    literal, reduced = (e.results[f"m{m}-{run}"]["distances"] for run in ("printed", "author"))
    mean, sigma, wide, spread = map(float, np.nanmean(literal, axis=0))
    printed = side_as_printed(mean, sigma, least)
    root, wide_root = least + math.sqrt(mean * sigma), least + math.sqrt(wide * spread)
    sides = least + np.sqrt(reduced[:, 2] * reduced[:, 3])
    sizes = {
        name: 1e-3 * _BYTES_PER_CELL * (published["side_mean"] / (field * (1.0 - overlap))) ** 2
        for name, field in (("printed", 42.0), ("author", 40.0))
    }
    measured = {
        "side_mean": {
            "author": np.nanmean(sides),
            "printed": printed,
            "remark": f"Noise as printed: (a) {printed:.2f}, (b) {root:.2f}, (c) {wide_root:.2f}°; "
            f"μ_d {mean:.2g}°, σ_d {sigma:.2g}°.",
        },
        "side_sigma": np.nanstd(sides),
        "region_kB": {**sizes, "remark": "Eq. 6.6 with the published side."},
    }
    where = f"table 6.8, p = {100 * overlap:g} %, μ = f = {m}, {method_of(tau)}"
    e.compare_line("6.8", str(overlap), where, published, measured)


def evaluate(e: Evaluation) -> None:
    """All numbers of tables 6.7, 6.8, H.1 and H.2, and the sequences."""
    factors = e.parameters["factors"]
    for compare, overlaps, taus in (
        (_compare_errors, e.parameters["tables"], _TAUS),
        (_compare_updates, e.parameters["tables"], _TAUS[1:]),
        (_compare_sides, e.parameters["tables"], _TAUS[1:]),
    ):
        for overlap, m, tau in itertools.product(overlaps, factors, taus):
            compare(e, overlap, m, tau)
    lines = []
    for part in e.parts:
        for name, numbers in e[part].items():
            if "reading" in part.values and name != "distances":
                line = {"factor": part["factor"], "method": name}
                lines.append(line | statistics(numbers, _UNFILTERED))
    e.write("rsi_as_printed.csv", lines)
