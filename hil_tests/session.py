"""Run a session script on a bench, step by step over each link."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

from starhil.hil_tests import script as scripts
from starhil.hil_tests.bench import Bench
from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.errors import BenchError, NackError
from starhil.hil_tests.expect import AttitudeCheck, resolve, show, show_angle
from starhil.hil_tests.images import write_png
from starhil.hil_tests.interruption import Interrupted
from starhil.hil_tests.load_figures import percentile
from starhil.hil_tests.raw_traffic import matches, send_and_listen
from starhil.hil_tests.results import FAILED, PASSED, SKIPPED, SessionResult, StepResult, summarize
from starhil.hil_tests.script import Script, Step
from starhil.hil_tests.transactions import Ack, Reading
from starhil.hil_tests.truth_log import TruthLogReader
from starhil.protocol.errors import ProtocolError
from starhil.protocol.values import Value

MS_PER_S: Final = 1e3
CLOCK_GRAIN_S: Final = 1e-6


Answer = TypeVar("Answer", Ack, Reading)


@dataclass
class Attempt:
    """Outcome of one attempt of a step; `problem` is None if it passed, otherwise what was wrong."""

    problem: str | None = None
    detail: str = ""
    """What was observed."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """Telemetry read."""
    figures: dict[str, float] = field(default_factory=dict)
    """Computed numbers."""
    latency_s: float | None = None
    """Largest latency, s."""


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
        self._folder = folder
        self._on_result = on_result
        self._captured: dict[str, Value] = {}
        self._step_begin_s = 0.0
        path = truth_path
        if path is None and script.truth.file is not None:
            path = folder / script.truth.file
        self._truth_log = None if path is None else TruthLogReader(path)

    def run(self) -> SessionResult:
        """Run all steps; after a failed one skip the others, unless the script sets `keep_going`.

        A signal, whether during a step or while a result is shown, ends the run; the results of earlier steps
        are kept.
        """
        begin = time.monotonic()
        planned = [(step, link) for step in self._script.steps for link in self._links_of(step)]
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

    def _links_of(self, step: Step) -> tuple[str, ...]:
        if isinstance(step, scripts.Wait | scripts.Restart | scripts.Control):
            return ("",)
        wanted = step.link or self._script.defaults.link
        if wanted == "both":
            return self._bench.links
        return (wanted or self._bench.links[0],)

    # --- one step ---

    def _run_step(self, step: Step, link: str) -> StepResult:
        begin = self._step_begin_s = time.monotonic()
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
            attempt = self._perform(step, link)
        except (BenchError, ProtocolError) as error:
            return Attempt(problem=str(error))
        limit = step.max_latency_s
        if attempt.problem is None and limit is not None and (attempt.latency_s or 0.0) > limit:
            attempt.problem = f"latency {attempt.latency_s or 0.0:.4f} s, expected at most {limit:g} s"
        if attempt.problem is None:
            self._captured.update({name: attempt.values[key] for name, key in step.capture.items()})
        return attempt

    def _perform(self, step: Step, link: str) -> Attempt:
        match step:
            case scripts.Wait():
                time.sleep(step.seconds)
                return Attempt()
            case scripts.Restart():
                self._bench.restart(step.signal)
                return Attempt(detail="ready again")
            case scripts.Control():
                return Attempt(detail=json.dumps(self._bench.control(step.action, step.keys)))
            case scripts.Command():
                return self._command(step, self._bench.client(link))
            case scripts.Read():
                return self._read(step, self._bench.client(link))
            case scripts.Listen():
                return self._listen(step, self._bench.client(link))
            case scripts.Sample():
                return self._sample(step, self._bench.client(link))
            case scripts.SetParameter():
                return self._set_parameter(step, self._bench.client(link))
            case scripts.GetParameter():
                return self._compare(step, self._bench.client(link).read_parameter(step.parameter.name))
            case scripts.DownloadImage():
                return self._download(step, self._bench.client(link))
            case scripts.Send():
                return self._send(step, self._bench.client(link))
            case _:
                raise TypeError(f"{type(step).__name__}: no such step")

    # --- actions ---

    def _command(self, step: scripts.Command, client: ObcClient) -> Attempt:
        row, data = step.row, step.raw
        if data is None:
            variables = self._variables()
            values = {
                name: _whole_as_integer(resolve(value, variables)) for name, value in step.values.items()
            }
            data = row.encode(values, check=step.refused is None)
        return self._exchange(step.refused, client.command_raw, row.name, data, **_patience(step))[0]

    def _set_parameter(self, step: scripts.SetParameter, client: ObcClient) -> Attempt:
        parameter = step.parameter
        value = resolve(step.value, self._variables())
        checked = step.refused is None
        attempt, ack = self._exchange(
            step.refused, client.set_parameter, parameter.name, value, **_patience(step), checked=checked
        )
        if ack is not None and checked:
            seen = client.get_parameter(parameter.name)
            wanted = parameter.check(value)
            if seen != wanted and not (
                isinstance(seen, float) and abs(seen - float(wanted)) <= 1e-6 * abs(seen)
            ):
                attempt.problem = f"{parameter.name} reads back as {show(seen)}, expected {show(wanted)}"
            attempt.detail = f"{parameter.name}={show(seen)}"
        return attempt

    def _read(self, step: scripts.Read, client: ObcClient) -> Attempt:
        attempt, reading = self._exchange(step.refused, client.read, step.row.name, **_patience(step))
        return attempt if reading is None or attempt.problem else self._compare(step, reading)

    @staticmethod
    def _exchange(
        refused: str | None, send: Callable[..., Answer], *arguments: Any, **options: Any
    ) -> tuple[Attempt, Answer | None]:
        """Send a request that must be accepted, or refused with the code named by `refused`; return its answer too."""
        try:
            answer = send(*arguments, **options)
        except NackError as error:
            if refused is None:
                raise
            if error.code_name != refused:
                problem = f"refused with {error.code} ({error.code_name}), expected {refused}"
                return Attempt(problem=problem), None
            return Attempt(detail=f"refused with {error.code} ({refused}), as expected"), None
        if refused is not None:
            return Attempt(problem=f"accepted, expected to be refused with {refused}"), answer
        return Attempt(detail="accepted", latency_s=answer.latency_s), answer

    def _listen(self, step: scripts.Listen, client: ObcClient) -> Attempt:
        """Judge the next messages since the begin of the step that no earlier attempt has judged."""
        attempt = Attempt()
        times: list[float] = []
        for _ in range(step.count):
            reading = client.wait_unsolicited(
                step.row.name,
                timeout_s=step.timeout_s or self._script.defaults.timeout_s,
                since_s=self._step_begin_s,
            )
            times.append(reading.received_s)
            attempt = self._compare(step, reading)
            if attempt.problem is not None:
                return attempt
        attempt.latency_s = None
        if step.count > 1:  # without the wait for the first reading
            attempt.figures["rate_hz"] = (step.count - 1) / max(times[-1] - times[0], CLOCK_GRAIN_S)
        return attempt

    def _sample(self, step: scripts.Sample, client: ObcClient) -> Attempt:
        path = self._folder / step.file
        fields = list(step.row.named_fields)
        latencies: list[float] = []
        crosses: list[float] = []
        problems: list[str] = []
        count = 0
        last = Attempt()
        begin = time.monotonic()
        with path.open("w", newline="", encoding="utf-8", buffering=1) as stream:
            writer = csv.writer(stream)
            writer.writerow(["obc_time_s", "latency_ms", *fields])
            while time.monotonic() - begin < step.for_s or count == 0:
                reading = client.read(step.row.name, **_patience(step))
                values = [_csv_text(reading[name]) for name in fields]
                writer.writerow(
                    [f"{reading.received_unix_s:.6f}", f"{reading.latency_s * MS_PER_S:.3f}", *values]
                )
                count += 1
                latencies.append(reading.latency_s)
                last = self._compare(step, reading)
                if last.problem is not None:
                    problems.append(last.problem)
                crosses += [last.figures[key] for key in ("cross_boresight_arcsec",) if key in last.figures]
                time.sleep(max(0.0, begin + count * step.every_s - time.monotonic()))
        good = count - len(problems)
        good_share = good / count
        figures = {
            "samples": float(count),
            "good_share": good_share,
            "latency_p50_ms": percentile(latencies, 0.5) * MS_PER_S,
            "latency_p99_ms": percentile(latencies, 0.99) * MS_PER_S,
        }
        if crosses:
            figures["cross_boresight_median_arcsec"] = percentile(crosses, 0.5)
            figures["cross_boresight_max_arcsec"] = max(crosses)
        measured = [f"{name}={v:.4g}" for name, v in figures.items() if name not in ("samples", "good_share")]
        detail = f"{count} samples in {step.file}, {good} good, {' '.join(measured)}"
        problem = None
        if good_share < step.at_least:
            problem = f"{len(problems)} of {count} samples did not meet the expectations; the last one: {problems[-1]}"
        elif count < step.min_samples:
            problem = (
                f"only {count} samples arrived in {step.for_s:g} s, expected at least {step.min_samples}"
            )
        return Attempt(problem, detail, last.values, figures, max(latencies))

    def _download(self, step: scripts.DownloadImage, client: ObcClient) -> Attempt:
        image = client.download_image(step.size, method=step.method)
        write_png(self._folder / step.file, image.pixels, image.width, image.height)
        figures = {
            "seconds": image.seconds,
            "bytes": float(image.bytes_received),
            "repeats": float(image.repeats),
        }
        levels = sorted(set(image.pixels))
        detail = f"{image.width}x{image.height} in {image.seconds:.2f} s → {step.file}"
        problem = None if len(levels) > 1 else f"{detail}: the image is blank (all pixels {levels[0]})"
        return Attempt(problem, detail, {}, figures)

    @staticmethod
    def _send(step: scripts.Send, client: ObcClient) -> Attempt:
        wanted = step.answer or ()
        seen = send_and_listen(client, step.data, step.listen_s, wanted, step.timeout_s)
        shown = ", ".join(text for text in seen if text) or "nothing"
        if step.answer is None:
            return Attempt(detail=f"came back: {shown}")
        if client.core.link.name == "serial":
            wanted = ("".join(wanted),)
        if len(seen) == len(wanted) and all(matches(a, b) for a, b in zip(wanted, seen, strict=True)):
            return Attempt(detail=f"came back: {shown}, as expected")
        return Attempt(problem=f"came back: {shown}, expected {', '.join(filter(None, wanted)) or 'nothing'}")

    # --- judging ---

    def _compare(self, step: Step, reading: Reading) -> Attempt:
        attempt = Attempt(
            detail=summarize(reading.values), values=reading.values, latency_s=reading.latency_s or None
        )
        variables = self._variables()
        problems = [
            text
            for field, wanted in step.expect.items()
            if (text := wanted.mismatch(field, reading[field], variables)) is not None
        ]
        if step.expect and not problems:
            attempt.detail = " ".join(f"{field}={show(reading[field])}" for field in step.expect)
        if step.attitude is not None and not problems:
            problems += self._judge_attitude(step, step.attitude, reading, attempt)
        attempt.problem = "; ".join(problems) or None
        return attempt

    def _judge_attitude(
        self, step: Step, check: AttitudeCheck, reading: Reading, attempt: Attempt
    ) -> list[str]:
        truth = check.attitude or self._script.truth.attitude
        if truth is None:
            if self._truth_log is None:
                raise BenchError(f"step {step.number}: no truth to compare the attitude with")
            if "time_of_exposure" not in reading.values:
                raise BenchError(f"step {step.number}: {reading.name} has no time; read precise_attitude")
            truth = self._truth_log.at(float(reading["time_of_exposure"]))
        error, problem = check.judge(reading.values, truth, self._bench.icd.conventions)
        if error is not None:
            attempt.figures.update(vars(error))
            attempt.detail += f" error: {show_angle(error.cross_boresight_arcsec)} cross, {show_angle(error.roll_arcsec)} roll"
        return [] if problem is None else [problem]

    def _variables(self) -> dict[str, Value]:
        now = time.time()
        return {**self._captured, "now": now, "now_s": int(now), "now_ms": int(now % 1.0 * MS_PER_S)}


def _patience(step: Step) -> dict[str, Any]:
    """Return how long and how often the client asks."""
    return {"timeout_s": step.timeout_s, "retries": step.retries}


def _whole_as_integer(value: Value) -> Value:
    """Convert a float with an integer value, such as a captured one, to an integer."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _csv_text(value: Value) -> str:
    """Format a value for a CSV file, with all digits."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value)
    return value.hex() if isinstance(value, bytes) else str(value)
