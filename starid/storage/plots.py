"""Common style of all figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from starid.storage.files import write_atomically

_STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.titlesize": 10,
    "legend.fontsize": 7,
    "legend.framealpha": 0.85,
    "lines.linewidth": 1.2,
    "figure.dpi": 130,
}


def figure(
    rows: int = 1, columns: int = 1, *, width: float = 7.0, height: float = 4.2, **options: Any
) -> Any:
    """Make a figure (size in inches) without a window, and its axes as in `matplotlib.pyplot.subplots`."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mpl.rcParams.update(_STYLE)
    return plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)


def save(fig: Any, path: Path) -> str:
    """Write a figure in the format of the suffix (PNG without one), close it, and return the file name."""
    import matplotlib.pyplot as plt

    form = path.suffix.removeprefix(".").lower() or "png"
    try:
        write_atomically(path, lambda part: fig.savefig(part, format=form, dpi=130))
    finally:
        plt.close(fig)
    return path.name


def colours(count: int) -> list[Any]:
    """Colours for a sequence of curves, from dark to light."""
    import matplotlib as mpl

    return [mpl.colormaps["viridis"](0.05 + 0.85 * i / max(count - 1, 1)) for i in range(count)]
