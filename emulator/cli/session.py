"""`starhil session`: run a session script against a star sensor on a serial line, a CAN bus or both."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.output import output_help


def command(
    script: Annotated[
        Path, typer.Argument(help="Session script (TOML), or the name of one that comes along.")
    ],
    serial: Annotated[
        str | None, typer.Option(help="Serial port: /dev/…, socket://host:port; with --start: auto.")
    ] = None,
    can: Annotated[
        str | None,
        typer.Option(help="CAN channel: vcan0, socketcand:127.0.0.1:29536/vcan0, …; with --start: auto."),
    ] = None,
    start: Annotated[
        bool, typer.Option("--start", help="Start the emulator as a process for this session, and end it.")
    ] = False,
    profile: Annotated[
        str | None, typer.Option(help="With --start: device profile, in place of the script's.")
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="Folder for logs, samples and pictures; default out/session/NAME.")
    ] = None,
    junit: Annotated[Path | None, typer.Option(help=output_help("Write a JUnit XML file."))] = None,
    truth: Annotated[
        Path | None, typer.Option(help="File of true attitudes that the emulator writes (--truth-log).")
    ] = None,
    dialect: Annotated[str, typer.Option(help="Form of serial replies: a, b or c.")] = "b",
    baud: Annotated[int, typer.Option(help="Bit rate of a real serial line.")] = 115200,
    host_address: Annotated[int, typer.Option(help="CAN address of this OBC.")] = 1,
    device_address: Annotated[int, typer.Option(help="CAN address of the device.")] = 4,
    keep_going: Annotated[bool, typer.Option("--keep-going", help="Go on after a failed step.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of the steps.")
    ] = False,
) -> None:
    """Run a session script step by step; exit status 0 all as expected, 1 a step failed, 2 refused.

    SIGINT, SIGTERM and SIGHUP end it and the emulator that it started; the steps left are reported as not run (exit
    status 128 and the number of the signal).
    """
    from starhil.hil_tests.bench import LinkOptions
    from starhil.hil_tests.interruption import interruptible
    from starhil.hil_tests.session_run import SessionRequest, run_session

    options = LinkOptions(
        serial=serial,
        can=can,
        dialect=dialect,
        baud=baud,
        host_address=host_address,
        device_address=device_address,
    )
    request = SessionRequest(
        script=script,
        options=options,
        start=start,
        profile=profile,
        folder=log,
        junit=junit,
        truth=truth,
        keep_going=keep_going,
        quiet=as_json,
    )
    with interruptible():
        result = run_session(request)
    if as_json:
        json.dump(result.to_json(), sys.stdout)
        print()
    if result.interruption is not None:
        raise typer.Exit(result.interruption.exit_status)
    raise typer.Exit(0 if result.passed else 1)
