"""A complete session: load the script, set up the bench, run the steps, write the reports."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from starhil.hil_tests.attitude import attitude_error, unit
from starhil.hil_tests.errors import BenchError, EmulatorProcessError, ScriptError
from starhil.hil_tests.reports import FAILED, PASSED, SKIPPED, prepare_report, write_junit
from starhil.hil_tests.rig.console_feed import RunFeed, console_address
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, pointed
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from starhil.hil_tests.rig.rig import LinkOptions, Rig, check_links, links_to_use
from starhil.hil_tests.rig.temporary_folder import temporary_folder
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.session.expect import show_angle
from starhil.hil_tests.session.results import SessionResult, StepResult, junit_cases
from starhil.hil_tests.session.script import Script, load_script
from starhil.hil_tests.session.session import run_steps
from starhil.hil_tests.session.step import BOOTING
from starhil.hil_tests.session.steps import Command, Control, Listen
from starhil.protocol.errors import escape_controls
from starhil.protocol.files.bundled import DEFAULT_UNIT, find, not_found
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.unit import load_unit

TRUTH_WITHIN_ARCSEC: Final = 1.0
"""Largest difference of two truths that are the same."""
INTRUSIVE_ACTIONS: Final = frozenset({"reset", "save_parameters", "erase_file", "format_card"})
"""Actions of telecommands that restart a unit, or erase or overwrite what it stores."""
DEFAULT_FOLDER: Final = Path("out") / "session"
STYLES: Final = {PASSED: ("✓", "green"), FAILED: ("✗", "bold red"), SKIPPED: ("-", "yellow")}


@dataclass(frozen=True)
class SessionRequest:
    """Options of the user; see `starhil session --help`."""

    script: Path
    options: LinkOptions
    unit: str | None = None
    start: bool = False
    profile: str | None = None
    folder: Path | None = None
    junit: Path | None = None
    truth: Path | None = None
    control: str | None = None
    """Address of the control channel of an emulator that runs already."""
    assume_truth: bool = False
    """Whether the unit is known to look where the script has the truth."""
    intrusive: bool = False
    """Whether a unit that is not known to be an emulator may be restarted, and what it stores erased or overwritten."""
    keep_going: bool = False
    quiet: bool = False
    view: str | None = None
    """Address of the console that shows the results; `auto` with `start`: the started emulator's."""
    settings: tuple[str, ...] = ()
    """Settings of the started emulator, which those of the script override."""


def find_script(path: Path) -> Path:
    """Return the script file; a plain name refers to a bundled script.

    Raises ScriptError: there is no such script; the text suggests similar names.
    """
    found = find("session", path)
    if not found.is_file():
        raise ScriptError(not_found("session", path))
    return found


def run_session(request: SessionRequest) -> SessionResult:
    """Run a session and return its result.

    Raises BenchError: the script is invalid, a port is not available, or the emulator does not start.
    """
    icd = load_unit(request.unit or DEFAULT_UNIT)
    path = find_script(request.script)
    script = load_script(path, icd)
    if request.keep_going:
        script.defaults.keep_going = True
    options = _options(request, script)
    _check_steps(path, script, icd, options.links, request)
    if request.truth is not None:
        TruthLogReader(request.truth).check()
    folder = request.folder or DEFAULT_FOLDER / path.stem
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BenchError(f"{folder}: the log folder cannot be created: {error.strerror}") from None
    if request.junit is not None:
        prepare_report(request.junit)
    console = Console(highlight=False, quiet=request.quiet)
    console.print(Text(escape_controls(script.title), style="bold"))
    unconfirmed = not request.start and request.control is None and request.truth is None
    if unconfirmed and _asks_for_an_emulator(script):
        remedy = f"use --start; or {_control_option(script, folder)}"
        hint = f"This session was written for an emulator; another unit may fail steps: {remedy}"
        console.print(Text(escape_controls(hint), style="yellow"), soft_wrap=True)
    show: Callable[[StepResult], None] = partial(_print_result, console)
    result: SessionResult | None = None
    try:
        with ExitStack() as stack:
            rig = _open_bench(request, script, options, icd, folder, stack)
            if request.control is not None:
                _check_emulator(path, script, rig, folder)
            show = _shown_on_console(request.view, script, rig, stack, show)
            begun = stack.enter_context(_running_step(console))
            result = run_steps(script, rig, folder, on_begin=begun, on_result=show, truth_path=request.truth)
        if all(step.status == SKIPPED for step in result.results) and result.interruption is None:
            result = _failed(result, "at least one step runs", "every step is skipped", show)
    except EmulatorProcessError as error:
        if result is None:
            raise
        result = _failed(result, "the emulator runs until it is ended", str(error), show)
    except Interrupted as interruption:  # before the first step, or after the last one
        if result is None:
            reason = f"not run: {interruption.reason}"
            steps = enumerate(script.steps, 1)
            skipped = (StepResult(number, step.name, "", SKIPPED, reason, 0.0) for number, step in steps)
            result = SessionResult(script.title, tuple(skipped), 0.0)
        result = replace(result, interruption=interruption)
    if request.junit is not None:
        write_junit(request.junit, script.title, junit_cases(result, path.stem), result.seconds)
    counts = ", ".join(f"{result.count(status)} {status}" for status in STYLES)
    style = "green" if result.passed else "bold red"
    console.print(Text(f"{counts} in {result.seconds:.1f} s; logs in {folder}", style=style), soft_wrap=True)
    return result


def _asks_for_an_emulator(script: Script) -> bool:
    """Return whether a script names a profile or settings of the emulator."""
    return bool(script.emulator.profile or script.emulator.settings)


def _compares_with_its_attitude(script: Script) -> bool:
    """Return whether a step compares with the attitude that a script has as the truth."""
    checks = [step.attitude for step in script.steps if step.attitude is not None]
    return script.truth.attitude is not None and any(check.attitude is None for check in checks)


def start_command(script: Script, folder: Path) -> str:
    emulator = script.emulator
    settings = pointed(script.truth.attitude, emulator.settings)
    words = ["starhil", "run", *([emulator.profile] if emulator.profile else [])]
    words += [word for setting in settings for word in ("--set", setting)]
    words += [] if emulator.seed is None else ["--seed", str(emulator.seed)]
    words += [] if script.truth.file is None else ["--truth-log", str(folder / script.truth.file)]
    return shlex.join([*words, "--control", "auto"])


def _control_option(script: Script, folder: Path) -> str:
    """Return how to name an emulator that runs, so that it is compared with what a script needs."""
    start = start_command(script, folder)
    return f"--control with the address on the ready line, for an emulator that runs by: {start}"


def _check_emulator(path: Path, script: Script, rig: Rig, folder: Path) -> None:
    """Raise BenchError if the emulator that runs is not the one that a script is for: profile, settings, where it looks."""
    status, emulator = rig.control("status", {}), script.emulator
    problems = []
    if status["clock"] == "stepped":
        problems.append("its clock is stepped, on which a session waits for ever")
    if emulator.profile and status["profile"] != Path(emulator.profile).stem:
        problems.append(f"its profile is {status['profile']}, not {Path(emulator.profile).stem}")
    present = {"run.algorithm": "algorithm", "run.clock": "clock", "truth.kind": "truth_kind"}
    for setting in emulator.settings:
        key, _, value = setting.partition("=")
        if key in present and (found := status[present[key]]) != value.strip("\"'"):
            problems.append(f"its {key} is {found}, not {value}")
    if status["mode"] == "boot":
        problems.append(BOOTING)
    elif status["mode"] == "error":
        problems.append("its mode is error")
    if script.truth.attitude is not None:
        truth = unit(rig.control("truth", {})["quaternion_xyzw"])
        off = attitude_error(truth, script.truth.attitude).total_arcsec
        if off > TRUTH_WITHIN_ARCSEC:
            problems.append(f"it looks {show_angle(off)} from where the script has the truth")
    if problems:
        command = start_command(script, folder)
        raise BenchError(
            f"{path.name}: the emulator does not fit: {'; '.join(problems)}; use --start, or start it by: {command}"
        )


def _check_steps(
    path: Path, script: Script, icd: InterfaceDefinition, links: tuple[str, ...], request: SessionRequest
) -> None:
    """Raise ScriptError if a step can never pass on these links, needs an emulator that the bench starts, or a truth that is missing."""
    controlled = request.start or request.control is not None
    if request.truth is None and not controlled:
        folder = request.folder or DEFAULT_FOLDER / path.stem
        control = _control_option(script, folder)
        if script.truth.file is not None:
            log = shlex.quote(str(folder / script.truth.file))
            raise ScriptError(
                f"{path.name}: compares attitudes with a truth that the emulator writes: use --start; or give --truth {log}, or "
                f"{control}"
            )
        if _compares_with_its_attitude(script) and not request.assume_truth:
            raise ScriptError(
                f"{path.name}: compares attitudes with its [truth], and nothing shows that the unit looks there: use --start; or give "
                f"--assume-truth if it does; or {control}"
            )
    commands = {step.row.name: step.row.action for step in script.steps if isinstance(step, Command)}
    intrusive = [name for name, action in commands.items() if action in INTRUSIVE_ACTIONS]
    if intrusive and not controlled and not request.intrusive:
        raise ScriptError(
            f"{path.name}: restarts the unit, or erases or overwrites what it stores ({', '.join(intrusive)}): use --start; or give "
            "--intrusive if it may; or, for an emulator that runs, --control with the address on its ready line"
        )
    for number, step, link in script.planned(links):
        why = ""
        if step.needs_emulator and not request.start:
            why = "only an emulator that the bench started can do this: use --start"
        elif step.needs_control and not controlled:
            why = "only an emulator can do this: use --start, or --control with the address on its ready line"
        elif isinstance(step, Listen) and link == "can" and icd.link.can is None:
            why = f"unit {icd.name} has only CANopen on CAN, where no row is sent without a request; read it"
        if why:
            raise ScriptError(f"{path.name}: step {number}: {type(step).__name__.lower()}: {why}")


def _failed(
    result: SessionResult, name: str, detail: str, show: Callable[[StepResult], None]
) -> SessionResult:
    """Return a result with one more step, which has failed."""
    end = StepResult(result.results[-1].number + 1, name, "", FAILED, detail, 0.0)
    show(end)
    return replace(result, results=(*result.results, end))


def _open_bench(
    request: SessionRequest,
    script: Script,
    options: LinkOptions,
    icd: InterfaceDefinition,
    folder: Path,
    stack: ExitStack,
) -> Rig:
    """Open the bench with its links, and start the emulator if requested."""
    emulator = None
    if request.start:
        if options.can == "auto":
            options = replace(options, can=stack.enter_context(private_can_bus()))
        state = stack.enter_context(temporary_folder("starhil-session-"))
        emulator = _emulator(request, script, options, folder, state)
    rig = stack.enter_context(
        Rig(options, icd, emulator=emulator, control=request.control, log_folder=folder)
    )
    if emulator is not None:
        emulator.check_unit(request.unit)
    for link in rig.links:
        rig.client(link)  # report a missing port before the first step
    return rig


def _shown_on_console(
    view: str | None, script: Script, rig: Rig, stack: ExitStack, show: Callable[[StepResult], None]
) -> Callable[[StepResult], None]:
    """Return a function that shows a result, also on the console if there is one."""
    if view is None:
        return show
    address = console_address(view, rig.emulator)
    unit = ", ".join(f"{link} {getattr(rig.options, link)}" for link in rig.links)
    planned = len(script.planned(rig.links))
    feed = stack.enter_context(
        RunFeed(address, kind="session", title=script.title, unit=unit, planned=planned)
    )

    def show_on_both(result: StepResult) -> None:
        show(result)
        shown = {key: getattr(result, key) for key in ("name", "status", "detail", "link", "seconds")}
        feed.result(id=str(result.number), **shown)

    return show_on_both


def _options(request: SessionRequest, script: Script) -> LinkOptions:
    wanted = (script.defaults.link or "serial") if request.start else None
    by_default = (
        "auto" if wanted in ("serial", "both") else None,
        "auto" if wanted in ("can", "both") else None,
    )
    serial, can = links_to_use(request.options.serial, request.options.can, by_default)
    check_links(serial, can, "--serial DEV, --can CHANNEL, both", start=request.start)
    timeout_s, retries = script.defaults.timeout_s, script.defaults.retries
    return replace(request.options, serial=serial, can=can, timeout_s=timeout_s, retries=retries)


def _emulator(
    request: SessionRequest, script: Script, options: LinkOptions, folder: Path, state: Path
) -> EmulatorProcess:
    """Prepare an emulator for the session, with an empty parameter store."""
    section = script.emulator
    beside = find_script(request.script).parent / (section.profile or "")
    truth_log = None
    if script.truth.file is not None and request.truth is None:
        truth_log = folder / script.truth.file
    extra = ["--view", "auto"] if request.view == "auto" else []
    extra += ["--control", "auto"] if any(isinstance(step, Control) for step in script.steps) else []
    return EmulatorProcess(
        emulator_command(
            profile=request.profile or (str(beside) if beside.is_file() else section.profile),
            unit=request.unit,
            serial=options.serial or "off",
            can=options.can or "off",
            dialect=options.dialect,
            seed=section.seed,
            settings=[*request.settings, *pointed(script.truth.attitude, section.settings)],
            state_dir=state,
            truth_log=truth_log,
            extra=extra,
        )
    )


@contextmanager
def _running_step(console: Console) -> Iterator[Callable[[int, str], None]]:
    """Show the running step and how long it has run, below the results, where the console is a terminal."""
    columns = TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    with Progress(
        *columns, console=console, disable=not console.is_terminal, transient=True, refresh_per_second=2
    ) as lines:
        task = lines.add_task("", total=None)

        def begun(number: int, name: str) -> None:
            lines.reset(task, description=f"… {number:3d}  {escape_controls(name)}")

        yield begun


def _print_result(console: Console, result: StepResult) -> None:
    mark, style = STYLES[result.status]
    line = Text(f"{mark} ", style=style)
    line.append(f"{result.number:3d}  ", style="dim")
    line.append(escape_controls(result.name))
    if result.link:
        line.append(f"  [{result.link}]", style="dim")
    if result.latency_s is not None:
        line.append(f"  {result.latency_s:.4f} s", style="cyan")
    if result.detail:
        line.append(f"  {escape_controls(result.detail)}", style="red" if result.status == FAILED else "dim")
    console.print(line, soft_wrap=True)
