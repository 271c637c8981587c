"""Run a session script on a bench, step by step over each link."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from starhil.hil_tests.bench import Bench
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.interruption import Interrupted
from starhil.hil_tests.results import FAILED, PASSED, SKIPPED, SessionResult, StepResult
from starhil.hil_tests.script import Script
from starhil.hil_tests.steps import Attempt, Session, Step
from starhil.hil_tests.truth_log import TruthLogReader
from starhil.protocol.errors import ProtocolError


class SessionRunner:
    """Runs a script on a bench.

    The emulator of the bench has been started; `folder` gets CSV and image files; `truth_path` is a file of true
    attitudes instead of the script's.
    """

    def __init__(
        self,
        script: Script,
        bench: Bench,
        folder: Path,
        *,
        on_result: Callable[[StepResult], None] = lambda _result: None,
        truth_path: Path | None = None,
    ) -> None:
        self._script = script
        self._bench = bench
        self._on_result = on_result
        if truth_path is None and script.truth.file is not None:
            truth_path = folder / script.truth.file
        truth = script.truth.attitude if truth_path is None else TruthLogReader(truth_path)
        self._session = Session(bench, folder, truth)

    def run(self) -> SessionResult:
        """Run all steps; after a failed one skip the others, unless the script sets `keep_going`.

        A signal, whether during a step or while a result is shown, ends the run; the results of earlier steps
        are kept.
        """
        begin = time.monotonic()
        planned = self._script.planned(self._bench.links)
        results: list[StepResult] = []
        interruption = None

        def record(result: StepResult) -> None:
            results.append(result)
            self._on_result(result)

        def skip_rest(reason: str) -> None:
            for step, link in planned[len(results) :]:
                record(StepResult(step.number, step.name, link, SKIPPED, reason, 0.0))

        try:
            for step, link in planned:
                record(self._run_step(step, link))
                if results[-1].status == FAILED and not self._script.defaults.keep_going:
                    break
            skip_rest("an earlier step failed")
        except Interrupted as signalled:
            interruption = signalled
            skip_rest(f"not run: {signalled.reason}")
        return SessionResult(self._script.title, tuple(results), time.monotonic() - begin, interruption)

    def _run_step(self, step: Step, link: str) -> StepResult:
        begin = self._session.step_begin_s = time.monotonic()
        if link and link not in self._bench.links:
            detail = f"needs a {link} link, the session has {' and '.join(self._bench.links)}"
            return StepResult(step.number, step.name, link, SKIPPED, detail, 0.0)
        for log in self._bench.logs.values():
            log.note(f"step {step.number}: {step.name}")
        attempt = Attempt()
        for turn in range(step.repeat):
            if turn:
                time.sleep(step.pause_s)
            attempt = self._try_until_passed(step, link)
            if attempt.problem is not None:
                if step.repeat > 1:
                    attempt.problem = f"time {turn + 1} of {step.repeat}: {attempt.problem}"
                break
        return StepResult(
            step.number,
            step.name,
            link,
            PASSED if attempt.problem is None else FAILED,
            attempt.detail if attempt.problem is None else attempt.problem,
            time.monotonic() - begin,
            attempt.latency_s,
            attempt.values,
            attempt.figures,
        )

    def _try_until_passed(self, step: Step, link: str) -> Attempt:
        """Try an action once, or repeatedly until its expectations hold or its time is over."""
        deadline = None if step.within_s is None else time.monotonic() + step.within_s
        while True:
            attempt = self._try_once(step, link)
            if attempt.problem is None or deadline is None:
                return attempt
            if time.monotonic() >= deadline:
                attempt.problem = f"not within {step.within_s:g} s: {attempt.problem}"
                return attempt
            time.sleep(min(step.pause_s, max(0.0, deadline - time.monotonic())))

    def _try_once(self, step: Step, link: str) -> Attempt:
        try:
            attempt = step.run(self._session, link)
        except (BenchError, ProtocolError) as error:
            return Attempt(problem=str(error))
        limit = step.max_latency_s
        if attempt.problem is None and limit is not None and (attempt.latency_s or 0.0) > limit:
            attempt.problem = f"latency {attempt.latency_s or 0.0:.4f} s, expected at most {limit:g} s"
        if attempt.problem is None:
            captured = {name: attempt.values[key] for name, key in step.capture.items()}
            self._session.captured.update(captured)
        return attempt
