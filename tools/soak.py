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

With `--worst`, an OBC polls while each channel gets its worst messages of 64 kB, two a second: the p99 of its replies may be twice
that without them. Windows with and without messages alternate, so that a busy machine slows both; exit status 1 on slower replies.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import random
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from aiohttp import ClientSession, ClientWebSocketResponse

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.errors import BenchError, DeviceError
from starhil.hil_tests.rig.control import ControlClient
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command, hub_command
from starhil.hil_tests.rig.rig import LinkOptions
from starhil.hil_tests.session import SessionRequest, run_session
from starhil.hil_tests.timing.figures import percentile

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


WORST_BYTES = 64_000
"""Size of each message of `--worst`; a datagram has at most 65 507 bytes."""
WORST_EVERY_S = 0.5
WORST_ROWS = 50_000
"""Number of rows of the truth file that the control channel names."""
WINDOW_POLLS = 100
WORST_WINDOWS = 4
"""Number of windows with messages for each channel."""
SLOWEST_RATIO = 2.0

Send = Callable[[], object]


def worst_requests() -> list[dict[str, Any]]:
    """Return requests on the control channel with as many errors, or as long ones, as fit."""

    def keys(name: str) -> dict[str, int]:
        return {f"{name}{number:05}": 1 for number in range(WORST_BYTES // (len(name) + 12))}

    segments = [{"do": "hold", **{f"s{number}": 1 for number in range(13)}}] * 440
    truths: list[dict[str, Any]] = [
        {"kind": "slew", "segments": [{}] * (WORST_BYTES // 5)},
        {"kind": "slew", "segments": segments},
        {"kind": "fixed", **keys("attitud")},
        {"kind": "a" * (WORST_BYTES - 99)},
    ]
    faults: list[dict[str, Any]] = [
        {"optical": {"planets": [{"ra_deg": 1}] * (WORST_BYTES // 17)}},
        {"optical": keys("moon")},
        {"serial": keys("drap")},
        {"device": {"error": "sensor" * (WORST_BYTES // 7)}},
    ]
    return [
        *({"do": "set_truth", "truth": truth} for truth in truths),
        *({"do": "fault", **fault} for fault in faults),
    ]


def worst_datagrams() -> list[bytes]:
    """Return datagrams of a feed: very many messages, and a very long one."""
    message = b'{"q":[0,0,0,1]}\n'
    return [
        message * (WORST_BYTES // len(message)),
        b"{}\n" * (WORST_BYTES // 3),
        b'{"q":[' + b"1," * (WORST_BYTES // 2 - 9) + b"1]}",
    ]


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


@contextlib.contextmanager
def sending(send: Send) -> Iterator[None]:
    """Call a function at intervals in a thread."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(WORST_EVERY_S):
            send()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def polled_ms(obc: ObcClient, rng: random.Random) -> list[float]:
    """Return the latencies of a window of requests, a hundred a second, milliseconds."""
    taken = []
    for _ in range(WINDOW_POLLS):
        begin = time.perf_counter()
        obc.telemetry(rng.choice(ROWS))
        taken.append(1e3 * (time.perf_counter() - begin))
        time.sleep(0.01)
    return taken


class Page:
    """A page of the console, which stays open."""

    def __init__(self, view: str, stack: ExitStack) -> None:
        page = urlsplit(view)
        self._runner = stack.enter_context(asyncio.Runner())
        session = self._runner.run(self._open())
        stack.callback(lambda: self._runner.run(session.close()))
        address = f"http://{page.netloc}/ws?{page.query}"
        self._pages = self._runner.run(self._connect(session, address))

    @staticmethod
    async def _open() -> ClientSession:
        return ClientSession()

    @staticmethod
    async def _connect(session: ClientSession, address: str) -> ClientWebSocketResponse:
        return await session.ws_connect(address, max_msg_size=0)

    def ask(self, request: dict[str, Any]) -> None:
        """Send a request and wait for its answer."""
        self._runner.run(self._ask(request))

    async def _ask(self, request: dict[str, Any]) -> None:
        await self._pages.send_str(json.dumps({**request, "id": 1}))
        async for message in self._pages:  # ends if the console closes
            await self._pages.send_str('{"do": "received"}')
            if b'"type": "answer"' in message.data:
                return


class Attack:
    """A running emulator, and its worst messages on each channel."""

    def __init__(self, emulator: EmulatorProcess, stack: ExitStack) -> None:
        self._ready = emulator.ready
        self._turn = 0
        self._page = Page(self._ready["view"], stack)
        self._control = stack.enter_context(ControlClient(self._ready["control"]))
        self._feed = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        host, _, port = self._ready["can"].removeprefix("socketcand:").partition("/")[0].partition(":")
        self._hub = stack.enter_context(socket.create_connection((host, int(port))))
        self._hub.sendall(b"< open vcan0 >")
        self._file = Path(stack.enter_context(TemporaryDirectory(prefix="starhil-soak-")), "truth.csv")
        rows = "".join(f"{second},0,0,0,1\n" for second in range(WORST_ROWS))
        self._file.write_text(f"t,qx,qy,qz,qw\n{rows}", encoding="ascii")
        self.channels: dict[str, Send] = {
            "control": self._to_control,
            "console": self._to_console,
            "feed": self._to_feed,
            "serial": self._to_serial,
            "hub": lambda: self._hub.sendall(b"< send 1234567 8 1 2 3 4 5 6 7 > <" * (WORST_BYTES // 35)),
            "CAN": lambda: self._hub.sendall(b"< send 07030104 8 1 2 3 4 5 6 7 9 >" * (WORST_BYTES // 35)),
            "NMT": lambda: self._hub.sendall(
                b"< send 000 2 1 2C >< send 000 2 82 2C >" * (WORST_BYTES // 39)
            ),
            "file": lambda: self._control.do("set_truth", truth={"kind": "file", "path": str(self._file)}),
        }

    def _next(self, messages: Sequence[Any]) -> Any:
        self._turn += 1
        return messages[self._turn % len(messages)]

    def _to_control(self) -> None:
        with contextlib.suppress(BenchError):
            request = dict(self._next(worst_requests()))
            self._control.do(request.pop("do"), **request)

    def _to_console(self) -> None:
        request = self._next(worst_requests())
        wanted = [{"do": "control", "request": request}, {"do": "encode", "row": "a" * (WORST_BYTES - 99)}]
        self._page.ask(wanted[self._turn % 2])

    def _to_serial(self) -> None:
        with Path(self._ready["serial"]).open("wb", buffering=0) as line:
            line.write(b"\x1f\x7f\x80" * (WORST_BYTES // 3))

    def _to_feed(self) -> None:
        host, _, port = self._ready["truth"].removeprefix("udp:").rpartition(":")
        self._feed.sendto(self._next(worst_datagrams()), (host, int(port)))


def worst(names: Sequence[str]) -> bool:
    """Print the p99 of replies with and without the worst messages of each channel; return whether all is well.

    The OBC polls on the serial line, and on CAN while the serial line gets the messages.
    """
    good, rng = True, random.Random(1)  # noqa: S311 (rows to request, not secrets)
    with ExitStack() as stack:
        hub = stack.enter_context(EmulatorProcess(hub_command()))
        command = emulator_command(
            profile="demo",
            can=hub.ready["can"],
            seed=1,
            settings=[f"links.serial.baud={BAUD}", "truth.kind=live"],
            extra=["--control", "auto", "--view", "auto", "--canopen", "44"],
        )
        emulator = stack.enter_context(EmulatorProcess(command))
        attack = Attack(emulator, stack)
        on_serial = ObcClient.open(serial=emulator.ready["serial"], baud=BAUD, timeout_s=SETTLE_S)
        on_can = ObcClient.open(can=emulator.ready["can"], timeout_s=SETTLE_S)
        for obc in (on_serial, on_can):
            polled_ms(stack.enter_context(obc), rng)  # warm up
        for name, send in attack.channels.items():
            if names and name not in names:
                continue
            obc = on_can if name == "serial" else on_serial
            without: list[float] = []
            with_messages: list[float] = []
            for _ in range(WORST_WINDOWS):
                without += polled_ms(obc, rng)
                with sending(send):
                    with_messages += polled_ms(obc, rng)
            before, after = percentile(without, 0.99), percentile(with_messages, 0.99)
            slower = after > SLOWEST_RATIO * before
            good = good and not slower
            print(
                f"{name:8s} p99 {before:6.1f} ms without, {after:6.1f} ms with messages of {WORST_BYTES} bytes, "
                f"maximum {max(without):6.1f} and {max(with_messages):6.1f} ms  {'SLOWER' if slower else 'ok'}",
                flush=True,
            )
    return good


def main() -> int:
    """Run the soak test and print the result; return 0 if nothing grew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=15.0, help="how long")
    parser.add_argument(
        "--worst", nargs="*", metavar="CHANNEL", help="the worst messages of each channel instead"
    )
    options = parser.parse_args()
    try:
        if options.worst is not None:
            return int(not worst(options.worst))
        figures = compare(soak(60.0 * options.minutes))
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
