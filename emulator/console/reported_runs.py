"""Session and conformance runs, which report their results to the console."""

from __future__ import annotations

import json
import time
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.signal import Signal

KEPT_RUNS: Final = 20
KEPT_RESULTS: Final = 2000
STATUSES: Final = ("passed", "failed", "skipped", "not run")

TEXTS: Final = {"status": 10, "id": 100, "name": 200, "link": 40, "detail": 500}
"""Texts of a result that are kept, each with its longest length, characters."""

LARGEST: Final = 1e9
"""Number above which a count or a time is not one."""

LONGEST_LINE: Final = 300
"""Longest kept line of the traffic of a result, characters."""

KEPT_LOG: Final = 20_000
"""Size of the kept traffic of a result: its last lines; characters."""

KEPT_LOGS: Final = 50
"""Number of results of a run whose traffic is kept: the latest."""


@dataclass
class ReportedRun:
    """A run: its description and its results so far."""

    run: str
    kind: str
    title: str
    unit: str
    planned: int
    begin_s: float
    results: list[str] = field(default_factory=list)
    """Results as JSON: each page that opens receives them all, and must not delay the links."""
    logs: deque[tuple[int, dict[str, Any]]] = field(default_factory=deque)
    """Results with their traffic and their places in `results`, oldest first."""
    end_s: float | None = None
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STATUSES, 0))

    def head(self) -> dict[str, Any]:
        """Return everything except the results."""
        return {key: value for key, value in vars(self).items() if key not in ("results", "logs")}

    def add(self, result: dict[str, Any]) -> None:
        """Count a result, and keep it if there is room."""
        self.counts[result["status"]] += 1
        if len(self.results) >= KEPT_RESULTS:
            return
        if "log" in result:
            self.logs.append((len(self.results), result))
        self.results.append(json.dumps(result))
        if len(self.logs) > KEPT_LOGS:
            place, oldest = self.logs.popleft()
            self.results[place] = json.dumps({key: value for key, value in oldest.items() if key != "log"})


class ReportedRuns:
    """The latest runs."""

    def __init__(self) -> None:
        self.changed: Final = Signal[dict[str, Any]]("runs")
        """Messages for pages."""
        self._runs: OrderedDict[str, ReportedRun] = OrderedDict()

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
        run = ReportedRun(
            run=str(event["run"])[:80],
            kind=str(event.get("kind", ""))[:40],
            title=str(event.get("title", ""))[:200],
            unit=str(event.get("unit", ""))[:200],
            planned=planned if isinstance(planned, int) and abs(planned) < LARGEST else 0,
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
        kept = _shortened(result)
        run.add(kept)
        self.changed.emit({"type": "result", "run": run.run, "counts": run.counts, "result": kept})

    def _find(self, event: dict[str, Any]) -> ReportedRun:
        run = self._runs.get(str(event["run"]))
        if run is None:
            raise EmulatorError("report: unknown run; report its begin first")
        return run

    def messages(self) -> Iterator[str]:
        """Yield the messages that describe all runs to a new page."""
        for run in self._runs.values():
            head = json.dumps({"type": "run", **run.head()})
            yield f'{head[:-1]}, "results": [{", ".join(run.results)}]}}'


def _shortened(result: dict[str, Any]) -> dict[str, Any]:
    """Return what a page shows of a reported result, with bounded lengths."""
    kept: dict[str, Any] = {key: str(result[key])[:most] for key, most in TEXTS.items() if key in result}
    seconds, lines = result.get("seconds"), result.get("log")
    if isinstance(seconds, (int, float)) and abs(seconds) < LARGEST:
        kept["seconds"] = seconds
    room, log = KEPT_LOG, deque[str]()
    for line in reversed(lines if isinstance(lines, list) else []):
        text = str(line)[:LONGEST_LINE]
        room -= len(text) + 1
        if room < 0:
            break
        log.appendleft(text)
    return {**kept, "log": list(log)} if log else kept
