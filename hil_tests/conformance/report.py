"""Conformance reports: terminal, JUnit, HTML, JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from jinja2 import StrictUndefined, Template
from rich.console import Console
from rich.table import Table
from rich.text import Text

from starhil.hil_tests.conformance.runner import Outcome
from starhil.hil_tests.conformance.unjudged_cases import is_unjudged
from starhil.hil_tests.reports import FAILED, NOT_RUN, PASSED, SKIPPED, TestCase, write_junit, write_report
from starhil.protocol.errors import escape_controls

STYLES: Final = {
    PASSED: ("✓", "green"),
    FAILED: ("✗", "bold red"),
    SKIPPED: ("-", "yellow"),
    NOT_RUN: ("-", "dim"),
}
SHOWN_IF_VERBOSE: Final = (PASSED, NOT_RUN)
TEMPLATE: Final = Path(__file__).with_name("report.html.j2")


def count(outcomes: Sequence[Outcome], status: str) -> int:
    return sum(outcome.status == status for outcome in outcomes)


def to_json(outcomes: Sequence[Outcome], facts: Mapping[str, str]) -> dict[str, Any]:
    """Return all results as JSON data, with facts about the run."""
    return {
        "unit": facts["links"],
        "facts": dict(facts),
        "cases": len(outcomes),
        "passed": count(outcomes, PASSED),
        "failed": count(outcomes, FAILED),
        "skipped": count(outcomes, SKIPPED),
        "not_run": count(outcomes, NOT_RUN),
        "outcomes": [outcome.to_json() for outcome in outcomes],
    }


def print_outcome(console: Console, outcome: Outcome, *, verbose: bool) -> None:
    """Print a line for a case; for passed cases, those not run, and what no case judges only if `verbose`."""
    if not verbose and (outcome.status in SHOWN_IF_VERBOSE or _is_unjudged(outcome)):
        return
    mark, style = STYLES[outcome.status]
    line = Text(f"{mark} ", style=style)
    line.append(f"{outcome.id}  ")
    line.append(f"{escape_controls(outcome.title)} [{escape_controls(outcome.clause)}]", style="dim")
    if outcome.status == FAILED:
        expected, seen = escape_controls(outcome.expected), escape_controls(outcome.seen)
        line.append(f"\n    expected {expected}\n    seen     {seen}", style="red")
    elif outcome.status in (SKIPPED, NOT_RUN):
        line.append(f"  {escape_controls(outcome.seen)}", style="yellow")
    console.print(line, soft_wrap=True)


def by_area(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Return the outcomes of each area, in the order of their first case."""
    areas: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        areas.setdefault(outcome.area, []).append(outcome)
    return areas


def print_summary(console: Console, outcomes: Sequence[Outcome]) -> None:
    table = Table("area", "cases", *STYLES, "seconds", box=None, pad_edge=False)
    for area, rows in by_area(outcomes).items():
        numbers = [len(rows), *(count(rows, status) for status in STYLES)]
        style = "red" if count(rows, FAILED) else ""
        table.add_row(area, *map(str, numbers), f"{sum(row.seconds for row in rows):.1f}", style=style)
    console.print(table)
    counts = ", ".join(f"{count(outcomes, status)} {status}" for status in STYLES)
    style = "bold red" if count(outcomes, FAILED) else "bold green"
    console.print(Text(f"{len(outcomes)} cases: {counts}", style=style))
    unjudged = sum(map(_is_unjudged, outcomes))
    if unjudged:
        what = "cases unjudged.* list" if unjudged > 1 else "case unjudged.* lists"
        console.print(
            f"{unjudged} {what} values of which only the limits are checked: --verbose shows them",
            style="dim",
        )


def _is_unjudged(outcome: Outcome) -> bool:
    return outcome.status == SKIPPED and is_unjudged(outcome.area)


def write_junit_report(path: Path, outcomes: Sequence[Outcome]) -> None:
    cases = [
        TestCase(
            outcome.area,
            f"{outcome.id}: {outcome.title}",
            outcome.status,
            outcome.detail,
            outcome.seconds,
            "\n".join([f"clause: {outcome.clause}", *outcome.log]),
        )
        for outcome in outcomes
    ]
    write_junit(path, "starhil conformance", cases, sum(outcome.seconds for outcome in outcomes))


def write_html_report(path: Path, outcomes: Sequence[Outcome], facts: Mapping[str, str]) -> None:
    """Write an HTML page with facts about the run, and all cases: clause, result, traffic, expected and seen."""
    template = Template(TEMPLATE.read_text(encoding="utf-8"), autoescape=True, undefined=StrictUndefined)
    text = template.render(
        title="Conformance",
        facts=facts,
        outcomes=outcomes,
        statuses=list(STYLES),
        areas=by_area(outcomes),
        count=count,
    )
    write_report(path, text.encode(errors="replace"))
