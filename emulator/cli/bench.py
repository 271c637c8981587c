"""`starhil bench`: measurements of speed and accuracy, each with the command that makes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.output import output_help, prepare_output

_TABLE_WIDTH = 134

group = typer.Typer(help="Measure speed, latency and accuracy.", no_args_is_help=True)


@group.command("latency")
def latency(
    rates: Annotated[
        list[float] | None,
        typer.Option("--rate", min=0.0, help="Update rate, Hz; 0 is standby. May be repeated."),
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

    from starhil.emulator.errors import EmulatorError
    from starhil.hil_tests.latency import measure

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


@group.command("centroid")
def centroid(
    rates: Annotated[
        list[float] | None, typer.Option("--rate", help="Body rate, degrees/s. May be repeated.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of random attitude a rate.")] = 30,
    seed: Annotated[int, typer.Option(min=0, help="Seed of attitudes and noise.")] = 1,
    bits: Annotated[int, typer.Option(help="8, 12 or 16.")] = 8,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help=output_help("Plot to write: .png, .svg or .pdf.")),
    ] = None,
    json_out: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure the error of centroids over magnitude and smear, beside the Cramér–Rao bound."""
    import dataclasses
    import json

    from rich.console import Console
    from rich.table import Table

    from starhil.emulator.benchmarks.centroid import DEFAULT_RATES_DEG_S, measure_centroids, plot_centroids
    from starhil.emulator.sensor.model import SensorModel

    if output is not None:
        prepare_output(output, "-o")
    progress = Console(stderr=True)
    sensor = SensorModel(bits=bits)
    rows = measure_centroids(rates or DEFAULT_RATES_DEG_S, frames, seed, sensor, progress=progress.print)
    if output is not None:
        plot_centroids(rows, output)
    if json_out:
        print(json.dumps({"seed": seed, "frames": frames, "rows": [dataclasses.asdict(row) for row in rows]}))
        return
    table = Table("rate °/s", "V", "stars", "found %", "error px", "bound px", "ratio", "stated px", "NSE")
    for row in rows:
        table.add_row(
            f"{row.rate_deg_s:g}",
            f"{row.v_low:g}…{row.v_high:g}",
            str(row.stars),
            f"{row.detected_pct:.1f}",
            f"{row.rms_px:.4f}",
            f"{row.bound_px:.4f}",
            f"{row.ratio:.3f}",
            f"{row.predicted_px:.4f}",
            f"{row.normalised_squared_error:.2f}",
        )
    Console().print(table)


@group.command("frame")
def frame(
    frames: Annotated[int, typer.Option(min=1, help="Frames that count.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of attitudes and noise.")] = 1,
    rate: Annotated[float, typer.Option(help="Body rate during the exposures, degrees/s.")] = 0.0,
    json_out: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Time a frame stage by stage on one core: rendered, detected, identified (processor time of one thread)."""
    import dataclasses
    import json

    from rich.console import Console
    from rich.table import Table

    from starhil.emulator.benchmarks.frame import measure_frames

    progress = Console(stderr=True)
    rows = measure_frames(frames, seed, rate, progress=progress.print)
    if json_out:
        print(json.dumps({"seed": seed, "rows": [dataclasses.asdict(row) for row in rows]}))
        return
    table = Table("stage", "frames", "median ms", "p99 ms", "least ms")
    for row in rows:
        figures = (f"{value:.2f}" for value in (row.median_ms, row.p99_ms, row.least_ms))
        table.add_row(row.stage, str(row.frames), *figures)
    Console().print(table)


@group.command("bus")
def bus(
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for each link.")] = 60.0,
    rate: Annotated[float, typer.Option(min=0.0, help="Frames a second of other nodes on CAN.")] = 7000.0,
    baud: Annotated[int, typer.Option(min=1200, help="Serial bit rate.")] = 921_600,
    p99_limit_ms: Annotated[
        float, typer.Option(help="Latency of CAN replies that 99 % of them must keep, milliseconds.")
    ] = 5.0,
    can: Annotated[str | None, typer.Option(help="CAN of a running device, e.g. vcan0.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial port of a running device.")] = None,
    canopen: Annotated[int | None, typer.Option(help="CANopen node of a running device.")] = None,
    device_address: Annotated[int, typer.Option(help="CAN address of the device.")] = 4,
    dialect: Annotated[str, typer.Option(help="Serial dialect of the device.")] = "b",
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime", help="Measure with real-time priority, so that other work does not count (as root)."
        ),
    ] = False,
    json_out: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Load the links of a device to the full and measure what is lost, wrong, late or irregular.

    Without --can and --serial it starts an emulator that solves frames at 10 Hz, and a CAN hub. The exit status is 0 only if
    nothing was lost or wrong and the latency of CAN replies (99th percentile) keeps the limit.
    """
    import json
    from contextlib import nullcontext

    from rich.console import Console

    from starhil.emulator.cli.bench_bus import Target, measure, own_device, print_figures
    from starhil.emulator.errors import EmulatorError
    from starhil.hil_tests.realtime import set_realtime_priority
    from starhil.protocol.serial_framing import Dialect

    if dialect not in set(Dialect):
        raise EmulatorError(f"--dialect {dialect}: must be a, b or c")
    progress = Console(stderr=True)
    given = Target(can, serial, canopen, device_address, baud, Dialect(dialect))
    own = can is None and serial is None
    with own_device(baud, realtime, progress.print) if own else nullcontext(given) as target:
        if realtime and not own:
            set_realtime_priority()
        figures = measure(target, seconds, rate, progress.print, realtime=realtime)
    good = figures.good(p99_limit_ms)
    if json_out:
        print(json.dumps({**figures.as_dict(), "good": good}))
    else:
        print_figures(figures, good)
    raise typer.Exit(0 if good else 1)


@group.command("identify")
def identify(
    peers: Annotated[
        str, typer.Option(help="Programs of others to compare with: tetra3rs,ruststartracker,cedar-solve.")
    ] = "",
    solvers: Annotated[
        str,
        typer.Option(
            help="Algorithms: geometric,lsi,rsi, published ones such as pyramid,grid, MODULE:FUNCTION of your own; 'all' with the others' programs too."
        ),
    ] = "geometric",
    frames: Annotated[int, typer.Option(min=1, help="Scenes a row.")] = 300,
    seed: Annotated[int, typer.Option(help="Seed of the scenes.")] = 1,
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="Row of the table; may be repeated. 'all' means every one; by default the standard ones, with --solvers all also other fields."
        ),
    ] = None,
    budget: Annotated[
        float, typer.Option(help="Seconds after which a solver is left out of the rest of a row.")
    ] = 120.0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder for leaderboard.md, leaderboard.json and pictures."),
    ] = None,
    json_out: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare identification programs on the same scenes, and with the bound (least squares of the true matches)."""
    import json

    from rich.console import Console
    from rich.table import Table

    from starhil.emulator.benchmarks.identify import LEADERBOARD, ROWS, STANDARD, run
    from starhil.emulator.benchmarks.leaderboard import write_leaderboard
    from starhil.emulator.benchmarks.peers import ALL

    everyone = solvers.strip() == "all"
    usual = LEADERBOARD if everyone else STANDARD
    rows = list(usual if not row else ROWS if "all" in row else row)
    progress = Console(stderr=True)
    answer = run(
        frames,
        seed,
        peers=_names(peers),
        own=ALL if everyone else _names(solvers),
        rows=rows,
        budget_s=budget,
        progress=lambda name: progress.print(f"row {name}"),
    )
    if output is not None:
        command = (
            f"starhil bench identify --solvers {solvers} --frames {frames} --seed {seed} --budget {budget:g}"
        )
        for path in write_leaderboard(answer, output, command):
            progress.print(f"wrote {path}")
    if json_out:
        print(json.dumps(answer))
        return
    table = Table(
        "σ px, false, missing",
        "solver",
        "frames",
        "valid %",
        "wrong",
        "″",
        "÷ floor",
        "roll ÷",
        "ms",
        "p99 ms",
        "CPU ms",
        "p99",
    )
    for entry in answer["rows"]:
        figures = (
            _shown(entry["boresight_median_arcsec"], 1),
            _shown(entry["floor_ratio"], 3),
            _shown(entry["roll_floor_ratio"], 3),
            _shown(entry["median_ms"], 3),
            _shown(entry["p99_ms"], 2),
            _shown(entry["cpu_median_ms"], 3),
            _shown(entry["cpu_p99_ms"], 2),
        )
        table.add_row(
            entry["row"],
            entry["solver"],
            str(entry["frames"]),
            f"{entry['valid_pct']:.2f}",
            str(entry["wrong"]),
            *figures,
        )
    console = Console()
    console.width = max(console.width, _TABLE_WIDTH)
    console.print(table)
    for name, why in answer["skipped"].items():
        console.print(f"{name}: skipped, {why}")


def _names(text: str) -> list[str]:
    """Names of a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _shown(value: float | None, digits: int) -> str:
    """Figure for a table."""
    return "–" if value is None else f"{value:.{digits}f}"
