"""Accuracy of LSI without noise: error maps 6.1–6.3 and precision curves 6.4–6.5, on and off the grid."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.metrics import error_colours
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.figures import Picture, precision, precision_axes
from starid.lab.experiments.lsi_trials import COLUMNS, GRID_LABELS, OFF, ON, ROWS, share, shares, solve_frames
from starid.storage.plots import colours

_LIMITS: Final = (0.3, 0.2, 0.1, 0.013, 0.008, 0.002)
_MAP_SCALES: Final = (0.1, 1.0)
_BEST_PERCENT: Final = 99.5
_COMPARED_FROM: Final = 99.0
_CHANGE: Final = 1e-6
_SMALL_RESIDUAL: Final = 1e-4
_KINDS: Final = {
    "author_mse": "MSE, as the author ran it",
    "author_1se": "1SE, as the author ran it",
    "mse": "MSE, as printed",
    "1se": "1SE, as printed",
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
        every=1 if values["percent"] == _BEST_PERCENT else context.parameters["every"],
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


def _maps(e: Evaluation, percents: list[float]) -> None:
    """Draw figures 6.1 to 6.3: databases on two scales, and turned cameras."""
    mapped = [percent for percent in percents if 99.1 <= percent <= 99.5] or percents[-1:]
    scales = [(f"p{p:g}", f"p = {p:g} %, 0° … {limit:g}°", limit) for p in mapped for limit in _MAP_SCALES]
    turned = f"p{e.parameters['roll_percent']:g}-roll"
    turns = [(f"{turned}{roll:g}", f"camera turned by {roll:g}°", 1.0) for roll in e.parameters["rolls"]]
    figures = [(1, "mse", 2, scales), (2, "1se", 2, scales)]
    figures += [] if e.context.quick else [(3, "mse", 1, turns)]
    for (number, kind, columns, shown), grid in itertools.product(figures, (ON, OFF)):
        maps = [
            _map(title, e.results[f"{key}-{grid}"][f"f_author_{kind}"], limit) for key, title, limit in shown
        ]
        title = f"ε_f of the {kind.upper()} solution as the author ran it, frames {GRID_LABELS[grid]}"
        size = {"columns": columns, "width": 3.5 + 2.75 * columns, "height": 0.6 + 1.7 * len(maps) / columns}
        e.draw(f"figure_6_{number}_{grid}.png", maps, title=title, sharex=True, sharey=True, **size)


def _precision(e: Evaluation, percents: list[float]) -> None:
    """Write and draw figures 6.4 and 6.5."""
    shades = dict(zip(percents, colours(len(percents)), strict=True))
    for number, quantity, symbol in ((4, "f", "ε_f"), (5, "theta", "ε_θ")):
        by_curve = {
            (percent, grid, kind): precision(errors, 1.0, f"p = {percent:g} %", color=shades[percent])
            for percent, grid, kind in itertools.product(percents, (ON, OFF), _KINDS)
            if (errors := e.results[f"p{percent:g}-{grid}"].get(f"{quantity}_{kind}")) is not None
        }
        columns = {f"p{p:g}_{grid}_{kind}_percent": curve.y for (p, grid, kind), curve in by_curve.items()}
        e.write(f"figure_6_{number}.csv", {"threshold_deg": next(iter(by_curve.values())).x} | columns)
        curves = (
            (f"{word}, {GRID_LABELS[grid]}", by_curve[percent, grid, kind])
            for (kind, word), grid, percent in itertools.product(_KINDS.items(), (ON, OFF), percents)
            if (percent, grid, kind) in by_curve
        )
        look = {"columns": 4, "width": 16.0, "height": 9.9, "sharey": True, "legend": "outside right upper"}
        e.draw(f"figure_6_{number}.png", curves, axes=precision_axes(symbol), **look)


def _compare_best(e: Evaluation, on: Results, off: Results) -> None:
    """Compare the database of 99.5 %, on and off the grid."""
    where, elsewhere = f"p = {_BEST_PERCENT:g} %, on the grid", f"p = {_BEST_PERCENT:g} %, off the grid"
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
    for (name, key), limit in itertools.product(
        (("sub-cell", "fine"), ("stars compared", "stars")), (0.3, 0.1)
    ):
        percent = shares(off, limit, ours=key)
        e.claim(
            f"{name} (ours), {elsewhere}: share with ε_f ≤ {limit:g}°, against LSI on the same frames",
            ours=f"{percent['ours']:.2f} %",
            matches=[percent["ours"] >= percent["printed"]],
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
                float(max(np.sum(np.abs(other[name] - first[name]) > _CHANGE) for other in others))
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


def evaluate(e: Evaluation) -> None:
    """Maps, precision curves, shares within limits, and their independence of the roll."""
    percents = e.parameters["percent"]
    _maps(e, percents)
    _precision(e, percents)
    for key, result in e.results.items():
        frames = {"ra_deg": result["frames"][:, 0], "dec_deg": result["frames"][:, 1]}
        values = {name: values for name, values in result.items() if name != "frames"}
        e.write(f"errors_{key}.csv", frames | values)
    off = e.results[f"p{_BEST_PERCENT:g}-{OFF}"]
    _compare_best(e, e.results[f"p{_BEST_PERCENT:g}-{ON}"], off)
    best = {
        reading: max(percents, key=lambda p: share(e.results[f"p{p:g}-{ON}"][f"f_{kind}"], 0.3))
        for reading, kind in (("author", "author_mse"), ("printed", "mse"), ("ours", "fine"))
    }
    e.compare("on the grid: the overlap p with most frames within 0.3°", **best)
    for grid, words in ((ON, "grows up to 99.5 %"), (OFF, None)):
        quantity = f"LSI (MSE), {GRID_LABELS[grid]}: share with ε_f ≤ 0.3° for p = {{}} %"
        _compare_listed(e, quantity, [f"p{percent:g}-{grid}" for percent in percents], percents, words, 1)
    _compare_rolls(e, e.parameters["roll_percent"], e.parameters["rolls"])
    agree = off["residual"] < _SMALL_RESIDUAL
    e.note = {
        "ambiguous": 100.0 * float(np.mean(agree & (off["f_fine"] > 0.01))),
        "lost": 100.0 * float(np.mean(~agree)),
        "stars": 100.0 * float(np.mean(off["f_stars"] > 0.01)),
        "agrees": _SMALL_RESIDUAL,
    }
