"""How fast the links answer while frames are made and solved, measured from the other end of the wire.

An emulator runs as a process of its own; requests for telemetry are sent over its pty and over its CAN hub, one at a time, at
random moments. Between them the same bytes go to a process that does nothing but send them back over a pty: its
latency is the machine's own, and what the emulator's is to be seen against.
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
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starhil.hil_tests.errors import BenchError
from starhil.protocol.can_framing import CanFrame, encode_request_frames
from starhil.protocol.icd import load_icd
from starhil.protocol.messages import Request
from starhil.protocol.serial_framing import encode_request

ROWS: Final = ("identification", "quaternion", "precise_attitude", "star_tracker", "unix_time")
"""Telemetry that is asked for in turn."""

PAUSE_S: Final = 0.004
"""Mean pause between two requests, seconds."""

REPLY_WITHIN_S: Final = 1.0
READY_WITHIN_S: Final = 180.0
BAUD: Final = 921_600
"""High, so that the time of the bytes on the line (1 ms for the longest reply) does not hide the device's."""

ECHO: Final = (
    "import os,sys\nf=int(sys.argv[1])\ntry:\n while d:=os.read(f,4096): os.write(f,d)\nexcept OSError: pass"
)
"""Program of the process that sends everything back."""

STARHIL: Final = "from starhil.emulator.cli import main; main()"


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
    """The emulator as a process: time to its ready line, resident memory of both its processes, frames left late."""

    worker: str
    ready_s: float
    memory_mb: float


class SerialProbe:
    """A serial OBC as bare as can be."""

    def __init__(self, path: str) -> None:
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
        """Ask for a row; return the time to the last byte of the reply in seconds, or None if none came."""
        row = load_icd().telemetry[name]
        begin = time.perf_counter()
        os.write(self._fd, encode_request(Request.of(row.id)))
        data = b""
        while len(data) < row.size + 4 or not data.endswith(b"\x1f\xff"):
            if not self._poll.poll(REPLY_WITHIN_S * 1000.0):
                return None
            data += os.read(self._fd, 4096)
        return time.perf_counter() - begin

    def close(self) -> None:
        """Give the port back."""
        os.close(self._fd)


class HubProbe:
    """A CAN OBC on the TCP hub as bare as can be."""

    def __init__(self, spec: str) -> None:
        host, port, bus = spec.removeprefix("socketcand:").replace("/", ":").split(":")
        self._socket = socket.create_connection((host, int(port)), REPLY_WITHIN_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = b""
        self._until(b"< hi >")
        self._socket.sendall(f"< open {bus} >".encode())
        self._until(b"< ok >")
        self._socket.sendall(b"< rawmode >")
        self._until(b"< ok >")

    def ask(self, name: str) -> float | None:
        """Ask for a row; return the time to the last frame of the reply in seconds, or None if none came."""
        row = load_icd().telemetry[name]
        frames = 1 if row.size <= 8 else -(-row.size // 7)  # a frame carries 8 bytes, a segment 7
        begin = time.perf_counter()
        for frame in encode_request_frames(Request.of(row.id), 1, 4):
            self._socket.sendall(_socketcand(frame))
        try:
            for _ in range(frames):
                self._until(b" >")
        except TimeoutError:
            return None
        return time.perf_counter() - begin

    def _until(self, end: bytes) -> None:
        while end not in self._buffer:
            data = self._socket.recv(4096)
            if not data:
                raise BenchError("CAN hub: closed the connection; is the emulator still running?")
            self._buffer += data
        self._buffer = self._buffer.partition(end)[2]

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


class EchoProbe:
    """A process that sends back what it gets over a pty: what the machine itself takes."""

    def __init__(self) -> None:
        self._fd, other = os.openpty()
        tty.setraw(other)
        self._process = subprocess.Popen([sys.executable, "-c", ECHO, str(other)], pass_fds=[other])  # noqa: S603
        os.close(other)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def ask(self, name: str) -> float | None:
        """Send as many bytes as a request for a row has; return the time until they are back, or None."""
        request = encode_request(Request.of(load_icd().telemetry[name].id))
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


@contextmanager
def running(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, str], float]]:
    """Start `starhil` with arguments; give process, words of its ready line, and seconds that it took.

    Raises
    ------
    BenchError
        It did not become ready.
    """
    begin = time.perf_counter()
    command = [sys.executable, "-c", STARHIL, *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603
    try:
        if process.stdout is None or not select.select([process.stdout], [], [], READY_WITHIN_S)[0]:
            raise BenchError(f"starhil {arguments[0]}: not ready within {READY_WITHIN_S:g} s")
        line = process.stdout.readline()
        if not line.startswith("ready "):
            raise BenchError(
                f"starhil {arguments[0]}: did not start: {line.strip() or 'its reason stands above'}"
            )
        ready = dict(word.split("=", 1) for word in line.split()[1:])
        yield process, ready, time.perf_counter() - begin
    finally:
        process.terminate()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def resident_mb(pid: int) -> float:
    """Resident memory of a process and its children, megabytes."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    total = 0.0
    for each in (str(pid), *children):
        for line in Path(f"/proc/{each}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmRSS:"):
                total += int(line.split()[1]) / 1024.0
    return total


def measure(
    rates_hz: list[float], seconds: float, worker: str, report: Callable[[str], None] = lambda _text: None
) -> tuple[list[LatencyRow], ProcessRow]:
    """Measure the latency of the links at rest and at each update rate.

    Parameters
    ----------
    rates_hz
        Update rates at which frames are solved; 0 stands for standby.
    seconds
        Time for each rate.
    worker
        `process` or `thread`.
    report
        Told what is being done.
    """
    from starhil.hil_tests.client import ObcClient

    rows: list[LatencyRow] = []
    rng = random.Random(1)  # noqa: S311 (pauses, not secrets)
    with ExitStack() as stack:
        _, hub_ready, _ = stack.enter_context(running("hub", "--port", "0"))  # a bus of its own
        process, ready, ready_s = stack.enter_context(
            running(
                *("run", "demo", "--serial", "auto", "--can", hub_ready["can"]),
                *("--set", f"run.worker={worker}", "--set", f"links.serial.baud={BAUD}"),
            )
        )
        with ObcClient.open(serial=ready["serial"], dialect="b", baud=BAUD) as client:
            client.command("set_mode", mode="standby")
        serial, hub, echo = SerialProbe(ready["serial"]), HubProbe(ready["can"]), EchoProbe()
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
        memory_mb = resident_mb(process.pid)
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
