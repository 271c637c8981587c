"""The comparison of identification programs as a Markdown table and as plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.files import write_atomically

Answer = Mapping[str, Any]

_HEAD: Final = """# Leaderboard of star identification

`{command}`: the same scenes for all solvers. A row is named by σ of the positions in px, false stars and missing stars of a sensor of 42°
and stars to V 5.5 where nothing else is said. *Right* counts answers whose boresight is within 0.1° and whose roll within 1° of the truth (where there is no sky to
identify: none), *wrong* the other answers; the rest gave none. *Ill-conditioned* are those of the wrong answers that are within the same
limits of the least-squares attitude of the true matches, so that no solver could do better with these stars.
A solver that had spent its budget answered fewer scenes.
"""


def markdown(answer: Answer, command: str) -> str:
    """Report of what `starhil.emulator.benchmarks.identify.run` returned: one table a row, best first, and one of what the solvers take."""
    lines = [_HEAD.format(command=command)]
    for row in dict.fromkeys(entry["row"] for entry in answer["rows"]):
        lines += [
            f"## {row}",
            "",
            "| solver | scenes | right % | wrong (ill-conditioned) | boresight ″ | over the floor | median ms | 99 % ms | CPU ms |",
            "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        ]
        lines += [_line(entry) for entry in ranked(answer, row)]
        lines.append("")
    lines += [
        "## What they take",
        "",
        "Database in kB, time to build or (geometric, lsi, rsi) load it, growth of the process's memory until the first answer. The published",
        "algorithms' memory holds the index of the verification, which whoever is first pays for.",
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
    lines += ["", f"Seed {answer['seed']}. Versions: {versions}.", ""]
    return "\n".join(lines)


def ranked(answer: Answer, row: str) -> list[Mapping[str, Any]]:
    """Entries of a row: fewest wrong first, then most right, then least processor time."""
    entries = [entry for entry in answer["rows"] if entry["row"] == row]
    return sorted(entries, key=lambda entry: (_wrong(entry), -right(entry), entry["cpu_median_ms"] or 0.0))


def right(entry: Mapping[str, Any]) -> float:
    """Share of scenes answered rightly, %; where there is no sky behind the points, no answer is the right one."""
    return (float(entry["valid_pct"]) if entry["sky"] else 100.0) - _wrong(entry)


def _wrong(entry: Mapping[str, Any]) -> float:
    """Share of scenes answered wrongly, %."""
    return 100.0 * float(entry["wrong"]) / max(int(entry["frames"]), 1)


def _line(entry: Mapping[str, Any]) -> str:
    figures = (
        _text(entry["boresight_median_arcsec"], 1),
        _text(entry["floor_ratio"], 2),
        _text(entry["median_ms"], 2),
        _text(entry["p99_ms"], 1),
        _text(entry["cpu_median_ms"], 2),
    )
    return f"| {entry['solver']} | {entry['frames']} | {right(entry):.1f} | {entry['wrong']} ({entry['ill_conditioned']}) | {' | '.join(figures)} |"


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def write_leaderboard(answer: Answer, folder: Path, command: str) -> list[Path]:
    """Write leaderboard.md, leaderboard.json and two plots, rates.png and times.png, into a folder; return their paths."""
    import json

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
    """Values of solvers (rows) over rows of the comparison (columns), NaN where there are none."""
    solvers, rows = _names(answer, "solver"), _names(answer, "row")
    table = np.full((len(solvers), len(rows)), np.nan)
    for entry in answer["rows"]:
        place = solvers.index(entry["solver"]), rows.index(entry["row"])
        found = right(entry) if value == "right" else entry[value]
        table[place] = np.nan if found is None else found
    return table


def _plot_rates(answer: Answer, path: Path) -> None:
    """Draw the share answered rightly as colour, and the number of wrong answers in the cells."""
    from starid.thesis.experiments.plots import figure, save

    solvers, rows = _names(answer, "solver"), _names(answer, "row")
    fig, axis = figure(width=2.5 + 0.62 * len(rows), height=1.8 + 0.3 * len(solvers))
    shares, wrong = _table(answer, "right"), _table(answer, "wrong")
    image = axis.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=100.0, aspect="auto")
    for (i, j), share in np.ndenumerate(shares):
        if np.isfinite(share):
            mark = f"\n{wrong[i, j]:.0f} wrong" if wrong[i, j] > 0 else ""
            axis.text(j, i, f"{share:.0f}{mark}", ha="center", va="center", fontsize=6)
    axis.set_xticks(range(len(rows)), rows, rotation=60, ha="right", fontsize=7)
    axis.set_yticks(range(len(solvers)), solvers, fontsize=7)
    axis.grid(visible=False)
    fig.colorbar(image, label="right / %")
    save(fig, path)


def _plot_times(answer: Answer, path: Path) -> None:
    """Draw median and 99 % of the processor time of a solve, each for the row in the middle of a solver's."""
    from starid.thesis.experiments.plots import figure, save

    solvers = _names(answer, "solver")
    fig, axis = figure(width=7.0, height=1.2 + 0.28 * len(solvers))
    places = np.arange(len(solvers))
    for value, word, marker in (("cpu_median_ms", "median", "o"), ("cpu_p99_ms", "99 %", "x")):
        table = _table(answer, value)
        axis.plot(np.nanmedian(table, axis=1), places, marker, label=word)
    axis.set(xscale="log", xlabel="processor time of a solve / ms", yticks=places)
    axis.set_yticks(places, solvers, fontsize=7)
    axis.invert_yaxis()
    axis.legend()
    save(fig, path)
