"""`starhil bench`: measurements of speed and accuracy, each with the command that makes it."""

from __future__ import annotations

from typing import Annotated

import typer

group = typer.Typer(help="Measure speed, latency and accuracy.", no_args_is_help=True)


@group.command("latency")
def latency(
    rates: Annotated[
        list[float] | None, typer.Option("--rate", help="Update rate, Hz; 0 is standby. May be repeated.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for each rate.")] = 15.0,
    workers: Annotated[
        list[str] | None, typer.Option("--worker", help="process or thread. May be repeated.")
    ] = None,
    json_out: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure how fast the links answer while frames are made and solved, and what the emulator takes to start."""
    import dataclasses
    import json

    from rich.console import Console
    from rich.table import Table

    from emulator.errors import EmulatorError
    from emulator.latency_bench import measure

    chosen = workers or ["process"]
    if unknown := sorted(set(chosen) - {"process", "thread"}):
        raise EmulatorError(f"--worker {unknown[0]}: must be process or thread")
    progress = Console(stderr=True)
    rows, processes = [], []
    for worker in chosen:
        links, process = measure(rates or [0.0, 1.0, 10.0], seconds, worker, progress.print)
        rows += links
        processes.append(process)
    if json_out:
        answer = {
            "rows": [dataclasses.asdict(row) for row in rows],
            "processes": [dataclasses.asdict(row) for row in processes],
        }
        print(json.dumps(answer))
        return
    table = Table("worker", "rate Hz", "link", "requests", "p50 ms", "p99 ms", "max ms", "lost")
    for row in rows:
        figures = (f"{value:.2f}" for value in (row.p50_ms, row.p99_ms, row.max_ms))
        table.add_row(
            row.worker, f"{row.update_rate_hz:g}", row.link, str(row.requests), *figures, str(row.lost)
        )
    console = Console()
    console.print(table)
    for process in processes:
        console.print(
            f"{process.worker}: ready {process.ready_s:.2f} s after its start, {process.memory_mb:.0f} MB resident"
        )
