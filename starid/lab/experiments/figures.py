"""Figures as data: a figure is curves, each with the title of its panel, and one function draws them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from starid.storage.plots import colours, figure, save


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

    Curves without a colour get one each, from dark to light. Those in `right` have a scale of their own, up to
    `right_limit`.
    """

    title: str
    curves: list[Curve]
    settings: dict[str, Any] = field(default_factory=dict)
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


def plane_axes(half_width: float) -> dict[str, Any]:
    """Settings of a panel that shows a frame, degrees."""
    limits = (-half_width, half_width)
    return {"xlabel": "x / °", "ylabel": "y / °", "xlim": limits, "ylim": limits}


def curves_of(
    table: Iterable[Mapping[str, Any]],
    x: str,
    y: str,
    label: Callable[[Mapping[str, Any]], str],
    style: str = "o-",
) -> list[Curve]:
    """A curve for each label of lines of a table, through the values of two columns."""
    by_label: dict[str, list[Mapping[str, Any]]] = {}
    for line in table:
        by_label.setdefault(label(line), []).append(line)
    return [
        Curve([line[x] for line in lines], [line[y] for line in lines], style, words)
        for words, lines in by_label.items()
    ]


def panels_of(content: Iterable[Panel | Picture | tuple[str, Curve]]) -> list[Panel | Picture]:
    """Panels in order; curves with the same title share one."""
    panels: dict[str | int, Panel | Picture] = {}
    for number, each in enumerate(content):
        if isinstance(each, Panel | Picture):
            panels[number] = each
        else:
            panel = panels.setdefault(each[0], Panel(each[0], []))
            panel.curves.append(each[1])  # type: ignore[union-attr]
    return list(panels.values())


def _picture(fig: Any, axis: Any, picture: Picture) -> list[Any]:
    place = {"origin": "lower", "extent": picture.extent, "interpolation": "nearest"}
    image = axis.imshow(picture.values, **place, **picture.options)
    axis.grid(visible=False)
    if picture.label:
        fig.colorbar(image, ax=axis, label=picture.label, extend=picture.beyond)
    return []


def _curves(axis: Any, panel: Panel) -> list[Any]:
    """Draw the curves; return those with a label."""
    free = [curve for curve in panel.curves if "color" not in curve.options]
    shades = dict(zip(map(id, free), colours(len(free)), strict=True))
    drawn = []
    for curve in panel.curves:
        colour = {"color": shades[id(curve)]} if id(curve) in shades else {}
        options = {"label": curve.label or None, **colour, **curve.options}
        drawn += axis.plot(curve.x, curve.y, curve.style, **options)
    if panel.right:
        right = axis.twinx()
        for curve in panel.right:
            drawn += right.plot(curve.x, curve.y, curve.style, label=curve.label, **curve.options)
        right.grid(visible=False)
        right.set_ylim(0.0, panel.right_limit)
    return [line for line in drawn if not line.get_label().startswith("_")]


def draw(
    path: Path,
    content: Iterable[Panel | Picture | tuple[str, Curve]],
    *,
    axes: Mapping[str, Any] | None = None,
    columns: int = 1,
    width: float = 7.0,
    height: float = 4.2,
    title: str = "",
    legend: str = "",
    legend_columns: int = 1,
    **options: Any,
) -> str:
    """Draw panels row by row, `columns` in a row; return the name of the file.

    `axes` are settings of all panels, besides those of each. `legend` is the place of the legend of each panel, or,
    if it begins with "outside", of one legend for all, with the labels of the first. The other options are those of
    `matplotlib.pyplot.subplots`.
    """
    shown = panels_of(content)
    rows = -(-len(shown) // columns)
    fig, grid = figure(rows, columns, width=width, height=height, squeeze=False, **options)
    for axis in grid.ravel()[len(shown) :]:
        axis.remove()
    common = legend.startswith("outside")
    for axis, panel in zip(grid.ravel(), shown, strict=False):
        handles = _picture(fig, axis, panel) if isinstance(panel, Picture) else _curves(axis, panel)
        axis.set(title=panel.title, **(axes or {}), **panel.settings)
        if "sharex" in options or "sharey" in options:
            axis.label_outer()
        if legend and not common:
            axis.legend(loc=legend)
        elif common and axis is grid[0, 0]:
            fig.legend(handles=handles, loc=legend, ncols=legend_columns)
    if title:
        fig.suptitle(title)
    return save(fig, path)
