"""`starhil conformance`: look for faults in a star sensor over its bus, emulated or real."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.output import output_help


def command(
    patterns: Annotated[
        list[str] | None,
        typer.Argument(
            help="Cases or areas, such as serial.framing or 'can.fields.*'; all if none is given."
        ),
    ] = None,
    serial: Annotated[
        str | None, typer.Option(help="Serial port: /dev/…, socket://host:port; with --start: auto.")
    ] = None,
    can: Annotated[
        str | None,
        typer.Option(help="CAN channel: vcan0, socketcand:127.0.0.1:29536/vcan0, …; with --start: auto."),
    ] = None,
    canopen: Annotated[
        int | None, typer.Option(min=1, max=127, help="CANopen node on the CAN channel.")
    ] = None,
    eds: Annotated[
        Path | None, typer.Option(help="Data sheet of the CANopen node; default: the product's.")
    ] = None,
    start: Annotated[
        bool, typer.Option("--start", help="Start the emulator as a process for this run.")
    ] = False,
    profile: Annotated[str | None, typer.Option(help="With --start: device profile.")] = None,
    speed: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=1.0,
            help="Run time in a second, below 1 on a slow or busy machine; an emulator that runs already must have it too (run --clock scaled:…).",
        ),
    ] = 1.0,
    safe_only: Annotated[
        bool, typer.Option("--safe-only", help="Only cases that change nothing: for a unit in use.")
    ] = False,
    list_only: Annotated[bool, typer.Option("--list", help="List the cases and end.")] = False,
    junit: Annotated[Path | None, typer.Option(help=output_help("Write a JUnit XML file."))] = None,
    html: Annotated[
        Path | None,
        typer.Option(help=output_help("Write a page with all that was sent, expected and seen.")),
    ] = None,
    dialect: Annotated[str, typer.Option(help="Form of serial replies: a, b or c.")] = "b",
    baud: Annotated[
        int | None,
        typer.Option(
            help="Bit rate of the serial line; without it the port is opened at 115200 and the pace of replies is not checked."
        ),
    ] = None,
    host_address: Annotated[int, typer.Option(help="CAN address of the tester.")] = 1,
    device_address: Annotated[int, typer.Option(help="CAN address of the device.")] = 4,
    time_out: Annotated[float, typer.Option(min=0.01, help="Longest time for an answer, s.")] = 1.0,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print passed cases too.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run conformance cases; exit status 0 none failed, 1 some failed, 2 refused.

    Settings that cases change are noted before and put back at the end, also after SIGINT, SIGTERM or SIGHUP, which leave
    the other cases as not run in the reports (exit status 128 and the number of the signal).

    Each case has an identifier, the clause or source that it checks, and what was sent, expected and seen.
    """
    from rich.console import Console

    from starhil.hil_tests.conformance import report
    from starhil.hil_tests.conformance.conformance_run import ConformanceRequest, all_cases, run_conformance
    from starhil.hil_tests.conformance.link_probe import ProbeTimes
    from starhil.hil_tests.errors import BenchError
    from starhil.hil_tests.interruption import interruptible
    from starhil.hil_tests.results import prepare_report
    from starhil.protocol.icd import load_icd

    if dialect not in ("a", "b", "c"):
        raise BenchError(f"--dialect {dialect}: must be a, b or c")
    if (start or list_only) and serial is None and can is None:
        serial, can = "auto", "auto"
    if canopen is not None and can is None:
        raise BenchError("--canopen needs --can: the channel that the node is on")
    if not start and not list_only and serial == "auto":
        raise BenchError("--serial auto needs --start: without it name the port")
    request = ConformanceRequest(
        serial=serial,
        can=can,
        canopen_node=canopen,
        eds=eds,
        start=start,
        profile=profile,
        dialect=dialect,
        baud=baud,
        host_address=host_address,
        device_address=device_address,
        patterns=tuple(patterns or ()),
        safe_only=safe_only,
        speed=speed,
        times=ProbeTimes(answer_s=time_out),
    )
    console = Console(highlight=False, quiet=as_json)
    if list_only:
        for item in all_cases(request, load_icd()):
            kind = "intrusive" if item.intrusive else "safe"
            print(f"{item.id}\t{kind}\t{item.title}\t{item.clause}")
        return
    for path in (junit, html):
        if path is not None:
            prepare_report(path)
    words = (
        serial and f"serial {serial} (dialect {dialect})",
        can and f"CAN {can}",
        canopen and f"CANopen node {canopen}",
    )
    unit = ", ".join(word for word in words if word) + (", emulator started for this run" if start else "")
    with interruptible():
        result = run_conformance(
            request, lambda outcome: report.print_outcome(console, outcome, verbose=verbose)
        )
        outcomes = result.outcomes
        if junit is not None:
            report.write_junit_report(junit, outcomes)
        if html is not None:
            report.write_html_report(html, outcomes, unit)
    if as_json:
        json.dump(report.to_json(outcomes, unit), sys.stdout)
        print()
    else:
        report.print_summary(console, outcomes)
    if result.interruption is not None:
        raise typer.Exit(result.interruption.exit_status)
    raise typer.Exit(1 if report.count(outcomes, "failed") else 0)
