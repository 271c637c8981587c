"""A complete conformance run: options, links, cases, interruption."""

from __future__ import annotations

import configparser
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from starhil.hil_tests.attitude import from_radec_roll
from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import Case, CaseFailed, Probe, TruthSource
from starhil.hil_tests.conformance.link_probe import ProbeTimes
from starhil.hil_tests.conformance.ports import LivePort
from starhil.hil_tests.conformance.runner import (
    Outcome,
    case_of_run,
    identity_of,
    left_out_text,
    not_run,
    run_cases,
    select_cases,
)
from starhil.hil_tests.conformance.serial_probe import DEFAULT_BAUD, SerialProbe
from starhil.hil_tests.conformance.suites import can_suite, serial_suite, settings_of
from starhil.hil_tests.errors import BenchError, EmulatorProcessError
from starhil.hil_tests.judge.definition import Unit, read_unit
from starhil.hil_tests.judge.links import BUSES
from starhil.hil_tests.reports import FAILED
from starhil.hil_tests.rig.console_feed import RunFeed, console_address
from starhil.hil_tests.rig.control import ControlClient, Truth
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, pointed
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from starhil.hil_tests.rig.temporary_folder import temporary_folder
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.protocol.errors import IcdError
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starhil.protocol.files.user_file import read_user_file
from starhil.protocol.serial.stack import chosen_dialect
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.serial import open_serial
from starhil.protocol.unit import load_unit

if TYPE_CHECKING:
    from canopen import ObjectDictionary


POINTING: Final = from_radec_roll(90.0, -30.0, 45.0)
"""Attitude of an emulator that a run starts: in any naming of the axes, a conjugated quaternion is at least 19 deg off."""


LEFT_OUT: Final = "it changes the device; --intrusive runs it"
"""Reason why a case was not run."""


DEVICE_TYPE: Final = 0x1000
"""Index of the one object that CiA 301 requires of every node."""
LONGEST_LINE: Final = 1000
"""Longest line of an EDS, of which CiA 306 allows 255 characters: Python's reader takes a time that grows with its square."""

WRONG_VALUES: Final = (ValueError, KeyError, TypeError, AttributeError, IndexError)
"""What the package canopen raises for values that no EDS has."""


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
    settings: tuple[str, ...] = ()
    """With `start`: overrides of the profile, `section.key=value`."""
    truth: str | None = None
    """Without `start`: a truth log, or right ascension, declination and roll of the sensor in degrees, as RA,DEC,ROLL."""
    dialect: str | None = None
    baud: int | None = None
    host_address: int = 1
    device_address: int = 4
    patterns: tuple[str, ...] = ()
    intrusive: bool | None = None
    """Whether cases that change the device are run; by default only with `start`."""
    speed: float = 1.0
    times: ProbeTimes = field(default_factory=ProbeTimes)
    view: str | None = None
    """Address of a console that shows the outcomes; `auto` with `start`: the started emulator's console."""

    @property
    def safe_only(self) -> bool:
        """Whether only cases that change nothing are run."""
        return not (self.start if self.intrusive is None else self.intrusive)


def requested_cases(request: ConformanceRequest) -> tuple[list[Case[Any]], list[Case[Any]]]:
    """Return the cases of all requested links, selected by pattern: those to run, and those left out because they change the device.

    Raises BenchError: no link is given, the unit does not have the dialect, or a pattern matches no case or none to run.
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
    """Outcomes of a run."""

    outcomes: list[Outcome]
    facts: dict[str, str]
    """For reports: `date`, versions of `starhil` and of the `definition`, `links`, `truth`, and `device on LINK`: its identity."""
    interruption: Interrupted | None = None
    """The signal that interrupted the run, if any."""


def _facts(request: ConformanceRequest, unit: Unit) -> dict[str, str]:
    links = [
        f"serial {request.serial}" + (f" (dialect {request.dialect})" if request.dialect else "")
        if request.serial
        else "",
        f"CAN {request.can}" if request.can else "",
        f"CANopen node {request.canopen_node}" if request.canopen_node else "",
    ]
    started = ", emulator started for this run" if request.start else ""
    return {
        "links": ", ".join(filter(None, links)) + started,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "starhil": version("starhil"),
        "definition": f"{unit.name} {unit.version}",
        "truth": "the emulator's" if request.start else request.truth or "not given",
    }


def run_conformance(
    request: ConformanceRequest, on_outcome: Callable[[Outcome], None] = lambda _outcome: None
) -> ConformanceResult:
    """Run the cases on the requested links.

    After an interruption, the remaining cases are marked as not run.

    Raises BenchError, ProtocolError: a port, a bus or the emulator is not available.
    """
    unit = read_unit(request.unit or DEFAULT_UNIT)
    cases, left_out = requested_cases(request)
    outcomes: list[Outcome] = []
    facts = _facts(request, unit)
    if left_out:
        facts["left out"] = left_out_text(left_out, [*cases, *left_out])
    complete = False

    listeners = [outcomes.append, on_outcome]

    def record(outcome: Outcome) -> None:
        for listener in listeners:
            listener(outcome)

    try:
        with ExitStack() as stack:
            ports: Mapping[str, str | None] = {"serial": request.serial, "can": request.can}
            truth = None if request.truth is None else truth_source(request.truth)
            links = {item.id.partition(".")[0] for item in cases}
            eds = _read_eds(request) if "canopen" in links else None
            emulator = _start_emulator(request, stack) if request.start else None
            if emulator is not None:
                ports = emulator.ready
                if "control" in emulator.ready:
                    control = stack.enter_context(ControlClient(emulator.ready["control"]))
                    truth = Truth(control, unit.conventions).attitude
            if request.view is not None:
                where = " ".join(port for link in BUSES if (port := ports.get(link)))
                address = console_address(request.view, emulator)
                planned = len(cases) + len(left_out)
                feed = stack.enter_context(
                    RunFeed(address, kind="conformance", title="Conformance", unit=where, planned=planned)
                )
                listeners.append(partial(_send_to_console, feed))
            for probe, port in _probes(request, unit, links, ports, eds, stack):
                probe.truth = truth
                facts[f"device on {probe.link}"] = identity_of(probe)
                mine = [item for item in cases if item.id.startswith(f"{probe.link}.")]
                run_cases(probe, mine, record, port=port)
            for item in left_out:
                record(not_run(item, LEFT_OUT))
            complete = True
    except EmulatorProcessError as error:
        if not complete:
            raise
        end = case_of_run(
            "emulator.end", "the emulator runs until it is ended, and ends cleanly", "starhil run"
        )
        record(Outcome.of(end, CaseFailed("exit with status 0 on request", str(error))))
    except Interrupted as interruption:
        done = {outcome.id for outcome in outcomes}
        for item in (*cases, *left_out):
            if item.id not in done:
                record(not_run(item, LEFT_OUT if item in left_out else interruption.reason))
        return ConformanceResult(outcomes, facts, interruption)
    return ConformanceResult(outcomes, facts)


def truth_source(text: str) -> TruthSource:
    """Return the true attitude that RA,DEC,ROLL in degrees states, or the newest one in the truth log of this name.

    Raises BenchError: the log cannot be read or is none, or an angle is out of range.
    """
    try:
        angles = [float(part) for part in text.split(",")]
    except ValueError:
        log = TruthLogReader(Path(text))
        log.check()
        return log.latest
    if len(angles) != 3:
        raise BenchError(f"--truth {text}: give three numbers in degrees, RA,DEC,ROLL, or a truth log")
    ra_deg, dec_deg, roll_deg = angles
    if not (math.isfinite(ra_deg + roll_deg) and abs(dec_deg) <= 90.0):
        raise BenchError(f"--truth {text}: give RA, Dec from -90 to 90 and roll in degrees")
    attitude = from_radec_roll(ra_deg, dec_deg, roll_deg)
    return lambda: attitude


def _send_to_console(feed: RunFeed, outcome: Outcome) -> None:
    feed.result(
        id=outcome.id,
        name=outcome.title,
        status=outcome.status,
        detail=outcome.detail,
        seconds=outcome.seconds,
        log=outcome.log if outcome.status == FAILED else (),
    )


def _probes(
    request: ConformanceRequest,
    unit: Unit,
    links: set[str],
    ports: Mapping[str, str | None],
    eds: tuple[ObjectDictionary, str] | None,
    stack: ExitStack,
) -> Iterator[tuple[Probe, str]]:
    """Open the links one after the other; yield the probe of each, and the name of its port."""
    serial, can = ports.get("serial"), ports.get("can")
    if "serial" in links and serial is not None:
        port = stack.enter_context(
            LivePort(open_serial(serial, baud=request.baud or DEFAULT_BAUD, paced=False), request.speed)
        )
        baud = DEFAULT_BAUD if request.start and request.baud is None else request.baud
        if baud is not None:  # the bit rate of the line does not change
            baud = round(baud / request.speed)
        settings, dialect = settings_of(unit), request.dialect
        yield (
            SerialProbe(port, unit, dialect=dialect, baud=baud, times=request.times, settings=settings),
            serial,
        )
    if "can" in links and can is not None:
        bus = stack.enter_context(LivePort(open_can(can), request.speed))
        host, device = request.host_address, request.device_address
        settings = settings_of(unit)
        probe = CanProbe(bus, unit, host=host, device=device, times=request.times, settings=settings)
        yield probe, f"{can} at address {device}"
    if eds is not None and can is not None:
        from starhil.hil_tests.conformance.canopen_probe import CanopenProbe
        from starhil.hil_tests.judge.canopen import entries

        node = int(request.canopen_node or 0)
        bus = stack.enter_context(LivePort(open_can(can), request.speed))
        yield CanopenProbe(bus, node, *eds, entries(unit, unit.canopen)), f"{can} at node {node}"


def _start_emulator(request: ConformanceRequest, stack: ExitStack) -> EmulatorProcess:
    folder = stack.enter_context(temporary_folder("starhil-"))
    channel = request.can or "off"
    if channel == "auto":
        channel = stack.enter_context(private_can_bus())
    extra = ["--control", f"unix:{folder}/control"]
    if request.canopen_node is not None:
        extra += ["--canopen", str(request.canopen_node)]
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
        settings=pointed(POINTING, request.settings),
        state_dir=folder,
        extra=extra,
    )
    emulator = stack.enter_context(EmulatorProcess(command))
    emulator.check_unit(request.unit)
    return emulator


def _read_eds(request: ConformanceRequest) -> tuple[ObjectDictionary, str]:
    """Return dictionary and text of the requested EDS, or else of the product's."""
    import canopen
    from canopen.objectdictionary import import_od

    text = _eds_text(request)
    with temporary_folder("starhil-eds-") as folder:
        path = folder / "unit.eds"
        path.write_text(text, encoding="utf-8")
        try:
            dictionary = import_od(str(path), int(request.canopen_node or 0))
        except (canopen.ObjectDictionaryError, configparser.Error, *WRONG_VALUES) as error:
            why = str(error).replace(str(path), str(request.eds))
            raise BenchError(f"{request.eds}: not a valid EDS: {why}") from None
    if DEVICE_TYPE not in dictionary:
        raise BenchError(f"{request.eds}: not a valid EDS: lacks object 1000h, which every node has")
    return dictionary, text


def _eds_text(request: ConformanceRequest) -> str:
    path = request.eds
    if path is None:
        from starhil.protocol.canopen.device_dictionary import DeviceDictionary
        from starhil.protocol.canopen.eds import build_eds

        return build_eds(DeviceDictionary(load_unit(request.unit or DEFAULT_UNIT)))
    try:
        text = read_user_file(path).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise BenchError(f"{path}: the EDS cannot be read: {error.strerror}") from None
    if max(map(len, text.splitlines()), default=0) > LONGEST_LINE:
        raise BenchError(f"{path}: not a valid EDS: a line has more than {LONGEST_LINE} characters")
    return text
