"""Latency of the links while images are rendered and solved, measured at the OBC.

Telemetry is requested from an emulator process over its pty and over a CAN hub, one request at a time, after
random pauses. In between, the same bytes are sent to a process that only echoes them over a pty. Its latency
is caused by the machine alone and serves as a reference.
"""

from __future__ import annotations

import os
import random
import select
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import cycle
from typing import Final

from starhil.hil_tests.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.load_figures import Spread
from starhil.protocol.can_framing import CanId, encode_request_frames
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.icd import load_unit
from starhil.protocol.messages import Reply
from starhil.protocol.serial_stack import build_serial_stack
from starhil.protocol.socketcand import format_send

ROWS: Final = ("identification", "quaternion", "precise_attitude", "star_tracker", "unix_time")
"""Telemetry rows of CubeStar that are requested in turn; for another unit, all rows."""

PAUSE_S: Final = 0.004
"""Mean pause between two requests, seconds."""

REPLY_WITHIN_S: Final = 1.0
HOST: Final = 1
DEVICE: Final = 4
"""CAN addresses of the OBC and of the device."""
SETTLE_S: Final = 3.0
"""Time for viewers to start and connect, seconds."""
BAUD: Final = 921_600
"""High, so that the transmission time (1 ms for the longest reply) is small compared with the latency."""

ECHO: Final = (
    "import os,sys\nf=int(sys.argv[1])\ntry:\n while d:=os.read(f,4096): os.write(f,d)\nexcept OSError: pass"
)
"""Program of the process that echoes all bytes."""


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
    def of(
        cls, link: str, worker: str, rate_hz: float, viewers: int, taken: Sequence[float | None]
    ) -> LatencyRow:
        """Summarise latencies in seconds; None stands for a lost reply."""
        found = [latency for latency in taken if latency is not None]
        figures = Spread.of(found)
        three = (figures.p50_ms, figures.p99_ms, figures.max_ms)
        return cls(link, worker, rate_hz, viewers, len(found), *three, len(taken) - len(found))


@dataclass(frozen=True)
class ProcessRow:
    """Start-up time and resident memory of the emulator with its worker."""

    worker: str
    ready_s: float
    memory_mb: float


class _Port:
    """A serial port without a loop around it."""

    def __init__(self, fd: int, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._stack = build_serial_stack(icd)
        self._fd = fd
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)

    def close(self) -> None:
        """Close the port."""
        os.close(self._fd)


class SerialRequester(_Port):
    """A minimal OBC on a serial line."""

    def __init__(self, path: str, icd: InterfaceDefinition) -> None:
        super().__init__(os.open(path, os.O_RDWR | os.O_NOCTTY), icd)
        self._host = self._stack.host()
        tty.setraw(self._fd)
        os.set_blocking(self._fd, False)

    def ask(self, name: str) -> float | None:
        """Request a row; return the time until the last byte of the reply in s, or None without a reply."""
        row = self._icd.telemetry[name]
        request = self._icd.request(row)
        self._host.expect(request)
        data = self._stack.encode_request(request)
        begin = time.perf_counter()
        os.write(self._fd, data)
        while self._poll.poll(REPLY_WITHIN_S * 1000.0):
            data = os.read(self._fd, 4096)
            arrived = time.perf_counter()
            if any(isinstance(event, Reply) for event in self._host.feed(data, arrived)):
                return arrived - begin
        self._host = self._stack.host()
        return None


class HubRequester:
    """A minimal OBC on the TCP hub for CAN."""

    def __init__(self, spec: str, icd: InterfaceDefinition) -> None:
        self._icd = icd
        host, port, bus = spec.removeprefix("socketcand:").replace("/", ":").split(":")
        self._socket = socket.create_connection((host, int(port)), REPLY_WITHIN_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = b""
        self._receive_until(b"< hi >")
        self._socket.sendall(f"< open {bus} >".encode())
        self._receive_until(b"< ok >")
        self._socket.sendall(b"< rawmode >")
        self._receive_until(b"< ok >")

    def ask(self, name: str) -> float | None:
        """Request a row; return the time until the last frame of the reply in s, or None without a reply."""
        row = self._icd.telemetry[name]
        frames = 1 if row.size <= 8 else -(-row.size // 7)  # a CAN frame carries 8 bytes, a segment 7
        begin = time.perf_counter()
        for frame in encode_request_frames(self._icd.request(row), HOST, DEVICE):
            self._socket.sendall(format_send(frame))
        try:
            while frames:
                frames -= self._is_reply(self._receive_until(b" >"), row.id)
        except TimeoutError:
            return None
        return time.perf_counter() - begin

    @staticmethod
    def _is_reply(text: bytes, row_id: int) -> bool:
        """Return whether a line from the hub is a frame of the reply to this OBC."""
        words = text.split()
        if words[:2] != [b"<", b"frame"]:
            return False
        can_id = CanId.unpack(int(words[2], 16))
        return (can_id.id, can_id.source, can_id.destination) == (row_id, DEVICE, HOST)

    def _receive_until(self, end: bytes) -> bytes:
        """Receive up to an end mark; return the bytes before it."""
        while end not in self._buffer:
            data = self._socket.recv(4096)
            if not data:
                raise BenchError("CAN hub: closed the connection; is the emulator still running?")
            self._buffer += data
        text, _, self._buffer = self._buffer.partition(end)
        return text

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


class EchoRequester(_Port):
    """A process that echoes requests over a pty, for the latency of the machine."""

    def __init__(self, icd: InterfaceDefinition) -> None:
        fd, other = os.openpty()
        super().__init__(fd, icd)
        tty.setraw(other)
        self._process = subprocess.Popen([sys.executable, "-c", ECHO, str(other)], pass_fds=[other])  # noqa: S603
        os.close(other)

    def ask(self, name: str) -> float | None:
        """Send the bytes of a request; return the time until their echo in s, or None without an echo."""
        request = self._stack.encode_request(self._icd.request(self._icd.telemetry[name]))
        begin = time.perf_counter()
        os.write(self._fd, request)
        if not self._poll.poll(REPLY_WITHIN_S * 1000.0):
            return None
        os.read(self._fd, 4096)
        return time.perf_counter() - begin

    def close(self) -> None:
        """End the process."""
        super().close()
        self._process.kill()
        self._process.wait()


PAIRS: Final = 4
"""Number of alternations between measurements without and with viewers."""


class Viewers:
    """Viewers of the console of an emulator, one process each."""

    def __init__(self, address: str, count: int) -> None:
        command = [sys.executable, "-m", "starhil.hil_tests.console_viewer", address]
        self._processes = [subprocess.Popen(command) for _ in range(count)]  # noqa: S603

    def close(self) -> None:
        """End them."""
        for process in self._processes:
            process.kill()
            process.wait()


Ask = Callable[[str], float | None]
"""Requests a row by name; returns the latency in seconds, or None without a reply."""


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
    rng = random.Random(1)  # noqa: S311 (pauses, not secrets)
    ready_s = memory_mb = 0.0
    turns = [0, viewers] * PAIRS if viewers else [0]
    """Number of viewers in each turn."""
    for rate in rates_hz:
        report(f"{worker}: {rate:g} Hz")
        with ExitStack() as stack:
            hub_process = stack.enter_context(EmulatorProcess(hub_command()))
            moving = [f"parameters.update_rate={rate}", "parameters.start_mode=lost_in_space"]
            begin = time.perf_counter()
            emulator = stack.enter_context(
                EmulatorProcess(
                    emulator_command(
                        profile="demo",
                        unit=unit,
                        can=hub_process.ready["can"],
                        settings=[
                            f"run.worker={worker}",
                            f"links.serial.baud={BAUD}",
                            *(moving if rate > 0.0 else ["parameters.start_mode=standby"]),
                        ],
                        extra=["--view", "auto"] if viewers else (),
                    )
                )
            )
            ready_s = ready_s or time.perf_counter() - begin
            links = _open_links(icd, emulator.ready, stack)
            taken: dict[tuple[int, str], list[float | None]] = {
                (count, link): [] for count in dict.fromkeys(turns) for link in links
            }
            for count in turns:
                with closing(Viewers(emulator.ready.get("view", ""), count)):
                    time.sleep(SETTLE_S if count else 0.0)
                    for link, latency in _latencies(icd, links, seconds / turns.count(0), rng):
                        taken[count, link].append(latency)
            rows += [
                LatencyRow.of(link, worker, rate, count, values) for (count, link), values in taken.items()
            ]
            memory_mb = max(memory_mb, emulator.memory_bytes() / 2**20)
    return rows, ProcessRow(worker, ready_s, memory_mb)


def _open_links(icd: InterfaceDefinition, ready: Mapping[str, str], stack: ExitStack) -> dict[str, Ask]:
    """Open the links that the emulator has, and the echo process for comparison."""
    if "serial" not in ready:
        raise BenchError(f"bench latency: unit {icd.name} has no serial link to measure")
    opened: dict[str, SerialRequester | HubRequester | EchoRequester] = {
        "serial": SerialRequester(ready["serial"], icd)
    }
    if "can" in ready and icd.link.can is not None:
        opened["can"] = HubRequester(ready["can"], icd)
    opened["echo"] = EchoRequester(icd)
    for requester in opened.values():
        stack.callback(requester.close)
    return {link: requester.ask for link, requester in opened.items()}


def _latencies(
    icd: InterfaceDefinition, links: Mapping[str, Ask], seconds: float, rng: random.Random
) -> Iterator[tuple[str, float | None]]:
    """Send requests on each link in turn for some time; yield link and latency."""
    names = cycle([name for name in ROWS if name in icd.telemetry] or list(icd.telemetry))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        name = next(names)
        for link, ask in links.items():
            yield link, ask(name)
            time.sleep(rng.expovariate(1.0 / PAUSE_S))
