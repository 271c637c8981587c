"""Figures as data: a figure is a list of panels, a panel a list of curves, and one function draws them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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

    Curves without a colour get one each, from dark to light; `cycle` leaves them to matplotlib. Those in `right` have
    a scale of their own, up to `right_limit`.
    """

    title: str
    curves: Iterable[Curve]
    settings: dict[str, Any] = field(default_factory=dict)
    legend: str = ""
    cycle: bool = False
    right: Sequence[Curve] = ()
    right_limit: float = 1.0


@dataclass(frozen=True, eq=False)
class Picture:
    """Values (h, w) over the plane, the first row at the bottom; `options` are those of `imshow`, `label` the scale's."""

    title: str
    values: Any
    extent: tuple[float, float, float, float]
    settings: dict[str, Any] = field(default_factory=dict)
    label: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    beyond: str = "neither"
    """Which end of the scale values may exceed."""


def precision(errors: Any, limit: float, label: str = "", style: str = "-", **options: Any) -> Curve:
    """Percentage of errors at or below a threshold, for 1000 thresholds from 0 to limit."""
    thresholds = np.round(np.linspace(0.0, limit, 1001), 6)
    ordered = np.sort(np.asarray(errors, dtype=np.float64))
    share = 100.0 * np.searchsorted(ordered, thresholds, side="right") / max(ordered.size, 1)
    return Curve(thresholds, share, style, label, options)


def precision_axes(symbol: str) -> dict[str, Any]:
    """Settings of a panel of precision curves."""
    words = {"xlabel": f"threshold of {symbol} / °", "ylabel": "precision rate / %"}
    return {**words, "xmargin": 0.0, "ylim": (0.0, 102.0)}


def curves_of(
    table: Iterable[Mapping[str, Any]],
    x: str,
    y: str,
    label: Callable[[Mapping[str, Any]], str],
    style: str = "o-",
) -> list[Curve]:
    """A curve for each label of lines of a table, through the values of two columns."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for line in table:
        found.setdefault(label(line), []).append(line)
    return [
        Curve([line[x] for line in lines], [line[y] for line in lines], style, words)
        for words, lines in found.items()
    ]


def panels(curves: Iterable[tuple[str, Curve]], legend: str = "", **settings: Any) -> list[Panel]:
    """Panels with the same settings, in order, from curves with the titles of their panels."""
    found: dict[str, list[Curve]] = {}
    for title, curve in curves:
        found.setdefault(title, []).append(curve)
    return [Panel(title, members, settings, legend) for title, members in found.items()]


def _picture(fig: Any, axis: Any, picture: Picture) -> list[Any]:
    place = {"origin": "lower", "extent": picture.extent, "interpolation": "nearest"}
    image = axis.imshow(picture.values, **place, **picture.options)
    axis.grid(visible=False)
    if picture.label:
        fig.colorbar(image, ax=axis, label=picture.label, extend=picture.beyond)
    return []


def _curves(axis: Any, panel: Panel) -> list[Any]:
    """Draw the curves; return those with a label."""
    curves = list(panel.curves)
    free = [curve for curve in curves if "color" not in curve.options]
    shades = dict(zip(map(id, free), [] if panel.cycle else colours(len(free)), strict=False))
    drawn = []
    for curve in curves:
        colour = {"color": shades[id(curve)]} if id(curve) in shades else {}
        drawn += axis.plot(
            curve.x, curve.y, curve.style, label=curve.label or None, **(colour | curve.options)
        )
    if panel.right:
        right = axis.twinx()
        for curve in panel.right:
            drawn += right.plot(curve.x, curve.y, curve.style, label=curve.label, **curve.options)
        right.grid(visible=False)
        right.set_ylim(0.0, panel.right_limit)
    if panel.legend:
        axis.legend(loc=panel.legend)
    return [line for line in drawn if not line.get_label().startswith("_")]


def draw(
    path: Path,
    panels: Sequence[Panel | Picture],
    *,
    columns: int = 1,
    width: float = 7.0,
    height: float = 4.2,
    title: str = "",
    legend: str = "",
    legend_columns: int = 1,
    **options: Any,
) -> str:
    """Draw the panels row by row, `columns` in a row; return the name of the file.

    `legend` is the place of one legend for all panels, with the labels of the first. The other options are those of
    `matplotlib.pyplot.subplots`.
    """
    rows = -(-len(panels) // columns)
    fig, axes = figure(rows, columns, width=width, height=height, squeeze=False, **options)
    for axis in axes.ravel()[len(panels) :]:
        axis.remove()
    for axis, panel in zip(axes.ravel(), panels, strict=False):
        handles = _picture(fig, axis, panel) if isinstance(panel, Picture) else _curves(axis, panel)
        axis.set(title=panel.title, **panel.settings)
        if "sharex" in options or "sharey" in options:
            axis.label_outer()
        if axis is axes[0, 0] and legend:
            fig.legend(handles=handles, loc=legend, ncols=legend_columns)
    if title:
        fig.suptitle(title)
    return save(fig, path)
