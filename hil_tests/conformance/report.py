"""Conformance reports: terminal, JUnit, HTML, JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from starhil.hil_tests.conformance.runner import Outcome
from starhil.hil_tests.results import FAILED, NOT_RUN, PASSED, SKIPPED, TestCase, write_junit, write_report
from starhil.protocol.errors import escape_controls

STYLES: Final = {
    PASSED: ("✓", "green"),
    FAILED: ("✗", "bold red"),
    SKIPPED: ("-", "yellow"),
    NOT_RUN: ("-", "dim"),
}
SHOWN_IF_VERBOSE: Final = (PASSED, NOT_RUN)

_PAGE: Final = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; color: #1b1f24; }}
table {{ border-collapse: collapse; width: 100%; margin: 1rem 0 2rem; }}
th, td {{ text-align: left; vertical-align: top; padding: .3rem .6rem; border-bottom: 1px solid #d8dee4; }}
th {{ background: #f6f8fa; }} code, pre {{ font: 12.5px/1.4 ui-monospace, monospace; }}
.passed {{ color: #1a7f37; }} .failed {{ color: #cf222e; font-weight: 600; }} .skipped, .not-run {{ color: #9a6700; }}
details pre {{ background: #f6f8fa; padding: .5rem; overflow-x: auto; }}
</style>
<h1>{title}</h1>
<table>{facts}</table>
<p><b>{total}</b> cases: <span class="passed">{passed} passed</span>, <span class="failed">{failed} failed</span>,
<span class="skipped">{skipped} skipped</span>, <span class="not-run">{not_run} not run</span>.</p>
{areas}
{details}
</html>
"""


def count(outcomes: Sequence[Outcome], status: str) -> int:
    """Return the number of cases with a status."""
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
    """Print a line for a case; for passed cases and those not run only if `verbose`."""
    if outcome.status in SHOWN_IF_VERBOSE and not verbose:
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


def areas_of(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the areas in the order of their first case."""
    return list(dict.fromkeys(outcome.area for outcome in outcomes))


def print_summary(console: Console, outcomes: Sequence[Outcome]) -> None:
    """Print a table by area."""
    table = Table("area", "cases", *STYLES, "seconds", box=None, pad_edge=False)
    for area in areas_of(outcomes):
        rows = [outcome for outcome in outcomes if outcome.area == area]
        numbers = [len(rows), *(count(rows, status) for status in STYLES)]
        style = "red" if count(rows, FAILED) else ""
        table.add_row(area, *map(str, numbers), f"{sum(row.seconds for row in rows):.1f}", style=style)
    console.print(table)
    counts = ", ".join(f"{count(outcomes, status)} {status}" for status in STYLES)
    style = "bold red" if count(outcomes, FAILED) else "bold green"
    console.print(Text(f"{len(outcomes)} cases: {counts}", style=style))


def write_junit_report(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write a JUnit XML file."""
    cases = [
        TestCase(
            outcome.area,
            f"{outcome.id}: {outcome.title}",
            outcome.status,
            f"expected {outcome.expected}; seen {outcome.seen}" if outcome.status == FAILED else outcome.seen,
            outcome.seconds,
            "\n".join([f"clause: {outcome.clause}", *outcome.log]),
        )
        for outcome in outcomes
    ]
    write_junit(path, "starhil conformance", cases, sum(outcome.seconds for outcome in outcomes))


def write_html_report(path: Path, outcomes: Sequence[Outcome], facts: Mapping[str, str]) -> None:
    """Write an HTML page with facts about the run, and all cases: clause, result, traffic, expected and seen."""
    rows = []
    for area in areas_of(outcomes):
        mine = [outcome for outcome in outcomes if outcome.area == area]
        cells = "".join(f"<td>{count(mine, status)}</td>" for status in STYLES)
        rows.append(
            f'<tr><td><a href="#{escape(area)}">{escape(area)}</a></td><td>{len(mine)}</td>{cells}</tr>'
        )
    heads = "".join(f"<th>{word}</th>" for word in ("area", "cases", *STYLES))
    text = _PAGE.format(
        title="Conformance",
        facts="".join(
            f"<tr><th>{escape(name)}</th><td>{escape(fact)}</td></tr>" for name, fact in facts.items()
        ),
        total=len(outcomes),
        passed=count(outcomes, PASSED),
        failed=count(outcomes, FAILED),
        skipped=count(outcomes, SKIPPED),
        not_run=count(outcomes, NOT_RUN),
        areas=f"<table><tr>{heads}</tr>{''.join(rows)}</table>",
        details="".join(_area_table(area, outcomes) for area in areas_of(outcomes)),
    )
    write_report(path, text.encode(errors="replace"))


def _area_table(area: str, outcomes: Sequence[Outcome]) -> str:
    rows = "".join(_row(outcome) for outcome in outcomes if outcome.area == area)
    heads = "".join(
        f"<th>{word}</th>" for word in ("case", "checked behaviour", "clause or source", "result")
    )
    return f'<h2 id="{escape(area)}">{escape(area)}</h2><table><tr>{heads}</tr>{rows}</table>'


def _row(outcome: Outcome) -> str:
    kind_of_result = outcome.status.replace(" ", "-")
    result = f'<span class="{kind_of_result}">{outcome.status}</span> in {outcome.seconds * 1e3:.0f} ms'
    if outcome.status == FAILED:
        result += f"<br>expected {escape(outcome.expected)}<br>seen {escape(outcome.seen)}"
    elif outcome.status in (SKIPPED, NOT_RUN):
        result += f"<br>{escape(outcome.seen)}"
    if outcome.log:
        result += f"<details><summary>sent and received</summary><pre>{escape(chr(10).join(outcome.log))}</pre></details>"
    kind = " <small>(intrusive)</small>" if outcome.intrusive else ""
    return (
        f"<tr><td><code>{escape(outcome.id)}</code>{kind}</td><td>{escape(outcome.title)}</td>"
        f"<td>{escape(outcome.clause)}</td><td>{result}</td></tr>"
    )
