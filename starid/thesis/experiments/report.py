"""The report: every experiment's rows beside the published values, its figures and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from starid.files import write_atomically
from starid.thesis.experiments.experiment import Kind, Row
from starid.thesis.experiments.known_misses import known_miss
from starid.thesis.experiments.runner import Finished

REPORT_FILE: Final = "report.md"
"""Name of the report in the results' folder."""

_HEAD: Final = """# The thesis's experiments, made again

Experiments of E. O. Özyurt, *A Feedback Star Identification Algorithm via Regularized Pattern Recognition Using a
Unique Feature Extraction* (Ph.D. thesis, Istanbul Technical University), computed here from the Hipparcos catalogue (new
reduction) and put beside the published values. Four columns, of which a row fills those that apply:

* **published**: what the thesis prints; a curve or a phrase is quoted, "—" means that it prints nothing.
* **as the author ran it**: the readings that recomputing the published numbers has recovered, MATLAB's `lasso` above all.
* **as printed**: the equations and parameters of the thesis's text, solved exactly.
* **ours**: what this project makes of the task.

A check belongs to one of three classes, counted apart:

* **agrees**: the value as the author ran it (or else as printed, or else ours) lies within a tolerance on *both* sides of the
  published number. The tolerance comes from the printed digits or from the sampling error, and the row says which.
* **better**: ours is on the better side of the published number; the row says by how much.
* **ours**: nothing was published; the bound is a requirement of this project.

A missed check is shown as a miss. One that is known to be missed names its reason; one that is not is a *regression*, and only that
gives the exit status 1.

How to read the accuracy figures of the LSI algorithm:

* **On the grid**: the thesis tests on 1 701 frames, and with p = 99.5 % every one of them *is* a frame of the database.
  The nearest neighbour is then the frame itself, and the figure says little about frames in between.
* **Off the grid**: the same frames, each moved by an irrational fraction of the grid step (drawn from a seeded
  generator), which is what a real sensor sees. Every accuracy figure of the LSI algorithm is given for both.
"""

CLASSES: Final[dict[Kind, str]] = {
    "agrees": "published numbers agree",
    "better": "published numbers are bettered",
    "ours": "bounds of this project hold",
}
"""The classes of checks and what is counted in each."""


def _mark(experiment: str, row: Row) -> str:
    if row.passed is None:
        return ""
    if row.passed:
        return row.kind
    return f"**missed** ({row.kind})" if known_miss(experiment, row) else f"**regression** ({row.kind})"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _remark(experiment: str, row: Row) -> str:
    known = known_miss(experiment, row)
    return " ".join(part for part in (row.remark, known.reason if known else "") if part)


def _table(rows: Iterable[tuple[str, Row]]) -> list[str]:
    lines = [
        "| quantity | published | as the author ran it | as printed | ours | check | class | remark |",
        "|---|---:|---:|---:|---:|---|---|---|",
    ]
    for experiment, row in rows:
        cells = (
            row.quantity,
            row.published,
            row.author,
            row.printed,
            row.ours,
            row.target,
            _mark(experiment, row),
            _remark(experiment, row),
        )
        lines.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
    return lines


def counts(results: Sequence[Finished]) -> dict[str, dict[str, int]]:
    """For each class how many numbers are met and how many there are."""
    rows = [row for result in results for row in result.outcome.rows]
    return {
        kind: {
            "met": sum(row.met for row in rows if row.kind == kind),
            "of": sum(row.of for row in rows if row.kind == kind),
        }
        for kind in CLASSES
    }


def regressions(results: Sequence[Finished]) -> list[tuple[str, Row]]:
    """Missed checks that are not known misses, with the names of their experiments."""
    return [
        (result.experiment.name, row)
        for result in results
        for row in result.outcome.failed
        if known_miss(result.experiment.name, row) is None
    ]


def _section(finished: Finished) -> list[str]:
    experiment, outcome = finished.experiment, finished.outcome
    lines = [f"## {experiment.title}", ""]
    for note in outcome.notes:
        lines += [note, ""]
    lines += _table((experiment.name, row) for row in outcome.rows)
    lines.append("")
    for name in outcome.files:
        if name.endswith(".png"):
            lines += [f"![{name}]({experiment.name}/{name})", ""]
    tables = [f"[{name}]({experiment.name}/{name})" for name in outcome.files if not name.endswith(".png")]
    if tables:
        lines += ["Data: " + ", ".join(tables), ""]
    lines += [f"`starhil reproduce {experiment.name}`, {finished.seconds:.0f} s of processor time.", ""]
    return lines


def report_text(results: Sequence[Finished], *, quick: bool, seed: int) -> str:
    """The report in Markdown."""
    missed = [(result.experiment.name, row) for result in results for row in result.outcome.failed]
    lost = regressions(results)
    lines = [_HEAD]
    if quick:
        lines += [
            "This is the **quick** run: fewer databases, fewer frames. Numbers that depend on the number of frames differ",
            "from those of the full run within their statistical spread.",
            "",
        ]
    minutes = sum(result.seconds for result in results) / 60.0
    lines += [
        f"Seed {seed}. All took {minutes:.1f} minutes of processor time, on two cores half as long.",
        "",
        "| class | met | of |",
        "|---|---:|---:|",
    ]
    found = counts(results)
    lines += [f"| {words} | {found[kind]['met']} | {found[kind]['of']} |" for kind, words in CLASSES.items()]
    lines.append("")
    if lost:
        lines += ["## Regressions", "", *_table(lost), ""]
    known = [entry for entry in missed if entry not in lost]
    if known:
        lines += ["## Known misses", "", *_table(known), ""]
    lines += ["## Contents", ""]
    lines += [f"* {result.experiment.title} — `{result.experiment.name}`" for result in results]
    lines.append("")
    for result in results:
        lines += _section(result)
    return "\n".join(lines)


def write_report(results: Sequence[Finished], folder: Path, *, quick: bool, seed: int) -> Path:
    """Write the report into the results' folder and return its path."""
    path = folder / REPORT_FILE
    text = report_text(results, quick=quick, seed=seed)
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def summary(results: Sequence[Finished]) -> dict[str, Any]:
    """Counts and rows as plain values, for `--json`."""
    rows = [(result, row) for result in results for row in result.outcome.rows]
    return {
        "experiments": {
            result.experiment.name: {
                "seconds": round(result.seconds, 2),
                "computed_parts": result.parts,
                "missed": [row.quantity for row in result.outcome.failed],
            }
            for result in results
        },
        "classes": counts(results),
        "missed": sum(row.passed is False for _, row in rows),
        "regressions": [f"{name}: {row.quantity}" for name, row in regressions(results)],
        "rows": [
            {
                "experiment": result.experiment.name,
                "quantity": row.quantity,
                "published": row.published,
                "as_the_author_ran_it": row.author,
                "as_printed": row.printed,
                "ours": row.ours,
                "class": row.kind,
                "target": row.target,
                "passed": row.passed,
                "known_miss": known.reason
                if (known := known_miss(result.experiment.name, row)) is not None
                else None,
            }
            for result, row in rows
        ],
    }
