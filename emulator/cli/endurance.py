"""`starhil endurance`: random lives of units in simulated time, judged by an oracle."""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import resource
import shlex
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import Jobs, names_of
from starhil.emulator.cli.output import compiles
from starhil.emulator.errors import EmulatorError
from starhil.hil_tests.rig.interruption import Interrupted, interruptible
from starhil.protocol.files.bundled import bundled_units
from starid.cli.options import AsJson
from starid.cli.output import progress_shown
from starid.storage.child_processes import importing_only_what_is_installed

IN_MEMORY: Final = Path("/dev/shm")  # noqa: S108 (a folder of its own is made there)
"""Folder for the state of the units, if there is one: a stored parameter then costs no time on a disk."""
RENDERED_STEPS: Final = 40
"""Steps of a life whose images are rendered."""
LONG_STEPS: Final = 150
SIGMA_ARCSEC: Final = {False: (10.0, 33.0), True: (60.0, 300.0)}
"""Largest standard deviations across and about the boresight of the error model, and of rendered images."""
YEAR_S: Final = 365.25 * 86_400.0


@dataclass(frozen=True)
class PlanOptions:
    """The lives of a run."""

    unit: Annotated[
        list[str] | None,
        typer.Option(
            help="Unit: a name or a folder. Repeatable; default: all bundled units in turns.",
            autocompletion=names_of("unit"),
        ),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first life; the others follow.")] = 1
    lives: Annotated[int, typer.Option(min=1, help="Number of lives.")] = 60
    hours: Annotated[
        float | None, typer.Option(min=0.001, help="Start lives for this time instead of a number of them.")
    ] = None
    steps: Annotated[int, typer.Option(min=1, help="Steps of a life.")] = 400
    rendered: Annotated[
        int, typer.Option(min=0, help="One life in this number is rendered and solved; 0: none.")
    ] = 97
    long: Annotated[int, typer.Option(min=0, help="One life in this number lasts for months; 0: none.")] = 25
    jobs: Jobs = 1

    def plan(self) -> Iterator[tuple[str, int, int, str]]:
        """Generate unit, seed, steps and kind of each life; a kind has a period, in which its last life is of it."""
        units = self.unit or sorted(bundled_units())
        kinds = {"rendered": (self.rendered, RENDERED_STEPS), "long": (self.long, LONG_STEPS)}
        kinds["usual"] = (1, self.steps)
        for number in itertools.count() if self.hours is not None else range(self.lives):
            kind, steps = next(
                (name, steps)
                for name, (period, steps) in kinds.items()
                if period and not (number + 1) % period
            )
            yield units[number % len(units)], self.seed + number, steps, kind


@compiles
@with_option_groups
def command(
    *,
    plan: PlanOptions,
    life: Annotated[
        Path | None,
        typer.Option(
            help="Repeat one life, a file that an earlier run has written, with the unit of --unit if given."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for lives that end in a violation.")
    ] = Path("out/endurance"),
    as_json: AsJson = False,
) -> None:
    """Run units through random operation in simulated time, and check everything on the bus against an independent model.

    Each run of a unit, a *life*, has valid and invalid requests on every link, faults, resets, power cycles, full disks and
    tumbles. One that violates the interface definition is shortened and written to -o, with a session and a recording that
    repeat it; the exit status is then 1.
    """
    if life is not None:
        from starhil.emulator.cli.life_file import read_life
        from starhil.protocol.unit import check_runs_no_code

        script, again = read_life(life), f"--life {shlex.quote(str(life))}"
        if plan.unit:
            (unit, *_) = plan.unit
            script, again = replace(script, unit=unit), f"{again} --unit {shlex.quote(unit)}"
        else:
            check_runs_no_code(script.unit, f"--life {life}")
        outcomes, interruption = [{**live(script, output), "repeat": again}], None
    else:
        outcomes, interruption = _ended_lives(_run(plan, output))
    figures = {"seed": plan.seed, **summary(outcomes)}
    if as_json:
        print(json.dumps({**figures, "violations": [item for item in outcomes if item["violation"]]}))
    else:
        _print(figures, outcomes)
    if interruption is not None:
        print(f"endurance: {interruption.reason}; lives that had not ended are not counted", file=sys.stderr)
        raise typer.Exit(interruption.exit_status)
    if any(item["violation"] for item in outcomes):
        raise typer.Exit(1)


def _ended_lives(
    running: Generator[dict[str, Any], None, None],
) -> tuple[list[dict[str, Any]], Interrupted | None]:
    """Collect the outcomes of lives until all have ended, or a signal interrupts them."""
    outcomes: list[dict[str, Any]] = []
    try:
        with interruptible(), closing(running):
            outcomes.extend(running)
    except Interrupted as interruption:
        return outcomes, interruption
    return outcomes, None


def _run(plan: PlanOptions, folder: Path) -> Generator[dict[str, Any], None, None]:
    """Run the lives of a plan in processes, until its end or that of the time."""
    context = get_context("spawn")
    try:
        with importing_only_what_is_installed():
            context.Lock()
    except OSError as error:
        raise EmulatorError(
            f"endurance: its processes need POSIX semaphores, which are not available ({error.strerror}): "
            "mount a tmpfs on /dev/shm"
        ) from None
    begin, lives = time.monotonic(), plan.plan()
    limit_s = None if plan.hours is None else plan.hours * 3600.0
    with (
        importing_only_what_is_installed(),
        ProcessPoolExecutor(plan.jobs, mp_context=context) as pool,
        progress_shown("endurance, lives" if limit_s is None else "endurance, seconds") as show,
    ):
        running: set[Future[dict[str, Any]]] = set()
        done = 0
        try:
            while True:
                in_time = limit_s is None or time.monotonic() - begin < limit_s
                while in_time and len(running) < 2 * plan.jobs and (item := next(lives, None)) is not None:
                    running.add(pool.submit(live_from_seed, *item, folder))
                if not running:
                    return
                ended, running = wait(running, return_when=FIRST_COMPLETED)
                done += len(ended)
                if limit_s is None:
                    show(done, plan.lives)
                else:
                    show(min(time.monotonic() - begin, limit_s), limit_s)
                for future in ended:
                    yield future.result()
        except (
            BaseException
        ):  # the pool would wait for lives that have begun; a signal also closes this generator
            for process in active_children():
                process.terminate()
            raise


def live_from_seed(unit: str, seed: int, steps: int, kind: str, folder: Path) -> dict[str, Any]:
    from starhil.emulator.launch.unit_in_memory import links_of
    from starhil.hil_tests.endurance.life import make_life
    from starhil.hil_tests.judge.definition import unit_of
    from starhil.protocol.unit import load_unit

    icd = load_unit(unit)
    life = make_life(
        unit_of(icd),
        unit,
        links_of(icd),
        seed,
        steps,
        is_long=kind == "long",
        rendered=kind == "rendered",
    )
    repeat = f"--unit {shlex.quote(unit)} --seed {seed} --lives 1"
    kinds = f"--rendered {int(kind == 'rendered')} --long {int(kind == 'long')}"
    length = f" --steps {steps}" if kind == "usual" else ""
    return {**live(life, folder), "repeat": f"{repeat} {kinds}{length}"}


def live(life: Any, folder: Path) -> dict[str, Any]:
    """Live a life; if it ends in a violation, shorten it and write it to the folder."""
    from starhil.hil_tests.endurance.violating_life import kind_of, shortened

    logging.getLogger("starhil").addHandler(logging.NullHandler())
    logging.getLogger("starhil").propagate = False
    begin = time.process_time()
    outcome = run_once(life)
    figures = {
        "unit": life.unit, "seed": life.seed, "rendered": life.rendered, **asdict(outcome),
        "cpu_s": time.process_time() - begin,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }  # fmt: skip
    if outcome.violation:
        kind = kind_of(outcome.violation)
        upto = replace(life, steps=life.steps[: outcome.step + 1])
        short = (
            upto
            if life.rendered
            else shortened(upto, lambda other: kind_of(run_once(other).violation) == kind)
        )
        figures["steps"] = len(short.steps)
        figures["files"] = [str(path) for path in write_life(short, outcome.violation, folder)]
    return figures


def run_once(life: Any, *, record: Path | None = None) -> Any:
    from starhil.emulator.launch.simulated_loop import SimulatedLoop
    from starhil.emulator.launch.unit_in_memory import UnitUnderTest
    from starhil.hil_tests.endurance.run import LifeRun
    from starhil.hil_tests.judge.definition import unit_of
    from starhil.protocol.unit import load_unit

    icd = load_unit(life.unit)
    with tempfile.TemporaryDirectory(dir=IN_MEMORY if IN_MEMORY.is_dir() else None) as folder:
        loop = SimulatedLoop()
        asyncio.set_event_loop(loop)
        unit = UnitUnderTest(
            icd,
            life.unit,
            life.links,
            life.profile,
            life.seed,
            Path(folder),
            rendered=life.rendered,
            record=record,
        )
        try:
            return loop.run_until_complete(
                LifeRun(life, unit_of(icd), unit, SIGMA_ARCSEC[life.rendered]).run()
            )
        finally:
            unit.dispose()
            loop.close()
            asyncio.set_event_loop(None)


# --- files ---


def write_life(life: Any, violation: str, folder: Path) -> list[Path]:
    """Write a life as JSON, as a session, and as the recording of its last time under power, if that can be repeated."""
    from starhil.hil_tests.endurance.life import UNRECORDED_STEPS
    from starhil.hil_tests.endurance.violating_life import session_of
    from starhil.hil_tests.judge.definition import read_unit

    name = f"{Path(life.unit).name}-{life.seed}"
    file, session, recording = folder / f"{name}.json", folder / f"{name}.toml", folder / f"{name}-recording"
    _write(file, json.dumps({**asdict(life), "violation": violation}, indent=1) + "\n")
    _write(session, session_of(life, read_unit(life.unit), violation))
    if UNRECORDED_STEPS & {step["do"] for step in life.steps}:
        return [file, session]
    run_once(life, record=recording)
    return [file, session, recording]


def _write(path: Path, text: str) -> None:
    from starid.storage.files import write_atomically

    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


# --- figures ---


def summary(outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return device-years, counts and the ratio of device time to processor time, in all and by unit."""
    units = sorted({item["unit"] for item in outcomes})
    by_unit = {unit: _of([item for item in outcomes if item["unit"] == unit]) for unit in units}
    return {**_of(outcomes), "units": by_unit}


def _of(outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    names = ("device_s", "exposed_s", "cpu_s", "frames", "requests", "readings", "attitudes")
    total = {name: sum(item[name] for item in outcomes) for name in names}
    device_s, exposed_s, cpu_s = (total.pop(name) for name in names[:3])
    return {
        "lives": len(outcomes),
        "device_years": device_s / YEAR_S,
        "imaging_years": exposed_s / YEAR_S,
        "factor": device_s / max(cpu_s, 1e-9),
        "cpu_hours": cpu_s / 3600.0,
        **total,
        "violating": sum(bool(item["violation"]) for item in outcomes),
    }


def _print(figures: dict[str, Any], outcomes: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    formats = {
        "lives": "d", "device_years": ".3f", "imaging_years": ".3f", "frames": "d", "requests": "d", "attitudes": "d",
        "violating": "d",
    }  # fmt: skip
    table = Table("unit", *(name.removesuffix("_years").replace("_", " ") for name in formats), box=None)
    for name, row in [*figures["units"].items(), ("all", figures)]:
        table.add_row(name, *(format(row[key], text) for key, text in formats.items()))
    Console().print(table)
    print(
        f"Years under power, and taking images. Seed {figures['seed']}; {figures['cpu_hours']:.2f} h of processor time, "
        f"each second of which simulated {figures['factor']:.0f} s"
    )
    for item in outcomes:
        if item["violation"]:
            print(f"{item['unit']} seed {item['seed']}: {item['violation']}")
            print(f"  {item['steps']} steps; {' '.join(item['files'])}")
            print(f"  starhil endurance {item['repeat']}")
