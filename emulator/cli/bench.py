"""`starhil bench`: benchmarks of speed, latency and accuracy."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import DeviceAddress, Seed, SerialDialect, Unit, checked_dialect
from starhil.emulator.cli.output import compiles
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starid.cli.options import AsJson, one_of
from starid.cli.output import Column, output_help, prepare_output, print_table, progress

if TYPE_CHECKING:
    from starhil.emulator.cli.bench_bus import Target

group = typer.Typer(
    help="Measure speed, latency, bus load and centroids (for the attitude accuracy of a device, see campaign; for solvers, starid bench).",
    no_args_is_help=True,
)


def _dicts(rows: Iterable[Any]) -> list[dict[str, Any]]:
    return [dataclasses.asdict(row) for row in rows]


def _figure(name: str, digits: int) -> Callable[[Any], str]:
    """Return a function that formats an attribute with a number of decimals."""
    return lambda row: f"{getattr(row, name):.{digits}f}"


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
    seconds: Annotated[float, typer.Option(min=1.0, max=1e6, help="Time per rate.")] = 15.0,
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
    from starhil.hil_tests.timing.latency import measure

    chosen = [one_of("--worker", worker, ("process", "thread")) for worker in workers or ["process"]]
    report = progress()
    rows, processes = [], []
    for worker in chosen:
        links, process = measure(unit, rates or [0.0, 1.0, 10.0], seconds, worker, report, viewers)
        rows += links
        processes.append(process)
    if as_json:
        print(json.dumps({"rows": _dicts(rows), "processes": _dicts(processes)}))
        return
    print_table(_LATENCY_COLUMNS, rows)
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
@compiles
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
        import_module("matplotlib")  # before the work
    sensor = SensorModel().with_(bits=bits)
    rows = measure_centroids(rates or DEFAULT_RATES_DEG_S, frames, seed, sensor, progress=progress())
    if output is not None:
        plot_centroids(rows, output)
    if as_json:
        print(json.dumps({"seed": seed, "frames": frames, "rows": _dicts(rows)}))
    else:
        print_table(_CENTROID_COLUMNS, rows)


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
@compiles
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

    rows: list[Any] = (
        measure_bodies(frames, seed, progress())
        if bodies
        else measure_frames(frames, seed, rate, progress=progress())
    )
    if as_json:
        print(json.dumps({"seed": seed, "rows": _dicts(rows)}))
    else:
        print_table(_BODIES_COLUMNS if bodies else _FRAME_COLUMNS, rows)


@dataclasses.dataclass(frozen=True)
class TargetOptions:
    """The links of a running device, or the rate of those of the device that is started."""

    baud: Annotated[int, typer.Option(min=1200, help="Bit rate of the serial line.")] = 921_600
    can: Annotated[str | None, typer.Option(help="CAN channel of a running device, e.g. vcan0.")] = None
    serial: Annotated[str | None, typer.Option(help="Serial port of a running device.")] = None
    canopen: Annotated[
        int | None, typer.Option(min=1, max=127, help="CANopen node ID of a running device.")
    ] = None
    device_address: DeviceAddress = 4
    dialect: SerialDialect = None

    def target(self) -> Target:
        from starhil.emulator.cli.bench_bus import Target
        from starhil.protocol.serial.cubespace import Dialect

        dialect = Dialect(checked_dialect(self.dialect) or "b")
        return Target(self.can, self.serial, self.canopen, self.device_address, self.baud, dialect)


@group.command("bus")
@with_option_groups
def bus(
    *,
    seconds: Annotated[float, typer.Option(min=1.0, max=1e6, help="Time per link.")] = 60.0,
    rate: Annotated[float, typer.Option(min=0.0, help="CAN frames per second from other nodes.")] = 7000.0,
    p99_limit_ms: Annotated[
        float, typer.Option(help="Limit for the 99th percentile of CAN reply latency, milliseconds.")
    ] = 5.0,
    device: TargetOptions,
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
    from starhil.emulator.cli.bench_bus import check_rows, measure, print_figures, started_device
    from starhil.hil_tests.timing.realtime import set_realtime_priority
    from starhil.protocol.unit import load_unit

    running = device.target()
    icd = load_unit(unit)
    check_rows(icd)
    report = progress()
    start = device.can is None and device.serial is None
    with started_device(unit, device.baud, realtime, report) if start else nullcontext(running) as target:
        if realtime and not start:
            set_realtime_priority()
        figures = measure(icd, target, seconds, rate, report, realtime=realtime)
    good = figures.good(p99_limit_ms)
    if as_json:
        print(json.dumps({**dataclasses.asdict(figures), "good": good}))
    else:
        print_figures(figures, good)
    raise typer.Exit(0 if good else 1)
