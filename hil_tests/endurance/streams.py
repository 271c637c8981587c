"""The rows that a definition sends at a rate: each comes on every link of the unit, a period after the last one."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.endurance.violation import Violation
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.rows import Row

LATE_S: Final = 1e-6
"""Largest error of a period."""


class Streams:
    """When the rows of a definition that are sent at a rate have come, by link and name."""

    def __init__(self, definition: Unit) -> None:
        self._periods_s = {
            row.name: 1.0 / row.unsolicited
            for row in definition.telemetry.values()
            if isinstance(row.unsolicited, float) and not row.carries_files
        }
        self._since_s: dict[str, float] = {}
        self._last: dict[tuple[str, str], tuple[float, bool]] = {}
        """Time of the last message, and whether only the definition can have caused it."""

    def begin(self, link: str, now_s: float) -> None:
        """Judge a link from now on: what was sent before may be lost, or of before a restart."""
        self._since_s[link] = now_s
        for name in self._periods_s:
            self._last.pop((link, name), None)

    def received(self, link: str, row: Row, at_s: float, *, subscribed: bool) -> None:
        """Judge the time at which a row was sent; one that is `subscribed` to may also come at other times."""
        period_s = self._periods_s.get(row.name)
        if period_s is None:
            return
        last_s, alone = self._last.get((link, row.name), (at_s, False))
        self._last[link, row.name] = (at_s, not subscribed)
        if alone and not subscribed and abs(at_s - last_s - period_s) > LATE_S:
            raise Violation(
                f"{link}: {row.name} {at_s - last_s:g} s after the previous one, not {period_s:g} s"
            )

    def passed(self, link: str, now_s: float) -> None:
        """Judge that no row is overdue."""
        for name, period_s in self._periods_s.items():
            last_s, _ = self._last.get((link, name), (self._since_s[link], False))
            if now_s - last_s > period_s + LATE_S:
                raise Violation(
                    f"{link}: no {name} for {now_s - last_s:g} s, although it is sent every {period_s:g} s"
                )
