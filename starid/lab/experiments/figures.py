"""Figures as data: a figure is a list of panels, a panel a list of curves, and one function draws them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from starid.plots import colours, figure, save


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve; `options` are those of `matplotlib.axes.Axes.plot`, and a dash in `label` hides it in the legend."""

    x: Any
    y: Any
    style: str = "-"
    label: str = ""
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves with common axes; `settings` are those of `matplotlib.axes.Axes.set`.

    Curves without a colour get one each, from dark to light; `cycle` leaves them to matplotlib.
    """

    title: str
    curves: Iterable[Curve]
    settings: dict[str, Any] = field(default_factory=dict)
    legend: str = ""
    cycle: bool = False


def precision(errors: Any, limit: float, label: str = "", style: str = "-", **options: Any) -> Curve:
    """Percentage of errors at or below a threshold, for 1000 thresholds from 0 to limit."""
    thresholds = np.linspace(0.0, limit, 1001)
    ordered = np.sort(np.asarray(errors, dtype=np.float64))
    share = 100.0 * np.searchsorted(ordered, thresholds, side="right") / max(ordered.size, 1)
    return Curve(thresholds, share, style, label, options)


def precision_axes(symbol: str, limit: float) -> dict[str, Any]:
    """Settings of a panel of precision curves."""
    return {
        "xlabel": f"threshold of {symbol} / °",
        "ylabel": "precision rate / %",
        "xlim": (0.0, limit),
        "ylim": (0.0, 102.0),
    }


def draw(
    path: Path,
    panels: Sequence[Panel],
    *,
    columns: int = 1,
    width: float = 7.0,
    height: float = 4.2,
    title: str = "",
    legend: str = "",
    legend_columns: int = 1,
    **options: Any,
) -> str:
    """Draw the panels row by row; return the name of the file.

    Parameters
    ----------
    path, panels
        File, and the panels.
    columns, width, height
        Number of panels in a row; size of the figure, inches.
    title
        Title of the figure.
    legend, legend_columns
        Place of one legend for all panels, with the labels of the first, and its columns.
    **options
        Options of `matplotlib.pyplot.subplots`.
    """
    rows = -(-len(panels) // columns)
    fig, axes = figure(rows, columns, width=width, height=height, squeeze=False, **options)
    for axis, panel in zip(axes.ravel(), panels, strict=False):
        curves = list(panel.curves)
        free = [curve for curve in curves if "color" not in curve.options]
        shades = dict(zip(map(id, free), [] if panel.cycle else colours(len(free)), strict=False))
        for curve in curves:
            colour = {"color": shades[id(curve)]} if id(curve) in shades else {}
            axis.plot(curve.x, curve.y, curve.style, label=curve.label or None, **(colour | curve.options))
        axis.set(title=panel.title, **panel.settings)
        if panel.legend:
            axis.legend(loc=panel.legend)
    if legend:
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc=legend, ncols=legend_columns)
    if title:
        fig.suptitle(title)
    return save(fig, path)
