"""The report: every experiment's rows beside the published values, its figures and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from starid.files import write_atomically
from starid.thesis.experiments.experiment import Row
from starid.thesis.experiments.runner import Finished

REPORT_FILE: Final = "report.md"
"""Name of the report in the results' folder."""

_HEAD: Final = """# The thesis's experiments, made again

Experiments of E. O. Özyurt, *A Feedback Star Identification Algorithm via Regularized Pattern Recognition Using a
Unique Feature Extraction* (Ph.D. thesis, Istanbul Technical University), computed here from the Hipparcos catalogue (new
reduction) and put beside the published values. "—" in the column "published" means that the thesis gives no number, only a curve
or nothing at all. A row with a target is a check; the others inform. Where a published value is not reached, or cannot be recovered
from the text, the remark or the paragraph above the table says so.

How to read the accuracy figures of the LSI algorithm:

* **On the grid**: the thesis tests on 1 701 frames, and with p = 99.5 % every one of them *is* a frame of the database.
  The nearest neighbour is then the frame itself, and the figure says little about frames in between.
* **Off the grid**: the same frames, each moved by an irrational fraction of the grid step (drawn from a seeded
  generator), which is what a real sensor sees. Every accuracy figure of the LSI algorithm is given for both.
"""


def _mark(row: Row) -> str:
    return {None: "", True: "ok", False: "**missed**"}[row.passed]


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _table(rows: Iterable[Row]) -> list[str]:
    lines = [
        "| quantity | published | ours | target | | remark |",
        "|---|---:|---:|---|---|---|",
    ]
    lines += [
        "| "
        + " | ".join(
            (
                _cell(row.quantity),
                _cell(row.published),
                _cell(row.ours),
                _cell(row.target),
                _mark(row),
                _cell(row.remark),
            )
        )
        + " |"
        for row in rows
    ]
    return lines


def _section(finished: Finished) -> list[str]:
    experiment, outcome = finished.experiment, finished.outcome
    lines = [f"## {experiment.title}", ""]
    for note in outcome.notes:
        lines += [note, ""]
    lines += _table(outcome.rows)
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
    checks = [row for result in results for row in result.outcome.rows if row.passed is not None]
    failed = [row for row in checks if row.passed is False]
    lines = [_HEAD]
    if quick:
        lines += [
            "This is the **quick** run: fewer databases, fewer frames. Numbers that depend on the number of frames differ",
            "from those of the full run within their statistical spread.",
            "",
        ]
    minutes = sum(result.seconds for result in results) / 60.0
    met = f"{len(checks) - len(failed)} of {len(checks)} checks are met."
    lines += [
        f"Seed {seed}. {met} All took {minutes:.1f} minutes of processor time, on two cores half as long.",
        "",
    ]
    if failed:
        lines += ["## Not met", "", *_table(failed), ""]
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
                "failed": [row.quantity for row in result.outcome.failed],
            }
            for result in results
        },
        "checks": sum(row.passed is not None for _, row in rows),
        "failed": sum(row.passed is False for _, row in rows),
        "rows": [
            {
                "experiment": result.experiment.name,
                "quantity": row.quantity,
                "published": row.published,
                "ours": row.ours,
                "target": row.target,
                "passed": row.passed,
            }
            for result, row in rows
        ],
    }
