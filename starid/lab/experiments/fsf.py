"""False-star filter and camera motion: figures 6.14–6.19, tables A.1–A.18."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Mask
from starid.identification.thesis.cme import CameraMotion, matched_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.fsf import ClusterFilter
from starid.identification.thesis.matlab_filter import MatlabFilter
from starid.identification.thesis.metrics import Confusion
from starid.identification.thesis.scalable_filter import TrackFilter, TrackFilterSettings
from starid.lab.experiments.author_noise import FILTER_MAGNITUDES, filter_noise
from starid.lab.experiments.comparison import best_constant
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.figures import Curve
from starid.lab.experiments.tables import CONFUSION
from starid.lab.simulation import PIXEL_DEG, NoiseModel, SimulatedFrame, moved_frames
from starid.storage.plots import colours

RADIUS_DEG: Final = 21.0
"""Radius of the circular field of these experiments, degrees."""

FACTORS: Final = (0, 1, 2, 3, 4, 5)
_KINDS: Final = {"brightness": "brightness", "position": "position", "both": "brightness and position"}
_CORNER: Final = (87.41, -8.86)
_BRIGHTEST: Final = 3.0
_COUNTS: Final = ("TP", "FP", "FN", "TN")
_INDICATORS: Final = ("accuracy", "precision", "recall", "f1")
_DISTANCES: Final = ("μ_d", "σ_d")
_PUBLISHED_FRAMES: Final = 1000


def frames_of_seven(
    rng: np.random.Generator, noise: NoiseModel, count: int
) -> tuple[SimulatedFrame, Iterator[SimulatedFrame]]:
    """The clean frame with the seven published stars, Hp < 3 in the square, and `count` frames moved from it."""
    catalog = star_catalog()
    positions = np.degrees(np.column_stack([catalog.ra_rad, catalog.dec_rad])) - _CORNER - RADIUS_DEG
    chosen = (catalog.hp < _BRIGHTEST) & np.all(np.abs(positions) <= RADIUS_DEG, axis=1)
    stars = catalog.hp[chosen], positions[chosen]
    frames = moved_frames(rng, *stars, noise, count=count, radius_deg=RADIUS_DEG)
    return next(frames), frames


def noise_of(kind: str, factor: float, false_stars: int) -> NoiseModel:
    """Noise model of one set, as printed."""
    return NoiseModel.of(kind, factor, false_stars=false_stars, magnitude_range=FILTER_MAGNITUDES)


def track_filter(noise: NoiseModel, least_deg: float, least_magnitude: float, **limits: Any) -> TrackFilter:
    """The scalable filter for a noise, with at least some uncertainty of position and brightness."""
    position, brightness = (
        noise.position_sigma_px * PIXEL_DEG,
        noise.brightness_sigma * noise.magnitude_per_unit,
    )
    settings = TrackFilterSettings(
        position_sigma_deg=max(position, least_deg),
        brightness_sigma=max(brightness, least_magnitude),
        **limits,
    )
    return TrackFilter(settings)


def motion_errors(motion: CameraMotion, frame: SimulatedFrame) -> tuple[float, float]:
    """Errors of the rotation and the translation of a frame, degrees."""
    away = motion.translation_deg - frame.shift_deg
    return abs(motion.rotation_deg - frame.rotation_deg), float(np.hypot(*away))


def author_distances(
    first: ObservedFrame, now: ObservedFrame, star_filter: MatlabFilter
) -> tuple[Mask, tuple[float, float]]:
    """Run the author's filter: true stars of the later frame, and μ_d and σ_d of *all* pairs in the cluster.

    The motion is fitted to the inliers; the distances are NaN if there is none.
    """
    pairs = star_filter.pairs(first, now)
    result = star_filter.inliers(first, now, pairs)
    motion = matched_motion(first, now, result.matches, model="affine")
    if motion is None:
        return result.true_now, (math.nan, math.nan)
    away = np.hypot(*(motion.apply(first.positions[pairs[:, 0]]) - now.positions[pairs[:, 1]]).T)
    return result.true_now, (float(away.mean()), float(away.std(ddof=1)))


def _author(context: Context, part: Part) -> Results:
    """Counts (6, first frames, frames, 4) and μ_d, σ_d (6, first frames, frames, 2)."""
    kind, false_stars, stretch = (part[name] for name in ("kind", "false_stars", "stretch"))
    starts, count = int(context.parameters["first_frames"]), int(context.parameters["frames"])
    counts = np.zeros((len(FACTORS), starts, count, 4), dtype=np.int64)
    distances = np.full((len(FACTORS), starts, count, 2), math.nan)
    star_filter = MatlabFilter(PIXEL_DEG)
    for k, factor in enumerate(FACTORS):
        noise = filter_noise(kind, factor, false_stars, stretch)
        for start in range(starts):
            # the first frames are the same for all noise factors, as they seem to be in the thesis
            first, _ = frames_of_seven(context.rng("first", false_stars, start), noise, 0)
            _, frames = frames_of_seven(context.rng(part.key, factor, start), noise, count)
            for i, frame in enumerate(frames):
                taken, distances[k, start, i] = author_distances(first.observed, frame.observed, star_filter)
                counts[k, start, i] = Confusion.of(taken, frame.is_star).counts
    return {"counts": counts, "distances": distances}


def _printed(context: Context, part: Part) -> Results:
    """Counts (6, 4) of the cluster filter and of ours, with the noise as printed."""
    kind, false_stars = part["kind"], part["false_stars"]
    counts: Results = {name: np.zeros((len(FACTORS), 4), dtype=np.int64) for name in ("any", "followed")}
    cluster = ClusterFilter()
    for k, factor in enumerate(FACTORS):
        noise = noise_of(kind, factor, false_stars)
        total = int(context.parameters["frames"]) * int(context.parameters["first_frames"])
        first, frames = frames_of_seven(context.rng(part.key, factor), noise, total)
        track = track_filter(noise, 0.01, 0.02, max_rotation_deg=6.0, max_shift_deg=2.5)
        track.update(first.observed)
        for frame in frames:
            taken = cluster(first.observed, frame.observed).true_now
            followed = track.update(frame.observed).true_now
            for name, mask in (("any", taken), ("followed", followed)):
                counts[name][k] += Confusion.of(mask, frame.is_star).counts
    return counts


def compute(context: Context, part: Part) -> Results:
    """Counts of a kind of noise and a number of false stars for all factors of the noise."""
    return _author(context, part) if "stretch" in part.values else _printed(context, part)


def _percent(counts: Sequence[int], indicator: str) -> float:
    """An indicator of eq. 6.2, percent, from true and false positives, false and true negatives."""
    return Confusion(*(int(count) for count in counts)).percent(indicator)


def _of_author(e: Evaluation, kind: str, f: int, k: int, indicator: str, stretch: float = 1.0) -> float:
    """Median over the first frames of an indicator as the author ran it, percent."""
    sums = e.results[f"{kind}-f{f}-author-x{stretch:g}"]["counts"][k].sum(axis=1)
    return float(np.median([_percent(counts, indicator) for counts in sums]))


def _values(e: Evaluation, kind: str, f: int, k: int, indicator: str) -> dict[str, float]:
    """An indicator of a set, percent: published, as the author ran it, as printed, and of the scalable filter."""
    printed = e.results[f"{kind}-f{f}-printed"]
    return {
        "published": _percent(CONFUSION[kind, f][k], indicator),
        "author": _of_author(e, kind, f, k, indicator),
        "printed": _percent(printed["any"][k], indicator),
        "ours": _percent(printed["followed"][k], indicator),
    }


def _largest(e: Evaluation, kind: str, f: int, k: int, indicator: str) -> float:
    """Three standard errors of an indicator at the published 1 000 frames about one first frame, percent.

    The stars of a frame are lost together, so that frames are the trials, and a published set has one first
    frame; both spreads are measured, the latter by the median deviation, as some first frames are hopeless.
    """
    counts = e.results[f"{kind}-f{f}-author-x1"]["counts"][k]
    starts, frames, _ = counts.shape
    place = {"recall": (0, 2), "precision": (0, 1)}[indicator]
    ratio = np.array([_percent(part, indicator) for part in counts.sum(axis=1)])
    members = counts[..., place].sum(axis=-1).mean()
    within = 1e4 * counts[..., place[1]].var(axis=1).mean() / members**2
    between = 1.4826 * float(np.median(np.abs(ratio - np.median(ratio))))
    # one star more or less in either sample, so that 100 % has an uncertainty too
    least = sum((100.0 / (n * members)) ** 2 for n in (_PUBLISHED_FRAMES, starts * frames))
    once = within / _PUBLISHED_FRAMES + max(between**2 - within / frames, 0.0)
    return 3.0 * math.sqrt(once + (within / frames + between**2) / starts + least)


def _write(e: Evaluation) -> None:
    lines = []
    for kind, f in itertools.product(e.parameters["kinds"], e.parameters["false_stars"]):
        printed, author = e.results[f"{kind}-f{f}-printed"], e.results[f"{kind}-f{f}-author-x1"]["counts"]
        for name, table in (
            ("as printed", printed["any"]),
            ("ours", printed["followed"]),
            ("as the author ran it", author.sum(axis=(1, 2))),
            ("published", np.array(CONFUSION[kind, f])),
        ):
            for factor, counts in zip(FACTORS, table.tolist(), strict=True):
                line = {"noise": kind, "false_stars": f, "factor": factor, "filter": name}
                line |= dict(zip(_COUNTS, counts, strict=True))
                confusion = Confusion(*counts)
                lines.append(line | {indicator: getattr(confusion, indicator) for indicator in _INDICATORS})
    e.write("confusion_matrices.csv", lines)


def _figures(e: Evaluation) -> None:
    """Draw figures 6.14 to 6.19: the indicators beside the published ones, and the means of μ_d and σ_d."""
    kinds, shades = e.parameters["kinds"], zip(e.parameters["false_stars"], colours(6), strict=False)
    sets = list(itertools.product(kinds, shades))
    for number, name in enumerate((*_INDICATORS, *_DISTANCES), start=14):
        curves = []
        for kind, (f, shade) in sets:
            panel, colour = f"{_KINDS[kind]} noise", {"color": shade}
            if name in _INDICATORS:
                values = [_values(e, kind, f, k, name) for k in FACTORS]
                author, published = ([each[word] for each in values] for word in ("author", "published"))
                curves.append((panel, Curve(FACTORS, published, ":", "", colour)))
            else:
                distances = e.results[f"{kind}-f{f}-author-x1"]["distances"]
                author = list(np.nanmean(distances[..., _DISTANCES.index(name)], axis=(1, 2)))
            curves.append((panel, Curve(FACTORS, author, "-o", f"f = {f}", colour | {"markersize": 3})))
        label = f"{name} / %" if name in _INDICATORS else f"mean {name} / °"
        axes = {"xlabel": "noise factor μ", "ylabel": label}
        look = {"columns": len(kinds), "width": 11.0, "legend": "outside right upper"}
        title = f"{name}, as the author ran it (dotted: published)"
        e.draw(f"figure_6_{number}.png", curves, axes=axes, title=title, **look)


def _compare_tables(e: Evaluation) -> None:
    """Count the sets of the tables that agree, and those with which the best constant agrees."""
    sets = list(itertools.product(e.parameters["false_stars"], range(len(FACTORS))))
    for kind, indicator in itertools.product(e.parameters["kinds"], ("recall", "precision")):
        matches, printed, intervals = [], 0, []
        for f, k in sets:
            case = (kind, f, k, indicator)
            values, largest = _values(e, *case), _largest(e, *case)
            theirs = values["published"]
            matches.append(abs(values["author"] - theirs) <= largest)
            printed += abs(values["printed"] - theirs) <= largest
            intervals.append((theirs - largest, theirs + largest))
        constant = best_constant(intervals)
        null = [low <= constant <= high for low, high in intervals]
        e.claim(
            f"tables A.1–A.18, {_KINDS[kind]} noise: {indicator} of the sets",
            published=f"{len(sets)} values",
            author=f"{sum(matches)} of {len(sets)}",
            printed=f"{printed} of {len(sets)}",
            matches=matches,
            null=null,
            target="within 3 standard errors at the published 1 000 frames about one first frame",
            remark=f"A constant {constant:.1f} % agrees with {sum(null)}.",
        )


def _compare_predictions(e: Evaluation, law: str, kinds: Sequence[str]) -> None:
    """Fit a constant of the noise to half of the sets, and predict the recall of the other half."""
    stretches = e.parameters["stretches"]
    sets = list(itertools.product(kinds, e.parameters["false_stars"], range(1, 6)))
    curves, published = {}, {}
    for case in sets:
        medians = [_of_author(e, *case, "recall", stretch) for stretch in stretches]
        curves[case] = np.polyfit(stretches, medians, 2)
        published[case] = _values(e, *case, "recall")["published"], _largest(e, *case, "recall")

    def away(case: tuple[str, int, int], stretch: float) -> float:
        theirs, largest = published[case]
        return abs(theirs - float(np.polyval(curves[case], stretch))) / largest

    trials = np.linspace(0.8, 1.2, 81)
    for words, odd in (("f = 0, 2, 4", 0), ("f = 1, 3, 5", 1)):
        fitted, others = ([case for case in sets if (case[1] % 2 == odd) is half] for half in (True, False))
        best = float(
            trials[int(np.argmin([sum(min(1.0, away(case, x) ** 2) for case in fitted) for x in trials]))]
        )
        matches = [away(case, best) <= 1.0 for case in others]
        e.claim(
            f"recall, {law} constant fitted to the sets with {words}: the other {len(others)} sets",
            published=f"{len(others)} values",
            author=f"{sum(matches)} of {len(others)}",
            matches=matches,
            target="as above",
            remark=f"The fit is {best:.3f} of the constant used.",
        )


def _compare_named(e: Evaluation) -> None:
    """Compare the values of figures 6.14 to 6.17 that section 6.2.2 states."""
    for kind, f, k, indicator in itertools.product(
        e.parameters["kinds"], e.parameters["false_stars"], range(len(FACTORS)), _INDICATORS
    ):
        quantity = f"{indicator}, {_KINDS[kind]} noise, μ = {k}, f = {f}"
        values = _values(e, kind, f, k, indicator)
        if e.published(quantity):
            e.compare(quantity, author=values["author"], printed=values["printed"])
        quantity += ": scalable filter (ours), noise as printed"
        if e.published(quantity):
            e.compare(quantity, ours=values["ours"])


def _compare_motion(e: Evaluation) -> None:
    sets = itertools.product(e.parameters["kinds"], e.parameters["false_stars"])
    distances = [e.results[f"{kind}-f{f}-author-x1"]["distances"][..., 0] for kind, f in sets]
    means = [np.nanmedian(np.nanmean(values, axis=2), axis=1) for values in distances]
    clean = max(float(np.nanmedian(values[0])) for values in distances)
    greatest = max(float(values.max()) for values in means)
    e.compare("figure 6.18: greatest mean μ_d of all sets", author=greatest)
    e.claim(
        "figure 6.18: μ_d without noise, median",
        published="of the order of 1e-15°",
        author=f"{clean:.1e}°",
        matches=[1e-16 < clean < 1e-14],
        target="within a factor of ten",
    )
    greatest = max(float(values[0]) for values in means)
    e.compare("figure 6.18: greatest mean μ_d without noise, with false stars", author=greatest)


def evaluate(e: Evaluation) -> None:
    """The confusion matrices, the constants of the noise and the motion."""
    _write(e)
    if not e.context.quick:
        _figures(e)
    _compare_tables(e)
    if len(e.parameters["stretches"]) > 1:
        _compare_predictions(e, "position", ("position", "both"))
        _compare_predictions(e, "brightness", ("brightness",))
    _compare_named(e)
    _compare_motion(e)
