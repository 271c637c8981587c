"""Run experiments: parts in parallel, none computed twice, every result stored in a file."""

from __future__ import annotations

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from starid.lab.experiments.comparison import Outcome, ReproduceError
from starid.lab.experiments.experiment import Context, Evaluation, Experiment, Part, Results
from starid.storage.child_processes import importing_only_what_is_installed
from starid.storage.files import write_atomically
from starid.storage.results import read_results, write_results

OUTCOME_FILE: Final = "outcome.json"

Progress = Callable[[str, int, int], None]
"""Called with the name of the experiment, the number of parts done and the total."""


@dataclass(frozen=True, slots=True)
class FinishedExperiment:
    """An experiment that has been run, its outcome, and what it cost.

    `seconds` is the processor time for its parts, summed over the processes, and for its tables and figures; `parts`
    the number of parts computed, 0 if all results were stored already.
    """

    experiment: Experiment
    outcome: Outcome
    seconds: float
    parts: int


@dataclass(frozen=True, slots=True)
class _Plan:
    experiment: Experiment
    context: Context
    parts: tuple[Part, ...]

    def file(self, part: Part) -> Path:
        mark = self.experiment.fingerprint(self.context.parameters, self.context.seed, part)
        return self.context.folder / "parts" / f"{part.key}-{mark}.npz"

    @property
    def fingerprint(self) -> str:
        return self.experiment.fingerprint(self.context.parameters, self.context.seed)

    @property
    def alone(self) -> bool:
        """Whether to run it alone because times are checked, which the quick run does not do."""
        return self.experiment.alone and not self.context.quick


def _plan(experiment: Experiment, folder: Path, *, quick: bool, seed: int) -> _Plan:
    name, parameters = experiment.name, experiment.parameters(quick=quick)
    context = Context(folder / name, folder / "databases", name, seed, parameters, quick)
    parts = tuple(experiment.parts(parameters))
    if len({part.key for part in parts}) != len(parts):
        raise ReproduceError(f"reproduce: {experiment.name} has two parts of the same name")
    return _Plan(experiment, context, parts)


def _processor_time() -> float:
    """Processor time of this process and of the children it has waited for, seconds."""
    return sum(os.times()[:4])


def _run_part(plan: _Plan, part: Part) -> tuple[str, float]:
    """Compute and store a part; return the name of the experiment and the processor time, seconds."""
    start = _processor_time()
    results = plan.experiment.compute(plan.context, part)
    seconds = _processor_time() - start

    write_results(plan.file(part), {**results, "seconds_": np.array(seconds)})
    return plan.experiment.name, seconds


def _load_part(path: Path) -> tuple[Results, float]:
    results = read_results(path, "reproduce")
    if "seconds_" not in results:
        raise ReproduceError(f"reproduce: {path} is not complete; remove it to compute it again")
    return results, float(results.pop("seconds_"))


def _stored_outcome(plan: _Plan) -> FinishedExperiment | None:
    """Return the stored outcome, if it is for the same parameters and all its files exist."""
    path = plan.context.folder / OUTCOME_FILE
    try:
        stored: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ReproduceError(
            f"reproduce: {path} cannot be read ({error}); remove it to compute it again"
        ) from error
    if stored["fingerprint"] != plan.fingerprint:
        return None
    outcome = Outcome.from_dict(stored["outcome"])
    if not all((plan.context.folder / name).exists() for name in outcome.files):
        return None
    return FinishedExperiment(plan.experiment, outcome, float(stored["seconds"]), 0)


def _evaluate_plan(plan: _Plan, computed: int) -> FinishedExperiment:
    start = _processor_time()
    results: dict[str, Results] = {}
    seconds = 0.0
    for part in plan.parts:
        results[part.key], spent = _load_part(plan.file(part))
        seconds += spent
    plan.context.folder.mkdir(parents=True, exist_ok=True)
    # tables and figures are overwritten, so an outcome for other parameters is no longer valid
    (plan.context.folder / OUTCOME_FILE).unlink(missing_ok=True)
    evaluation = Evaluation(plan.context, plan.parts, results)
    plan.experiment.evaluate(evaluation)
    outcome = evaluation.outcome()
    seconds += _processor_time() - start
    content = {
        "fingerprint": plan.fingerprint,
        "seconds": round(seconds, 3),
        "outcome": dataclasses.asdict(outcome),
    }
    text = json.dumps(content, indent=1, ensure_ascii=False)
    write_atomically(plan.context.folder / OUTCOME_FILE, lambda path: path.write_text(text, encoding="utf-8"))
    return FinishedExperiment(plan.experiment, outcome, seconds, computed)


def run(
    experiments: Sequence[Experiment],
    folder: Path,
    *,
    quick: bool = False,
    seed: int = 1,
    jobs: int = 2,
    progress: Progress | None = None,
) -> list[FinishedExperiment]:
    """Run experiments; results in `folder` for the same parameters are reused.

    Results do not depend on `jobs`, the number of processes. Experiments that measure time run afterwards, one part at
    a time, unless `quick`. `progress` is called whenever a part is finished.

    Raises
    ------
    ReproduceError
        A stored result cannot be read, or an experiment has no quick form.
    """
    from joblib import Parallel, delayed

    plans = [_plan(experiment, folder, quick=quick, seed=seed) for experiment in experiments]
    finished = {plan.experiment.name: _stored_outcome(plan) for plan in plans}
    open_plans = [plan for plan in plans if finished[plan.experiment.name] is None]
    todo = [(plan, part) for plan in open_plans for part in plan.parts if not plan.file(part).exists()]
    missing = Counter(plan.experiment.name for plan, _ in todo)
    left, done = missing.copy(), 0

    def end(plan: _Plan) -> None:
        finished[plan.experiment.name] = _evaluate_plan(plan, missing[plan.experiment.name])

    for plan in open_plans:
        if missing[plan.experiment.name] == 0:
            end(plan)
    by_name = {plan.experiment.name: plan for plan in open_plans}
    todo.sort(key=lambda task: task[0].experiment.start_order)
    for alone in (False, True):
        tasks = [(plan, part) for plan, part in todo if plan.alone == alone]
        work = (delayed(_run_part)(plan, part) for plan, part in tasks)
        parallel = Parallel(n_jobs=1 if alone else jobs, return_as="generator_unordered", batch_size=1)
        with importing_only_what_is_installed():
            for name, _ in parallel(work):
                done += 1
                left[name] -= 1
                if progress is not None:
                    progress(name, done, len(todo))
                if left[name] == 0:
                    end(by_name[name])
    return [result for plan in plans if (result := finished[plan.experiment.name]) is not None]


def finished_in(
    folder: Path, experiments: Sequence[Experiment], *, quick: bool, seed: int
) -> list[FinishedExperiment]:
    """Load the outcomes stored in a folder for these parameters and this seed; compute nothing."""
    stored = (
        _stored_outcome(_plan(experiment, folder, quick=quick, seed=seed))
        for experiment in experiments
        if not quick or experiment.quick is not None
    )
    return [each for each in stored if each is not None]
