"""Session and conformance runs, which report their results to the console."""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.signals import Signal

KEPT_RUNS: Final = 20
KEPT_RESULTS: Final = 2000
STATUSES: Final = ("passed", "failed", "skipped", "not run")


@dataclass
class Run:
    """A run: its description and its results so far."""

    run: str
    kind: str
    title: str
    unit: str
    planned: int
    begin_s: float
    results: list[dict[str, Any]] = field(default_factory=list)
    end_s: float | None = None
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STATUSES, 0))

    def head(self) -> dict[str, Any]:
        """Return everything except the results."""
        content = vars(self).copy()
        del content["results"]
        return content


class Runs:
    """The latest runs."""

    def __init__(self) -> None:
        self.changed: Final = Signal[dict[str, Any]]("runs")
        """Messages for pages."""
        self._runs: OrderedDict[str, Run] = OrderedDict()

    def report(self, event: object) -> None:
        """Record a report of a run: its begin, a result or its end."""
        if not isinstance(event, dict) or not isinstance(event.get("run"), str):
            raise EmulatorError("report: must be an object with `run` and `event`")
        match event.get("event"):
            case "begin":
                self._begin_run(event)
            case "result":
                self._add_result(event)
            case "end":
                run = self._find(event)
                run.end_s = time.time()
                self.changed.emit({"type": "run", **run.head()})
            case _:
                raise EmulatorError("report: event must be begin, result or end")

    def _begin_run(self, event: dict[str, Any]) -> None:
        planned = event.get("planned")
        run = Run(
            run=str(event["run"])[:80],
            kind=str(event.get("kind", ""))[:40],
            title=str(event.get("title", ""))[:200],
            unit=str(event.get("unit", ""))[:200],
            planned=planned if isinstance(planned, int) else 0,
            begin_s=time.time(),
        )
        self._runs[run.run] = run
        while len(self._runs) > KEPT_RUNS:
            self._runs.popitem(last=False)
        self.changed.emit({"type": "run", **run.head()})

    def _add_result(self, event: dict[str, Any]) -> None:
        run = self._find(event)
        result = event.get("result")
        if not isinstance(result, dict) or result.get("status") not in STATUSES:
            raise EmulatorError(f"report: result needs a status, one of {', '.join(STATUSES)}")
        run.counts[str(result["status"])] += 1
        if len(run.results) < KEPT_RESULTS:
            run.results.append(result)
        self.changed.emit({"type": "result", "run": run.run, "counts": run.counts, "result": result})

    def _find(self, event: dict[str, Any]) -> Run:
        run = self._runs.get(str(event["run"]))
        if run is None:
            raise EmulatorError("report: unknown run; report its begin first")
        return run

    def messages(self) -> Iterator[str]:
        """Yield the messages that describe all runs to a new page."""
        for run in self._runs.values():
            yield json.dumps({"type": "run", **run.head(), "results": run.results})
