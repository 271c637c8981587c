"""Studies of the false-star filters: parameters 6.12, tables 6.3–6.5, hundreds of objects per frame."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Final

import numpy as np

from starid.lab.experiments.comparison import (
    Tolerance,
    agreement,
    null_model,
    published,
    sampled_deviation,
    sampled_mean,
    sampling,
    shown,
)
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    parts_of,
    row,
    write_lines,
)
from starid.lab.experiments.fsf import (
    RADIUS_DEG,
    author_distances,
    author_noise,
    frames_of_seven,
    motion_errors,
    noise_of,
)
from starid.lab.simulation import PIXEL_DEG, NoiseModel, turned
from starid.plots import figure, save
from starid.thesis.cme import estimate_motion, matched_motion
from starid.thesis.false_stars import ObservedFrame
from starid.thesis.fsf import ClusterFilter
from starid.thesis.matlab_filter import MatlabFilter
from starid.thesis.metrics import Confusion
from starid.thesis.rsi import correlation
from starid.thesis.scalable_filter import TrackFilter, TrackFilterSettings

_SPREAD_DEG: Final = 0.1
_EPSILONS: Final = tuple(round(0.2 * k, 1) for k in range(1, 11))
_SHARES: Final = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0)
_CASES: Final = ("none", "brightness", "position", "both")
_CASE_NOTE: Final = """Ten moved frames, noise factor 1. The thesis has rotation errors of 0.7° in most
rows of table 6.4, even without noise: its sign or reference must have been different. Figure 6.13 shows a
frame and the earlier one after the estimated motion, without and with noise."""

_ALL: Final = 100.0
_CASE_FRAMES: Final = 10
_CASE_STARS: Final = 70
_ROUNDING_ERROR_DEG: Final = 1e-12
"""Errors below this are rounding errors, degrees."""

_PUBLISHED_FRAMES: Final = 1000
_KINDS: Final = ("transient", "stationary", "drifting")
_CROWD_NOTE: Final = """Counted are all false stars, and the true stars that were in the field in both frames
before as well, since the filter needs three sightings. Slowly drifting stars need a few more frames to be
recognised. The time is taken from the fastest tenth of the frames, since other work on the machine slows the
rest."""


def _choice_parts(parameters: Parameters) -> list[Part]:
    return [
        *parts_of("eps{epsilon:g}", epsilon=parameters["epsilons"], least=[3.0]),
        *parts_of("share{share:g}-eps{epsilon:g}", epsilon=(0.4, 0.8), share=parameters["shares"]),
    ]


def _choice_work(context: Context, part: Part) -> Results:
    noise = NoiseModel(position_sigma_px=_SPREAD_DEG / PIXEL_DEG)
    lost, shift_errors = [], []
    first, frames = frames_of_seven(context.rng("frames"), noise, int(context.parameters["frames"]))
    for frame in frames:
        least = part.values.get("least") or part.values["share"] * len(frame.observed)
        result = ClusterFilter(part.values["epsilon"], least)(first.observed, frame.observed)
        lost.append(np.count_nonzero(~result.true_now))
        motion = matched_motion(first.observed, frame.observed, result.matches)
        if motion is not None:
            shift_errors.append(motion_errors(motion, frame)[1])
    return {"lost": np.array(lost, dtype=np.float64), "shift": np.array(shift_errors)}


def _evaluate_choice(context: Context, results: Mapping[str, Results]) -> Outcome:
    means = {
        part.key: (
            float(results[part.key]["lost"].mean()),
            float(np.mean(results[part.key]["shift"])) if results[part.key]["shift"].size else math.nan,
        )
        for part in _choice_parts(context.parameters)
    }
    lines = [
        {"part": key, "lost_stars": lost, "shift_error_deg": error} for key, (lost, error) in means.items()
    ]
    table = write_lines(context.folder / "parameter_choice.csv", lines)
    epsilons, shares = context.parameters["epsilons"], context.parameters["shares"]
    fig, axes = figure(1, 2)
    for i, (style, label) in enumerate((("o-", "stars lost a frame"), ("s-", "error of the shift / °"))):
        axes[0].plot(epsilons, [means[f"eps{e:g}"][i] for e in epsilons], style, label=label)
    axes[0].set(xlabel="ε (min_samples = 3)")
    for epsilon in (0.4, 0.8):
        lost_stars = [means[f"share{s:g}-eps{epsilon:g}"][0] for s in shares]
        axes[1].plot(shares, lost_stars, "o-", label=f"stars lost a frame, ε = {epsilon:g}")
    axes[1].set(xlabel="min_samples / number of objects")
    for ax in axes:
        ax.legend()
    name = save(fig, context.folder / "figure_6_12.png")
    chosen = means["share0.5-eps0.4"]
    rows = (
        shown(
            "stars lost a frame, ε = 0.4, min_samples = 0.5·n, position noise 0.1°",
            published="close to 0",
            printed=chosen[0],
            digits=3,
            remark="The choice of the thesis; smaller min_samples lose fewer stars here, but let more false stars pass.",
        ),
        shown("error of the shift, the same", printed=chosen[1], unit="°", digits=4),
    )
    return Outcome(rows, (table, name))


def _case_parts(parameters: Parameters) -> list[Part]:
    return parts_of("f{false_stars}-{kind}", false_stars=parameters["false_stars"], kind=_CASES)


def _case_work(context: Context, part: Part) -> Results:
    kind, clean = part.values["kind"], part.values["kind"] == "none"
    noise = noise_of("both" if clean else kind, 0.0 if clean else 1.0, part.values["false_stars"])
    counts = np.zeros(4, dtype=np.int64)
    errors = []
    first, frames = frames_of_seven(context.rng(part.key), noise, _CASE_FRAMES)
    for frame in frames:
        result = ClusterFilter()(first.observed, frame.observed)
        counts += Confusion.of(result.true_now, frame.is_star).counts
        motion = matched_motion(first.observed, frame.observed, result.matches, model="affine")
        errors.append((math.nan, math.nan) if motion is None else motion_errors(motion, frame))
    return {"counts": counts, "errors": np.array(errors)}


def _evaluate_case(context: Context, results: Mapping[str, Results]) -> Outcome:
    lines = []
    columns: dict[str, list[Row]] = {}
    for part in _case_parts(context.parameters):
        f, kind = part.values["false_stars"], part.values["kind"]
        c = Confusion(*results[part.key]["counts"].tolist())
        errors = results[part.key]["errors"]
        mean, sigma = errors.mean(axis=0), errors.std(axis=0, ddof=1)
        where = f"f = {f}, noise: {kind}"
        # accuracy and precision (the recall is 100 %), and mean and deviation of ε_γ and ε_ρ
        accuracy, precision, *known = published("fsf-case-study", f"tables 6.3 and 6.4, {where}")
        line = {"f": f, "noise": kind, "accuracy": c.accuracy, "precision": c.precision, "recall": c.recall}
        line |= {"rotation_error_deg": mean[0], "rotation_sigma_deg": sigma[0]}
        line |= {"shift_error_deg": mean[1], "shift_sigma_deg": sigma[1]}
        line |= {"published_accuracy": 0.01 * accuracy, "published_precision": 0.01 * precision}
        line |= {"published_rotation_error_deg": known[0], "published_shift_error_deg": known[2]}
        lines.append(line)
        for name, theirs in (("accuracy", accuracy), ("precision", precision), ("recall", _ALL)):
            columns.setdefault(name, []).append(
                agreement(
                    f"table 6.3, {where}: {name}",
                    published=theirs,
                    tolerance=sampling(theirs, _CASE_STARS),
                    printed=c.percent(name),
                    unit="%",
                )
            )
        values = (mean[0], sigma[0], mean[1], sigma[1])
        for i, (symbol, value) in enumerate(zip(("ε_γ", "σ_γ", "ε_ρ", "σ_ρ"), values, strict=True)):
            spread = max(known[i - i % 2 + 1], _ROUNDING_ERROR_DEG)
            tolerance = (
                sampled_mean(spread, _CASE_FRAMES) if i % 2 == 0 else sampled_deviation(spread, _CASE_FRAMES)
            )
            columns.setdefault(symbol, []).append(
                agreement(
                    f"table 6.4, {where}: {symbol}",
                    published=known[i],
                    tolerance=tolerance,
                    printed=float(value),
                    unit="°",
                    digits=4,
                )
            )
    table = write_lines(context.folder / "tables_6_3_and_6_4.csv", lines)
    rows = [row for column in columns.values() for row in null_model(column)]
    return Outcome(tuple(rows), (table, _reconstruction_figure(context)), (_CASE_NOTE,))


def _reconstruction_figure(context: Context) -> str:
    """Draw figure 6.13: the stars of a frame, and of the previous one after the estimated motion."""
    fig, axes = figure(1, 2, width=9.5, height=4.6, sharey=True)
    for factor, ax in zip((0.0, 1.0), axes, strict=True):
        clean, frames = frames_of_seven(context.rng("figure 6.13"), noise_of("both", factor, 0), 1)
        first, second = clean.observed, next(frames).observed
        matches = ClusterFilter()(first, second).matches
        stars = second.positions[matches[:, 1]]
        motion = estimate_motion(first.positions[matches[:, 0]], stars)
        moved = motion.apply(first.positions[matches[:, 0]])
        magnified = ax.inset_axes((0.03, 0.03, 0.3, 0.3))
        for axis, size in ((ax, 7.0), (magnified, 11.0)):
            axis.plot(*stars.T, "bo", markersize=size, fillstyle="none", label="stars")
            axis.plot(*moved.T, "r+", markersize=size, label="reconstructed")
        at = stars[int(np.argmax(np.hypot(*(moved - stars).T)))]
        magnified.set(
            xlim=at[0] + np.array([-0.3, 0.3]), ylim=at[1] + np.array([-0.3, 0.3]), xticks=[], yticks=[]
        )
        ax.indicate_inset_zoom(magnified, edgecolor="black")
        ax.set(
            title=f"μ = {factor:g}: γ̃ = {motion.rotation_deg:.3f}°, μ_d = {motion.mean_distance_deg:.1e}°",
            xlabel="x / °",
            xlim=(-RADIUS_DEG, RADIUS_DEG),
            ylim=(-RADIUS_DEG, RADIUS_DEG),
        )
    axes[0].set_ylabel("y / °")
    axes[0].legend(loc="upper right")
    fig.suptitle("Figure 6.13: the inset magnifies the star that lies farthest from its reconstruction")
    return save(fig, context.folder / "figure_6_13.png")


def _correlation_parts(parameters: Parameters) -> list[Part]:
    return parts_of("m{factor}", factor=parameters["factors"])


def _correlation_work(context: Context, part: Part) -> Results:
    """μ_d and σ_d of the frames (n, 2), as the author ran it and as printed."""
    factor, count = part.values["factor"], int(context.parameters["frames"])
    found = MatlabFilter(PIXEL_DEG)
    first, frames = frames_of_seven(context.rng(part.key), author_noise("both", factor, factor), count)
    author = np.array([author_distances(first.observed, frame.observed, found)[1] for frame in frames])
    first, frames = frames_of_seven(context.rng(part.key), noise_of("both", factor, factor), count)
    printed = []
    for frame in frames:
        matches = ClusterFilter()(first.observed, frame.observed).matches
        motion = matched_motion(first.observed, frame.observed, matches, model="affine")
        if motion is not None:
            printed.append((motion.mean_distance_deg, motion.sigma_distance_deg))
    return {"author": author[np.isfinite(author[:, 0])], "printed": np.array(printed)}


def _of_correlation(published: float, trials: int) -> Tolerance:
    """Tolerance for two correlation coefficients: three standard errors, by Fisher's transformation."""
    error = 3.0 * (1.0 - published**2) * math.sqrt(2.0 / (trials - 3))
    return error, f"3 standard errors of two coefficients of {trials}, {error:.2g}"


def _evaluate_correlation(context: Context, results: Mapping[str, Results]) -> Outcome:
    rows, lines = [], []
    parts = _correlation_parts(context.parameters)
    fig, axes = figure(len(parts), 1, height=1.6 * len(parts), squeeze=False)
    for part, ax in zip(parts, axes[:, 0], strict=True):
        motion = results[part.key]["author"]
        rho, p = correlation(motion[:, 0], motion[:, 1])
        printed, _ = correlation(*results[part.key]["printed"].T)
        factor = part.values["factor"]
        lines.append({"factor": factor, "rho": rho, "p": p})
        known = published("cme-correlation", "table 6.5")[factor]
        rows.append(
            agreement(
                f"table 6.5: correlation of μ_d and σ_d, μ = f = {factor}",
                published=known,
                tolerance=_of_correlation(known, _PUBLISHED_FRAMES),
                author=rho,
                printed=printed,
                digits=3,
                remark=f"p-value {p:.1g}.",
            )
        )
        ax.plot(motion[:50, 0], label="μ_d / °")
        ax.plot(motion[:50, 1], label="σ_d / °")
        ax.set(title=f"μ = f = {factor}")
        ax.legend(loc="upper right")
    axes[-1, 0].set_xlabel("trial")
    name = save(fig, context.folder / "figures_6_31_6_32_d.png")
    table = write_lines(context.folder / "table_6_5.csv", lines)
    note = (
        "As the author ran it, over all pairs in the cluster about the motion fitted to the inliers: an outlier raises the mean "
        "and the deviation together, which gives the coefficients near 1. The published decrease at μ = f = 2 is not explained."
    )
    return Outcome(tuple(rows), (table, name), (note,))


def _crowd_parts(parameters: Parameters) -> list[Part]:
    return parts_of("{kind}-{true_stars}", kind=_KINDS, true_stars=parameters["true_stars"])


def _crowd_work(context: Context, part: Part) -> Results:
    rng = context.rng(part.key)
    true, false = part.values["true_stars"], part.values["true_stars"] // 3
    total = round(true * 60.0**2 / 42.0**2)
    sky, magnitude = rng.uniform(-30.0, 30.0, (total, 2)), rng.uniform(0.0, 5.5, total)
    fixed, fixed_magnitude = rng.uniform(-20.0, 20.0, (false, 2)), rng.uniform(0.0, 5.5, false)
    velocity = rng.normal(0.0, 0.3, (false, 2))
    sigma = 0.2 * PIXEL_DEG
    track = TrackFilter(TrackFilterSettings(position_sigma_deg=sigma, brightness_sigma=0.1))
    counts, times = np.zeros(4, dtype=np.int64), []
    before = (np.zeros(total + false, dtype=np.bool_), np.zeros(total + false, dtype=np.bool_))
    for t in range(int(context.parameters["frames"])):
        turn, shift = 0.5 * t, np.array([6.0 * math.sin(0.05 * t), 6.0 * math.sin(0.07 * t)])
        others = {
            "transient": rng.uniform(-20.0, 20.0, (false, 2)),
            "stationary": fixed,
            "drifting": turned(fixed + velocity * t, turn) + shift,
        }[part.values["kind"]]
        places = np.concatenate([turned(sky, turn) + shift, others])
        places += rng.normal(0.0, sigma, places.shape)
        values = np.concatenate([magnitude, fixed_magnitude]) + rng.normal(0.0, 0.1, len(places))
        inside = np.abs(places).max(axis=1) <= 21.0
        frame = ObservedFrame(values[inside], places[inside])
        begin = time.perf_counter()
        result = track.update(frame)
        times.append(1e3 * (time.perf_counter() - begin))
        known = inside & ((before[0] & before[1]) | (np.arange(len(places)) >= total))
        before = (inside, before[0])
        if t >= 4:
            is_star = (np.arange(len(places)) < total)[known]
            counts += Confusion.of(result.true_now[known[inside]], is_star).counts
    return {"counts": counts, "ms": np.array(times[1:])}


def _evaluate_crowd(context: Context, results: Mapping[str, Results]) -> Outcome:
    rows = []
    for part in _crowd_parts(context.parameters):
        c = Confusion(*results[part.key]["counts"].tolist())
        true = part.values["true_stars"]
        label = f"{true} true and {true // 3} {part.values['kind']} false stars"
        rows += [
            row(f"scalable filter, {name}, {label}", ours=c.percent(name), unit="%", at_least=least)
            for name, least in (("recall", 99.0), ("precision", 99.5))
        ]
        rows.append(
            row(
                f"scalable filter, time a frame, {label}",
                ours=float(np.percentile(results[part.key]["ms"], 10.0)),
                unit="ms",
                at_most=5.0 if true == 150 and not context.quick else None,
            )
        )
    return Outcome(tuple(rows), (), (_CROWD_NOTE,))


EXPERIMENTS: Final = (
    Experiment(
        "fsf-parameters",
        "Choice of ε and min_samples: figure 6.12",
        _choice_parts,
        _choice_work,
        _evaluate_choice,
        full={"epsilons": list(_EPSILONS), "shares": list(_SHARES), "frames": 1000},
        quick=None,
    ),
    Experiment(
        "fsf-case-study",
        "Case study of the filter and the motion: tables 6.3 and 6.4, figure 6.13",
        _case_parts,
        _case_work,
        _evaluate_case,
        full={"false_stars": [0, 1, 2]},
        quick={"false_stars": [0, 1, 2]},
        revision=2,
    ),
    Experiment(
        "cme-correlation",
        "Mean and deviation of the distances: table 6.5, figures 6.31, 6.32 and D",
        _correlation_parts,
        _correlation_work,
        _evaluate_correlation,
        full={"factors": [0, 1, 2, 3, 4, 5], "frames": 1000},
        quick=None,
        revision=3,
    ),
    Experiment(
        "scalable-filter",
        "The filter for hundreds of objects",
        _crowd_parts,
        _crowd_work,
        _evaluate_crowd,
        full={"true_stars": [150, 225], "frames": 200},
        quick={"true_stars": [150], "frames": 40},
        alone=True,
    ),
)
