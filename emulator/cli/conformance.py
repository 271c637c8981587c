"""`starhil conformance`: test a star tracker, emulated or real, over its bus."""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import BenchOptions, OrbitChoice, Settings, checked_dialect, with_orbit
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starid.cli.options import AsJson
from starid.cli.output import output_help, steps_shown

if TYPE_CHECKING:
    from starhil.hil_tests.conformance.conformance_run import ConformanceRequest
    from starhil.protocol.icd import InterfaceDefinition


def links_of(icd: InterfaceDefinition, node: int | None) -> tuple[str | None, str | None]:
    """Return serial port and CAN channel of a unit, with a CANopen node or without."""
    serial = None if icd.link.serial is None else "auto"
    return serial, None if icd.link.can is None and node is None else "auto"


@dataclass(frozen=True)
class CaseOptions:
    """Which cases are run, and how."""

    canopen: Annotated[
        int | None,
        typer.Option(min=1, max=127, help="Also test the CANopen node with this ID on the CAN channel."),
    ] = None
    eds: Annotated[Path | None, typer.Option(help="EDS file of the CANopen node; default: starhil's.")] = None
    orbit: OrbitChoice = None
    settings: Settings = None
    truth: Annotated[
        str | None,
        typer.Option(
            metavar="LOG|RA,DEC,ROLL",
            help="Without --start: the true attitude, as the truth log of a running emulator (run --truth-log), or as right "
            "ascension, declination and roll of a sensor at rest in degrees.",
        ),
    ] = None
    speed: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=1.0,
            help="Simulation seconds per second, below 1 for a slow or busy machine. An emulator that is already "
            "running must use the same speed (run --clock scaled:…).",
        ),
    ] = 1.0
    intrusive: Annotated[
        bool | None,
        typer.Option(
            "--intrusive/--safe-only",
            help="Also run cases that change modes and parameters of the device and erase its files, or only those that change nothing.",
            show_default="--safe-only; with --start, --intrusive",
        ),
    ] = None
    baud: Annotated[
        int | None,
        typer.Option(
            help="Bit rate of the serial line. Default: 115200, without checking the pace of replies."
        ),
    ] = None
    time_out: Annotated[float, typer.Option(min=0.01, max=1e6, help="Timeout for a reply, seconds.")] = 1.0

    def request(
        self, bench: BenchOptions, patterns: tuple[str, ...], *, list_only: bool
    ) -> ConformanceRequest:
        """Return the request, with all links of the unit if the emulator is started and none is given."""
        from starhil.hil_tests.conformance.conformance_run import ConformanceRequest
        from starhil.hil_tests.conformance.link_probe import ProbeTimes
        from starhil.hil_tests.errors import BenchError
        from starhil.hil_tests.rig.rig import OFF, check_links, links_to_use
        from starhil.protocol.unit import load_unit

        icd, canopen = load_unit(bench.unit or DEFAULT_UNIT), self.canopen
        if canopen is None and icd.canopen_only and bench.can != OFF:
            canopen = int(icd.parameters["canopen_node"].default)
        everything = links_of(icd, canopen) if bench.start or list_only else (None, None)
        serial, can = links_to_use(bench.serial, bench.can, everything)
        if self.canopen is not None and can is None:
            raise BenchError("--canopen needs --can: give the channel of the node")
        check_links(
            serial, can, "--serial DEV, --can CHANNEL, --canopen NODE", start=bench.start or list_only
        )
        settings = with_orbit(self.settings, self.orbit)
        if settings and not bench.start:
            option = "--set" if self.orbit is None else "--orbit"
            raise BenchError(f"{option} needs --start: it overrides a key of the emulator's profile")
        if self.truth is not None and bench.start:
            raise BenchError("--truth is for a unit that runs already; with --start the truth is known")
        return ConformanceRequest(
            unit=bench.unit,
            serial=serial,
            can=can,
            canopen_node=canopen,
            eds=self.eds,
            start=bench.start,
            profile=bench.profile,
            settings=tuple(settings),
            truth=self.truth,
            dialect=checked_dialect(bench.dialect),
            baud=self.baud,
            host_address=bench.host_address,
            device_address=bench.device_address,
            patterns=patterns,
            intrusive=self.intrusive,
            speed=self.speed,
            times=ProbeTimes(answer_s=self.time_out),
            view=bench.view,
        )


@with_option_groups
def command(
    patterns: Annotated[
        list[str] | None,
        typer.Argument(help="Cases or areas, such as serial.framing or 'can.fields.*'. Default: all."),
    ] = None,
    *,
    bench: BenchOptions,
    cases: CaseOptions,
    list_only: Annotated[
        bool, typer.Option("--list", help="List the cases that would be run, and exit.")
    ] = False,
    html: Annotated[
        Path | None,
        typer.Option(help=output_help("Write an HTML report with the sent, expected and received data.")),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Print passed cases too, and what no case judges.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Test a star tracker, emulated or real, over its bus.

    Without --start, only cases that change nothing are run, unless --intrusive is given.

    The exit status is 0 if no case failed, 1 if some failed, and 2 for invalid input. Settings changed by
    cases are restored at the end. After SIGINT, SIGTERM or SIGHUP they are restored too, the remaining cases
    are reported as not run, and the exit status is 128 plus the signal's number.

    For each case, reports give its ID, the clause or source that it checks, and the sent, expected and
    received data.
    """
    from rich.console import Console

    from starhil.hil_tests.conformance import report
    from starhil.hil_tests.conformance.conformance_run import requested_cases, run_conformance
    from starhil.hil_tests.conformance.runner import Outcome, left_out_text
    from starhil.hil_tests.conformance.unjudged_cases import is_unjudged
    from starhil.hil_tests.reports import NOT_RUN, prepare_report
    from starhil.hil_tests.rig.interruption import interruptible

    request, junit = cases.request(bench, tuple(patterns or ()), list_only=list_only), bench.junit
    console = Console(highlight=False, quiet=as_json)
    requested, left_out = requested_cases(request)
    notice = left_out_text(left_out, [*requested, *left_out]) if left_out else ""
    if list_only:
        for item in requested:
            kind = "intrusive" if item.intrusive else "safe"
            print(f"{item.id}\t{kind}\t{item.title}\t{item.clause}")
        judged = Counter(each.area.partition(".")[0] for each in requested if not is_unjudged(each.area))
        counts = ", ".join(f"{number} {link}" for link, number in judged.items())
        listing = len(requested) - judged.total()
        print(f"judged cases: {counts}; {listing} more list values without a rule", file=sys.stderr)
        if notice:
            print(notice, file=sys.stderr)
        return
    for path in (junit, html):
        if path is not None:
            prepare_report(path)
    with interruptible(), steps_shown("conformance", len(requested), None if as_json else console) as step:

        def show(outcome: Outcome) -> None:
            if outcome.status != NOT_RUN:
                step(outcome.id)
            report.print_outcome(console, outcome, verbose=verbose)

        result = run_conformance(request, show)
        outcomes = result.outcomes
        if junit is not None:
            report.write_junit_report(junit, outcomes)
        if html is not None:
            report.write_html_report(html, outcomes, result.facts)
    if as_json:
        json.dump(report.to_json(outcomes, result.facts), sys.stdout)
        print()
    else:
        report.print_summary(console, outcomes)
        if notice:
            console.print(notice, style="bold yellow", soft_wrap=True)
    if result.interruption is not None:
        raise typer.Exit(result.interruption.exit_status)
    raise typer.Exit(1 if report.count(outcomes, "failed") else 0)
