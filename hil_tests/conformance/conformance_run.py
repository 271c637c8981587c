"""A complete conformance run: options, links, cases, interruption."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import Case
from starhil.hil_tests.conformance.link_probe import ProbeTimes
from starhil.hil_tests.conformance.ports import live_can, live_serial
from starhil.hil_tests.conformance.runner import (
    Outcome,
    Verdict,
    case_of_run,
    not_run,
    run_cases,
    select_cases,
)
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.hil_tests.conformance.suites import can_suite, serial_suite, settings_of
from starhil.hil_tests.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.errors import BenchError, EmulatorProcessError
from starhil.hil_tests.interruption import Interrupted
from starhil.hil_tests.judge.definition import Unit, read_unit
from starhil.hil_tests.private_can_bus import private_can_bus
from starhil.hil_tests.results import FAILED
from starhil.hil_tests.run_feed import RunFeed, console_address
from starhil.hil_tests.temporary_folder import temporary_folder
from starhil.protocol.icd import load_unit
from starhil.protocol.serial_stack import chosen_dialect
from starhil.protocol.unit_folders import DEFAULT_UNIT
from starhil.protocol.values import IcdError

DEFAULT_BAUD: Final = 115200


@dataclass(frozen=True)
class ConformanceRequest:
    """Options of the user; see `starhil conformance --help`."""

    unit: str | None = None
    serial: str | None = None
    can: str | None = None
    canopen_node: int | None = None
    eds: Path | None = None
    start: bool = False
    profile: str | None = None
    dialect: str | None = None
    baud: int | None = None
    host_address: int = 1
    device_address: int = 4
    patterns: tuple[str, ...] = ()
    safe_only: bool = False
    speed: float = 1.0
    times: ProbeTimes = field(default_factory=ProbeTimes)
    view: str | None = None
    """Address of a console that shows the outcomes; `auto` with `start`: the started emulator's console."""


def all_cases(request: ConformanceRequest) -> list[Case[Any]]:
    """Return the cases of all requested links, selected by pattern and safety.

    Raises
    ------
    BenchError
        No link is given, the unit does not have the dialect, or a pattern matches no case.
    """
    unit = read_unit(request.unit or DEFAULT_UNIT)
    cases: list[Case[Any]] = []
    if request.dialect is not None:
        try:
            chosen_dialect(load_unit(request.unit or DEFAULT_UNIT), request.dialect)
        except IcdError as error:
            raise BenchError(f"--dialect {request.dialect}: {error}") from None
    if request.serial is not None:
        cases += serial_suite(unit)
    if request.can is not None and (unit.can is not None or request.canopen_node is None):
        cases += can_suite(unit)
    if request.canopen_node is not None:
        from starhil.hil_tests.conformance.canopen_suite import canopen_suite

        cases += canopen_suite(unit)
    if not cases:
        raise BenchError("no link: use --serial DEV, --can CHANNEL, --canopen NODE, or --start")
    return select_cases(cases, request.patterns, safe_only=request.safe_only)


@dataclass(frozen=True)
class ConformanceResult:
    """Outcomes of a run, and the signal that interrupted it, if any."""

    outcomes: list[Outcome]
    interruption: Interrupted | None = None


def run_conformance(
    request: ConformanceRequest, on_outcome: Callable[[Outcome], None] = lambda _outcome: None
) -> ConformanceResult:
    """Run the cases on the requested links.

    After an interruption, the remaining cases are marked as not run.

    Raises
    ------
    BenchError, ProtocolError
        A port, a bus or the emulator is not available.
    """
    unit = read_unit(request.unit or DEFAULT_UNIT)
    cases = all_cases(request)
    outcomes: list[Outcome] = []
    complete = False

    def record(outcome: Outcome) -> None:
        outcomes.append(outcome)
        on_outcome(outcome)

    try:
        with ExitStack() as stack:
            serial, can = request.serial, request.can
            emulator = _start_emulator(request, stack) if request.start else None
            if emulator is not None:
                serial, can = emulator.ready.get("serial"), emulator.ready.get("can")
            shown: Callable[[Outcome], None] = record
            if request.view is not None:
                address = console_address(request.view, emulator)
                shown = _shown_on_console(address, f"{serial or ''} {can or ''}", len(cases), stack, record)
            _run_on_links(request, unit, cases, serial, can, shown)
            complete = True
    except EmulatorProcessError as error:
        if not complete:
            raise
        record(_outcome_of_early_end(error))
    except Interrupted as interruption:
        done = {outcome.id for outcome in outcomes}
        for item in cases:
            if item.id not in done:
                record(not_run(item, interruption.reason))
        return ConformanceResult(outcomes, interruption)
    return ConformanceResult(outcomes)


def _shown_on_console(
    address: str, unit: str, planned: int, stack: ExitStack, record: Callable[[Outcome], None]
) -> Callable[[Outcome], None]:
    """Return a function that shows an outcome on the console too."""
    feed = stack.enter_context(
        RunFeed(address, kind="conformance", title="Conformance", unit=unit.strip(), planned=planned)
    )

    def record_on_both(outcome: Outcome) -> None:
        record(outcome)
        detail = outcome.seen
        if outcome.status == FAILED:
            detail = f"expected {outcome.expected}; seen {outcome.seen}"
        feed.result(
            outcome.title,
            outcome.status,
            detail,
            identity=outcome.id,
            seconds=outcome.seconds,
            traffic=outcome.log if outcome.status == FAILED else (),
        )

    return record_on_both


def _run_on_links(
    request: ConformanceRequest,
    unit: Unit,
    cases: Sequence[Case[Any]],
    serial: str | None,
    can: str | None,
    on_outcome: Callable[[Outcome], None],
) -> None:
    """Run the cases of each link in turn."""
    with ExitStack() as stack:
        mine = [item for item in cases if item.id.startswith("serial.")]
        if mine and serial is not None:
            port = stack.enter_context(live_serial(serial, request.baud or DEFAULT_BAUD, request.speed))
            baud = DEFAULT_BAUD if request.start and request.baud is None else request.baud
            if baud is not None:  # the bit rate of the line does not change
                baud = round(baud / request.speed)
            own, dialect = settings_of(unit), request.dialect
            probe = SerialProbe(port, unit, dialect=dialect, baud=baud, times=request.times, settings=own)
            run_cases(probe, mine, on_outcome, port=serial)
        mine = [item for item in cases if item.id.startswith("can.")]
        if mine and can is not None:
            bus = stack.enter_context(live_can(can, request.speed))
            addresses = {"host": request.host_address, "device": request.device_address}
            run_cases(
                CanProbe(bus, unit, times=request.times, settings=settings_of(unit), **addresses),
                mine,
                on_outcome,
                port=f"{can} at address {request.device_address}",
            )
        mine = [item for item in cases if item.id.startswith("canopen.")]
        if mine and can is not None:
            _run_canopen(request, can, mine, on_outcome)


def _outcome_of_early_end(error: EmulatorProcessError) -> Outcome:
    """Return the outcome for an emulator that ended early; earlier outcomes are kept."""
    case = case_of_run("emulator.end", "the emulator runs until it is ended, and ends cleanly", "starhil run")
    return Outcome.of(case, Verdict(FAILED, "exit with status 0 on request", str(error)))


def _start_emulator(request: ConformanceRequest, stack: ExitStack) -> EmulatorProcess:
    """Start an emulator with the requested links."""
    folder = stack.enter_context(temporary_folder("starhil-conformance-"))
    needs_bus = request.can is not None or request.canopen_node is not None
    channel = "off"
    if needs_bus:
        channel = (
            stack.enter_context(private_can_bus()) if request.can in (None, "auto") else str(request.can)
        )
    extra = [] if request.canopen_node is None else ["--canopen", str(request.canopen_node)]
    if request.speed != 1.0:
        extra += ["--clock", f"scaled:{request.speed:g}"]
    if request.view == "auto":
        extra += ["--view", "auto"]
    command = emulator_command(
        profile=request.profile,
        unit=request.unit,
        serial="off" if request.serial is None else request.serial,
        can=channel,
        dialect=request.dialect,
        seed=1,
        state_dir=folder,
        extra=extra,
    )
    emulator = stack.enter_context(EmulatorProcess(command))
    emulator.check_unit(request.unit)
    return emulator


def _run_canopen(
    request: ConformanceRequest,
    can: str,
    cases: Sequence[Case[Any]],
    on_outcome: Callable[[Outcome], None],
) -> None:
    """Run the CANopen cases with the requested EDS, or else the product's."""
    import canopen
    from canopen.objectdictionary import import_od

    from starhil.hil_tests.conformance.canopen_probe import CanopenProbe

    node = int(request.canopen_node or 0)
    text = _eds_text(request)
    with temporary_folder("starhil-eds-") as folder:
        path = folder / "unit.eds"
        path.write_text(text, encoding="utf-8")
        try:
            dictionary = import_od(str(path), node)
        except (canopen.ObjectDictionaryError, ValueError, KeyError) as error:
            raise BenchError(f"{request.eds}: not a valid EDS: {error}") from None
    with live_can(can, request.speed) as bus:
        probe = CanopenProbe(bus, node, dictionary, text)
        run_cases(probe, cases, on_outcome, port=f"{can} at node {node}")


def _eds_text(request: ConformanceRequest) -> str:
    path = request.eds
    if path is None:
        from starhil.protocol.canopen import build_dictionary, build_eds

        return build_eds(build_dictionary(load_unit(request.unit or DEFAULT_UNIT)))
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BenchError(f"{path}: the EDS cannot be read: {error.strerror}") from None
