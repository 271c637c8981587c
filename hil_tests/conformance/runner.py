"""Selection and execution of conformance cases."""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Callable, Iterable, Sequence, Sized
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from starhil.hil_tests.conformance.case import Case, CaseFailed, CaseSkipped, Probe
from starhil.hil_tests.errors import BenchError, LinkLostError
from starhil.hil_tests.judge.headers import InexpressibleError
from starhil.hil_tests.reports import FAILED, NOT_RUN, PASSED, SKIPPED
from starhil.protocol.errors import ProtocolError

T = TypeVar("T")

Ending = CaseFailed | CaseSkipped | None
"""How a case or a part of it ended; None: it passed."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case, whose ID, area, title, clause and intrusiveness it has."""

    id: str
    area: str
    title: str
    clause: str
    intrusive: bool
    status: str
    """`passed`, `failed`, `skipped` or `not run`."""
    expected: str
    seen: str
    """Both set for a failed case; for a skipped case or one not run, `seen` has the reason."""
    seconds: float
    """Duration, with the recovery after a failure."""
    log: tuple[str, ...]
    """Sent and received traffic, with times."""

    @classmethod
    def of(cls, case: Case[Any], ending: Ending, seconds: float = 0.0, log: Sequence[str] = ()) -> Outcome:
        match ending:
            case CaseFailed():
                result = FAILED, ending.expected, ending.seen
            case CaseSkipped():
                result = SKIPPED, "", str(ending)
            case _:
                result = PASSED, "", ""
        return cls(case.id, case.area, case.title, case.clause, case.intrusive, *result, seconds, tuple(log))

    @property
    def detail(self) -> str:
        """What was expected and seen, or the reason, in one line; empty if the case passed."""
        return str(CaseFailed(self.expected, self.seen)) if self.status == FAILED else self.seen

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as JSON data, with the log only of a failed case."""
        value = dict(vars(self))
        value["seconds"] = round(self.seconds, 4)
        value["log"] = list(self.log) if self.status == FAILED else []
        return value


def select_cases(
    cases: Iterable[Case[Any]], patterns: Sequence[str] = (), *, safe_only: bool = False
) -> tuple[list[Case[Any]], list[Case[Any]]]:
    """Return the cases whose ID matches a pattern with `*` and `?`, or begins with a plain name: those to run, and those left out.

    Cases that change the device are left out if `safe_only`.

    Raises BenchError: a pattern matches no case, or none of its cases is left.
    """
    items = list(cases)
    selected: set[str] = set()
    for pattern in patterns or ("*",):
        matches = [item for item in items if _matches(item.id, pattern)]
        if not matches:
            areas = ", ".join(sorted({item.area for item in items}))
            raise BenchError(f"no conformance case matches '{pattern}'; areas: {areas}")
        if safe_only and all(item.intrusive for item in matches):
            raise BenchError(f"no case that matches '{pattern}' is run: {left_out_text(matches, matches)}")
        selected.update(item.id for item in matches)
    chosen = [item for item in items if item.id in selected]
    left_out = [item for item in chosen if safe_only and item.intrusive]
    return [item for item in chosen if not (safe_only and item.intrusive)], left_out


def left_out_text(left_out: Sized, chosen: Sized) -> str:
    """Return how many of the chosen cases are left out, why, and how to run them."""
    return f"{len(left_out)} of {len(chosen)} cases are left out, because they change the device; --intrusive runs them"


def _matches(case_id: str, pattern: str) -> bool:
    return case_id == pattern or case_id.startswith(pattern + ".") or fnmatch.fnmatchcase(case_id, pattern)


def run_case(probe: Probe, case: Case[Any]) -> Outcome:
    """Run a case on any link; any behaviour of device or link becomes an outcome."""
    probe.log.clear()

    def run() -> None:
        probe.begin(intrusive=case.intrusive)
        case.run(probe)

    begin = time.perf_counter()
    _, ending = _attempt(probe, run)
    _, after = _attempt(probe, lambda: probe.end(intrusive=case.intrusive, passed=ending is None))
    if isinstance(after, CaseFailed) and not isinstance(ending, CaseFailed):
        ending = after
    log = tuple(probe.log)
    if isinstance(ending, CaseFailed) and not isinstance(ending.__cause__, LinkLostError):
        _attempt(probe, probe.recover)
    return Outcome.of(case, ending, time.perf_counter() - begin, log)


def _attempt(probe: Probe, act: Callable[[], T]) -> tuple[T | None, Ending]:
    """Run a part of a case; return its result, and how it ended.

    Unexpected frames, such as an empty heartbeat, appear as exceptions in the code that decodes them; they
    fail the case.
    """
    try:
        return act(), None
    except (CaseFailed, CaseSkipped) as ending:
        return None, ending
    except (BenchError, ProtocolError) as error:
        failure = CaseFailed("a case that can be carried out", str(error))
        failure.__cause__ = error
        return None, failure
    except InexpressibleError as error:
        return None, CaseSkipped(f"no message of this link can express what the case sends: {error}")
    except (LookupError, ValueError) as error:
        last = next((line for line in reversed(probe.log) if " <- " in line), "nothing")
        seen = f"{last.partition(' <- ')[2] or last} ({type(error).__name__}: {error})"
        return None, CaseFailed("an answer that can be read", seen)


def identity_of(probe: Probe) -> str:
    """Return what a device reports of its identity; empty if it reports nothing."""
    return _attempt(probe, probe.identity)[0] or ""


def run_cases(
    probe: Probe,
    cases: Iterable[Case[Any]],
    on_outcome: Callable[[Outcome], None] = lambda _outcome: None,
    *,
    port: str = "the link",
) -> list[Outcome]:
    """Run the cases of one link in order.

    If the device does not answer, a failed outcome names the port, and the remaining cases are not run. The
    settings are recorded before the first case that changes them, and restored after the last one, also when
    the run is interrupted. Only a failure to do so adds an outcome.
    """
    waiting = list(cases)
    outcomes: list[Outcome] = []

    def record(outcome: Outcome) -> None:
        outcomes.append(outcome)
        on_outcome(outcome)

    def report_trouble(what: str, title: str, act: Callable[[], None]) -> None:
        _, ending = _attempt(probe, act)
        if isinstance(ending, CaseFailed):
            record(Outcome.of(case_of_run(f"{link}.{what}", title), ending, log=probe.log))

    if not waiting:
        return outcomes
    link = waiting[0].id.partition(".")[0]
    probe.log.clear()
    mute = _failure_if_silent(probe, port, booting=False)
    intrusive = mute is None and any(item.intrusive for item in waiting)
    if intrusive:
        report_trouble("settings.found", "the settings can be read before the first case", probe.prepare)
    try:
        while waiting and mute is None:
            outcome = run_case(probe, waiting.pop(0))
            record(outcome)
            if outcome.status == FAILED and waiting:
                mute = _failure_if_silent(probe, port, booting=intrusive)
    finally:
        if intrusive:
            probe.log.clear()
            report_trouble("settings.kept", "the settings are restored after the last case", probe.restore)
    if mute is not None:
        record(Outcome.of(case_of_run(f"{link}.answers", "the device answers"), mute, log=probe.log))
        for item in waiting:
            record(not_run(item, mute.seen))
    return outcomes


def not_run(item: Case[Any], reason: str) -> Outcome:
    return replace(Outcome.of(item, CaseSkipped(f"not run: {reason}")), status=NOT_RUN)


def case_of_run(case_id: str, title: str, clause: str = "starhil conformance") -> Case[Any]:
    """Return a case for an outcome of the run itself; it has no check."""
    return Case(case_id, case_id.rpartition(".")[0], title, clause, lambda _probe: None)


def _failure_if_silent(probe: Probe, port: str, *, booting: bool) -> CaseFailed | None:
    """Return the failure of a device that does not answer; None if it answers or the link was lost."""
    seen, _ = _attempt(probe, lambda: probe.silence(booting=booting))
    if seen is None:
        return None
    what = f"nothing answers on {port}" if seen == "nothing" else f"no valid answer on {port}: {seen}"
    return CaseFailed("an answer to a request", what)
