"""Accuracy of LSI without noise: error maps 6.1–6.3 and precision curves 6.4–6.5, on and off the grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from starid.arrays import Array
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.figures import Panel, Picture, precision, precision_axes
from starid.lab.experiments.lsi_trials import COLUMNS, GRID_LABELS, OFF, ON, ROWS, share, shares, solve_frames
from starid.plots import colours
from starid.thesis.metrics import error_colours

_LIMITS: Final = (0.3, 0.2, 0.1, 0.013, 0.008, 0.002)
_MAP_SCALES: Final = (0.1, 1.0)
_BEST: Final = 99.5
_COMPARED_FROM: Final = 99.0
_SAME: Final = 1e-6
_AGREES: Final = 1e-4
_KINDS: Final = {
    "author_mse": "MSE, as the author ran it",
    "author_1se": "1SE, as the author ran it",
    "mse": "MSE, as printed",
    "fine": "sub-cell, ours",
    "stars": "stars compared, ours",
}


def compute(context: Context, part: Part) -> Results:
    """Errors of the test frames for one database."""
    values = part.values
    return solve_frames(
        context,
        values["percent"] / 100.0,
        values["grid"],
        rng=context.rng(str(values["grid"]), str(values["percent"])),
        roll_deg=float(values["roll"]),
        every=1 if values["percent"] == _BEST else context.parameters["every"],
        compares=values["grid"] == OFF and values["roll"] == 0.0 and values["percent"] >= _COMPARED_FROM,
    )


def _map(title: str, errors: Array, limit: float) -> Picture:
    """Map of ε_f over the test frames."""
    from matplotlib.colors import ListedColormap

    scheme = ListedColormap(error_colours(np.linspace(0.0, 1.0, 256), 1.0))
    settings = {"xlabel": "α of the centre / °", "ylabel": "δ of the centre / °"}
    scale = {"aspect": "auto", "cmap": scheme, "vmin": 0.0, "vmax": limit}
    values, extent = errors.reshape(ROWS, COLUMNS), (19.5, 334.5, -70.5, 64.5)
    return Picture(title, values, extent, settings, "ε_f / °", scale, "max")


def _draw_maps(e: Evaluation, name: str, maps: Sequence[Picture], columns: int, title: str) -> None:
    size = {"width": 3.5 + 2.75 * columns, "height": 0.6 + 1.7 * len(maps) / columns}
    e.draw(name, maps, columns=columns, title=title, sharex=True, sharey=True, **size)


def _maps(e: Evaluation, percents: list[float], rolls: list[float], roll_percent: float) -> None:
    mapped = [percent for percent in percents if 99.1 <= percent <= 99.5] or percents[-1:]
    for number, kind, word in ((1, "author_mse", "MSE"), (2, "author_1se", "1SE")):
        for grid in (ON, OFF):
            maps = [
                _map(
                    f"p = {percent:g} %, 0° … {limit:g}°",
                    e.results[f"p{percent:g}-{grid}"][f"f_{kind}"],
                    limit,
                )
                for percent in mapped
                for limit in _MAP_SCALES
            ]
            title = f"ε_f of the {word} solution as the author ran it, frames {GRID_LABELS[grid]}"
            _draw_maps(e, f"figure_6_{number}_{grid}.png", maps, 2, title)
    for grid in () if e.context.quick else (ON, OFF):
        turns = [
            _map(
                f"camera turned by {roll:g}°",
                e.results[f"p{roll_percent:g}-roll{roll:g}-{grid}"]["f_author_mse"],
                1.0,
            )
            for roll in rolls
        ]
        title = f"ε_f (MSE) as the author ran it, p = {roll_percent:g} %, frames {GRID_LABELS[grid]}"
        _draw_maps(e, f"figure_6_3_{grid}.png", turns, 1, title)


def _precision_figures(e: Evaluation, percents: list[float]) -> None:
    shades = dict(zip(percents, colours(len(percents)), strict=True))
    for number, quantity, symbol in ((4, "f", "ε_f"), (5, "theta", "ε_θ")):
        panels = []
        for grid in (ON, OFF):
            for kind, word in _KINDS.items():
                curves = [
                    precision(result[f"{quantity}_{kind}"], 1.0, f"p = {percent:g} %", color=shades[percent])
                    for percent in percents
                    if f"{quantity}_{kind}" in (result := e.results[f"p{percent:g}-{grid}"])
                ]
                panels.append(Panel(f"{word}, {GRID_LABELS[grid]}", curves, precision_axes(symbol, 1.0)))
        size = {"columns": len(_KINDS), "width": 16.0, "height": 6.6, "sharey": True}
        e.draw(f"figure_6_{number}.png", panels, legend="outside right upper", **size)


def _compare_best(e: Evaluation, on: Results, off: Results) -> None:
    """Compare the database of 99.5 %, on and off the grid."""
    where, elsewhere = f"p = {_BEST:g} %, on the grid", f"p = {_BEST:g} %, off the grid"
    for limit in _LIMITS:
        e.compare(f"LSI (MSE), {where}: share with ε_f ≤ {limit:g}°", **shares(on, limit))
    e.compare(f"LSI (MSE), {where}: share with ε_f > 1°", **shares(on, 1.0, beyond=True))
    quantity = f"LSI (MSE), {where}: mean ε_ψ"
    e.compare(quantity, author=on["psi_author"].mean(), printed=on["psi_mse"].mean())
    for limit in (0.2, 1.0):
        e.compare(f"LSI (MSE), {where}: share with ε_θ ≤ {limit:g}°", **shares(on, limit, "theta"))
    for limit in _LIMITS:
        quantity = f"LSI (MSE) and sub-cell (ours), {elsewhere}: share with ε_f ≤ {limit:g}°"
        e.compare(quantity, **shares(off, limit), unit="%")
    for limit in _LIMITS:
        quantity = f"stars compared (ours), {elsewhere}: share with ε_f ≤ {limit:g}°"
        e.compare(quantity, ours=share(off["f_stars"], limit))
    for name, key in (("sub-cell", "f_fine"), ("stars compared", "f_stars")):
        for limit in (0.3, 0.1):
            ours = share(off[key], limit)
            e.claim(
                f"{name} (ours), {elsewhere}: share with ε_f ≤ {limit:g}°, against LSI on the same frames",
                ours=f"{ours:.2f} %",
                matches=[ours >= share(off["f_mse"], limit)],
                target="≥ LSI as printed on the same frames",
                kind="ours",
            )
    beyond = shares(off, 1.0, ours="stars", beyond=True)
    e.compare(f"LSI (MSE) and stars compared (ours), {elsewhere}: share with ε_f > 1°", **beyond, unit="%")


def _compare_listed(
    e: Evaluation,
    quantity: str,
    keys: Sequence[str],
    conditions: Sequence[float],
    words: str | None,
    digits: int,
) -> None:
    """Show the shares within 0.3° under several conditions in one row."""
    found = [shares(e.results[key], 0.3) for key in keys]
    author, printed, ours = (
        ", ".join(f"{one[reading]:.{digits}f}" for one in found) + " %"
        for reading in ("author", "printed", "ours")
    )
    quantity = quantity.format(", ".join(f"{condition:g}" for condition in conditions))
    e.compare(quantity, text=words, author=author, printed=printed, ours=ours)


def _compare_rolls(e: Evaluation, percent: float, rolls: list[float]) -> None:
    for grid in (ON, OFF):
        where = f"p = {percent:g} %, {GRID_LABELS[grid]}"
        keys = [f"p{percent:g}-roll{roll:g}-{grid}" for roll in rolls]
        first, *others = (e.results[key] for key in keys)
        for what, author, printed in (("ε_ψ", "psi_author", "psi_mse"), ("ε_f", "f_author_mse", "f_mse")):
            changed = [
                float(max(np.sum(np.abs(other[name] - first[name]) > _SAME) for other in others))
                for name in (author, printed)
            ]
            e.compare(
                f"{where}: frames whose {what} changes when the camera is turned",
                author=changed[0],
                printed=changed[1],
                digits=0,
                remark=f"Of {first[author].size} frames.",
            )
        _compare_listed(e, f"{where}: share with ε_f ≤ 0.3° at roll {{}}°", keys, rolls, "equal", 2)


def _write(e: Evaluation, percents: list[float]) -> None:
    thresholds = np.round(np.linspace(0.0, 1.0, 1001), 3)
    for number, quantity in ((4, "f"), (5, "theta")):
        columns: dict[str, Any] = {"threshold_deg": thresholds}
        for percent in percents:
            for grid in (ON, OFF):
                result = e.results[f"p{percent:g}-{grid}"]
                for kind in ("author_mse", "author_1se", "mse", "1se", "fine", "stars"):
                    if f"{quantity}_{kind}" not in result:
                        continue
                    ordered = np.sort(result[f"{quantity}_{kind}"])
                    rate = 100.0 * np.searchsorted(ordered, thresholds, side="right") / ordered.size
                    columns[f"p{percent:g}_{grid}_{kind}_percent"] = rate
        e.write(f"figure_6_{number}.csv", columns)
    for key, result in e.results.items():
        columns = {"ra_deg": result["frames"][:, 0], "dec_deg": result["frames"][:, 1]}
        columns.update({name: values for name, values in result.items() if name != "frames"})
        e.write(f"errors_{key}.csv", columns)


def evaluate(e: Evaluation) -> None:
    """Maps, precision curves, shares within limits, and their independence of the roll."""
    percents, rolls = e.parameters["percent"], e.parameters["rolls"]
    roll_percent = e.parameters["roll_percent"]
    _maps(e, percents, rolls, roll_percent)
    _precision_figures(e, percents)
    _write(e, percents)
    off = e.results[f"p{_BEST:g}-{OFF}"]
    _compare_best(e, e.results[f"p{_BEST:g}-{ON}"], off)
    best = {
        reading: max(percents, key=lambda p: share(e.results[f"p{p:g}-{ON}"][f"f_{kind}"], 0.3))
        for reading, kind in (("author", "author_mse"), ("printed", "mse"), ("ours", "fine"))
    }
    e.compare("on the grid: the overlap p with most frames within 0.3°", **best)
    for grid, words in ((ON, "grows up to 99.5 %"), (OFF, None)):
        quantity = f"LSI (MSE), {GRID_LABELS[grid]}: share with ε_f ≤ 0.3° for p = {{}} %"
        _compare_listed(e, quantity, [f"p{percent:g}-{grid}" for percent in percents], percents, words, 1)
    _compare_rolls(e, roll_percent, rolls)
    agree = off["residual"] < _AGREES
    e.note = {
        "ambiguous": 100.0 * float(np.mean(agree & (off["f_fine"] > 0.01))),
        "lost": 100.0 * float(np.mean(~agree)),
        "stars": 100.0 * float(np.mean(off["f_stars"] > 0.01)),
        "agrees": _AGREES,
    }
