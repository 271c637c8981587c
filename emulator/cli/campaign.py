"""`starhil campaign`: accuracy and speed over many seeded frames."""

from __future__ import annotations

import itertools
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import Jobs, OrbitChoice, Seed, Settings, names_of, with_orbit
from starhil.emulator.cli.output import compiles
from starid.camera import DEFAULT_FOV_DEG
from starid.cli.options import AsJson
from starid.cli.output import Column, print_table, steps_shown
from starid.storage.child_processes import importing_only_what_is_installed

if TYPE_CHECKING:
    from starhil.emulator.benchmarks.campaign import CampaignPlan
    from starhil.emulator.benchmarks.ecss_campaign import EcssPlan

_WITH_PROFILE: Final = ("frames", "seed", "profile", "orbit", "setting")
"""Options of a lost-in-space campaign that hold for a profile, too."""

WORKERS_S: Final = 60
"""Time for which a Dask scheduler may be without workers."""

_COLUMNS: Final[tuple[Column, ...]] = (
    ("figure", lambda row: row[0]),
    ("value", lambda row: f"{row[1]:.4g}" if isinstance(row[1], float) else str(row[1])),
)


def _number(name: str, digits: int) -> Callable[[dict[str, Any]], str]:
    return lambda row: "" if row[name] is None else f"{row[name]:.{digits}f}"


def _with_error(name: str, error: str, digits: int) -> Callable[[dict[str, Any]], str]:
    number, sampling = _number(name, digits), _number(error, digits)
    return lambda row: number(row) + (f" ± {text}" if (text := sampling(row)) else "")


def _numbers(digits: int, *names: str) -> Callable[[dict[str, Any]], str]:
    numbers = [_number(name, digits) for name in names]
    return lambda row: ", ".join(text for number in numbers if (text := number(row)))


_ALGORITHM_FIGURES: Final[tuple[Column, ...]] = (
    ("images", _number("frames", 0)),
    ("valid, %", _with_error("valid_pct", "valid_error_pct", 1)),
    ("wrong", _number("wrong", 0)),
    ("right, %", _with_error("right_pct", "right_error_pct", 1)),
    ("across within 0.3°, %", _with_error("within_pct", "within_error_pct", 1)),
    ("median error across, about, °", _numbers(4, "across_deg", "about_deg")),
    ("stated across, °", _number("stated_deg", 4)),
    (
        "squared error / stated",
        _with_error("normalised_squared_error", "normalised_squared_error_error", 2),
    ),
    ("answers from a region", _number("in_region", 0)),
    ("filter triggered", _number("triggers", 0)),
    ("kept of true, false stars, %", _numbers(0, "true_kept_pct", "false_kept_pct")),
    ("median time, 99 %, ms", _numbers(1, "median_ms", "p99_ms")),
    ("database, kB", _number("kilobytes", 0)),
)
"""Figures of an algorithm; after ±, one standard error."""

_ORBIT_COLUMNS: Final[tuple[Column, ...]] = (
    ("attitude, or cause of none", lambda row: row["cause"]),
    ("images", lambda row: str(row["frames"])),
    ("%", lambda row: f"{row['share_pct']:.1f}"),
)

_TRACKING_COLUMNS: Final[tuple[Column, ...]] = (
    ("last image", lambda row: row["way"]),
    ("images", lambda row: str(row["frames"])),
    ("valid", lambda row: str(row["valid"])),
    ("wrong", lambda row: str(row["wrong"])),
    ("across, 99 % ″", _numbers(0, "median_arcsec", "p99_arcsec")),
    ("about, 99 % ″", _numbers(0, "roll_median_arcsec", "roll_p99_arcsec")),
    ("chi2", _number("normalised_squared_error", 2)),
    ("stars", _number("matched_median", 0)),
    ("detect, identify ms", _numbers(2, "detect_ms", "identify_ms")),
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
    requirements: Annotated[
        Path | None,
        typer.Option(
            help="TOML file of limits on figures; the report says which are met (--figures: their names)."
        ),
    ] = None
    jobs: Jobs = 1

    def plan(self) -> EcssPlan:
        from starhil.emulator.benchmarks.ecss_campaign import EcssPlan

        return EcssPlan(
            self.profile,
            tuple(with_orbit(self.setting, self.orbit)),
            self.seed,
            fields=self.fields,
            rest_frames=self.rest_frames,
            frames=self.frames,
        )

    def command(self) -> str:
        """Return the command that makes the same report."""
        words = ["starhil", "campaign", "--ecss", "--profile", self.profile]
        words += [] if self.orbit is None else ["--orbit", self.orbit]
        for setting in self.setting or ():
            words += ["--set", setting]
        for name in ("confidence", "rest_frames", "frames", "fields", "seed", "requirements"):
            if (value := getattr(self, name)) is not None:
                words += [f"--{name.replace('_', '-')}", str(value)]
        return shlex.join(words)


@group.callback()
@compiles
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
    figures: Annotated[
        bool, typer.Option("--figures", help="List the names of figures for --requirements, and end.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Measure the accuracy and reliability of attitudes over many rendered images.

    With --ecss: attitude errors by kind, and rates of correct, wrong and invalid attitudes against body rate,
    Sun, Moon, Earth, false stars and particles. The exit status is 1 if any attitude at rest is wrong, or a requirement is not
    shown to be met. For speed, latency and other solvers, see `starhil bench`.
    """
    if context.invoked_subcommand is not None:
        if ecss:
            raise typer.BadParameter(f"--ecss takes no subcommand; remove {context.invoked_subcommand}")
        return
    if not ecss and not figures:
        typer.echo(context.get_help())
        raise typer.Exit(2)
    from starhil.emulator.benchmarks.ecss_campaign import parts, run_ecss
    from starhil.emulator.benchmarks.ecss_errors import coverage_factor
    from starhil.emulator.benchmarks.ecss_report import as_markdown, figure_names, make_report, write_report
    from starhil.emulator.benchmarks.ecss_requirements import read_requirements

    if figures:
        print("\n".join(figure_names()))
        return
    coverage_factor(images.confidence)  # before hours of work
    requirements = (
        () if images.requirements is None else read_requirements(images.requirements, figure_names())
    )
    if output is not None:
        import_module("matplotlib")
        import_module("fpdf")
    plan = images.plan()
    _warn(plan)
    folder = None if output is None else output / "parts"
    finished = list(_with_progress(run_ecss(plan, folder=folder, jobs=images.jobs), len(parts(plan))))
    report = make_report(plan, finished, images.confidence)
    files = () if output is None else write_report(report, images.command(), requirements, output)
    measured = report.named_figures()
    verdicts = {item.id: item.verdict(measured[item.figure]) for item in requirements}
    if as_json:
        print(
            json.dumps({**report.figures(), "requirements": verdicts, "files": [str(file) for file in files]})
        )
    elif output is None:
        print(as_markdown(report, images.command(), requirements))
    else:
        print(f"report written to {output / 'report.md'}, .html and .pdf")
        for item, verdict in verdicts.items():
            if verdict != "met":
                print(f"{item}: {verdict}")
    if report.outcomes[0].wrong or set(verdicts.values()) - {"met"}:
        raise typer.Exit(1)


@dataclass(frozen=True)
class PlanOptions:
    """The images of a campaign."""

    frames: Annotated[int, typer.Option(min=1, help="Number of images.")] = 1000
    seed: Seed = 1
    profile: Annotated[
        str | None,
        typer.Option(
            help="Device profile, a name or a TOML file, whose camera, detector and parameters are used; "
            "instead of the options from --fov on.",
            autocompletion=names_of("profile"),
        ),
    ] = None
    orbit: OrbitChoice = None
    setting: Settings = None
    fov: Annotated[float, typer.Option(help="Full width of the field of view, degrees.")] = DEFAULT_FOV_DEG
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

    def device_plan(self) -> EcssPlan | None:
        """Return the plan for the device of a profile, or None if there is no profile.

        Raises typer.BadParameter: an option contradicts it.
        """
        from starhil.emulator.benchmarks.ecss_campaign import EcssPlan

        if self.profile is None:
            if self.setting or self.orbit is not None:
                raise typer.BadParameter("--set and --orbit change the profile given by --profile; give both")
            return None
        for item in fields(self):
            if item.name not in _WITH_PROFILE and getattr(self, item.name) != item.default:
                option = f"--{item.name.replace('_', '-')}"
                raise typer.BadParameter(f"{option} and --profile exclude each other; use --set")
        return EcssPlan(
            self.profile,
            tuple(with_orbit(self.setting, self.orbit)),
            self.seed,
            rest_frames=self.frames,
        )

    def plan(self) -> CampaignPlan:
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
@compiles
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
    from starhil.emulator.benchmarks.ecss_campaign import REST, parts, run_ecss
    from starhil.emulator.benchmarks.ecss_report import rest_figures

    figures: dict[str, Any] = {"seed": images.seed}
    if (device := images.device_plan()) is not None:
        _warn(device)
        with _backend(dask, jobs):
            shown = _with_progress(
                run_ecss(device, folder=output, jobs=jobs, only=REST), len(parts(device, REST))
            )
            figures |= rest_figures(shown)
    else:
        plan = images.plan()
        with _backend(dask, jobs):
            chunks = list(_with_progress(run_campaign(plan, folder=output, jobs=jobs), plan.chunks))
        figures |= summarise(np.concatenate(chunks), plan.fov_deg)
    if as_json:
        print(json.dumps(figures))
    else:
        print_table(_COLUMNS, figures.items())
    if figures["wrong"] or figures["valid_pct"] < require_valid:
        raise typer.Exit(1)


@group.command("algorithms")
@compiles
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
    scene: Annotated[
        str | None,
        typer.Option(
            metavar="TEXT", help="Only conditions with this text in their name, such as '0.3 deg/s'."
        ),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option(
            "--without",
            metavar="PART",
            help="Take away a part of the thesis's algorithms: features, weights, filter, motion or region.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare geometric, thesis, and thesis with refinement on the same rendered images.

    Lost in space at random attitudes, and turning at 0.3 deg/s, with 0, 5 and 30 false stars and 5 missing ones. Refined
    attitudes are wrong beyond 0.1 deg, those of the features alone beyond 1.5 deg; the exit status is 1 if a refined one
    is wrong.
    """
    from starhil.emulator.benchmarks.algorithms import SCENES, AlgorithmPlan, run_algorithms
    from starid.identification.thesis.ablations import checked_part

    plan = AlgorithmPlan(profile, frames, seed, tuple(with_orbit(setting, orbit)), checked_part(part))
    scenes = SCENES[:1] if lost_only else tuple(each for each in SCENES if (scene or "") in each.name)
    with steps_shown("campaign", sum(each.images(frames) for each in scenes)) as step:
        rows = list(run_algorithms(plan, scenes, step))
    if as_json:
        print(json.dumps(rows))
    else:
        for name, group in itertools.groupby(rows, key=lambda row: row["scene"]):
            _print_algorithms(name, list(group))
    if any(row["wrong"] for row in rows if row["algorithm"] != "thesis"):
        raise typer.Exit(1)


def _print_algorithms(scene: str, rows: list[dict[str, Any]]) -> None:
    """Print the figures of a scene, with a column for each algorithm."""

    def column(row: dict[str, Any]) -> Column:
        return row["algorithm"], lambda figure: figure[1](row)

    print(scene)
    print_table([("", lambda figure: figure[0]), *map(column, rows)], _ALGORITHM_FIGURES)


@group.command("orbit")
@compiles
def orbit_campaign(
    *,
    profile: Annotated[
        str, typer.Option(help="Device profile: a name or a TOML file.", autocompletion=names_of("profile"))
    ] = "cubestar",
    orbit: Annotated[
        str, typer.Option("--orbit", help="Orbit: leo, or a TOML file.", autocompletion=names_of("orbit"))
    ] = "leo",
    setting: Settings = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of images, evenly spread over the time.")] = 1000,
    days: Annotated[float, typer.Option(min=1e-3, max=1000.0, help="Time along the orbit, days.")] = 1.0,
    pointing: Annotated[
        str,
        typer.Option(
            help="zenith: away from the Earth, turning with the orbit; random: at rest in random directions."
        ),
    ] = "zenith",
    seed: Seed = 1,
    jobs: Jobs = 1,
    as_json: AsJson = False,
) -> None:
    """Count what costs a device in orbit how many images: Sun, Moon, Earth, particles, rate, temperature.

    Each image is solved lost in space. One without a right attitude is solved again without one of these after the
    other; those that spare it are its cause. The exit status is 1 if any attitude is wrong.
    """
    from starhil.emulator.benchmarks.orbit_campaign import OrbitPlan, run_orbit, summarise

    plan = OrbitPlan(profile, tuple(with_orbit(setting, orbit)), seed, frames, days, pointing)
    rows = summarise(list(_with_progress(run_orbit(plan, jobs=jobs), plan.chunks)))
    if as_json:
        print(json.dumps(rows))
    else:
        print_table(_ORBIT_COLUMNS, rows)
    if any(row["frames"] for row in rows if row["cause"] == "wrong"):
        raise typer.Exit(1)


@group.command("tracking")
@compiles
def tracking(
    *,
    profile: Annotated[
        str, typer.Option(help="Device profile: a name or a TOML file.", autocompletion=names_of("profile"))
    ] = "cubestar",
    setting: Settings = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of images that count.")] = 1000,
    seed: Seed = 1,
    blocked: Annotated[
        float, typer.Option(help="Fraction of the field hidden in these images, 0 to 1.")
    ] = 0.75,
    rate: Annotated[float, typer.Option(min=0, help="Body rate, deg/s, about a random axis.")] = 0.0,
    jump: Annotated[
        float,
        typer.Option(
            min=0, help="Largest turn before these images that the device does not expect, degrees."
        ),
    ] = 0.0,
    jobs: Jobs = 1,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Folder for finished parts, created if missing. A second run resumes from it.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Track through images of which most is hidden, after some that show the whole field.

    The same images are solved lost in space, and with the prediction from the attitudes before. An image is wrong if its attitude is
    valid but off by more than 0.1 deg. The exit status is 1 if any is wrong.
    """
    from starhil.emulator.benchmarks.tracking_campaign import TrackingPlan, run_tracking, summarise

    plan = TrackingPlan(profile, tuple(setting or ()), seed, frames, blocked, rate, jump)
    rows = summarise(list(_with_progress(run_tracking(plan, folder=output, jobs=jobs), plan.chunks)))
    if as_json:
        print(json.dumps(rows))
    else:
        print_table(_TRACKING_COLUMNS, rows)
    if any(row["wrong"] for row in rows):
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
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            raise EmulatorError(
                f"campaign: the Dask scheduler at {dask!r} has no workers after {WORKERS_S} s: start some"
            ) from None
        stack.enter_context(parallel_config(backend="dask", client=client))
        yield


def _warn(plan: EcssPlan) -> None:
    """Say on stderr if the camera sees too few stars."""
    if warning := plan.warning():
        print(f"starhil: campaign: {warning}", file=sys.stderr)


def _with_progress(chunks: Iterable[Any], total: int) -> Iterator[Any]:
    """Show on stderr how many chunks are done while iterating over them."""
    with steps_shown("campaign", total) as step:
        for chunk in chunks:
            step()
            yield chunk
