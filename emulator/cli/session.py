"""`starhil session`: run a session script against a star tracker on a serial line, a CAN bus or both."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import (
    BenchOptions,
    OrbitChoice,
    checked_dialect,
    list_option,
    names_of,
    with_orbit,
)
from starid.cli.options import AsJson


@with_option_groups
def command(
    script: Annotated[
        Path,
        typer.Argument(
            help="Name of a bundled session, or a TOML script.", autocompletion=names_of("session")
        ),
    ],
    *,
    bench: BenchOptions,
    orbit: OrbitChoice = None,
    log: Annotated[
        Path | None, typer.Option(help="Folder for logs, samples and images; default out/session/NAME.")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="Truth log of the emulator (run --truth-log).")] = None,
    control: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Control channel of an emulator that runs already, from its ready line."
        ),
    ] = None,
    assume_truth: Annotated[
        bool,
        typer.Option("--assume-truth", help="The unit looks where the script's table truth says."),
    ] = False,
    intrusive: Annotated[
        bool,
        typer.Option(
            "--intrusive",
            help="Without --start and --control: the unit may be restarted, and what it stores erased or overwritten.",
        ),
    ] = False,
    baud: Annotated[int, typer.Option(help="Bit rate of a real serial line.")] = 115200,
    keep_going: Annotated[bool, typer.Option("--keep-going", help="Continue after a failed step.")] = False,
    as_json: AsJson = False,
    _list: Annotated[bool, list_option("session")] = False,
) -> None:
    """Run a session (a TOML script of telecommands, reads and expectations).

    The exit status is 0 if all steps passed, 1 if a step failed, and 2 for invalid input. SIGINT, SIGTERM and
    SIGHUP end the session and the emulator that it started; the remaining steps are reported as not run, and
    the exit status is 128 plus the signal's number.
    """
    from starhil.hil_tests.errors import BenchError
    from starhil.hil_tests.rig.interruption import interruptible
    from starhil.hil_tests.rig.rig import LinkOptions
    from starhil.hil_tests.session import SessionRequest, run_session

    if orbit is not None and not bench.start:
        raise BenchError("--orbit needs --start: it changes the emulator's profile")
    links = LinkOptions(
        bench.serial,
        bench.can,
        checked_dialect(bench.dialect),
        baud,
        bench.host_address,
        bench.device_address,
    )
    request = SessionRequest(
        script,
        links,
        bench.unit,
        bench.start,
        bench.profile,
        log,
        bench.junit,
        truth,
        control,
        assume_truth,
        intrusive,
        keep_going,
        quiet=as_json,
        view=bench.view,
        settings=tuple(with_orbit(None, orbit)),
    )
    with interruptible():
        result = run_session(request)
    if as_json:
        json.dump(result.to_json(), sys.stdout)
        print()
    if result.interruption is not None:
        raise typer.Exit(result.interruption.exit_status)
    raise typer.Exit(0 if result.passed else 1)
