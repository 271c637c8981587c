"""False-star filter and camera motion: parameters 6.12, figures 6.14–6.19, tables A.1–A.18."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from starid.lab.experiments.comparison import agreement, improvement, same, sampled_mean, sampling
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    parts_of,
    star_catalog,
    write_lines,
)
from starid.lab.experiments.published import TABLES
from starid.lab.simulation import PIXEL_DEG, NoiseModel, SimulatedFrame, moved_frames
from starid.plots import colours, figure, save
from starid.thesis.cme import CameraMotion, MotionModel, matched_motion
from starid.thesis.false_stars import FilterResult
from starid.thesis.fsf import ClusterFilter
from starid.thesis.metrics import Confusion
from starid.thesis.scalable_filter import TrackFilter, TrackFilterSettings

RADIUS_DEG: Final = 21.0
"""Radius of the circular field of these experiments, degrees."""

EQUIVALENT: Final = 0.2
"""Factor on the printed noise for which the thesis's affine motion has the published μ_d of figure 6.18."""

KINDS: Final = ("brightness", "position", "both")
_MODELS: Final[tuple[MotionModel, ...]] = ("affine", "rigid")
_KIND_LABELS: Final = {"brightness": "brightness", "position": "position", "both": "brightness and position"}
FACTORS: Final = (0, 1, 2, 3, 4, 5)
_CORNER: Final = (87.41, -8.86)
_BRIGHTEST: Final = 3.0
_MAGNITUDES: Final = (-1.5, 3.0)
_COUNTS: Final = ("TP", "FP", "FN", "TN")
_INDICATORS: Final = ("accuracy", "precision", "recall", "f1")
_FILTERS: Final = ("any", "matched", "followed")
_WORST_MOTION_DEG: Final = 0.0419
_ALL: Final = 100.0
_SPREAD_OF_MOTION: Final = 0.35
"""Relative standard deviation of the μ_d of a frame, for seven stars and an affine motion."""
_STARS_A_FRAME: Final = 6.617
_NAMED: Final = (
    ("brightness", 0, 0, "accuracy", 100.0),
    ("brightness", 5, 5, "accuracy", 96.92),
    ("brightness", 5, 5, "precision", 99.90),
    ("brightness", 5, 5, "recall", 94.73),
    ("brightness", 5, 5, "f1", 97.25),
    ("position", 0, 5, "accuracy", 79.78),
    ("position", 5, 5, "accuracy", 87.64),
    ("position", 4, 5, "recall", 77.21),
    ("position", 4, 5, "f1", 87.09),
    ("both", 0, 5, "accuracy", 78.53),
    ("both", 5, 5, "precision", 99.83),
)
"""Kind of noise, f, μ, indicator and its published value."""


def first_frame() -> tuple[Any, Any]:
    """Magnitudes (7,) and offsets (7, 2), degrees, of the published stars: Hp < 3 in the square."""
    catalog = star_catalog()
    positions = np.degrees(np.column_stack([catalog.ra_rad, catalog.dec_rad])) - _CORNER - RADIUS_DEG
    chosen = (catalog.hp < _BRIGHTEST) & np.all(np.abs(positions) <= RADIUS_DEG, axis=1)
    return catalog.hp[chosen].copy(), positions[chosen]


def frames_of_seven(
    rng: np.random.Generator, noise: NoiseModel, count: int
) -> tuple[SimulatedFrame, Iterator[SimulatedFrame]]:
    """The clean frame with the seven stars, and `count` frames moved from it."""
    frames = moved_frames(rng, *first_frame(), noise, count=count, radius_deg=RADIUS_DEG)
    return next(frames), frames


def noise_of(kind: str, factor: float, false_stars: int) -> NoiseModel:
    """Noise model of one set."""
    return NoiseModel.factor(
        factor,
        false_stars,
        position=kind != "brightness",
        brightness=kind != "position",
        magnitude_range=_MAGNITUDES,
    )


def _motion(
    first: SimulatedFrame, frame: SimulatedFrame, result: FilterResult, model: MotionModel
) -> tuple[float, float, float, float]:
    """μ_d, σ_d, and errors of rotation and translation, degrees; NaN with too few matches."""
    motion = matched_motion(first.observed, frame.observed, result.matches, model=model)
    if motion is None:
        return math.nan, math.nan, math.nan, math.nan
    return motion.mean_distance_deg, motion.sigma_distance_deg, *motion_errors(motion, frame)


def motion_errors(motion: CameraMotion, frame: SimulatedFrame) -> tuple[float, float]:
    """Errors of the rotation and the translation of a frame, degrees."""
    away = motion.translation_deg - frame.shift_deg
    return abs(motion.rotation_deg - frame.rotation_deg), float(np.hypot(*away))


def _parts(parameters: Parameters) -> list[Part]:
    return parts_of(
        "{kind}-f{false_stars}-x{scale:g}",
        kind=parameters["kinds"],
        false_stars=parameters["false_stars"],
        scale=parameters["scales"],
    )


def _compute(context: Context, part: Part) -> Results:
    kind, false_stars, scale = part.values["kind"], part.values["false_stars"], part.values["scale"]
    count = int(context.parameters["frames"])
    counts = {name: np.zeros((len(FACTORS), 4), dtype=np.int64) for name in _FILTERS}
    motions = {model: np.full((len(FACTORS), count, 4), math.nan) for model in _MODELS}
    cluster = ClusterFilter()
    for k, factor in enumerate(FACTORS):
        noise = noise_of(kind, factor * scale, false_stars)
        first, frames = frames_of_seven(context.rng(part.key, factor), noise, count)
        track = TrackFilter(
            TrackFilterSettings(
                position_sigma_deg=max(noise.position_sigma_px * PIXEL_DEG, 0.01),
                brightness_sigma=max(noise.brightness_sigma * noise.magnitude_per_unit, 0.02),
                max_rotation_deg=6.0,
                max_shift_deg=2.5,
            )
        )
        track.update(first.observed)
        for i, frame in enumerate(frames):
            result = cluster(first.observed, frame.observed)
            followed = track.update(frame.observed).true_now
            for name, taken in zip(_FILTERS, (result.true_now, result.matched, followed), strict=True):
                counts[name][k] += Confusion.of(taken, frame.is_star).counts
            for model, values in motions.items():
                values[k, i] = _motion(first, frame, result, model)
    return {**counts, **{str(model): values for model, values in motions.items()}}


def _percent(counts: Sequence[int], indicator: str) -> float:
    """An indicator of eq. 6.2, percent, from true and false positives, false and true negatives."""
    return Confusion(*(int(count) for count in counts)).percent(indicator)


def _table(context: Context, results: Mapping[str, Results]) -> str:
    lines = []
    for part in _parts(context.parameters):
        kind, false_stars, scale = part.values["kind"], part.values["false_stars"], part.values["scale"]
        published = np.array(TABLES[kind, false_stars])
        for name, counts in (
            *((name, results[part.key][name]) for name in _FILTERS),
            ("published", published),
        ):
            for k, factor in enumerate(FACTORS):
                line = {"noise": kind, "scale": scale, "false_stars": false_stars, "factor": factor}
                line |= {"filter": name, **dict(zip(_COUNTS, counts[k].tolist(), strict=True))}
                confusion = Confusion(*counts[k].tolist())
                lines.append(line | {indicator: getattr(confusion, indicator) for indicator in _INDICATORS})
    return write_lines(context.folder / "confusion_matrices.csv", lines)


def _indicator_figures(context: Context, results: Mapping[str, Results]) -> list[str]:
    files = []
    for number, indicator in enumerate(_INDICATORS, start=14):
        fig, axes = figure(1, len(context.parameters["kinds"]), width=11.0)
        for kind, ax in zip(context.parameters["kinds"], np.ravel(axes), strict=True):
            for f, colour in zip(context.parameters["false_stars"], colours(6), strict=False):
                counts = results[f"{kind}-f{f}-x1"]["any"]
                ours, theirs = ([_percent(c, indicator) for c in sets] for sets in (counts, TABLES[kind, f]))
                ax.plot(FACTORS, ours, "-o", color=colour, markersize=3, label=f"f = {f}")
                ax.plot(FACTORS, theirs, ":", color=colour)
            ax.set(title=f"{_KIND_LABELS[kind]} noise", xlabel="noise factor μ", ylabel=f"{indicator} / %")
        fig.legend(*np.ravel(axes)[0].get_legend_handles_labels(), loc="outside right upper")
        fig.suptitle(f"{indicator.capitalize()}, noise as printed (dotted: published)")
        files.append(save(fig, context.folder / f"figure_6_{number}.png"))
    return files


def _motion_figures(context: Context, results: Mapping[str, Results]) -> list[str]:
    files = []
    for place, (name, number) in enumerate((("μ_d", "6_18"), ("σ_d", "6_19"))):
        fig, axes = figure(1, len(context.parameters["kinds"]), width=11.0)
        for kind, ax in zip(context.parameters["kinds"], np.ravel(axes), strict=True):
            for f, colour in zip(context.parameters["false_stars"], colours(6), strict=False):
                for scale, style in zip(context.parameters["scales"], ("-o", "--"), strict=False):
                    values = np.nanmean(results[f"{kind}-f{f}-x{scale:g}"]["affine"][:, :, place], axis=1)
                    ax.plot(FACTORS, values, style, color=colour, markersize=3, label=f"f = {f}, ×{scale:g}")
            ax.set(title=f"{_KIND_LABELS[kind]} noise", xlabel="noise factor μ", ylabel=f"mean {name} / °")
        fig.legend(*np.ravel(axes)[0].get_legend_handles_labels(), loc="outside right upper")
        scales = " and ".join(f"× {scale:g}" for scale in context.parameters["scales"])
        fig.suptitle(
            f"Mean {name} over the frames, noise {scales}; published: at most {_WORST_MOTION_DEG:g}° of μ_d"
        )
        files.append(save(fig, context.folder / f"figure_{number}.png"))
    return files


def _agreeing(
    results: Mapping[str, Results],
    kind: str,
    false_stars: Sequence[int],
    scale: float,
    name: str,
    indicator: str,
) -> list[bool]:
    """Whether an indicator agrees within sampling error, for each set of a kind of noise."""
    matches = []
    for f in false_stars:
        counts = results[f"{kind}-f{f}-x{scale:g}"][name]
        for ours, published in zip(counts, TABLES[kind, f], strict=True):
            theirs = _percent(published, indicator)
            largest, _ = sampling(theirs, _trials(ours, published, indicator))
            matches.append(abs(_percent(ours, indicator) - theirs) <= largest)
    return matches


def _trials(ours: Any, published: Sequence[int], indicator: str) -> int:
    """Number of independent trials; for the recall frames, as the stars of a frame are lost together."""
    if indicator == "precision":
        return int(min(ours[0] + ours[1], published[0] + published[1]))
    return int(min(ours[0] + ours[2], published[0] + published[2]) / _STARS_A_FRAME + 0.5)


def _matrix(context: Context, results: Mapping[str, Results], scale: float, indicator: str) -> str:
    """Tabulate our and the published indicator: a line for each table A.1–A.18, a column for each μ."""
    noise_label = "noise as printed" if scale == 1.0 else f"noise × {scale:g}"
    head = f"{indicator} / %, {noise_label}: published / in the cluster / matched"
    lines = [
        "| " + " | ".join((head, *(f"μ = {factor}" for factor in FACTORS))) + " |",
        "|---" + "|---:" * len(FACTORS) + "|",
    ]
    for kind in context.parameters["kinds"]:
        for f in context.parameters["false_stars"]:
            result = results[f"{kind}-f{f}-x{scale:g}"]
            cells = []
            for k in range(len(FACTORS)):
                counts = (TABLES[kind, f][k], result["any"][k], result["matched"][k])
                cells.append(" / ".join(f"{_percent(c, indicator):.1f}" for c in counts))
            number = 3 * f + 1 + KINDS.index(kind)
            label = f"A.{number}: f = {f}, {_KIND_LABELS[kind]}"
            lines.append("| " + " | ".join((label, *cells)) + " |")
    return "\n".join(lines)


def _table_rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    """Count the sets of the tables that agree, for every interpretation of the noise and of the rule."""
    rows = []
    false_stars = context.parameters["false_stars"]
    for kind in context.parameters["kinds"]:
        for indicator in ("recall", "precision"):
            found = {
                (scale, name): _agreeing(results, kind, false_stars, scale, name, indicator)
                for scale in context.parameters["scales"]
                for name in ("any", "matched")
            }
            sets = len(found[1.0, "any"])
            rows.append(
                same(
                    f"tables A.1–A.18, {_KIND_LABELS[kind]} noise: {indicator} of the sets",
                    published=f"{sets} values",
                    author=f"{sum(found[1.0, 'matched'])} of {sets}",
                    printed=f"{sum(found[1.0, 'any'])} of {sets}",
                    matches=found[1.0, "matched"],
                    target="as the author ran it, within 3 standard errors of both counts, "
                    + ("stars as trials" if indicator == "precision" else "frames as trials"),
                    remark=f"With noise × {EQUIVALENT:g}: {sum(found[EQUIVALENT, 'matched'])}.",
                )
            )
    return rows


def _named_rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    """The values of figures 6.14 to 6.17 that section 6.2.2 states."""
    rows = []
    for kind, f, k, indicator, published in _NAMED:
        if kind not in context.parameters["kinds"] or f not in context.parameters["false_stars"]:
            continue
        literal, reduced = (results[f"{kind}-f{f}-x{scale:g}"] for scale in (1.0, EQUIVALENT))
        printed, author, ours = (_percent(literal[name][k], indicator) for name in _FILTERS)
        smaller = _percent(reduced["matched"][k], indicator)
        trials = int(context.parameters["frames"])
        quantity = f"{indicator}, {_KIND_LABELS[kind]} noise, μ = {k}, f = {f}"
        rows.append(
            agreement(
                quantity,
                published=published,
                tolerance=sampling(published, trials),
                author=author,
                printed=printed,
                ours=ours,
                unit="%",
                remark=f"As the author ran it, noise × {EQUIVALENT:g}: {smaller:.2f} %.",
            )
        )
        if published == _ALL:
            continue
        rows.append(
            improvement(
                f"{quantity}: scalable filter (ours), noise as printed",
                published=published,
                ours=ours,
                larger=True,
                unit="%",
            )
        )
    return rows


def _motion_rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    def mean(kind: str, f: int, scale: float, k: int, model: str) -> float:
        return float(np.nanmean(results[f"{kind}-f{f}-x{scale:g}"][model][k, :, 0]))

    parameters = context.parameters
    sets = [(kind, f, k) for kind in parameters["kinds"] for f in parameters["false_stars"] for k in range(6)]
    author, printed, ours = (
        max(mean(kind, f, scale, k, model) for kind, f, k in sets)
        for scale, model in ((EQUIVALENT, "affine"), (1.0, "affine"), (EQUIVALENT, "rigid"))
    )
    clean = max(
        float(np.nanmedian(results[f"{kind}-f{f}-x1"]["affine"][0, :, 0]))
        for kind in parameters["kinds"]
        for f in parameters["false_stars"]
    )
    dirty = max(
        mean(kind, f, 1.0, 0, "affine") for kind in parameters["kinds"] for f in parameters["false_stars"]
    )
    return [
        agreement(
            "figure 6.18: greatest mean μ_d of all sets",
            published=_WORST_MOTION_DEG,
            tolerance=sampled_mean(_SPREAD_OF_MOTION * _WORST_MOTION_DEG, int(parameters["frames"])),
            author=author,
            printed=printed,
            ours=ours,
            unit="°",
            digits=4,
            remark=f"As the author ran it: noise × {EQUIVALENT:g}, chosen for this number, and an affine motion; ours: the same "
            "noise and a rigid one.",
        ),
        same(
            "figure 6.18: μ_d without noise, median",
            published="of the order of 1e-15°",
            author=f"{clean:.1e}°",
            matches=[1e-16 < clean < 1e-14],
            target="within a factor of ten",
        ),
        agreement(
            "figure 6.18: greatest mean μ_d without noise, with false stars",
            published=0.0083,
            tolerance=(0.00415, "half of it, as single frames dominate it"),
            author=dirty,
            unit="°",
            digits=4,
        ),
    ]


_NOTE: Final = """Seven stars (Hp < 3), circular field of 21°; every moved frame is compared with the first,
complete one, which has its own false stars but no noise. Only this interpretation gives the published numbers
of true and false stars in the field, about 6 617 and 976 per false star. *As printed*, every object "in the
cluster" is a star; *as the author ran it*, two objects must be "matched": name each other most often, and at
least twice. Only this reproduces the precision, in nearly all sets; under the printed rule one chance member
of the cluster lets a false star pass.

The recall is not reproduced in most sets. The published recall falls by half a percent with every unit of
brightness noise, which does not affect the clustering, and with position noise from the start, while ours
holds up to μ = 3; the text does not explain it. At μ = 4 and 5 with many false stars, ours is below the
published recall: the 21 disparities of seven stars spread so far that in many frames no neighbourhood of ε =
0.4 contains half as many points as there are objects (experiment `fsf-limits` counts these frames).

The published μ_d corresponds to a fifth of the printed noise: an affine motion has 0.042° at one pixel of
noise, the thesis 0.0419° at "μ = 5". In table 6.4, however, the translation error is one pixel at μ = 1. The
sets are therefore run with the printed noise and with a fifth of it. All 108 confusion matrices are in
`confusion_matrices.csv`; the tables here list the recall."""


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    files = [_table(context, results)]
    if not context.quick:
        files += _indicator_figures(context, results) + _motion_figures(context, results)
    tables = [_matrix(context, results, scale, "recall") for scale in context.parameters["scales"]]
    rows = [makes(context, results) for makes in (_table_rows, _named_rows, _motion_rows)]
    return Outcome(tuple(itertools.chain(*rows)), tuple(files), (_NOTE, *tables))


EXPERIMENTS: Final = (
    Experiment(
        "fsf-confusion",
        "False-star filter and camera motion: figures 6.14–6.19, tables A.1–A.18",
        _parts,
        _compute,
        _evaluate,
        full={
            "kinds": list(KINDS),
            "false_stars": [0, 1, 2, 3, 4, 5],
            "scales": [1.0, EQUIVALENT],
            "frames": 1000,
        },
        revision=2,
        quick={"kinds": ["both"], "false_stars": [0, 5], "scales": [1.0, EQUIVALENT], "frames": 150},
    ),
)
