"""The report: rows of all experiments compared with the published values, figures and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from starid.lab.experiments.comparison import Row
from starid.lab.experiments.runner import FinishedExperiment
from starid.lab.experiments.tables import class_of, known_miss, numbers_by_choice
from starid.storage.files import write_atomically

REPORT_FILE: Final = "report.md"
"""Name of the report in the folder of results."""

CLASSES: Final = {
    "agrees": "published numbers agree",
    "weak": "published numbers agree, and a constant answer does too",
    "fitted": "published numbers are explained by a constant fitted to them",
    "better": "published numbers are bettered",
    "ours": "bounds of this project hold",
}
"""Classes of checks, and what is counted in each."""


def _mark(experiment: str, row: Row) -> str:
    if row.passed is None:
        return ""
    kind: str = class_of(experiment, row)
    if kind == "agrees" and row.weak == row.of:
        kind = "agrees, weak"
    if row.passed:
        return kind
    return f"**missed** ({kind})" if known_miss(experiment, row) else f"**regression** ({kind})"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _remark(experiment: str, row: Row) -> str:
    known = known_miss(experiment, row)
    return " ".join(part for part in (row.remark, known.reason if known else "") if part)


def _table(head: str, numbers: int, lines: Iterable[Iterable[str]]) -> list[str]:
    """Format a table in Markdown; `numbers` columns after the first are aligned to the right."""
    names = head.split("|")
    rule = "|---" + "|---:" * numbers + "|---" * (len(names) - 1 - numbers) + "|"
    text = ["| " + " | ".join(names) + " |", rule]
    return text + ["| " + " | ".join(map(_cell, line)) + " |" for line in lines]


def _row_table(rows: Iterable[tuple[str, Row]]) -> list[str]:
    head = "quantity|published|as the author ran it|as printed|ours|check|class|remark"
    lines = (
        (
            *(row.quantity, row.published, row.author, row.printed, row.ours, row.target),
            *(_mark(experiment, row), _remark(experiment, row)),
        )
        for experiment, row in rows
    )
    return _table(head, 4, lines)


def counts(results: Sequence[FinishedExperiment]) -> dict[str, dict[str, int]]:
    """For each class, how many numbers agree and how many there are."""
    by_class = {kind: {"met": 0, "of": 0} for kind in CLASSES}
    for kind, row in ((class_of(name, row), row) for name, row in _named_rows(results) if row.kind):
        weak, weak_met = (row.weak, row.weak_met) if kind == "agrees" else (0, 0)
        for each, met, of in ((kind, row.met - weak_met, row.of - weak), ("weak", weak_met, weak)):
            by_class[each]["met"] += met
            by_class[each]["of"] += of
    return by_class


def _named_rows(results: Iterable[FinishedExperiment]) -> list[tuple[str, Row]]:
    return [(result.experiment.name, row) for result in results for row in result.outcome.rows]


def _choices(results: Iterable[FinishedExperiment]) -> list[str]:
    by_choice = numbers_by_choice(_named_rows(results))
    return [
        "## Free choices",
        "",
        f"The column *as the author ran it* rests on {len(by_choice)} choices that the text of the thesis does not make. A number",
        "may depend on several.",
        "",
        *_table(
            "choice|numbers that depend on it|of these agree|it was fitted to",
            3,
            (
                (name, *(f"{each[key]}" for key in ("numbers", "agree", "fitted")))
                for name, each in by_choice.items()
            ),
        ),
        "",
    ]


def regressions(results: Sequence[FinishedExperiment]) -> list[tuple[str, Row]]:
    """Failed checks that are not known misses, with the names of their experiments."""
    return [
        (name, row)
        for name, row in _named_rows(results)
        if row.passed is False and known_miss(name, row) is None
    ]


def _section(finished: FinishedExperiment) -> list[str]:
    experiment, outcome = finished.experiment, finished.outcome
    lines = [f"## {experiment.title}", ""]
    for note in outcome.notes:
        lines += [note, ""]
    lines += _row_table((experiment.name, row) for row in outcome.rows)
    lines.append("")
    for name in outcome.files:
        if name.endswith(".png"):
            lines += [f"![{name}]({experiment.name}/{name})", ""]
    tables = [f"[{name}]({experiment.name}/{name})" for name in outcome.files if not name.endswith(".png")]
    if tables:
        lines += ["Data: " + ", ".join(tables), ""]
    lines += [f"`starid reproduce {experiment.name}`, {finished.seconds:.0f} s of processor time.", ""]
    return lines


def report_text(results: Sequence[FinishedExperiment], *, quick: bool, seed: int) -> str:
    missed = [(name, row) for name, row in _named_rows(results) if row.passed is False]
    lost = regressions(results)
    lines = [Path(__file__).with_name("notes").joinpath("report.md").read_text(encoding="utf-8")]
    if quick:
        lines += [
            "This is the **quick** run: fewer databases, fewer frames. Numbers that depend on the number of frames differ",
            "from those of the full run within their statistical spread.",
            "",
        ]
    minutes = sum(result.seconds for result in results) / 60.0
    lines += [
        f"Seed {seed}. The run took {minutes:.1f} minutes of processor time, about half as long on two cores.",
        "",
    ]
    found = counts(results)
    table = ((words, str(found[kind]["met"]), str(found[kind]["of"])) for kind, words in CLASSES.items())
    lines += [*_table("class|met|of", 2, table), ""]
    lines += _choices(results)
    if lost:
        lines += ["## Regressions", "", *_row_table(lost), ""]
    known = [entry for entry in missed if entry not in lost]
    if known:
        lines += ["## Known misses", "", *_row_table(known), ""]
    lines += ["## Contents", ""]
    lines += [f"* {result.experiment.title} — `{result.experiment.name}`" for result in results]
    lines.append("")
    for result in results:
        lines += _section(result)
    return "\n".join(lines)


def write_report(results: Sequence[FinishedExperiment], folder: Path, *, quick: bool, seed: int) -> Path:
    """Write the report to the folder of results and return its path."""
    path = folder / REPORT_FILE
    text = report_text(results, quick=quick, seed=seed)
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def summary(results: Sequence[FinishedExperiment]) -> dict[str, Any]:
    """Counts and rows as plain values, for `--json`."""
    rows = _named_rows(results)
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
        "choices": numbers_by_choice(rows),
        "missed": sum(row.passed is False for _, row in rows),
        "regressions": [f"{name}: {row.quantity}" for name, row in regressions(results)],
        "rows": [
            {
                "experiment": name,
                "quantity": row.quantity,
                "published": row.published,
                "as_the_author_ran_it": row.author,
                "as_printed": row.printed,
                "ours": row.ours,
                "class": class_of(name, row),
                "target": row.target,
                "passed": row.passed,
                "known_miss": known.reason if (known := known_miss(name, row)) is not None else None,
            }
            for name, row in rows
        ],
    }
