"""`starhil campaign`: accuracy and speed over many seeded frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import Jobs, OrbitChoice, Seed, Settings, names_of, with_orbit
from starid.cli.options import AsJson
from starid.cli.output import Column, print_table
from starid.storage.child_processes import importing_only_what_is_installed

if TYPE_CHECKING:
    from starhil.emulator.benchmarks.campaign import CampaignPlan

_COLUMNS: Final[tuple[Column, ...]] = (
    ("figure", lambda row: row[0]),
    ("value", lambda row: f"{row[1]:.4g}" if isinstance(row[1], float) else str(row[1])),
)


def _number(name: str, digits: int) -> Callable[[dict[str, Any]], str]:
    return lambda row: "" if row[name] is None else f"{row[name]:.{digits}f}"


_ALGORITHM_COLUMNS: Final[tuple[Column, ...]] = (
    ("scene", lambda row: row["scene"]),
    ("algorithm", lambda row: row["algorithm"]),
    ("frames", lambda row: str(row["frames"])),
    ("valid %", _number("valid_pct", 1)),
    ("wrong", lambda row: str(row["wrong"])),
    ("within .3 %", _number("within_pct", 1)),
    ("across deg", _number("across_deg", 4)),
    ("about deg", _number("about_deg", 4)),
    ("chi2", _number("normalised_squared_error", 2)),
    ("triggers", lambda row: str(row["triggers"])),
    ("ms", _number("median_ms", 2)),
    ("p99 ms", _number("p99_ms", 1)),
    ("kB", _number("kilobytes", 0)),
)

group = typer.Typer(
    help="Measure the accuracy and reliability of attitudes over many rendered images (for speed and solvers, see bench).",
    invoke_without_command=True,
)


@dataclass(frozen=True)
class EcssOptions:
    """The device and the images of a campaign per ECSS-E-ST-60-20C."""

    profile: Annotated[
        str, typer.Option(help="Device profile: a name or a TOML file.", autocompletion=names_of("profile"))
    ] = "cubestar"
    orbit: OrbitChoice = None
    setting: Settings = None
    confidence: Annotated[float, typer.Option(help="Confidence level of the errors, 0.5 to below 1.")] = 0.997
    rest_frames: Annotated[int, typer.Option(min=10, help="Images at random attitudes, at rest.")] = 2000
    frames: Annotated[
        int, typer.Option(min=5, help="Images at each value of an influence (rate, Sun …).")
    ] = 100
    fields: Annotated[
        int, typer.Option(min=3, help="Number of directions in the sky, to separate the kinds of error.")
    ] = 80
    seed: Seed = 1
    jobs: Jobs = 1


@group.callback()
@with_option_groups
def campaigns(
    context: typer.Context,
    *,
    ecss: Annotated[
        bool,
        typer.Option(
            "--ecss",
            help="Measure the performance of a device per ECSS-E-ST-60-20C and write a report to -o.",
        ),
    ] = False,
    images: EcssOptions,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Folder for report.md, CSV files, plots and finished parts. A second run resumes from it.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the accuracy and reliability of attitudes over many rendered images.

    With --ecss: attitude errors by kind, and rates of correct, wrong and invalid attitudes against body rate,
    Sun, Moon, Earth, false stars and particles. The exit status is 1 if any attitude at rest is wrong. For
    speed, latency and other solvers, see `starhil bench`.
    """
    if context.invoked_subcommand is not None:
        if ecss:
            raise typer.BadParameter(f"--ecss takes no subcommand; remove {context.invoked_subcommand}")
        return
    if not ecss:
        typer.echo(context.get_help())
        raise typer.Exit(2)
    from starhil.emulator.benchmarks.ecss_campaign import EcssPlan, parts, run_ecss
    from starhil.emulator.benchmarks.ecss_errors import coverage_factor
    from starhil.emulator.benchmarks.ecss_report import as_markdown, make_report, write_report

    coverage_factor(images.confidence)  # before hours of work
    if output is not None:
        import_module("matplotlib")
    plan = EcssPlan(
        images.profile,
        tuple(with_orbit(images.setting, images.orbit)),
        images.seed,
        fields=images.fields,
        rest_frames=images.rest_frames,
        frames=images.frames,
    )
    folder = None if output is None else output / "parts"
    finished = list(_with_progress(run_ecss(plan, folder=folder, jobs=images.jobs), len(parts(plan))))
    report = make_report(plan, finished, images.confidence)
    files = () if output is None else write_report(report, output)
    if as_json:
        print(json.dumps({**report.figures(), "files": [str(file) for file in files]}))
    elif output is None:
        print(as_markdown(report))
    else:
        print(f"report written to {output / 'report.md'}")
    if report.outcomes[0].wrong:
        raise typer.Exit(1)


@dataclass(frozen=True)
class PlanOptions:
    """The images of a campaign."""

    frames: Annotated[int, typer.Option(min=1, help="Number of images.")] = 1000
    seed: Seed = 1
    fov: Annotated[float, typer.Option(help="Full width of the field of view, degrees.")] = 42.0
    unknown_field: Annotated[
        bool,
        typer.Option("--unknown-field", help="Identify without knowing --fov, like `identify --fov auto`."),
    ] = False
    rate: Annotated[
        float, typer.Option(min=0, help="Body rate during the exposure, deg/s, about a random axis.")
    ] = 0.0
    blocked: Annotated[float, typer.Option(help="Fraction of the field hidden by a dark body, 0 to 0.9.")] = (
        0.0
    )
    algorithm: Annotated[str, typer.Option(help="Star identification algorithm: geometric, lsi or rsi.")] = (
        "geometric"
    )
    sky: Annotated[
        str,
        typer.Option(
            help="clear, or hard: 100 false stars to about 50 true ones, planets, hot pixels, the Moon or glare, "
            "and rates up to 2 deg/s."
        ),
    ] = "clear"

    def plan(self) -> CampaignPlan:
        """Return the plan."""
        from starhil.emulator.benchmarks.campaign import CampaignPlan

        return CampaignPlan(
            self.frames,
            self.seed,
            self.fov,
            self.rate,
            self.blocked,
            self.algorithm,
            sky=self.sky,
            unknown_field=self.unknown_field,
        )


@group.command("lost-in-space")
@with_option_groups
def lost_in_space(
    *,
    images: PlanOptions,
    require_valid: Annotated[
        float, typer.Option(help="Exit with status 1 if a lower percentage of images is valid.")
    ] = 99.5,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes, also for --dask local.")] = 1,
    dask: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, or `local` to start one.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Folder for finished chunks, created if missing. A second run resumes from it.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render, detect and identify images at uniformly random attitudes.

    An image is wrong if its attitude is flagged valid but off by more than 0.1°. The exit status is 1 if any
    image is wrong or too few are valid.
    """
    import numpy as np

    from starhil.emulator.benchmarks.campaign import run_campaign, summarise

    plan = images.plan()
    with _backend(dask, jobs):
        chunks = list(_with_progress(run_campaign(plan, folder=output, jobs=jobs), plan.chunks))
    rows = np.concatenate(chunks)
    figures: dict[str, Any] = {"seed": images.seed, **summarise(rows, images.fov)}
    if as_json:
        print(json.dumps(figures))
    else:
        print_table(_COLUMNS, figures.items())
    if figures["wrong"] or figures["valid_pct"] < require_valid:
        raise typer.Exit(1)


@group.command("algorithms")
def algorithms(
    *,
    profile: Annotated[
        str, typer.Option(help="Device profile: a name or a TOML file.", autocompletion=names_of("profile"))
    ] = "cubestar",
    orbit: OrbitChoice = None,
    setting: Settings = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of images in each condition.")] = 200,
    seed: Seed = 1,
    lost_only: Annotated[
        bool, typer.Option("--lost-only", help="Only images at random attitudes with nothing wrong.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Compare geometric, thesis, and thesis with refinement on the same rendered images.

    Lost in space at random attitudes, and turning at 0.3 deg/s, with 0, 5 and 30 false stars and 5 missing ones. Refined
    attitudes are wrong beyond 0.1 deg, those of the features alone beyond 1.5 deg; the exit status is 1 if a refined one
    is wrong.
    """
    from starhil.emulator.benchmarks.algorithms import SCENES, AlgorithmPlan, run_algorithms

    plan = AlgorithmPlan(profile, frames, seed, tuple(with_orbit(setting, orbit)))
    scenes = SCENES[:1] if lost_only else SCENES
    rows = list(_with_progress(run_algorithms(plan, scenes), 3 * len(scenes)))
    if as_json:
        print(json.dumps(rows))
    else:
        print_table(_ALGORITHM_COLUMNS, rows)
    if any(row["wrong"] for row in rows if row["algorithm"] != "thesis"):
        raise typer.Exit(1)


@contextmanager
def _backend(dask: str | None, jobs: int) -> Iterator[None]:
    """Use the joblib backend that `--dask` selects; without it, joblib's local processes."""
    if dask is None:
        yield
        return
    from starhil.emulator.errors import EmulatorError

    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise EmulatorError(
            "campaign: --dask needs the `cluster` extra: pip install 'starhil[cluster]'"
        ) from error
    from joblib import parallel_config

    with importing_only_what_is_installed(), ExitStack() as stack:
        try:
            address = dask
            if dask == "local":
                address = stack.enter_context(
                    LocalCluster(
                        n_workers=jobs, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
                    )
                )
            client = stack.enter_context(Client(address, timeout="10s"))
        except (OSError, ValueError) as error:
            raise EmulatorError(f"campaign: no Dask scheduler at {dask!r}: {error}") from error
        if not client.ncores():
            raise EmulatorError(f"campaign: the Dask scheduler at {dask!r} has no workers: start some")
        stack.enter_context(parallel_config(backend="dask", client=client))
        yield


def _with_progress(chunks: Any, total: int) -> Any:
    """Show a progress bar on stderr while iterating over the chunks."""
    from rich.console import Console
    from rich.progress import track

    return track(chunks, "campaign", total=total, console=Console(stderr=True))
