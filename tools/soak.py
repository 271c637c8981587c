"""Run the emulator for a while under load and faults, and fail if memory, descriptors or latency grow.

The emulator solves ten frames per second and serves a pty and a CAN hub. In each round a session runs over
both links; then the control channel injects faults into sky, device and wires, requests are sent, and the
faults are cleared. After each round, resident memory and open descriptors of all processes (emulator,
pipeline worker, hub) and the 99th percentile of the latency of each link are measured.

The first quarter of the time is the warm-up, in which caches, frame logs and the allocator's arenas fill. Of
the rest, the first and the last third are compared by their medians, so that one bad round on a busy machine
does not matter:

memory        may grow by 8 MB, since the allocator fluctuates. In 15 minutes about 4500 frames and 60 sessions lie
              between the two thirds, so a leak of 2 kB per frame or 140 kB per session fails.
descriptors   may not grow: every round ends in the same state, without any client.
latency       p99 may grow by half plus 10 ms; growing lists or queues would exceed this in time.

Prints one line per round and the figures at start and end; exit status 1 on growth or a failed session.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from starhil.hil_tests.bench import LinkOptions
from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.control import ControlClient
from starhil.hil_tests.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.errors import BenchError, DeviceError
from starhil.hil_tests.load_figures import percentile
from starhil.hil_tests.session_run import SessionRequest, run_session

WARM_UP_SHARE = 0.25
MEMORY_GROWTH_MB = 8.0
LATENCY_FACTOR, LATENCY_GROWTH_MS = 1.5, 10.0
MIN_ROUNDS = 8
"""Minimum number of rounds, so that each third has two."""

BAUD = 921_600
REQUESTS = 200
"""Number of requests per link and round whose latency is measured."""
FAULTY_REQUESTS = 20
FAULTY_TIMEOUT_S = 0.1
SETTLE_S = 10.0
"""Timeout for the emulator to close the connections of the last client."""
ROWS = ("identification", "quaternion", "precise_attitude", "star_tracker")
SESSION = Path(__file__).with_name("soak_session.toml")

FAULTS: tuple[dict[str, Any], ...] = (
    {"serial": {"drop": 0.3, "corrupt": 0.2, "junk": 0.2}, "can": {"drop": 0.3, "corrupt": 0.2, "junk": 0.2}},
    {"serial": {"split": 3, "gap_s": 0.001}, "can": {"delay_s": 0.05}},
    {"optical": {"false_stars": 50}},
    {"device": {"stuck": True}},
)


@dataclass(frozen=True)
class Sample:
    """Measurements after a round: elapsed time, memory, open descriptors, p99 latency of each link."""

    time_s: float
    memory_mb: float
    descriptors: int
    serial_p99_ms: float
    can_p99_ms: float


@dataclass(frozen=True)
class Figure:
    """A figure at the start and the end of a soak, and its limit at the end."""

    name: str
    start: float
    end: float
    limit: float

    @property
    def grew(self) -> bool:
        """Whether the figure exceeds its limit."""
        return not self.end <= self.limit


def compare(samples: Sequence[Sample]) -> list[Figure]:
    """Return the figures of the first and the last third after the warm-up.

    Raises
    ------
    ValueError
        Too few samples to compare.
    """
    end_s = samples[-1].time_s if samples else 0.0
    warm = [sample for sample in samples if sample.time_s >= WARM_UP_SHARE * end_s]
    third = len(warm) // 3
    if len(samples) < MIN_ROUNDS or third < 2:
        raise ValueError(f"{len(samples)} rounds are too few to compare: give more minutes")
    first, last = warm[:third], warm[-third:]

    def figure(name: str, value: Callable[[Sample], float], limit: Callable[[float], float]) -> Figure:
        start, end = (median(map(value, part)) for part in (first, last))
        return Figure(name, start, end, limit(start))

    def slower(start: float) -> float:
        return LATENCY_FACTOR * start + LATENCY_GROWTH_MS

    return [
        figure("memory, MB", lambda sample: sample.memory_mb, lambda start: start + MEMORY_GROWTH_MB),
        figure("descriptors", lambda sample: sample.descriptors, lambda start: start),
        figure("serial latency p99, ms", lambda sample: sample.serial_p99_ms, slower),
        figure("CAN latency p99, ms", lambda sample: sample.can_p99_ms, slower),
    ]


def processes(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants."""
    yield pid
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    for child in children.split():
        yield from processes(int(child))


def descriptors(pids: Sequence[int]) -> int:
    """Count the open descriptors of processes."""
    return sum(len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in pids)


def settled_descriptors(pids: Sequence[int]) -> int:
    """Count open descriptors once both ends of closed connections are closed."""
    deadline = time.monotonic() + SETTLE_S
    count = descriptors(pids)
    while time.monotonic() < deadline:
        time.sleep(0.2)
        before, count = count, descriptors(pids)
        if count == before:
            break
    return count


class Soak:
    """A running emulator with its hub, and the actions of a round."""

    def __init__(self, emulator: EmulatorProcess, hub: EmulatorProcess, folder: Path) -> None:
        self._emulator, self._hub, self._folder = emulator, hub, folder
        self._links = {"serial": emulator.ready["serial"], "can": emulator.ready["can"]}
        self._rng = random.Random(1)  # noqa: S311 (rows to request, not secrets)
        self._begin = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Time since the start, seconds."""
        return time.monotonic() - self._begin

    def round(self, number: int) -> Sample:
        """Run a session, inject and clear faults, and measure.

        Raises
        ------
        BenchError
            A step of the session fails, or the emulator ended.
        """
        options = LinkOptions(serial=self._links["serial"], can=self._links["can"], baud=BAUD)
        result = run_session(SessionRequest(SESSION, options, folder=self._folder, quiet=True))
        for step in result.results:
            if step.status == "failed":
                raise BenchError(f"round {number}: {step.link} {step.name}: {step.detail}")
        with ControlClient(self._emulator.ready["control"]) as control:
            control.do("fault", **FAULTS[number % len(FAULTS)])
            for link in self._links:
                self._ask_in_vain(link)
            control.do("clear_faults")
        latencies = (self._latency_p99_ms("serial"), self._latency_p99_ms("can"))
        both = (self._emulator, self._hub)
        memory_mb = sum(process.memory_bytes() for process in both) / 1e6
        pids = [pid for process in both for pid in processes(process.process.pid)]
        return Sample(self.elapsed_s, memory_mb, settled_descriptors(pids), *latencies)

    def _client(self, link: str, timeout_s: float) -> ObcClient:
        if link == "serial":
            return ObcClient.open(serial=self._links[link], baud=BAUD, timeout_s=timeout_s)
        return ObcClient.open(can=self._links[link], timeout_s=timeout_s)

    def _ask_in_vain(self, link: str) -> None:
        """Send requests while faults are active; some are not answered."""
        with self._client(link, FAULTY_TIMEOUT_S) as obc:
            for _ in range(FAULTY_REQUESTS):
                with contextlib.suppress(DeviceError):
                    obc.telemetry(self._rng.choice(ROWS))

    def _latency_p99_ms(self, link: str) -> float:
        with self._client(link, SETTLE_S) as obc:
            obc.telemetry("identification")  # warm up the connection
            taken = []
            for _ in range(REQUESTS):
                begin = time.perf_counter()
                obc.telemetry(self._rng.choice(ROWS))
                taken.append(1e3 * (time.perf_counter() - begin))
        return percentile(taken, 0.99)


def soak(seconds: float) -> list[Sample]:
    """Run rounds for a time, print each, and return the samples."""
    samples: list[Sample] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="starhil-soak-")))
        hub = stack.enter_context(EmulatorProcess(hub_command()))
        command = emulator_command(
            profile="demo",
            can=hub.ready["can"],
            seed=1,
            settings=[f"links.serial.baud={BAUD}"],
            state_dir=folder / "state",
            extra=["--control", "auto"],
        )
        emulator = stack.enter_context(EmulatorProcess(command))
        running = Soak(emulator, hub, folder / "session")
        while running.elapsed_s < seconds:
            sample = running.round(len(samples))
            samples.append(sample)
            print(
                f"round {len(samples):3d} {sample.time_s:6.0f} s  {sample.memory_mb:6.1f} MB  "
                f"{sample.descriptors:3d} descriptors  p99 serial {sample.serial_p99_ms:6.1f} ms  "
                f"CAN {sample.can_p99_ms:6.1f} ms",
                flush=True,
            )
    return samples


def main() -> int:
    """Run the soak test and print the result; return 0 if nothing grew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=15.0, help="how long")
    minutes = parser.parse_args().minutes
    try:
        figures = compare(soak(60.0 * minutes))
    except (BenchError, ValueError) as error:
        print(f"soak: {error}", file=sys.stderr)
        return 1
    for figure in figures:
        verdict = "GREW" if figure.grew else "ok"
        print(
            f"{figure.name:24s} start {figure.start:7.1f}  end {figure.end:7.1f}  limit {figure.limit:7.1f}  {verdict}"
        )
    return int(any(figure.grew for figure in figures))


if __name__ == "__main__":
    raise SystemExit(main())
