"""How the features vary over the sky: maps 2.3–2.8 and variation plots 2.9–2.12."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.arrays import Array
from starid.lab.experiments.comparison import agreement, same, shown
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    parts_of,
    planar_sky,
    write_csv,
    write_lines,
)
from starid.plots import colours, figure, save

FRAME_DEG: Final = 42.0
"""Frame width of these figures, degrees: their zones, δ −6° … 36° and α 0° … 42°, are 42° wide."""

NO_LIMIT: Final = -99.0
"""A brightness limit that keeps every star."""

_COLUMNS: Final = ("n", "A", "r", "sigma_A", "sigma_r", "theta")
_MAPS: Final = {
    "n": ("2_3", "number of stars", "n"),
    "A": ("2_4", "brightness mean", "A / mag"),
    "r": ("2_5", "polar radius", "r / °"),
    "theta": ("2_6", "polar angle", "θ / °"),
    "sigma_A": ("2_7", "brightness deviation", "σ_A / mag"),
    "sigma_r": ("2_8", "polar radius deviation", "σ_r / °"),
}
"""Feature → number of its map, name, and symbol with unit; in the order of the panels."""

_NOTE: Final = """No brightness limit; frames 42° wide in the flat (α, δ) plane, as the thesis draws them,
with every star of the catalogue. The thesis prints no numbers with these figures; the values in its text are
compared. A frame near δ = ±90° extends beyond the pole, where the flat plane ends, so half of it is empty:
only for this reason r grows and n falls at the upper and lower rims of the maps."""


def _features(centres: Array, kappa: float) -> Array:
    """Features and θ (degrees) of frames, (n, 6); NaN for a frame without stars."""
    from starid.thesis.frame_sky import cell_features

    sky = planar_sky(kappa, "faintest", FRAME_DEG)
    table = np.full((len(centres), 6), np.nan)
    sums, out = np.empty(8), np.empty(5)
    for i, (ra, dec) in enumerate(centres):
        angle = cell_features(sky.arrays, ra % 360.0, dec, sums, out)
        if out[0] >= 1.0:
            table[i, :5] = out
            table[i, 5] = np.degrees(angle)
    return table


def _parts(parameters: Parameters) -> list[Part]:
    axes, whole = ("ra", "dec"), {"axis": "map", "percent": parameters["map_percent"], "kappa": NO_LIMIT}
    return [
        Part("map", whole),
        *parts_of("{axis}-p{percent:g}", axis=axes, percent=parameters["percent"], kappa=[NO_LIMIT]),
        *parts_of("{axis}-kappa{kappa:g}", axis=axes, percent=[90.0], kappa=parameters["kappa"]),
    ]


def _compute(context: Context, part: Part) -> Results:
    del context
    step = FRAME_DEG * (1.0 - part.values["percent"] / 100.0)
    ra = np.arange(0.0, 360.0, step)
    dec = -90.0 + step * np.arange(round(180.0 / step) + 1)
    dec = dec[dec <= 90.0 + 1e-9]
    if part.values["axis"] == "map":
        places = np.stack(np.meshgrid(ra, dec), axis=-1)
    elif part.values["axis"] == "ra":
        places = np.stack([ra, np.full_like(ra, -6.0 + 0.5 * FRAME_DEG)], axis=-1)
    else:
        places = np.stack([np.full_like(dec, 0.5 * FRAME_DEG), dec], axis=-1)
    table = _features(places.reshape(-1, 2), part.values["kappa"])
    return {"ra": ra, "dec": dec, "places": places.reshape(-1, 2), "features": table}


def _maps(context: Context, result: Results) -> list[str]:
    files = []
    shape = (result["dec"].size, result["ra"].size)
    for i, name in enumerate(_COLUMNS):
        number, quantity, symbol = _MAPS[name]
        fig, axis = figure(width=7.0, height=3.6)
        options: dict[str, Any] = {"cmap": "twilight", "vmin": -180, "vmax": 180} if name == "theta" else {}
        values = result["features"][:, i].reshape(shape)
        image = axis.pcolormesh(result["ra"], result["dec"], values, shading="nearest", **options)
        fig.colorbar(image, ax=axis, label=f"{quantity} {symbol}")
        axis.grid(visible=False)
        axis.set(xlabel="α of the centre / °", ylabel="δ of the centre / °", xlim=(0, 360), ylim=(-90, 90))
        axis.set_xticks(range(0, 361, 60))
        axis.set_yticks(range(-90, 91, 30))
        files.append(save(fig, context.folder / f"figure_{number}.png"))
    columns = {"ra_deg": result["places"][:, 0], "dec_deg": result["places"][:, 1]}
    columns.update({name: result["features"][:, i] for i, name in enumerate(_COLUMNS)})
    return [*files, write_csv(context.folder / "feature_maps.csv", columns)]


def _variation(
    context: Context, results: Mapping[str, Results], number: int, axis: str, keys: dict[str, str]
) -> list[str]:
    fig, axes = figure(6, 1, width=7.5, height=9.5, sharex=True)
    lines: list[dict[str, Any]] = []
    for (key, label), colour in zip(keys.items(), colours(len(keys)), strict=True):
        result = results[key]
        where = result["places"][:, 0 if axis == "ra" else 1]
        for panel, name in zip(axes, _MAPS, strict=True):
            panel.plot(where, result["features"][:, _COLUMNS.index(name)], color=colour, label=label)
        for (ra, dec), features in zip(result["places"], result["features"], strict=True):
            line = {"curve": label, "ra_deg": ra, "dec_deg": dec}
            lines.append(line | dict(zip(_COLUMNS, features, strict=True)))
    for panel, name in zip(axes, _MAPS, strict=True):
        panel.set_ylabel(_MAPS[name][2])
    axes[-1].set_xlabel("α of the centre / °" if axis == "ra" else "δ of the centre / °")
    axes[-1].set_xlim((0, 360) if axis == "ra" else (-90, 90))
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(keys))
    name = f"figure_2_{number}"
    return [save(fig, context.folder / f"{name}.png"), write_lines(context.folder / f"{name}.csv", lines)]


def _rows(whole: Results) -> list[Row]:
    table, dec = whole["features"], whole["places"][:, 1]
    n, brightness, radius = table[:, 0], table[:, 1], table[:, 2]
    inner = np.abs(dec) <= 90.0 - 0.5 * FRAME_DEG
    south, north = n[inner & (dec < 0)].mean(), n[inner & (dec > 0)].mean()
    return [
        agreement(
            "figure 2.3: most stars in a frame",
            published=5000.0,
            tolerance=(500.0, "half of the first digit of “nearly 5000”, 500"),
            printed=float(n.max()),
            digits=0,
        ),
        shown(
            "figure 2.3: fewest stars in a frame",
            published="a few hundreds",
            printed=float(n.min()),
            digits=0,
            remark="At the rims of the flat plane, where half the frame is empty.",
        ),
        same(
            "figure 2.3: mean number of stars, southern over northern hemisphere (whole frames)",
            published="higher in the south",
            printed=f"{south / north:.2f}",
            matches=[bool(south > north)],
            target="> 1",
        ),
        same(
            "figure 2.4: least and greatest brightness mean A over the map",
            published="within (8, 9) mag",
            printed=f"{brightness.min():.2f} … {brightness.max():.2f} mag",
            matches=[bool(brightness.min() > 8.0), bool(brightness.max() < 9.0)],
            target="> 8 and < 9 mag",
        ),
        agreement(
            "figure 2.5: greatest polar radius r",
            published=10.0,
            tolerance=(0.5, "half of a degree of “up to 10°”"),
            printed=float(radius.max()),
            unit="°",
        ),
        shown(
            "figure 2.5: greatest polar radius r of frames that lie whole within −90° … 90°",
            printed=float(radius[inner].max()),
            unit="°",
            remark="The same without the empty space beyond the poles.",
        ),
    ]


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    percents, limits = context.parameters["percent"], context.parameters["kappa"]
    files = _maps(context, results["map"])
    for number, axis in ((9, "ra"), (10, "dec")):
        keys = {f"{axis}-p{p:g}": f"p = {p:g} %" for p in percents}
        files += _variation(context, results, number, axis, keys)
    for number, axis in ((11, "ra"), (12, "dec")):
        keys = {f"{axis}-kappa{k:g}": "no limit" if k == NO_LIMIT else f"κ = {k:g}" for k in limits}
        files += _variation(context, results, number, axis, keys)
    bright = results[f"ra-kappa{limits[-1]:g}"]["features"]
    everything = results[f"ra-kappa{limits[0]:g}"]["features"]
    counts, means = (
        [float(np.nanmean(table[:, column])) for table in (everything, bright)] for column in (0, 1)
    )
    falls = same(
        f"figure 2.11: mean n and A without a limit, and with κ = {limits[-1]:g}",
        published="n falls, A rises sharply",
        printed=f"n {counts[0]:.0f} → {counts[1]:.0f}, A {means[0]:.2f} → {means[1]:.2f} mag",
        matches=[counts[1] < counts[0], means[1] > means[0]],
        target="n falls, A rises",
    )
    return Outcome((*_rows(results["map"]), falls), tuple(files), (_NOTE,))


_FULL: Final = {
    "map_percent": 90.0,
    "percent": [60.0, 70.0, 80.0, 90.0, 95.0],
    "kappa": [NO_LIMIT, 1.0, 3.0, 5.0, 7.0, 9.0],
}

EXPERIMENTS: Final = (
    Experiment(
        "feature-maps",
        "Features over the sky: figures 2.3–2.12",
        _parts,
        _compute,
        _evaluate,
        full=_FULL,
        quick=_FULL,
    ),
)
