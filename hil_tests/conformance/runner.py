"""Running conformance cases: which, in what order, and what came of each."""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from hil_tests.conformance.case import Case, CaseFailed, CaseSkipped
from hil_tests.conformance.link_probe import LinkProbe
from hil_tests.errors import BenchError
from hil_tests.results import FAILED, PASSED, SKIPPED
from protocol.errors import ProtocolError

RECOVERY_S: Final = 1.0
"""Pause after a failed case, for time-outs of the device to pass."""


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes
    ----------
    id, area, title, clause, intrusive
        Those of the case.
    status
        `passed`, `failed` or `skipped`.
    expected, seen
        Of a failed case; of a skipped one the reason is in `seen`.
    log
        What was sent and received, with times.
    """

    id: str
    area: str
    title: str
    clause: str
    intrusive: bool
    status: str
    expected: str
    seen: str
    seconds: float
    log: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON takes it; the log only where the case failed."""
        value = dict(vars(self))
        value["seconds"] = round(self.seconds, 4)
        value["log"] = list(self.log) if self.status == FAILED else []
        return value


def select_cases(
    cases: Iterable[Case[Any]], patterns: Sequence[str] = (), *, safe_only: bool = False
) -> list[Case[Any]]:
    """Return the cases whose identifier matches one of the patterns (`*` and `?`; a bare name takes what begins so).

    Raises
    ------
    BenchError
        A pattern matches none.
    """
    chosen = list(cases)
    if patterns:
        for pattern in patterns:
            if not any(_matches(item.id, pattern) for item in chosen):
                areas = ", ".join(sorted({item.area for item in chosen}))
                raise BenchError(f"no conformance case matches '{pattern}'; areas: {areas}")
        chosen = [item for item in chosen if any(_matches(item.id, pattern) for pattern in patterns)]
    return [item for item in chosen if not (safe_only and item.intrusive)]


def _matches(identifier: str, pattern: str) -> bool:
    return (
        identifier == pattern
        or identifier.startswith(pattern + ".")
        or fnmatch.fnmatchcase(identifier, pattern)
    )


def run_case(probe: LinkProbe, case: Case[Any]) -> Outcome:
    """Run one case on a serial line or on CAN."""
    status, expected, seen = PASSED, "", ""
    begin = time.perf_counter()
    probe.begin()
    try:
        case.run(probe)
        probe.end()
    except CaseFailed as failure:
        status, expected, seen = FAILED, failure.expected, failure.seen
    except CaseSkipped as reason:
        status, seen = SKIPPED, str(reason)
    except (BenchError, ProtocolError) as error:
        status, expected, seen = FAILED, "a case that can be carried out", str(error)
    seconds = time.perf_counter() - begin
    log = tuple(probe.log)
    if status == FAILED:
        probe.sleep(RECOVERY_S)
    return Outcome(
        case.id, case.area, case.title, case.clause, case.intrusive, status, expected, seen, seconds, log
    )


def run_cases(
    probe: LinkProbe,
    cases: Iterable[Case[Any]],
    on_outcome: Callable[[Outcome], None] = lambda _outcome: None,
) -> list[Outcome]:
    """Run cases in order."""
    outcomes = []
    for item in cases:
        outcome = run_case(probe, item)
        outcomes.append(outcome)
        on_outcome(outcome)
    return outcomes
