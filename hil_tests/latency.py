"""Latency of the links while images are rendered and solved, measured from the OBC's side.

An emulator process is asked for telemetry over its pty and over a CAN hub, one request at a time,
after random pauses. In between, the same bytes go to a process that only echoes them over a pty:
its latency is that of the machine, with which the emulator's latency is compared.
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
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

from starhil.hil_tests.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.errors import BenchError
from starhil.protocol.can_framing import CanFrame, encode_request_frames
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import Request
from starhil.protocol.serial_framing import encode_request

ROWS: Final = ("identification", "quaternion", "precise_attitude", "star_tracker", "unix_time")
"""Telemetry rows, requested in turn."""

PAUSE_S: Final = 0.004
"""Mean pause between two requests, seconds."""

REPLY_WITHIN_S: Final = 1.0
BAUD: Final = 921_600
"""High, so that the transmission time (1 ms for the longest reply) is short against the latency."""

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
    requests: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    lost: int


@dataclass(frozen=True)
class ProcessRow:
    """Start-up time and resident memory of the emulator with its worker."""

    worker: str
    ready_s: float
    memory_mb: float


class SerialRequester:
    """A minimal OBC on a serial line."""

    def __init__(self, path: str, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._path = path
        self.open()

    def open(self) -> None:
        """Open the port."""
        self._fd = os.open(self._path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._fd)
        os.set_blocking(self._fd, False)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def ask(self, name: str) -> float | None:
        """Request a row.

        Return the time until the last byte of the reply, s, or None without a reply.
        """
        row = self._icd.telemetry[name]
        begin = time.perf_counter()
        os.write(self._fd, encode_request(Request.of(row.id)))
        data = b""
        while len(data) < row.size + 4 or not data.endswith(b"\x1f\xff"):
            if not self._poll.poll(REPLY_WITHIN_S * 1000.0):
                return None
            data += os.read(self._fd, 4096)
        return time.perf_counter() - begin

    def close(self) -> None:
        """Close the port."""
        os.close(self._fd)


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
        """Request a row.

        Return the time until the last frame of the reply, s, or None without a reply.
        """
        row = self._icd.telemetry[name]
        frames = 1 if row.size <= 8 else -(-row.size // 7)  # a CAN frame carries 8 bytes, a segment 7
        begin = time.perf_counter()
        for frame in encode_request_frames(Request.of(row.id), 1, 4):
            self._socket.sendall(_socketcand(frame))
        try:
            for _ in range(frames):
                self._receive_until(b" >")
        except TimeoutError:
            return None
        return time.perf_counter() - begin

    def _receive_until(self, end: bytes) -> None:
        while end not in self._buffer:
            data = self._socket.recv(4096)
            if not data:
                raise BenchError("CAN hub: closed the connection; is the emulator still running?")
            self._buffer += data
        self._buffer = self._buffer.partition(end)[2]

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


class EchoRequester:
    """A process that echoes requests over a pty, for the latency of the machine."""

    def __init__(self, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._fd, other = os.openpty()
        tty.setraw(other)
        self._process = subprocess.Popen([sys.executable, "-c", ECHO, str(other)], pass_fds=[other])  # noqa: S603
        os.close(other)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def ask(self, name: str) -> float | None:
        """Send the bytes of a request; return the time until their echo, s, or None without one."""
        request = encode_request(Request.of(self._icd.telemetry[name].id))
        begin = time.perf_counter()
        os.write(self._fd, request)
        if not self._poll.poll(REPLY_WITHIN_S * 1000.0):
            return None
        os.read(self._fd, 4096)
        return time.perf_counter() - begin

    def close(self) -> None:
        """End the process."""
        os.close(self._fd)
        self._process.kill()
        self._process.wait()


def measure(
    icd: InterfaceDefinition,
    rates_hz: list[float],
    seconds: float,
    worker: str,
    report: Callable[[str], None] = lambda _text: None,
) -> tuple[list[LatencyRow], ProcessRow]:
    """Measure the latency of the links at rest and at each update rate.

    Parameters
    ----------
    icd
        Interface definition of the CubeStar.
    rates_hz
        Update rates, Hz; 0 is standby.
    seconds
        Time for each rate.
    worker
        `process` or `thread`.
    report
        Called with the progress.
    """
    from starhil.hil_tests.client import ObcClient

    rows: list[LatencyRow] = []
    rng = random.Random(1)  # noqa: S311 (pauses, not secrets)
    with ExitStack() as stack:
        hub_process = stack.enter_context(EmulatorProcess(hub_command()))
        begin = time.perf_counter()
        emulator = stack.enter_context(
            EmulatorProcess(
                emulator_command(
                    profile="demo",
                    can=hub_process.ready["can"],
                    settings=[f"run.worker={worker}", f"links.serial.baud={BAUD}"],
                )
            )
        )
        ready, ready_s = emulator.ready, time.perf_counter() - begin
        with ObcClient.open(serial=ready["serial"], dialect="b", baud=BAUD) as client:
            client.command("set_mode", mode="standby")
        serial, hub, echo = (
            SerialRequester(ready["serial"], icd),
            HubRequester(ready["can"], icd),
            EchoRequester(icd),
        )
        for probe in (serial, hub, echo):
            stack.callback(probe.close)
        probes = {"serial": serial.ask, "can": hub.ask, "echo": echo.ask}
        for rate in rates_hz:
            report(f"{worker}: {rate:g} Hz")
            serial.close()
            with ObcClient.open(serial=ready["serial"], dialect="b", baud=BAUD) as client:
                if rate > 0.0:
                    client.command("set_update_rate", rate=rate)
                client.command("set_mode", mode="lost_in_space" if rate > 0.0 else "standby")
            serial.open()
            rows += _measure_links(probes, worker, rate, seconds, rng)
        memory_mb = emulator.memory_bytes() / 2**20
    return rows, ProcessRow(worker, ready_s, memory_mb)


def _measure_links(
    probes: Mapping[str, Callable[[str], float | None]],
    worker: str,
    rate: float,
    seconds: float,
    rng: random.Random,
) -> list[LatencyRow]:
    taken: dict[str, list[float]] = {link: [] for link in probes}
    lost = dict.fromkeys(probes, 0)
    end = time.monotonic() + seconds
    count = 0
    while time.monotonic() < end:
        name = ROWS[count % len(ROWS)]
        count += 1
        for link, ask in probes.items():
            latency = ask(name)
            if latency is None:
                lost[link] += 1
            else:
                taken[link].append(latency * 1000.0)
            time.sleep(rng.expovariate(1.0 / PAUSE_S))
    return [_row(link, worker, rate, sorted(values), lost[link]) for link, values in taken.items()]


def _row(link: str, worker: str, rate: float, values: list[float], lost: int) -> LatencyRow:
    if not values:
        return LatencyRow(link, worker, rate, 0, float("nan"), float("nan"), float("nan"), lost)
    p50, p99 = (values[min(len(values) - 1, int(share * len(values)))] for share in (0.5, 0.99))
    return LatencyRow(link, worker, rate, len(values), p50, p99, values[-1], lost)


def _socketcand(frame: CanFrame) -> bytes:
    data = "".join(f" {byte:02X}" for byte in frame.data)
    return f"< send {frame.id:08X} {len(frame.data)}{data} >".encode()
