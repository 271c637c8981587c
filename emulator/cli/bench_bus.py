"""`starhil bench bus`: links under full load, and jitter of periodic messages."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.timing.can_load import DEVICE, load_can
from starhil.hil_tests.timing.figures import CanLoad, Jitter, SerialLoad
from starhil.hil_tests.timing.jitter import (
    event_timer_jitter,
    heartbeat_jitter,
    sync_to_pdo,
    unsolicited_jitter,
)
from starhil.hil_tests.timing.latency import REQUESTED_ROWS
from starhil.hil_tests.timing.realtime import set_realtime_priority
from starhil.hil_tests.timing.serial_load import load_serial
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.serial.cubespace import Dialect

UPDATE_RATE_HZ = 10.0
NODE = 44
UNSOLICITED_HZ = 20.0
HEARTBEAT_MS = 50
EVENT_TIMER_MS = 50
SYNC_S = 0.05
WARM_UP_S = 60.0
"""Timeout for the emulator to reach tracking."""
REQUIRED_ROWS = (
    *REQUESTED_ROWS,
    "identified_stars",
    "communication_status",
    "set_hole_map_1",
    "set_unsolicited",
    "set_update_rate",
    "set_mode",
)


def check_rows(icd: InterfaceDefinition) -> None:
    """Check that a unit has the rows that the load requests."""
    missing = [name for name in REQUIRED_ROWS if name not in icd.telemetry and name not in icd.telecommands]
    if missing:
        raise BenchError(
            f"bench bus: unit {icd.name} lacks the CubeStar rows that are used to load the links ({', '.join(missing)}); "
            "measure another unit with bench latency"
        )


@dataclass(frozen=True)
class Target:
    """The links of the device under test; None for a missing link."""

    can: str | None
    serial: str | None
    canopen: int | None
    device: int = DEVICE
    baud: int = 921_600
    dialect: Dialect = Dialect.B


@dataclass
class BusFigures:
    """All figures of one run."""

    can: CanLoad | None = None
    serial: SerialLoad | None = None
    jitter: list[Jitter] = field(default_factory=list)
    frames_per_s: dict[str, float] = field(default_factory=dict)
    """Frames per second solved by the device while each link was loaded."""

    def good(self, p99_limit_ms: float) -> bool:
        """Return whether nothing was lost or wrong and 99 % of the CAN replies arrived within the limit."""
        can_good = self.can is None or (self.can.good and self.can.latency.p99_ms <= p99_limit_ms)
        return can_good and (self.serial is None or self.serial.good)


@contextmanager
def started_device(unit: str, baud: int, realtime: bool, report: Callable[[str], None]) -> Iterator[Target]:
    """Start a hub and an emulator that solves frames at 10 Hz, each in its own process.

    With `realtime`, both and this process get real-time priority, but not the pipeline worker.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        hub = stack.enter_context(EmulatorProcess(hub_command()))
        command = emulator_command(
            profile="demo",
            unit=unit,
            serial="auto",
            can=hub.ready["can"],
            state_dir=folder,
            settings=[f"links.serial.baud={baud}"],
            extra=["--canopen", str(NODE)],
        )
        report("starting the emulator")
        emulator = stack.enter_context(EmulatorProcess(command))
        if realtime:
            set_realtime_priority()
            for process in (hub, emulator):
                set_realtime_priority(process.process.pid)
        with ObcClient.open(can=hub.ready["can"], device_address=DEVICE, unit=unit) as client:
            client.command("set_update_rate", rate=UPDATE_RATE_HZ)
            client.command("set_mode", mode="lost_in_space")
            client.wait_for("device_status", lambda status: status["mode"] == "tracking", within_s=WARM_UP_S)
        yield Target(hub.ready["can"], emulator.ready["serial"], NODE, baud=baud)


def measure(
    icd: InterfaceDefinition,
    target: Target,
    seconds: float,
    rate: float,
    report: Callable[[str], None],
    *,
    realtime: bool = False,
) -> BusFigures:
    figures = BusFigures()
    if target.can is not None:
        report(f"CAN: {rate:g} frames/s for {seconds:g} s")
        with count_solved_frames(icd, target, "can", figures):
            load = load_can(icd, target.can, seconds, rate, device=target.device, realtime=realtime)
            figures.can = asyncio.run(load)
    if target.serial is not None:
        report(f"serial: {target.baud} Bd both ways for {seconds:g} s")
        with count_solved_frames(icd, target, "serial", figures):
            figures.serial = asyncio.run(
                load_serial(icd, target.serial, seconds, target.baud, target.dialect)
            )
    if target.can is not None:
        jitter_s = max(min(seconds / 3.0, 20.0), 2.0)
        report(f"jitter: {jitter_s:g} s each")
        can, node = target.can, target.canopen
        measurements = [unsolicited_jitter(icd, can, jitter_s, UNSOLICITED_HZ, device=target.device)]
        if node is not None:
            measurements += [
                heartbeat_jitter(can, jitter_s, HEARTBEAT_MS, node=node),
                event_timer_jitter(can, jitter_s, EVENT_TIMER_MS, node=node),
                sync_to_pdo(can, jitter_s, SYNC_S, node=node),
            ]
        figures.jitter = [asyncio.run(measurement) for measurement in measurements]
    return figures


@contextmanager
def count_solved_frames(
    icd: InterfaceDefinition, target: Target, link: str, figures: BusFigures
) -> Iterator[None]:
    """Record the frames per second that the device solves during the block, read over CAN."""
    if target.can is None:
        yield
        return
    with ObcClient.open(can=target.can, device_address=target.device, unit=icd) as client:
        first = client.telemetry("device_status")
        yield
        last = client.telemetry("device_status")
    count = int(last["frames_valid"]) - int(first["frames_valid"])
    seconds = float(last["uptime"]) - float(first["uptime"])
    figures.frames_per_s[link] = round(count / seconds, 2)


def print_figures(figures: BusFigures, good: bool) -> None:
    if figures.can is not None:
        load = figures.can
        print(
            f"CAN     {load.offered_per_s:g} frames/s from other nodes for {load.seconds:g} s: {load.sent} sent, "
            f"{load.lost} lost, {load.disordered} out of order"
        )
        print(
            f"        {load.requests} requests: {load.unanswered} unanswered, {load.wrong} wrong; "
            f"latency {_percentiles(load.latency)}"
        )
        print(f"        for comparison, an echo process: {_percentiles(load.machine)}")
    if figures.serial is not None:
        line = figures.serial
        print(
            f"serial  {line.baud} Bd for {line.seconds:g} s: {line.sent_share:.0%} of the line out, {line.received_share:.0%} in; "
            f"{line.exchanges} exchanges, {line.wrong} wrong"
        )
    for link, frames in figures.frames_per_s.items():
        print(f"frames  {frames:g} per second solved under load ({link})")
    for jitter in figures.jitter:
        print(
            f"jitter  {jitter.what}: mean {jitter.period_ms:.2f} ms over {jitter.messages}; "
            f"{_percentiles(jitter.deviation)}"
        )
    print("good" if good else "NOT good: something was lost, wrong or late")


def _percentiles(figures: Any) -> str:
    return f"p50 {figures.p50_ms:.2f} ms, p99 {figures.p99_ms:.2f} ms, max {figures.max_ms:.2f} ms"
