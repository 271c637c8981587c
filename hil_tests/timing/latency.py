"""Latency of the links while images are rendered and solved, measured at the OBC.

Telemetry is requested from an emulator process over its pty and over a CAN hub, one request at a time, after
random pauses. In between, the same bytes are sent to a process that only echoes them over a pty. Its latency
is caused by the machine alone and serves as a reference.
"""

from __future__ import annotations

import asyncio
import random
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, closing
from dataclasses import dataclass
from itertools import cycle
from math import inf
from typing import Any, Final

from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink, HostLink, SerialHostLink
from starhil.hil_tests.errors import BenchError, LinkLostError, NackError, NoReplyError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.timing.figures import Spread
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import Reply, Request
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.serial import open_serial
from starhil.protocol.unit import load_unit

REQUESTED_ROWS: Final = (
    "identification",
    "quaternion",
    "precise_attitude",
    "star_tracker",
    "unix_time",
    "device_status",
)
"""Telemetry rows of CubeStar that are requested in turn; for another unit, all rows."""

PAUSE_S: Final = 0.004
"""Mean pause between two requests, seconds.

The pauses are random so that requests arrive in every phase of image processing.
"""

REPLY_WITHIN_S: Final = 1.0
SETTLE_S: Final = 3.0
"""Time for viewers to start and connect, seconds."""
BAUD: Final = 921_600
"""High, so that the transmission time (1 ms for the longest reply) is small compared with the latency."""

ECHO: Final = """
import os, sys, tty
f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
os.write(f, b"ready")
while d := os.read(f, 4096):
    os.write(f, d)
"""
"""Program of the process that echoes all bytes."""

PAIRS: Final = 4
"""Number of alternations between measurements without and with viewers."""

Ask = Callable[[Row], Awaitable[float]]
"""Requests a row; returns the latency in seconds, infinite without a reply."""


@dataclass(frozen=True)
class LatencyRow:
    """Latencies of one link at one update rate, milliseconds."""

    link: str
    worker: str
    update_rate_hz: float
    viewers: int
    requests: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    lost: int

    @classmethod
    def of(cls, link: str, worker: str, rate_hz: float, viewers: int, taken: Sequence[float]) -> LatencyRow:
        """Summarise latencies in seconds, infinite for a lost reply."""
        figures, lost = Spread.of(taken), taken.count(inf)
        three = (figures.p50_ms, figures.p99_ms, figures.max_ms)
        return cls(link, worker, rate_hz, viewers, len(taken) - lost, *three, lost)


@dataclass(frozen=True)
class ProcessRow:
    """Start-up time and resident memory of the emulator with its worker."""

    worker: str
    ready_s: float
    memory_mb: float


async def exchange(client: AsyncObcClient, request: Request, name: str) -> tuple[float, Reply | None]:
    """Send a request; return the latency in seconds, infinite without an answer, and the reply unless it is a refusal."""
    try:
        reply, latency = await client.transact(request, name)
    except NackError:
        return client.transactions[-1].latency_s, None
    except (NoReplyError, LinkLostError):
        return inf, None
    return latency, reply


async def ask_in_turn(asks: Mapping[str, Ask], rows: Iterable[Row], seconds: float) -> dict[str, list[float]]:
    """Request rows from several peers in turn, after random pauses, for some time; return the latencies by peer."""
    rng = random.Random(1)  # noqa: S311 (pauses, not secrets)
    latencies: dict[str, list[float]] = {peer: [] for peer in asks}
    end = time.monotonic() + seconds
    for row in cycle(rows):
        for peer, ask in asks.items():
            latencies[peer].append(await ask(row))
            await asyncio.sleep(rng.expovariate(1.0 / PAUSE_S))
        if time.monotonic() >= end:
            break
    return latencies


class Echo:
    """A process that echoes requests over a pty, for the latency of the machine."""

    def __init__(self, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._stack = SerialStack(icd)
        self._line = open_serial("pty", paced=False)
        self._arrived: asyncio.Queue[float] = asyncio.Queue()

    async def start(self) -> None:
        await self._line.start(lambda _data: self._arrived.put_nowait(time.perf_counter()))
        self._process = subprocess.Popen([sys.executable, "-P", "-c", ECHO, self._line.description])  # noqa: S603
        await self._arrived.get()

    async def ask(self, row: Row) -> float:
        """Send the bytes of a request; return the time until their echo in s, infinite without an echo."""
        request = self._stack.encode_request(self._icd.request(row))
        self._arrived = asyncio.Queue()  # a late echo of the last request is discarded
        begin = time.perf_counter()
        self._line.send(request)
        try:
            async with asyncio.timeout(REPLY_WITHIN_S):
                return await self._arrived.get() - begin
        except TimeoutError:
            return inf

    async def close(self) -> None:
        self._process.kill()
        self._process.wait()
        await self._line.close()


class Viewers:
    """Viewers of the console of an emulator, one process each."""

    def __init__(self, address: str, count: int) -> None:
        command = [sys.executable, "-P", "-m", "starhil.hil_tests.timing.console_viewer", address]
        self._processes = [subprocess.Popen(command) for _ in range(count)]  # noqa: S603

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()


def measure(
    unit: str,
    rates_hz: list[float],
    seconds: float,
    worker: str,
    report: Callable[[str], None] = lambda _text: None,
    viewers: int = 0,
) -> tuple[list[LatencyRow], ProcessRow]:
    """Measure the latency of the links of a unit at rest and at each update rate.

    A rate of 0 Hz is standby; `worker` is `process` or `thread`; with `viewers` of the console, each rate is measured
    alternately without and with them.
    """
    icd = load_unit(unit)
    rows: list[LatencyRow] = []
    ready_s = memory_mb = 0.0
    for rate in rates_hz:
        report(f"{worker}: {rate:g} Hz")
        moving = [f"parameters.update_rate={rate}", "parameters.start_mode=lost_in_space"]
        with EmulatorProcess(hub_command()) as hub:
            command = emulator_command(
                profile="demo",
                unit=unit,
                can=hub.ready["can"],
                settings=[
                    f"run.worker={worker}",
                    f"links.serial.baud={BAUD}",
                    *(moving if rate > 0.0 else ["parameters.start_mode=standby"]),
                ],
                extra=["--view", "auto"] if viewers else (),
            )
            begin = time.perf_counter()
            with EmulatorProcess(command) as emulator:
                ready_s = ready_s or time.perf_counter() - begin
                taken = asyncio.run(_measure_links(icd, emulator.ready, seconds, viewers))
                memory_mb = max(memory_mb, emulator.memory_bytes() / 2**20)
        rows += [LatencyRow.of(link, worker, rate, count, values) for (count, link), values in taken.items()]
    return rows, ProcessRow(worker, ready_s, memory_mb)


async def _measure_links(
    icd: InterfaceDefinition, ready: Mapping[str, str], seconds: float, viewers: int
) -> dict[tuple[int, str], list[float]]:
    rows = [icd.telemetry[name] for name in REQUESTED_ROWS if name in icd.telemetry]
    turns = [0, viewers] * PAIRS if viewers else [0]
    taken: dict[tuple[int, str], list[float]] = {}
    async with AsyncExitStack() as stack:
        asks = await _open_links(icd, ready, stack)
        for count in turns:
            with closing(Viewers(ready.get("view", ""), count)):
                await asyncio.sleep(SETTLE_S if count else 0.0)
                latencies = await ask_in_turn(asks, rows or icd.readable, seconds / turns.count(0))
            for link, values in latencies.items():
                taken.setdefault((count, link), []).extend(values)
    return taken


async def _open_links(
    icd: InterfaceDefinition, ready: Mapping[str, str], stack: AsyncExitStack
) -> dict[str, Ask]:
    """Open the links that the emulator has, and the echo process for comparison."""
    if "serial" not in ready:
        raise BenchError(f"bench latency: unit {icd.name} has no serial link to measure")
    asks: dict[str, Ask] = {}

    async def open_link(link: HostLink[Any]) -> None:
        client = AsyncObcClient(link, icd, timeout_s=REPLY_WITHIN_S)
        await client.start()
        stack.push_async_callback(client.close)

        async def ask(row: Row) -> float:
            return (await exchange(client, icd.request(row), row.name))[0]

        asks[link.name] = ask

    await open_link(SerialHostLink(icd, ready["serial"], baud=BAUD))
    if "can" in ready and icd.link.can is not None:
        await open_link(CanHostLink(ready["can"]))
    echo = Echo(icd)
    await echo.start()
    stack.push_async_callback(echo.close)
    return {**asks, "echo": echo.ask}
