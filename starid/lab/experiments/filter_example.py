"""Input of the filter and its cluster: figures 3.2, 5.3 and 5.4; the example of section 6.2.1."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arrays import Array, Mask
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.figures import Picture
from starid.lab.simulation import INTENSITY_UNITS, PIXEL_DEG, turned
from starid.plots import figure, save
from starid.thesis.cme import matched_motion
from starid.thesis.false_stars import ObservedFrame
from starid.thesis.fsf import (
    EPSILON,
    MIN_SAMPLES_SHARE,
    ClusterFilter,
    density_clusters,
    disparity_list,
    main_cluster,
    pair_count,
    pairs_of,
)

_FIELD_DEG: Final = 42.0
_PIXELS: Final = 937
_STARS: Final = 6
_TURN_DEG: Final = 10.0
_SHIFT_DEG: Final = (0.0, -5.0)
_FAINTEST: Final = 3.8
_PATCH: Final = (28.1, 30.1, 29.2, 31.9)
_BRIGHTNESS_SIGMA: Final = 5.0


def _field(limit: float) -> tuple[Array, Array]:
    """Magnitudes (n,) and α, δ in degrees (n, 2) of the stars in the field to a limit, brightest first."""
    catalog = star_catalog()
    places = np.degrees(np.column_stack([catalog.ra_rad, catalog.dec_rad]))
    chosen = np.all((places > 0.0) & (places < _FIELD_DEG), axis=1) & (catalog.hp <= limit)
    order = np.argsort(catalog.hp[chosen])
    return catalog.hp[chosen][order], places[chosen][order]


def _frames(rng: np.random.Generator) -> tuple[ObservedFrame, ObservedFrame]:
    """The two frames of figure 5.4; the last object of each is the false star."""
    brightness, places = _field(99.0)
    brightness, centred = brightness[:_STARS], places[:_STARS] - 0.5 * _FIELD_DEG
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
    found: Results = {}
    for name, frames in (("exact", (before, now)), ("pixels", (_to_pixels(before), _to_pixels(now)))):
        disparities, chosen = _disparities(*frames)
        result = ClusterFilter()(*frames)
        motion = matched_motion(*frames, result.matches, model="affine")
        found[f"disparities_{name}"], found[f"chosen_{name}"] = disparities, chosen
        found[f"stars_{name}"] = result.true_now
        found[f"turn_{name}"] = np.array(math.nan if motion is None else motion.rotation_deg)
    for name, frame in (("before", before), ("now", now)):
        found[name] = np.column_stack([frame.positions, frame.brightness])
    return found


def _cluster_figure(context: Context, result: Results) -> str:
    fig, axes = figure(1, 2, width=10.0, height=4.4, subplot_kw={"projection": "3d"})
    for axis, (name, title) in zip(axes, (("exact", "exact"), ("pixels", "to whole pixels")), strict=True):
        points, chosen = result[f"disparities_{name}"], result[f"chosen_{name}"]
        axis.scatter(*points[~chosen].T, s=4, c="C0", alpha=0.4, label="outliers")
        axis.scatter(*points[chosen].T, s=14, c="gold", edgecolors="black", lw=0.3, label="the cluster")
        axis.set(xlabel="ΔA / mag", ylabel="Δd / °", zlabel="Δm / °", title=title)
        axis.legend()
    fig.suptitle("Figure 3.2: 441 disparities and the cluster of the true pairs")
    return save(fig, context.folder / "figure_3_2.png")


def _image(brightness: Array, pixels: Array) -> Array:
    """Draw stars as Gaussians; intensity falls linearly with magnitude, as in the thesis's 8-bit images."""
    image = np.zeros((_PIXELS, _PIXELS))
    reach = np.arange(-8, 9)
    for mag, (x, y) in zip(brightness, pixels, strict=True):
        columns, rows = np.meshgrid(round(x) + reach, round(y) + reach)
        inside = (columns >= 0) & (columns < _PIXELS) & (rows >= 0) & (rows < _PIXELS)
        peak = INTENSITY_UNITS * np.clip((_FAINTEST + 2.0 - mag) / (_FAINTEST + 2.0), 0.05, 1.0)
        spot = peak * np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 2.0)
        np.add.at(image, (rows[inside], columns[inside]), spot[inside])
    return np.clip(image, 0.0, INTENSITY_UNITS)


def _noise_figure(e: Evaluation) -> None:
    rng = e.context.rng("figure 5.3")
    brightness, places = _field(_FAINTEST)
    pixels = places / PIXEL_DEG
    clean = _image(brightness, pixels)
    dim = brightness + rng.normal(0.0, _BRIGHTNESS_SIGMA, brightness.size) * _FAINTEST / INTENSITY_UNITS
    noisy = _image(dim, pixels + rng.normal(0.0, 1.0, pixels.shape))
    panels = []
    for window in ((0.0, _FIELD_DEG, 0.0, _FIELD_DEG), _PATCH):
        for image, title in ((clean, "without noise"), (noisy, "σ_p = 1 px, σ_m = 5")):
            settings = {"xlim": window[:2], "ylim": window[2:], "xlabel": "α / °", "ylabel": "δ / °"}
            extent = (0.0, _FIELD_DEG, 0.0, _FIELD_DEG)
            panels.append(Picture(title, image, extent, settings, options={"cmap": "gray"}))
    e.draw("figure_5_3.png", panels, columns=2, width=8.0, height=8.0, title="Figure 5.3")


def _pair_figure(context: Context, result: Results) -> str:
    fig, axes = figure(1, 2, width=9.0, height=4.6, sharey=True)
    half = 0.5 * _FIELD_DEG
    for axis, name, title in zip(axes, ("before", "now"), ("t", "t + 1"), strict=True):
        x, y, mag = result[name].T
        axis.scatter(x[:-1], y[:-1], s=60.0 - 15.0 * mag[:-1], c="black", label="stars")
        axis.scatter(x[-1:], y[-1:], s=40, marker="^", c="C3", label="false star")
        for number, place in enumerate(zip(x, y, strict=True)):
            axis.annotate(str(number + 1), place, xytext=(4, 4), textcoords="offset points", fontsize=7)
        axis.set(title=title, xlabel="x / °", xlim=(-half, half), ylim=(-half, half))
    axes[0].set_ylabel("y / °")
    axes[0].legend()
    fig.suptitle("Figure 5.4: shifted by −5° in declination and turned by 10°")
    return save(fig, context.folder / "figure_5_4.png")


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
    e.files.append(_cluster_figure(e.context, result))
    _noise_figure(e)
    e.files.append(_pair_figure(e.context, result))
    points = result["disparities_pixels"]
    columns = dict(zip(("brightness_mag", "separation_deg", "slope_deg"), points.T, strict=True))
    e.write("figure_3_2.csv", {**columns, "in_cluster": result["chosen_pixels"].astype(int)})
