"""Run the steps of a session script on a bench, each over its links."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from starhil.hil_tests.attitude import Quaternion
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.reports import FAILED, PASSED, SKIPPED
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.hil_tests.rig.rig import ControlledTruth, Rig
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.session.results import SessionResult, StepResult
from starhil.hil_tests.session.script import Script
from starhil.hil_tests.session.step import Attempt, SessionState, Step, TruthOverTime
from starhil.protocol.errors import ProtocolError


def run_steps(
    script: Script,
    rig: Rig,
    folder: Path,
    *,
    on_begin: Callable[[int, str], object] = lambda _number, _name: None,
    on_result: Callable[[StepResult], None] = lambda _result: None,
    truth_path: Path | None = None,
) -> SessionResult:
    """Run all steps; after a failed one skip the others, unless the script sets `keep_going`.

    `folder` gets CSV and image files; `truth_path` is a file of true attitudes instead of the script's truth. A signal,
    whether during a step or while a result is shown, ends the run; the results of earlier steps are kept.
    """
    truth: Quaternion | TruthOverTime | None = script.truth.attitude
    if truth_path is not None:
        truth = TruthLogReader(truth_path)
    elif truth is None and rig.has_control_of_another:
        truth = ControlledTruth(rig)
    elif script.truth.file is not None:
        truth = TruthLogReader(folder / script.truth.file)
    session = SessionState(rig, folder, truth)
    begin = time.monotonic()
    planned = script.planned(rig.links)
    results: list[StepResult] = []
    interruption = None

    def record(result: StepResult) -> None:
        results.append(result)
        on_result(result)

    def skip_rest(reason: str) -> None:
        for number, step, link in planned[len(results) :]:
            record(StepResult(number, step.name, link, SKIPPED, reason, 0.0))

    try:
        for number, step, link in planned:
            on_begin(number, step.name)
            record(_run_step(session, number, step, link))
            if results[-1].status == FAILED and not script.defaults.keep_going:
                break
        skip_rest("an earlier step failed")
    except Interrupted as signalled:
        interruption = signalled
        skip_rest(f"not run: {signalled.reason}")
    return SessionResult(script.title, tuple(results), time.monotonic() - begin, interruption)


def _run_step(session: SessionState, number: int, step: Step, link: str) -> StepResult:
    begin = session.step_begin_s = time.monotonic()
    links = session.rig.links
    if link and link not in links:
        detail = f"needs a {link} link, the session has {' and '.join(links)}"
        return StepResult(number, step.name, link, SKIPPED, detail, 0.0)
    for log in session.rig.logs.values():
        log.note(f"step {number}: {step.name}")
    attempt = Attempt()
    for turn in range(step.repeat):
        if turn:
            time.sleep(step.pause_s)
        attempt = _try_until_passed(session, step, link)
        if attempt.problem is not None:
            if step.repeat > 1:
                attempt.problem = f"time {turn + 1} of {step.repeat}: {attempt.problem}"
            break
    status, detail = (PASSED, attempt.detail) if attempt.problem is None else (FAILED, attempt.problem)
    found = attempt.latency_s, attempt.values, attempt.figures
    return StepResult(number, step.name, link, status, detail, time.monotonic() - begin, *found)


def _try_until_passed(session: SessionState, step: Step, link: str) -> Attempt:
    """Try an action once, or repeatedly until its expectations hold or its time is over."""
    begin = time.monotonic()
    problems: list[str] = []
    while True:
        attempt = _try_once(session, step, link)
        if step.within_s is None:
            return attempt
        if attempt.problem is None:
            if problems:
                held = f"after {time.monotonic() - begin:.2f} s"
                attempt.detail = f"{held}: {attempt.detail}" if attempt.detail else held
            return attempt
        problems.append(attempt.problem)
        deadline = begin + step.within_s
        if time.monotonic() >= deadline:
            attempt.problem = f"not within {step.within_s:g} s: {_of_attempts(problems)}"
            return attempt
        time.sleep(min(step.pause_s, max(0.0, deadline - time.monotonic())))


def _of_attempts(problems: Sequence[str]) -> str:
    """Return what was wrong in the first and the last attempt, and how many there were."""
    first, last = problems[0], problems[-1]
    if first == last:
        return last if len(problems) == 1 else f"{last} ({len(problems)} attempts; the first was the same)"
    return f"{last} (attempt {len(problems)}; the first: {first})"


def _try_once(session: SessionState, step: Step, link: str) -> Attempt:
    try:
        attempt = step.run(session, link)
    except (BenchError, ProtocolError) as error:
        return Attempt(problem=str(error))
    limit, latency = step.max_latency_s, attempt.latency_s or 0.0
    if attempt.problem is None and limit is not None and latency > limit:
        attempt.problem = f"latency {latency:.4f} s, expected at most {limit:g} s"
    if attempt.problem is None:
        session.captured.update({name: attempt.values[key] for name, key in step.capture.items()})
    return attempt
