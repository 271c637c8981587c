"""How the features vary over the sky: maps 2.3–2.8 and variation plots 2.9–2.12."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.frame_sky import cell_features
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, planar_sky
from starid.lab.experiments.figures import Panel, Picture, curves_of

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


def _features(centres: Array, kappa: float) -> Array:
    """Features and θ (degrees) of frames, (n, 6); NaN for a frame without stars."""
    sky = planar_sky(kappa=kappa, fov_deg=FRAME_DEG)
    table = np.full((len(centres), 6), np.nan)
    sums, out = np.empty(8), np.empty(5)
    for i, (ra, dec) in enumerate(centres):
        angle = cell_features(sky.arrays, ra % 360.0, dec, sums, out)
        if out[0] >= 1.0:
            table[i] = *out, np.degrees(angle)
    return table


def compute(context: Context, part: Part) -> Results:
    """Features of the frames of a map, or along a line in α or δ."""
    del context
    step = FRAME_DEG * (1.0 - part["percent"] / 100.0)
    ra = np.arange(0.0, 360.0, step)
    dec = -90.0 + step * np.arange(round(180.0 / step) + 1)
    dec = dec[dec <= 90.0 + 1e-9]
    if part["axis"] == "map":
        places = np.stack(np.meshgrid(ra, dec), axis=-1).reshape(-1, 2)
    elif part["axis"] == "ra":
        places = np.stack([ra, np.full_like(ra, -6.0 + 0.5 * FRAME_DEG)], axis=-1)
    else:
        places = np.stack([np.full_like(dec, 0.5 * FRAME_DEG), dec], axis=-1)
    return {"ra": ra, "dec": dec, "places": places, "features": _features(places, part["kappa"])}


def _maps(e: Evaluation) -> None:
    result = e.results["map"]
    shape = (result["dec"].size, result["ra"].size)
    half = 0.5 * FRAME_DEG * (1.0 - e.parameters["map_percent"] / 100.0)
    extent = (-half, result["ra"][-1] + half, -90.0 - half, result["dec"][-1] + half)
    settings: dict[str, Any] = {"xlabel": "α of the centre / °", "ylabel": "δ of the centre / °"}
    settings |= {"xlim": (0, 360), "xticks": range(0, 361, 60)}
    settings |= {"ylim": (-90, 90), "yticks": range(-90, 91, 30)}
    for values, name in zip(result["features"].T, _COLUMNS, strict=True):
        number, quantity, symbol = _MAPS[name]
        options = {"cmap": "twilight", "vmin": -180, "vmax": 180} if name == "theta" else {}
        scale = {"aspect": "auto", **options}
        picture = Picture("", values.reshape(shape), extent, settings, f"{quantity} {symbol}", scale)
        e.draw(f"figure_{number}.png", [picture], height=3.6)
    columns = {"ra_deg": result["places"][:, 0], "dec_deg": result["places"][:, 1]}
    e.write("feature_maps.csv", columns | dict(zip(_COLUMNS, result["features"].T, strict=True)))


def _variation(e: Evaluation, number: int, axis: str, keys: dict[str, str]) -> None:
    column, symbol, limits = ("ra_deg", "α", (0, 360)) if axis == "ra" else ("dec_deg", "δ", (-90, 90))
    lines = [
        {"curve": label, "ra_deg": ra, "dec_deg": dec} | dict(zip(_COLUMNS, features, strict=True))
        for key, label in keys.items()
        for (ra, dec), features in zip(e.results[key]["places"], e.results[key]["features"], strict=True)
    ]
    e.write(f"figure_2_{number}.csv", lines)
    shown = [
        Panel(
            "",
            curves_of(lines, column, name, lambda line: line["curve"], "-"),
            {"ylabel": unit, "xlim": limits},
        )
        for name, (_, _, unit) in _MAPS.items()
    ]
    shown[-1].settings["xlabel"] = f"{symbol} of the centre / °"
    legend = {"legend": "outside upper center", "legend_columns": len(keys)}
    e.draw(f"figure_2_{number}.png", shown, width=7.5, height=9.5, sharex=True, **legend)


def _compare_map(e: Evaluation) -> None:
    whole = e.results["map"]
    table, dec = whole["features"], whole["places"][:, 1]
    n, brightness, radius = table[:, 0], table[:, 1], table[:, 2]
    inner = np.abs(dec) <= 90.0 - 0.5 * FRAME_DEG
    south, north = n[inner & (dec < 0)].mean(), n[inner & (dec > 0)].mean()
    e.compare("figure 2.3: most stars in a frame", printed=n.max())
    e.compare("figure 2.3: fewest stars in a frame", printed=n.min())
    e.compare(
        "figure 2.3: mean number of stars, southern over northern hemisphere (whole frames)",
        printed=south / north,
    )
    e.claim(
        "figure 2.4: least and greatest brightness mean A over the map",
        published="within (8, 9) mag",
        printed=f"{brightness.min():.2f} … {brightness.max():.2f} mag",
        matches=[bool(brightness.min() > 8.0), bool(brightness.max() < 9.0)],
        target="> 8 and < 9 mag",
    )
    e.compare("figure 2.5: greatest polar radius r", printed=radius.max())
    e.compare(
        "figure 2.5: greatest polar radius r of frames that lie whole within −90° … 90°",
        printed=radius[inner].max(),
        unit="°",
        remark="The same without the empty space beyond the poles.",
    )


def evaluate(e: Evaluation) -> None:
    """Maps and curves, and the numbers in the text."""
    percents, limits = e.parameters["percent"], e.parameters["kappa"]
    _maps(e)
    for number, axis in ((9, "ra"), (10, "dec")):
        _variation(e, number, axis, {f"{axis}-p{p:g}": f"p = {p:g} %" for p in percents})
    for number, axis in ((11, "ra"), (12, "dec")):
        labels = {f"{axis}-kappa{k:g}": "no limit" if k == NO_LIMIT else f"κ = {k:g}" for k in limits}
        _variation(e, number, axis, labels)
    _compare_map(e)
    everything, bright = (e.results[f"ra-kappa{limits[i]:g}"]["features"] for i in (0, -1))
    counts, means = (
        [float(np.nanmean(table[:, column])) for table in (everything, bright)] for column in (0, 1)
    )
    e.claim(
        f"figure 2.11: mean n and A without a limit, and with κ = {limits[-1]:g}",
        published="n falls, A rises sharply",
        printed=f"n {counts[0]:.0f} → {counts[1]:.0f}, A {means[0]:.2f} → {means[1]:.2f} mag",
        matches=[counts[1] < counts[0], means[1] > means[0]],
        target="n falls, A rises",
    )
