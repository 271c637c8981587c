"""`starid reproduce`: repeat the experiments of the thesis and compare the results with the published ones."""

from __future__ import annotations

import json
import time
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from starid.cli.options import AsJson
from starid.cli.output import prepare_folder, progress_shown


def command(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Experiments. Default: all.")
    ] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder for report.md, tables and figures, created if missing."),
    ] = Path("out/reproduce"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Run a subset that takes a few minutes, with its checks.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    list_only: Annotated[bool, typer.Option("--list", help="List the experiments and exit.")] = False,
    as_json: AsJson = False,
) -> None:
    """Repeat the experiments of the thesis that introduced the LSI and RSI algorithms.

    E. O. Özyurt, A Feedback Star Identification Algorithm via Regularized Pattern Recognition Using
    a Unique Feature Extraction, Istanbul Technical University. Writes tables, figures, and report.md
    with published and measured values.

    A second run in the same folder resumes the first and skips experiments finished with the same parameters.
    The report covers all finished experiments in the folder. The exit status is 1 if a check fails that is
    not known to fail; the report shows every failure.
    """
    from starid.lab.experiments.registry import experiments, select
    from starid.lab.experiments.report import CLASSES, summary, write_report
    from starid.lab.experiments.runner import finished_in, run

    if list_only:
        _list(as_json=as_json, titles={n: (e.title, e.quick is not None) for n, e in experiments().items()})
        return
    selection = select(names or [], quick=quick)
    import_module("matplotlib")  # before the work
    prepare_folder(output, "-o")
    start = time.perf_counter()
    with progress_shown("starting") as show:
        results = run(
            selection,
            output,
            quick=quick,
            seed=seed,
            jobs=jobs,
            progress=lambda name, done, total: show(done, total, name),
        )
    everything = finished_in(output, list(experiments().values()), quick=quick, seed=seed)
    report = write_report(everything, output, quick=quick, seed=seed)
    figures = {
        "report": str(report),
        "seed": seed,
        "quick": quick,
        "seconds": round(time.perf_counter() - start, 2),
        **summary(results),
    }
    if as_json:
        print(json.dumps(figures))
    else:
        for result in results:
            print(f"{result.experiment.name:<24} {result.seconds:7.1f} s")
        for kind, text in CLASSES.items():
            found = figures["classes"][kind]
            print(f"{found['met']} of {found['of']} {text}")
        for lost in figures["regressions"]:
            print(f"regression: {lost}")
        print(
            f"{figures['missed']} missed, {len(figures['regressions'])} of them regressions; "
            f"{figures['seconds']} s; report: {report}"
        )
    if figures["regressions"]:
        raise typer.Exit(1)


def _list(*, as_json: bool, titles: dict[str, tuple[str, bool]]) -> None:
    if as_json:
        print(json.dumps({name: {"title": title, "quick": quick} for name, (title, quick) in titles.items()}))
        return
    for name, (title, quick) in titles.items():
        print(f"{name:<24} {'quick  ' if quick else '       '}{title}")
