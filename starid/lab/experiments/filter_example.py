"""Input of the filter and its cluster: figures 3.2 and 5.4; the example of section 6.2.1."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Mask
from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.fsf import (
    EPSILON,
    MIN_SAMPLES_SHARE,
    ClusterFilter,
    density_clusters,
    disparity_list,
    main_cluster,
    pair_count,
    pairs_of,
)
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.figures import Curve, plane_axes
from starid.lab.simulation import PIXEL_DEG, turned

_FIELD_DEG: Final = 42.0
_STARS: Final = 6
_TURN_DEG: Final = 10.0
_SHIFT_DEG: Final = (0.0, -5.0)


def _frames(rng: np.random.Generator) -> tuple[ObservedFrame, ObservedFrame]:
    """The two frames of figure 5.4; the last object of each is the false star."""
    catalog = star_catalog()
    places = np.degrees(np.column_stack([catalog.ra_rad, catalog.dec_rad]))
    inside = np.flatnonzero(np.all((places > 0.0) & (places < _FIELD_DEG), axis=1))
    chosen = inside[np.argsort(catalog.hp[inside])[:_STARS]]
    brightness, centred = catalog.hp[chosen], places[chosen] - 0.5 * _FIELD_DEG
    false = rng.uniform(-0.4 * _FIELD_DEG, 0.4 * _FIELD_DEG, (2, 2))
    mags = np.append(brightness, rng.uniform(brightness[0], brightness[-1]))
    moved = turned(centred, _TURN_DEG) + np.array(_SHIFT_DEG)
    return (
        ObservedFrame(mags, np.vstack([centred, false[0]])),
        ObservedFrame(mags, np.vstack([moved, false[1]])),
    )


def _to_pixels(frame: ObservedFrame) -> ObservedFrame:
    """Round the positions in a frame to whole pixels."""
    return ObservedFrame(frame.brightness, np.rint(frame.positions / PIXEL_DEG) * PIXEL_DEG)


def _disparities(before: ObservedFrame, now: ObservedFrame) -> tuple[Array, Mask]:
    """All disparities of two frames, (n, 3), and a mask of those in the main cluster."""
    first, second = pairs_of(before), pairs_of(now)
    found = np.empty((len(first) * len(second), 3))
    disparity_list(first, second, found)
    labels = density_clusters(found, EPSILON, MIN_SAMPLES_SHARE * len(now))
    return found, labels == main_cluster(labels)


def compute(context: Context, part: Part) -> Results:
    """Disparities, cluster and motion of the two frames, exact and to whole pixels."""
    before, now = _frames(context.rng(part.key))
    results: Results = {}
    for name, frames in (("exact", (before, now)), ("pixels", (_to_pixels(before), _to_pixels(now)))):
        disparities, chosen = _disparities(*frames)
        result = ClusterFilter()(*frames)
        motion = matched_motion(*frames, result.matches, model="affine")
        results[f"disparities_{name}"], results[f"chosen_{name}"] = disparities, chosen
        results[f"stars_{name}"] = result.true_now
        results[f"turn_{name}"] = np.array(math.nan if motion is None else motion.rotation_deg)
    for name, frame in (("before", before), ("now", now)):
        results[name] = np.column_stack([frame.positions, frame.brightness])
    return results


def _draw_clusters(e: Evaluation, result: Results) -> None:
    curves = []
    for name, title in (("exact", "exact"), ("pixels", "to whole pixels")):
        _, separations, slopes = result[f"disparities_{name}"].T
        chosen = result[f"chosen_{name}"]
        curves += [
            (title, Curve(separations[~chosen], slopes[~chosen], ".", "outliers")),
            (title, Curve(separations[chosen], slopes[chosen], "o", "the cluster")),
        ]
    title = "Figure 3.2: 441 disparities and the cluster of the true pairs"
    look = {"columns": 2, "width": 10.0, "height": 4.4, "legend": "best"}
    e.draw("figure_3_2.png", curves, axes={"xlabel": "Δd / °", "ylabel": "Δm / °"}, title=title, **look)


def _draw_pair(e: Evaluation, result: Results) -> None:
    curves = []
    for name, title in (("before", "t"), ("now", "t + 1")):
        x, y, _ = result[name].T
        curves += [
            (title, Curve(x[:-1], y[:-1], "o", "stars")),
            (title, Curve(x[-1:], y[-1:], "^", "false star")),
        ]
    title = "Figure 5.4: shifted by −5° in declination and turned by 10°"
    look = {"columns": 2, "width": 9.0, "height": 4.6, "legend": "best", "sharey": True}
    e.draw("figure_5_4.png", curves, axes=plane_axes(0.5 * _FIELD_DEG), title=title, **look)


def evaluate(e: Evaluation) -> None:
    """Counts, the objects kept and the rotation, with the three figures."""
    result = e.results["example"]
    disparities = len(result["disparities_exact"])
    e.compare(
        "figure 3.2: feature vectors of a frame, disparities", printed=[pair_count(_STARS + 1), disparities]
    )
    kept = result["stars_exact"]
    e.claim(
        "figure 5.4: objects taken for stars; the false one is rejected",
        published="all six stars, not the false one",
        printed=", ".join(str(i + 1) for i in np.flatnonzero(kept)),
        matches=[bool(kept[:-1].all()), not kept[-1]],
        target="1 to 6, not 7",
    )
    for name, label in (("exact", "exact places"), ("pixels", "places to whole pixels")):
        turns = np.abs(result[f"disparities_{name}"][result[f"chosen_{name}"], 2])
        e.compare(
            f"section 6.2.1: turns γ̃ of the cluster's pairs, {label}",
            printed=f"{turns.min():.2f}° … {turns.max():.2f}°",
            ours=f"{abs(float(result[f'turn_{name}'])):.3f}°",
        )
    _draw_clusters(e, result)
    _draw_pair(e, result)
    points = result["disparities_pixels"]
    columns = dict(zip(("brightness_mag", "separation_deg", "slope_deg"), points.T, strict=True))
    e.write("figure_3_2.csv", {**columns, "in_cluster": result["chosen_pixels"].astype(int)})
