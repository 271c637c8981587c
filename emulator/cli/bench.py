"""`starhil bench`: benchmarks of speed, latency and accuracy."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias

import typer

from starhil.emulator.cli.options import DIALECTS, AsJson, DeviceAddress, SerialDialect, Unit, one_of
from starhil.emulator.cli.output import output_help, prepare_output
from starhil.protocol.unit_folders import DEFAULT_UNIT

Column: TypeAlias = tuple[str, Callable[[Any], str]]
"""Heading of a column, and the function that formats a row for it."""

Seed: TypeAlias = Annotated[int, typer.Option("--seed", min=0, help="Random seed.")]

group = typer.Typer(
    help="Measure speed, latency, bus load and single algorithms (for the attitude accuracy of a device, see campaign).",
    no_args_is_help=True,
)


def _progress() -> Callable[[str], None]:
    """Return a function that prints progress to stderr."""
    from rich.console import Console

    return Console(stderr=True).print


def _print_table(columns: Sequence[Column], rows: Iterable[Any]) -> None:
    """Print a table in full width, even in a narrower terminal."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(*(heading for heading, _ in columns), box=SIMPLE)
    for row in rows:
        table.add_row(*(show(row) for _, show in columns))
    console = Console()
    console.width = max(console.width, Console(width=1000).measure(table).maximum)
    console.print(table)


def _dicts(rows: Iterable[Any]) -> list[dict[str, Any]]:
    return [dataclasses.asdict(row) for row in rows]


def _figure(name: str, digits: int) -> Callable[[Any], str]:
    """Return a function that formats an attribute with a number of decimals."""
    return lambda row: f"{getattr(row, name):.{digits}f}"


def _entry(name: str, digits: int) -> Callable[[Any], str]:
    """Return a function that formats an entry of a dictionary with a number of decimals, or a dash."""
    return lambda row: "–" if row[name] is None else f"{row[name]:.{digits}f}"


_LATENCY_COLUMNS: Final[tuple[Column, ...]] = (
    ("worker", lambda row: row.worker),
    ("rate Hz", lambda row: f"{row.update_rate_hz:g}"),
    ("viewers", lambda row: str(row.viewers)),
    ("link", lambda row: row.link),
    ("requests", lambda row: str(row.requests)),
    ("p50 ms", _figure("p50_ms", 2)),
    ("p99 ms", _figure("p99_ms", 2)),
    ("max ms", _figure("max_ms", 2)),
    ("lost", lambda row: str(row.lost)),
)


@group.command("latency")
def latency(
    rates: Annotated[
        list[float] | None,
        typer.Option("--rate", min=0.0, help="Update rate, Hz; 0 is standby. Repeatable."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Time per rate.")] = 15.0,
    workers: Annotated[
        list[str] | None, typer.Option("--worker", help="process or thread. Repeatable.")
    ] = None,
    viewers: Annotated[
        int,
        typer.Option(min=0, help="Number of console pages; each rate is measured with and without them."),
    ] = 0,
    unit: Unit = DEFAULT_UNIT,
    as_json: AsJson = False,
) -> None:
    """Measure reply latency on both links while images are solved, and the emulator's start-up time."""
    from starhil.hil_tests.latency import measure

    chosen = [one_of("--worker", worker, ("process", "thread")) for worker in workers or ["process"]]
    report = _progress()
    rows, processes = [], []
    for worker in chosen:
        links, process = measure(unit, rates or [0.0, 1.0, 10.0], seconds, worker, report, viewers)
        rows += links
        processes.append(process)
    if as_json:
        print(json.dumps({"rows": _dicts(rows), "processes": _dicts(processes)}))
        return
    _print_table(_LATENCY_COLUMNS, rows)
    for process in processes:
        print(f"{process.worker}: ready after {process.ready_s:.2f} s, {process.memory_mb:.0f} MB resident")


_CENTROID_COLUMNS: Final[tuple[Column, ...]] = (
    ("rate °/s", lambda row: f"{row.rate_deg_s:g}"),
    ("V", lambda row: f"{row.v_low:g}…{row.v_high:g}"),
    ("stars", lambda row: str(row.stars)),
    ("found %", _figure("detected_pct", 1)),
    ("error px", _figure("rms_px", 4)),
    ("bound px", _figure("bound_px", 4)),
    ("ratio", _figure("ratio", 3)),
    ("stated px", _figure("predicted_px", 4)),
    ("NSE", _figure("normalised_squared_error", 2)),
)


@group.command("centroid")
def centroid(
    rates: Annotated[
        list[float] | None, typer.Option("--rate", help="Body rate, degrees/s. Repeatable.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Images per rate, at random attitudes.")] = 30,
    seed: Seed = 1,
    bits: Annotated[int, typer.Option(help="Bits per pixel: 8, 12 or 16.")] = 8,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help=output_help("Plot to write: .png, .svg or .pdf."))
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure centroid errors by magnitude and smear, compared with the Cramér–Rao bound."""
    from starhil.emulator.benchmarks.centroid import DEFAULT_RATES_DEG_S, measure_centroids, plot_centroids
    from starhil.emulator.sensor.model import SensorModel

    if output is not None:
        prepare_output(output, "-o")
    sensor = SensorModel(bits=bits)
    rows = measure_centroids(rates or DEFAULT_RATES_DEG_S, frames, seed, sensor, progress=_progress())
    if output is not None:
        plot_centroids(rows, output)
    if as_json:
        print(json.dumps({"seed": seed, "frames": frames, "rows": _dicts(rows)}))
    else:
        _print_table(_CENTROID_COLUMNS, rows)


_FRAME_COLUMNS: Final[tuple[Column, ...]] = (
    ("stage", lambda row: row.stage),
    ("frames", lambda row: str(row.frames)),
    ("median ms", _figure("median_ms", 2)),
    ("p99 ms", _figure("p99_ms", 2)),
    ("least ms", _figure("least_ms", 2)),
)


_BODIES_COLUMNS: Final[tuple[Column, ...]] = (
    ("in the field", lambda row: row.in_field),
    *_FRAME_COLUMNS[:2],
    ("without ms", _figure("without_ms", 2)),
    ("with ms", _figure("with_ms", 2)),
    ("ratio", _figure("ratio", 3)),
)


@group.command("frame")
def frame(
    frames: Annotated[int, typer.Option(min=1, help="Number of images.")] = 200,
    seed: Seed = 1,
    rate: Annotated[float, typer.Option(help="Body rate during the exposures, degrees/s.")] = 0.0,
    bodies: Annotated[
        bool,
        typer.Option(
            "--bodies",
            help="Compare images with bodies and aberration with the same images without them, at rest.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Measure the processor time to render, detect and identify an image on one core."""
    from starhil.emulator.benchmarks.frame import measure_bodies, measure_frames

    rows: list[Any]
    if bodies:
        rows = measure_bodies(frames, seed, _progress())
    else:
        rows = measure_frames(frames, seed, rate, progress=_progress())
    if as_json:
        print(json.dumps({"seed": seed, "rows": _dicts(rows)}))
    else:
        _print_table(_BODIES_COLUMNS if bodies else _FRAME_COLUMNS, rows)


@group.command("bus")
def bus(
    seconds: Annotated[float, typer.Option(min=1.0, help="Time per link.")] = 60.0,
    rate: Annotated[float, typer.Option(min=0.0, help="CAN frames per second from other nodes.")] = 7000.0,
    baud: Annotated[int, typer.Option(min=1200, help="Bit rate of the serial line.")] = 921_600,
    p99_limit_ms: Annotated[
        float, typer.Option(help="Limit for the 99th percentile of CAN reply latency, milliseconds.")
    ] = 5.0,
    can: Annotated[str | None, typer.Option(help="CAN channel of a running device, e.g. vcan0.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial port of a running device.")] = None,
    canopen: Annotated[
        int | None, typer.Option(min=1, max=127, help="CANopen node ID of a running device.")
    ] = None,
    device_address: DeviceAddress = 4,
    dialect: SerialDialect = None,
    unit: Unit = DEFAULT_UNIT,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Run with real-time priority, so that other processes have no effect (needs root).",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Load the links of CubeStar to capacity and measure losses, errors, latency and jitter.

    Without --can and --serial, this starts a CAN hub and an emulator that solves images at 10 Hz. The exit
    status is 0 only if nothing was lost or wrong and the 99th percentile of the CAN reply latency is within
    the limit.
    """
    from contextlib import nullcontext

    from starhil.emulator.cli.bench_bus import Target, check_rows, measure, print_figures, started_device
    from starhil.hil_tests.realtime import set_realtime_priority
    from starhil.protocol.icd import load_unit
    from starhil.protocol.serial_framing import Dialect

    if dialect is not None:
        one_of("--dialect", dialect, DIALECTS)
    icd = load_unit(unit)
    check_rows(icd)
    report = _progress()
    running = Target(can, serial, canopen, device_address, baud, Dialect(dialect or "b"))
    start = can is None and serial is None
    with started_device(unit, baud, realtime, report) if start else nullcontext(running) as target:
        if realtime and not start:
            set_realtime_priority()
        figures = measure(icd, target, seconds, rate, report, realtime=realtime)
    good = figures.good(p99_limit_ms)
    if as_json:
        print(json.dumps({**dataclasses.asdict(figures), "good": good}))
    else:
        print_figures(figures, good)
    raise typer.Exit(0 if good else 1)


_IDENTIFY_COLUMNS: Final[tuple[Column, ...]] = (
    ("σ px, false, missing", lambda row: row["row"]),
    ("solver", lambda row: row["solver"]),
    ("frames", lambda row: str(row["frames"])),
    ("valid %", _entry("valid_pct", 2)),
    ("wrong (ill-conditioned)", lambda row: f"{row['wrong']} ({row['ill_conditioned']})"),
    ("″", _entry("boresight_median_arcsec", 1)),
    ("÷ floor", _entry("floor_ratio", 3)),
    ("roll ÷", _entry("roll_floor_ratio", 3)),
    ("ms", _entry("median_ms", 3)),
    ("p99 ms", _entry("p99_ms", 2)),
    ("CPU ms", _entry("cpu_median_ms", 3)),
    ("p99", _entry("cpu_p99_ms", 2)),
)


@group.command("identify")
def identify(
    peers: Annotated[
        str,
        typer.Option(
            help="Third-party solvers to compare with: tetra3rs,ruststartracker,cedar-solve,solve-field."
        ),
    ] = "",
    solvers: Annotated[
        str,
        typer.Option(
            help="Solvers: geometric,lsi,rsi, lsi-matlab,lsi-sklearn, published ones such as pyramid,grid "
            "(pyramid-even: with evenly spread guide stars), or MODULE:FUNCTION; 'all': geometric, lsi, rsi, the published and the third-party ones."
        ),
    ] = "geometric",
    frames: Annotated[int, typer.Option(min=1, help="Scenes per row.")] = 300,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 1,
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="Row of the table. Repeatable. 'all': every row; 'papers': the scenes in the papers of the published algorithms. "
            "Default: the standard rows; with --solvers all, also other fields of view."
        ),
    ] = None,
    budget: Annotated[
        float, typer.Option(help="Time limit of a solver per row, seconds; the rest of the row is skipped.")
    ] = 120.0,
    raw: Annotated[
        bool, typer.Option("--raw", help="Use the answers of published algorithms without verification.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder for leaderboard.md, leaderboard.json and plots."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare star identification solvers on the same scenes and with the least-squares bound."""
    from starhil.emulator.benchmarks.identify import LEADERBOARD, PAPERS, ROWS, STANDARD, run
    from starhil.emulator.benchmarks.leaderboard import write_leaderboard
    from starhil.emulator.benchmarks.peers import ALL

    everyone = solvers.strip() == "all"
    usual = LEADERBOARD if everyone else STANDARD
    report = _progress()
    answer = run(
        frames,
        seed,
        peers=_names(peers),
        own=ALL if everyone else _names(solvers),
        rows=list(usual if not row else ROWS if "all" in row else PAPERS if "papers" in row else row),
        budget_s=budget,
        raw=raw,
        progress=lambda name: report(f"row {name}"),
    )
    if output is not None:
        command = (
            f"starhil bench identify --solvers {solvers} --frames {frames} --seed {seed} --budget {budget:g}"
            + (" --raw" if raw else "")
            + "".join(f' --row "{name}"' for name in row or [])
        )
        for path in write_leaderboard(answer, output, command):
            report(f"wrote {path}")
    if as_json:
        print(json.dumps(answer))
        return
    _print_table(_IDENTIFY_COLUMNS, answer["rows"])
    for name, why in answer["skipped"].items():
        print(f"{name}: skipped, {why}")


def _names(text: str) -> list[str]:
    """Split a comma-separated list."""
    return [name.strip() for name in text.split(",") if name.strip()]
