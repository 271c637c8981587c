"""The comparison of identification programs as a Markdown table and as plots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.storage.files import write_atomically

Answer = Mapping[str, Any]

_HEAD: Final = """# Leaderboard of star identification

`{command}`: all solvers are given the same scenes. A heading gives σ of the positions in px, and the numbers of false and of missing
stars; unless it says otherwise, the field is 42° wide and shows stars to V 5.5. *Right* answers are within 0.1° of the true boresight and
1° of the true roll; in scenes without a sky, it is right not to answer. All other answers are *wrong*. *Ill-conditioned* answers are wrong
answers within the same limits of the least-squares attitude of the true matches: no solver could do better with these stars.
A solver that used up its time budget was given fewer scenes: compare no percentages before the number of scenes.
"""


def markdown(answer: Answer, command: str) -> str:
    """Return the report of `starid.lab.leaderboard.comparison.run`: a table per row, best solver first, and one of resources."""
    lines = [_HEAD.format(command=command)]
    for row in dict.fromkeys(entry["row"] for entry in answer["rows"]):
        lines += [
            f"## {row}",
            "",
            "| solver | scenes | right % | wrong (ill-conditioned) | boresight ″ | over the floor | median ms | 99 % ms | CPU ms |",
            "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        ]
        lines += [_line(entry, answer["frames"]) for entry in ranked(answer, row)]
        lines.append("")
    lines += [
        "## Database, build time and memory",
        "",
        "Size of the database; time to build it or, for geometric, lsi and rsi, to load it;",
        "growth of the process's memory until the first answer.",
        "The published algorithms share the index for verification; its memory is counted for the first of them that runs.",
        "",
        "| solver | field | stars to V | database kB | build s | memory MB |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {entry['solver']} | {entry['field_deg']:g}° | {entry['limit_v']:.1f} | {_text(entry['database_kb'], 0)} "
        f"| {_text(entry['build_s'], 2)} | {_text(entry['memory_mb'], 0)} |"
        for entry in answer["solvers"]
    ]
    lines += ["", *(f"- {name}: skipped, {why}" for name, why in answer["skipped"].items())]
    versions = ", ".join(f"{name} {version}" for name, version in answer["versions"].items())
    lines += ["", f"{answer['date']}, seed {answer['seed']}. Versions: {versions}.", ""]
    return "\n".join(lines)


def ranked(answer: Answer, row: str) -> list[Mapping[str, Any]]:
    """Return the entries of a row: fewest wrong answers first, then most right ones, then least processor time."""
    entries = [entry for entry in answer["rows"] if entry["row"] == row]
    return sorted(entries, key=lambda entry: (_wrong(entry), -right(entry), entry["cpu_median_ms"] or 0.0))


def right(entry: Mapping[str, Any]) -> float:
    """Return the share of right answers, %; in scenes without a sky, it is right not to answer."""
    return (float(entry["valid_pct"]) if entry["sky"] else 100.0) - _wrong(entry)


def _wrong(entry: Mapping[str, Any]) -> float:
    """Return the share of wrong answers, %."""
    return 100.0 * float(entry["wrong"]) / max(int(entry["frames"]), 1)


def _line(entry: Mapping[str, Any], scene_count: int) -> str:
    figures = (
        _text(entry["boresight_median_arcsec"], 1),
        _text(entry["floor_ratio"], 2),
        _text(entry["median_ms"], 2),
        _text(entry["p99_ms"], 1),
        _text(entry["cpu_median_ms"], 2),
    )
    scenes = (
        f"{entry['frames']}" if entry["frames"] == scene_count else f"**{entry['frames']}** of {scene_count}"
    )
    return f"| {entry['solver']} | {scenes} | {right(entry):.1f} | {entry['wrong']} ({entry['ill_conditioned']}) | {' | '.join(figures)} |"


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def write_leaderboard(answer: Answer, folder: Path, command: str) -> list[Path]:
    """Write leaderboard.md, leaderboard.json and two plots, rates.png and times.png, into a folder; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    report, data = folder / "leaderboard.md", folder / "leaderboard.json"
    plots = [folder / "rates.png", folder / "times.png"]
    text = markdown(answer, command) + "".join(f"\n![{path.stem}]({path.name})\n" for path in plots)
    write_atomically(report, lambda part: part.write_text(text, encoding="utf-8"))
    content = json.dumps(answer, indent=1, ensure_ascii=False)
    write_atomically(data, lambda part: part.write_text(content, encoding="utf-8"))
    _plot_rates(answer, plots[0])
    _plot_times(answer, plots[1])
    return [report, data, *plots]


def _names(answer: Answer, key: str) -> Sequence[str]:
    return list(dict.fromkeys(entry[key] for entry in answer["rows"]))


def _table(answer: Answer, value: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a value of each solver (first axis) in each row of the report (second axis); NaN if not measured."""
    solvers, rows = _names(answer, "solver"), _names(answer, "row")
    table = np.full((len(solvers), len(rows)), np.nan)
    for entry in answer["rows"]:
        cell = solvers.index(entry["solver"]), rows.index(entry["row"])
        found = right(entry) if value == "right" else entry[value]
        table[cell] = np.nan if found is None else found
    return table


def _plot_rates(answer: Answer, path: Path) -> None:
    """Draw the share of right answers as colour; in the cells, also the wrong ones, and the scenes if not all."""
    from starid.storage.plots import figure, save

    solvers, rows = _names(answer, "solver"), _names(answer, "row")
    fig, axis = figure(width=2.5 + 0.62 * len(rows), height=1.8 + 0.3 * len(solvers))
    shares, wrong, scenes = (_table(answer, name) for name in ("right", "wrong", "frames"))
    image = axis.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=100.0, aspect="auto")
    for (i, j), share in np.ndenumerate(shares):
        if np.isfinite(share):
            mark = f"\n{wrong[i, j]:.0f} wrong" if wrong[i, j] > 0 else ""
            mark += f"\nof {scenes[i, j]:.0f}" if scenes[i, j] < answer["frames"] else ""
            axis.text(j, i, f"{share:.0f}{mark}", ha="center", va="center", fontsize=6)
    axis.set_xticks(range(len(rows)), rows, rotation=60, ha="right", fontsize=7)
    axis.set_yticks(range(len(solvers)), solvers, fontsize=7)
    axis.grid(visible=False)
    fig.colorbar(image, label="right / %")
    save(fig, path)


def _plot_times(answer: Answer, path: Path) -> None:
    """Draw median and 99th percentile of the processor time of a solve, each as the median over the rows."""
    from starid.storage.plots import figure, save

    solvers = _names(answer, "solver")
    fig, axis = figure(width=7.0, height=1.2 + 0.28 * len(solvers))
    heights = np.arange(len(solvers))
    for value, label, marker in (("cpu_median_ms", "median", "o"), ("cpu_p99_ms", "99 %", "x")):
        table = _table(answer, value)
        axis.plot(np.nanmedian(table, axis=1), heights, marker, label=label)
    axis.set(xscale="log", xlabel="processor time of a solve / ms", yticks=heights)
    axis.set_yticks(heights, solvers, fontsize=7)
    axis.invert_yaxis()
    axis.legend()
    save(fig, path)
