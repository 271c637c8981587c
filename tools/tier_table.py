#!/usr/bin/env python3
"""Print what a test run covered: tier, tests run, skipped, why.

    tools/tier_table.py FOLDER

Each tier has a file NAME.xml in the folder, as `pytest --junit-xml` writes it, or if there is none NAME.reason, a line that
says why. Uses only the standard library.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import NamedTuple

SHOWN_REASON = 110
"""Characters of a reason that are shown."""


class Tier(NamedTuple):
    """A row of the table."""

    name: str
    run: str
    skipped: str
    reasons: tuple[str, ...]


def read_tier(folder: Path, name: str) -> Tier:
    """Return what a tier has run, from its files in the folder."""
    report = folder / f"{name}.xml"
    if not report.exists():
        return Tier(name, "none", "all", ((folder / f"{name}.reason").read_text(encoding="utf-8"),))
    cases = list(ET.parse(report).iter("testcase"))  # noqa: S314 (written by pytest on this machine)
    skips = [case.find("skipped") for case in cases]
    reasons = Counter(skip.get("message", "") for skip in skips if skip is not None)
    lines = tuple(f"{count} x {text}" for text, count in reasons.most_common())
    return Tier(name, str(len(cases) - reasons.total()), str(reasons.total()), lines)


def table(tiers: list[Tier]) -> str:
    """Return the table as text; each further reason has a line of its own."""
    rows = [("tier", "run", "skipped", "why")]
    for tier in tiers:
        first, *others = tier.reasons or ("",)
        rows.append((tier.name, tier.run, tier.skipped, first))
        rows += [("", "", "", other) for other in others]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = []
    for name, run, skipped, why in rows:
        reason = " ".join(why.split())
        shown = reason if len(reason) <= SHOWN_REASON else f"{reason[: SHOWN_REASON - 1]}…"
        cells = f"{name:<{widths[0]}}  {run:>{widths[1]}}  {skipped:>{widths[2]}}  {shown}"
        lines.append(cells.rstrip())
    return "\n".join(lines)


def main() -> None:
    """Print the table of the folder that is named."""
    folder = Path(sys.argv[1])
    print(table([read_tier(folder, name) for name in sorted({path.stem for path in folder.iterdir()})]))


if __name__ == "__main__":
    main()
