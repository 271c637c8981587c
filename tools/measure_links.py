"""Measure throughput and round trips of the CAN hub, and round trips of a pseudo-terminal, between processes.

    python tools/measure_links.py [--frames N] [--trips N] [--json]

Hub and both ends are separate processes, as in normal use. The peer only echoes, so that the figures measure
the links alone.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing as mp
import socket
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starhil.protocol.can_framing import CanFrame
from starhil.protocol.hub import CanHub
from starhil.protocol.socketcand import format_send
from starhil.protocol.transports import open_can, open_serial

PING = CanFrame(0x08AA0401, bytes(range(8)))
SERIAL_PING = b"\x1f\x7f\x80\x1f\xff"


def _serve(main: Callable[[Connection], Any], pipe: Connection) -> None:
    asyncio.run(main(pipe))


async def _hub(pipe: Connection) -> None:
    hub = CanHub(port=0)
    await hub.start()
    pipe.send(f"socketcand:127.0.0.1:{hub.port}/vcan0")
    await asyncio.to_thread(pipe.recv)
    pipe.send((hub.statistics.frames, hub.statistics.delivered, hub.statistics.dropped))
    await hub.close()


async def _can_echo(pipe: Connection) -> None:
    transport = open_can(pipe.recv())
    await transport.start(lambda frame: transport.send(CanFrame(frame.id ^ 0x01000000, frame.data)))
    pipe.send("ready")
    await asyncio.to_thread(pipe.recv)
    await transport.close()


async def _can_count(pipe: Connection) -> None:
    spec, frames = pipe.recv()
    count = 0

    def take(_: CanFrame) -> None:
        nonlocal count
        count += 1
        if count == frames:
            pipe.send(time.monotonic())

    transport = open_can(spec)
    await transport.start(take)
    pipe.send("ready")
    await asyncio.to_thread(pipe.recv)
    await transport.close()


async def _pty_echo(pipe: Connection) -> None:
    transport = open_serial("auto", symlink=Path(pipe.recv()), paced=False)
    await transport.start(transport.send)
    pipe.send("ready")
    await asyncio.to_thread(pipe.recv)
    await transport.close()


class Helper:
    """A process that serves one end of a link, and the pipe to it."""

    def __init__(self, main: Callable[[Connection], Any], first: object = None) -> None:
        self.pipe, far = mp.Pipe()
        self.process = mp.get_context("spawn").Process(target=_serve, args=(main, far), daemon=True)
        self.process.start()
        if first is not None:
            self.pipe.send(first)
        self.first_message = self.pipe.recv()

    def end(self) -> None:
        """End the process."""
        self.pipe.send("end")
        self.process.join(10)


def percentile(values: list[float], share: float) -> float:
    """Return the value below which a given fraction of the values lies."""
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def _trips(times: list[float]) -> dict[str, float]:
    micro = [1e6 * value for value in times]
    return {
        "p50_us": round(percentile(micro, 0.5), 1),
        "p99_us": round(percentile(micro, 0.99), 1),
        "max_us": round(max(micro), 1),
    }


async def _round_trips(transport: Any, ping: Any, trips: int) -> list[float]:
    answered = asyncio.Event()
    await transport.start(lambda _: answered.set())
    times = []
    for _ in range(trips):
        answered.clear()
        begin = time.perf_counter()
        transport.send(ping)
        await asyncio.wait_for(answered.wait(), 10)
        times.append(time.perf_counter() - begin)
    await transport.close()
    return times


def hub_round_trip(spec: str, trips: int) -> dict[str, float]:
    """Round trips of one frame over the hub to an echo and back."""
    echo = Helper(_can_echo, spec)
    times = asyncio.run(_round_trips(open_can(spec), PING, trips))
    echo.end()
    return _trips(times)


def hub_flood(spec: str, frames: int) -> dict[str, float]:
    """Measure frames per second from one sender, as fast as it can, to one receiving transport."""
    reader = Helper(_can_count, (spec, frames))
    host, _, port = spec.removeprefix("socketcand:").partition("/")[0].rpartition(":")
    with socket.create_connection((host, int(port))) as raw:
        raw.sendall(b"< open vcan0 >")
        begin = time.monotonic()
        for _ in range(frames // 1000):
            raw.sendall(format_send(PING) * 1000)
        end = reader.pipe.recv()
    reader.end()
    return {"frames_per_s": round(frames / (end - begin)), "seconds": round(end - begin, 3)}


def pty_round_trip(trips: int) -> dict[str, float]:
    """Round trips of a telemetry request over a pseudo-terminal, without pacing."""
    with TemporaryDirectory() as folder:
        link = Path(folder) / "tty"
        echo = Helper(_pty_echo, str(link))
        times = asyncio.run(_round_trips(open_serial(str(link), paced=False), SERIAL_PING, trips))
        echo.end()
    return _trips(times)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200_000, help="frames of the flood")
    parser.add_argument("--trips", type=int, default=5_000, help="round trips of each link")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    arguments = parser.parse_args()
    hub = Helper(_hub)
    results = {
        "hub_round_trip": hub_round_trip(hub.first_message, arguments.trips),
        "hub_flood": hub_flood(hub.first_message, arguments.frames),
        "pty_round_trip": pty_round_trip(arguments.trips),
    }
    hub.pipe.send("end")
    received, delivered, dropped = hub.pipe.recv()
    results["hub_totals"] = {"received": received, "delivered": delivered, "dropped": dropped}
    if arguments.json:
        print(json.dumps(results))
        return
    for name, figures in results.items():
        print(f"{name:16s}", "  ".join(f"{key} {value}" for key, value in figures.items()))


if __name__ == "__main__":
    main()
