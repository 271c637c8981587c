"""Tables of raw traffic on any link with the expected answers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from starhil.hil_tests.conformance.case import CaseArea
from starhil.hil_tests.conformance.link_probe import LinkProbe

ProbeType = TypeVar("ProbeType", bound=LinkProbe)


@dataclass(frozen=True)
class Exchange:
    """Raw traffic and the answers to it; ID, title and clause as in a case."""

    id: str
    title: str
    sent: tuple[str, ...]
    """Raw traffic, in the format of `LinkProbe.send_text`."""
    answers: tuple[str, ...] = ()
    """All expected answers, in the format of `LinkProbe.expect_exactly`."""
    clause: str | None = None
    """None: the clause of the area."""
    pause_s: float = 0.0
    """Pause after each item, s."""


def add_exchange_cases(
    area: CaseArea[ProbeType], rows: Iterable[Exchange], *, intrusive: bool = False
) -> None:
    """Add one case per row."""
    for row in rows:
        area.case(row.id, row.title, row.clause, intrusive=intrusive)(partial(_exchange, row))


def filled(table: Iterable[Exchange], texts: dict[str, str]) -> Iterator[Exchange]:
    """Yield the rows of a table with names in braces replaced by texts; skip rows with a missing text."""
    for row in table:
        with suppress(KeyError):
            sent, answers = (tuple(text.format(**texts) for text in part) for part in (row.sent, row.answers))
            name, title = row.id.format(**texts), row.title.format(**texts)
            yield replace(row, id=name, title=title, sent=sent, answers=answers)


def _exchange(row: Exchange, probe: LinkProbe) -> None:
    probe.expecting(*row.answers)
    for text in row.sent:
        probe.send_text(text)
        probe.sleep(row.pause_s)
    for answer in row.answers:
        probe.expect_exactly(answer)
    probe.expect_silence("no more was requested")
    # an incomplete message ends at the start of the next one
    probe.expect_alive()
