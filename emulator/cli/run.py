"""`starhil run`: run the emulator."""

from __future__ import annotations

import asyncio
import importlib
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_args, get_type_hints

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import (
    OrbitChoice,
    ProfileArgument,
    Settings,
    UnitChoice,
    absolute_unit,
    as_toml,
    checked_dialect,
    list_option,
    names_of,
    with_orbit,
)
from starhil.emulator.cli.termination import ended_by_signals
from starhil.emulator.console.recorders import RECORDERS
from starhil.emulator.errors import EmulatorError
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starid.cli.output import compiling_reported, output_help, prepare_output

if TYPE_CHECKING:
    from starhil.emulator.launch import Emulator, RunOptions
    from starhil.emulator.profile import Profile


LINKS_PANEL: Final = "Other links, several heads"
TIME_PANEL: Final = "Time, seed and state"
CONTROL_PANEL: Final = "Control channel, tokens, files and log"
"""Groups of the options in `--help`, after those that most runs need."""


@dataclass(frozen=True)
class Key:
    """The key of the profile that an option replaces."""

    name: str
    value: Callable[[Any, int], Any] = lambda value, _number: value
    """Returns the value of the key for the nth head; folders and links differ by head."""


def _unit(unit: str, _number: int) -> str:
    return absolute_unit(unit)


def _state_dir(folder: Path, number: int) -> str:
    own_folder = "" if number == 1 else f"head-{number}"  # in the folder of the first
    return str(folder.resolve() / own_folder)


def _symlink(path: Path, number: int) -> str:
    from starhil.emulator.launch import path_of_head

    return str(path_of_head(path.absolute(), number))


@dataclass(frozen=True)
class DeviceOptions:
    """What replaces keys of the profile of every head; an option that names no key changes nothing."""

    unit: Annotated[UnitChoice, Key("unit", _unit)] = None
    serial: Annotated[
        str | None,
        Key("links.serial.port"),
        typer.Option(
            help="Serial link: auto (a pty), a device path, listen://HOST:PORT, or off. Default: the profile's (auto)."
        ),
    ] = None
    dialect: Annotated[
        str | None,
        Key("links.serial.dialect"),
        typer.Option(
            rich_help_panel=LINKS_PANEL,
            help="Format of serial replies: a for OBC software written for the CubeComputer (replies begin with the "
            "row ID), b for a stand-alone node (no ID), c for generation 2. With the wrong dialect, values are shifted by "
            "one byte. Default: the profile's (b).",
        ),
    ] = None
    can: Annotated[
        str | None,
        Key("links.can.channel"),
        typer.Option(
            help="CAN link: auto (vcan0 if available, else the TCP hub; a new hub if another emulator there has the address), a "
            "channel, or off. Default: the profile's (auto)."
        ),
    ] = None
    canopen: Annotated[
        int | None,
        Key("links.canopen.node"),
        typer.Option(
            rich_help_panel=LINKS_PANEL,
            min=0,
            max=127,
            help="Also run a CANopen node with this ID; 0: off. Default: the profile's (0).",
        ),
    ] = None
    seed: Annotated[
        int | None,
        Key("run.seed"),
        typer.Option(rich_help_panel=TIME_PANEL, help="Random seed. Default: the profile's (1)."),
    ] = None
    clock: Annotated[
        str | None,
        Key("run.clock"),
        typer.Option(
            rich_help_panel=TIME_PANEL,
            help="Simulation clock: real, scaled:FACTOR, or stepped (advances only on request, for repeatable runs). "
            "Default: the profile's (real).",
        ),
    ] = None
    state_dir: Annotated[
        Path | None,
        Key("run.state_dir", _state_dir),
        typer.Option(
            rich_help_panel=TIME_PANEL,
            help="Folder for state that survives restarts, such as saved parameters. Default: no state is kept.",
        ),
    ] = None
    symlink: Annotated[
        Path | None,
        Key("links.serial.symlink", _symlink),
        typer.Option(help="Symbolic link to the pty, from the ready line to the end."),
    ] = None
    orbit: OrbitChoice = None
    settings: Settings = None

    def profile(self, name: str, number: int) -> Profile:
        """Load the profile of the nth head, with the options in place of its keys."""
        from starhil.emulator.profile import load_profile

        overrides = [
            f"{key.name}={as_toml(key.value(value, number))}"
            for option, hint in get_type_hints(type(self), include_extras=True).items()
            for key in get_args(hint)
            if isinstance(key, Key) and (value := getattr(self, option)) is not None
        ]
        return load_profile(name, [*with_orbit(self.settings, self.orbit), *overrides])


@dataclass(frozen=True)
class AroundOptions:
    """What is opened around the run: files, scenario, control channel and console."""

    control: Annotated[
        str,
        typer.Option(
            rich_help_panel=CONTROL_PANEL,
            help="Control channel: off, auto (a Unix socket that only this user can open), unix:/PATH, "
            "or HOST:PORT (open to all local users).",
        ),
    ] = "off"
    control_token: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=CONTROL_PANEL,
            envvar="STARHIL_CONTROL_TOKEN",
            help="Token required in each request on the control channel.",
        ),
    ] = None
    truth_log: Annotated[
        Path | None,
        typer.Option(help=output_help("CSV file of true and measured attitudes, one row per frame.")),
    ] = None
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", rich_help_panel=CONTROL_PANEL, help="Overwrite an existing truth log or recording."
        ),
    ] = False
    scenario: Annotated[
        str,
        typer.Option(
            help="Scenario of timed faults and attitude changes: the name of a bundled scenario, or a TOML file.",
            autocompletion=names_of("scenario"),
        ),
    ] = ""
    view: Annotated[
        str,
        typer.Option(
            metavar="[HOST:PORT]",
            help="Serve the console, a web page; the ready line has its address. Without HOST:PORT: a free port of "
            "127.0.0.1.",
        ),
    ] = "off"
    view_token: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=CONTROL_PANEL,
            envvar="STARHIL_VIEW_TOKEN",
            help="Token of a second address of the console (`view_only` on the ready line), whose pages can look but not "
            "command. It is the same in the next run, so that such pages reconnect.",
        ),
    ] = None
    command_token: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=CONTROL_PANEL,
            envvar="STARHIL_COMMAND_TOKEN",
            help="Token of the console's address (`view`), the same in the next run, so that its pages reconnect; default: "
            "a random one.",
        ),
    ] = None
    record: Annotated[
        list[Path] | None,
        typer.Option(
            help="Record to a folder (for `starhil replay`)"
            + "".join(f" or to FILE{suffix} ({kind.use})" for suffix, kind in RECORDERS.items())
            + ". Missing folders are created. Repeatable."
        ),
    ] = None

    def run_options(self) -> RunOptions:
        """Return the options of the run; the folders of its files are created."""
        from starhil.emulator.cli.console_client import ConsoleClient
        from starhil.emulator.control.token import check_token
        from starhil.emulator.launch import ConsoleOptions, RunOptions

        of_console = {"--view-token": self.view_token, "--command-token": self.command_token}
        for option, token in {"--control-token": self.control_token, **of_console}.items():
            if token is not None:
                check_token(option, token)
        for option, token in of_console.items():
            if token is not None and self.view == "off":
                raise EmulatorError(f"{option}: needs --view")
        if self.view_token is not None and self.view_token == self.command_token:
            raise EmulatorError("--view-token: must differ from --command-token")
        records = _by_format(self.record or ())
        folder = records.pop("", None)
        files = tuple(records.values())
        for path, option in ((self.truth_log, "--truth-log"), *((file, "--record") for file in files)):
            if path is not None:
                prepare_output(path, option)
        for needed in filter(None, (RECORDERS[file.suffix].needs for file in files)):
            importlib.import_module(needed)  # a missing extra is reported before anything starts
        return RunOptions(
            truth_log=self.truth_log,
            overwrite=self.overwrite,
            control=self.control,
            control_token=self.control_token or "",
            scenario=self.scenario,
            record=folder,
            console=None
            if self.view == "off" and not files
            else ConsoleOptions(
                ConsoleClient, self.view, self.view_token or "", self.command_token or "", files
            ),
        )


@with_option_groups
def command(
    profile: ProfileArgument = None,
    head: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel=LINKS_PANEL,
            help="Emulate several heads: give --head PROFILE for each, instead of PROFILE. All heads share one clock and the "
            "first head's truth; each has its own mount.",
            autocompletion=names_of("profile"),
        ),
    ] = None,
    *,
    device: DeviceOptions,
    around: AroundOptions,
    log: Annotated[
        str,
        typer.Option(
            rich_help_panel=CONTROL_PANEL, help="Log level on stderr: debug, info, warning or error."
        ),
    ] = "warning",
    _list: Annotated[bool, list_option("profile", "scenario")] = False,
) -> int:
    """Run the emulator until SIGINT, SIGTERM or SIGHUP.

    When the emulator accepts commands, it prints a line on stdout that gives the links:
    `ready serial=… can=… unit=… profile=… seed=…`. The exit status is 1 if a log, a recording or the state could not be
    written, for example because the disk is full; the run goes on without it.
    """
    from starhil.emulator.launch import Emulator, with_own_seeds
    from starhil.emulator.links.table import LINKS
    from starhil.emulator.profile import DEFAULT_PROFILE
    from starhil.emulator.sensor.pipeline.worker_process import take_worker
    from starhil.emulator.simulation.threads import run_loop

    levels = ("debug", "info", "warning", "error")
    if log not in levels:
        raise EmulatorError(f"--log {log}: must be one of {', '.join(levels)}")
    logging.basicConfig(level=log.upper(), format="%(relativeCreated)7.0f %(name)s %(levelname)s %(message)s")
    checked_dialect(device.dialect)
    if head and profile is not None:
        raise EmulatorError(
            f"{profile}: a profile and --head exclude each other; give it as --head {profile}"
        )
    names = head or [profile or DEFAULT_PROFILE]
    profiles = with_own_seeds([device.profile(name, number) for number, name in enumerate(names, start=1)])
    reachable = any(kind.requested(each.links) for each in profiles for kind in LINKS.values())
    observed = around.truth_log or around.record or (around.control, around.view) != ("off", "off")
    if not reachable and not observed:
        raise EmulatorError(
            "no link: the device could not be reached, and nothing would be recorded; "
            "give --serial auto, --can auto, --canopen NODE, --view, --control auto or --truth-log FILE"
        )
    options = around.run_options()
    if profile is None and not head and (unit := profiles[0].unit_source) != DEFAULT_UNIT:
        print(
            f"note: camera, sensor and parameters of the unit {unit} are those of the profile {DEFAULT_PROFILE}; name a profile to "
            "change them (starhil docs profile)",
            file=sys.stderr,
        )
    if any(each.identifier.get("refinement") is False for each in profiles):
        print(
            "note: identifier.refinement=false is for experiments: attitudes are valid whatever their stated uncertainty, and most are "
            "off by degrees (starhil docs identification)",
            file=sys.stderr,
        )
    return run_loop(serve(lambda: Emulator(profiles, options, take_worker())))


async def serve(make: Callable[[], Emulator]) -> int:
    """Run an emulator, made in the event loop, until a signal or the control channel ends it; return the exit status."""
    import gc

    from starhil.emulator.simulation.guard import log_loop_errors_once
    from starhil.emulator.simulation.threads import share_interpreter

    share_interpreter()
    emulator = make()
    log_loop_errors_once(asyncio.get_running_loop())
    with ended_by_signals(emulator.ended.set):
        try:
            line = asyncio.create_task(_started(emulator))
            stop = asyncio.create_task(emulator.ended.wait())
            with compiling_reported(start=True):
                await asyncio.wait({line, stop}, return_when=asyncio.FIRST_COMPLETED)
            if line.done():
                gc.collect()
                gc.freeze()  # long-lived objects: garbage collection would pause the links
                gc.enable()
                print(line.result(), flush=True)
                await stop
            else:
                line.cancel()
                await asyncio.wait({line})
        finally:
            await emulator.close()
    return int(emulator.failed)


async def _started(emulator: Emulator) -> str:
    """Start an emulator, wait until it is ready, and return the ready line."""
    await emulator.start()
    return await emulator.ready()


def _by_format(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the files of `--record` by suffix, and the folder by the empty suffix."""
    by_suffix: dict[str, Path] = {}
    for path in paths:
        suffix = path.suffix if path.suffix in RECORDERS else ""
        other = by_suffix.setdefault(suffix, path)
        if other is not path:
            kind = f"{suffix[1:].upper()} file" if suffix else "folder"
            raise EmulatorError(f"--record {path}: one {kind} per run, and {other} is one already")
    return by_suffix
