"""`starhil run`: the emulator as a process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.output import output_help, prepare_output


def command(
    profile: Annotated[
        str, typer.Argument(help="Name of a profile, or path of a profile file.")
    ] = "cubestar",
    serial: Annotated[
        str | None, typer.Option(help="auto (a pty), a device, listen://HOST:PORT, or off.")
    ] = None,
    dialect: Annotated[
        str | None,
        typer.Option(
            help="Form of serial replies: a for OBC software written for the CubeComputer (a reply begins with the identifier), "
            "b for a stand-alone node (it does not; the default), c for generation 2. With the wrong one values are "
            "shifted by a byte."
        ),
    ] = None,
    can: Annotated[
        str | None, typer.Option(help="auto (vcan0, else the TCP hub), a channel, or off.")
    ] = None,
    canopen: Annotated[
        int | None, typer.Option(min=0, max=127, help="Node of the CANopen slave beside it; 0 is off.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all noise.")] = None,
    clock: Annotated[str | None, typer.Option(help="real, scaled:FACTOR or stepped.")] = None,
    state_dir: Annotated[
        Path | None,
        typer.Option(
            help="Folder that keeps saved parameters and the boot count over a restart; without it they are lost."
        ),
    ] = None,
    symlink: Annotated[Path | None, typer.Option(help="Link to the pty, removed at the end.")] = None,
    control: Annotated[
        str,
        typer.Option(
            help="Control channel: off, auto (a Unix socket for this user alone), unix:/PATH, "
            "or HOST:PORT (open to every local user)."
        ),
    ] = "off",
    control_token: Annotated[
        str | None,
        typer.Option(
            envvar="STARHIL_CONTROL_TOKEN", help="What each request on the control channel has to carry."
        ),
    ] = None,
    truth_log: Annotated[
        Path | None, typer.Option(help=output_help("CSV file of truth and measurement, a row a frame."))
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a truth log that exists.")] = False,
    scenario: Annotated[
        str,
        typer.Option(
            help="Scenario: a TOML file, or the name of one in configs/scenarios; faults and truths at given times."
        ),
    ] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="section.key=value that overrides the profile; may be repeated."),
    ] = None,
    log: Annotated[str, typer.Option(help="debug, info, warning or error; to stderr.")] = "warning",
) -> None:
    """Run the emulator until SIGINT, SIGTERM or SIGHUP.

    One line on stdout, `ready serial=… dialect=… can=… seed=…`, tells that it takes commands and where.
    """
    from starhil.emulator.pipeline.worker_process import take_worker

    worker = take_worker()  # first of all: it imports and warms up while this process does the rest

    import asyncio
    import gc
    import logging

    from starhil.emulator.errors import EmulatorError
    from starhil.emulator.launch import Run, RunOptions
    from starhil.emulator.profile import load_profile
    from starhil.protocol.serial_framing import Dialect

    levels = ("debug", "info", "warning", "error")
    if log not in levels:
        raise EmulatorError(f"--log {log}: must be one of {', '.join(levels)}")
    logging.basicConfig(level=log.upper(), format="%(relativeCreated)7.0f %(name)s %(levelname)s %(message)s")
    if dialect is not None and dialect not in list(Dialect):
        raise EmulatorError(f"--dialect {dialect}: must be a, b or c")
    overrides = list(settings or ())
    given = {
        "links.serial.port": serial,
        "links.serial.dialect": dialect,
        "links.can.channel": can,
        "run.clock": clock,
        "run.state_dir": None if state_dir is None else str(state_dir.resolve()),
        "links.serial.symlink": None if symlink is None else str(symlink.absolute()),
    }
    overrides += [f"{key}={_quoted(value)}" for key, value in given.items() if value is not None]
    if canopen is not None:
        overrides.append(f"links.canopen.node={canopen}")
    if seed is not None:
        overrides.append(f"run.seed={seed}")
    loaded = load_profile(profile, overrides)
    links = loaded.links
    if (links.serial.port, links.can.channel, control) == ("off", "off", "off") and not (
        links.canopen.node or truth_log
    ):
        raise EmulatorError(
            "no link: nothing could reach the device, and nothing is recorded; "
            "give --serial auto, --can auto, --canopen NODE, --control auto or --truth-log FILE"
        )

    if control_token is not None and not control_token:
        raise EmulatorError("--control-token: is empty; give a text, or leave it out")
    options = RunOptions(truth_log, overwrite, control, control_token or "", scenario)
    if truth_log is not None:
        prepare_output(truth_log, "--truth-log")

    async def run() -> None:
        import signal

        emulator = Run(loaded, options, worker)
        loop = asyncio.get_running_loop()
        ends = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup has it ignored
            ends.append(signal.SIGHUP)
        for number in ends:
            loop.add_signal_handler(number, emulator.ended.set)
        try:
            await emulator.start()
            line = asyncio.create_task(emulator.emulation.ready())
            stop = asyncio.create_task(emulator.ended.wait())
            await asyncio.wait({line, stop}, return_when=asyncio.FIRST_COMPLETED)
            if line.done():
                gc.collect()
                gc.freeze()  # what is there now stays: the collector need not stop the links to look at it
                print(line.result(), flush=True)
                await stop
            else:
                line.cancel()
        finally:
            await emulator.close()

    asyncio.run(run())


def _quoted(text: str) -> str:
    """Write a text as TOML."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
