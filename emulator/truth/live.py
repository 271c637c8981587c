"""Truth from a live feed: a dynamics simulator sends attitudes as JSON lines over UDP or TCP.

One message per line (TCP), or one or more lines per datagram (UDP)::

    {"t": 12.25, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.3, 0.0]}

``t``
    Seconds on the sender's clock, increasing. Optional; default: time of receipt.
``q``
    Quaternion ICRS→sensor, scalar last (x, y, z, w), of length 1 within 1 %.
``rate``
    Body rate in the sensor frame, degrees per second, at most `MAX_RATE_DEG_S` per axis. Optional;
    default: derived from the last two messages, or without ``t`` from messages at least
    `RECEIPT_BASELINE_S` apart. A rate that contradicts the attitudes makes a bad message
    (`starhil.emulator.truth.feed_rates`).

The first message sets the offset between the sender's clock and simulation time; drift is tracked
(`starhil.emulator.truth.sender_clock`) and rates are scaled accordingly. With ``timeline = "run"`` in the
profile, ``t`` is simulation time.

Between two messages the attitude is interpolated. After the last one it is propagated at the last rate for
at most ``stale_s``; then it is held and flagged ``stale``. With ``timeline = "run"`` it is also stale if the
last ``t`` is older than that.

A bad message is counted, logged (the 1st, 10th, 100th …) and otherwise ignored. A ``t`` that does not
increase makes a bad message, except that a jump back by more than `RESTART_S` starts a new timeline.
"""

from __future__ import annotations

import asyncio
import bisect
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.json_lines import RepeatedKeyError, parse_json, read_lines
from starhil.emulator.truth.feed_rates import SHORTEST_S, FeedError, FeedRates
from starhil.emulator.truth.sender_clock import SenderClock
from starhil.emulator.truth.source import MAX_RATE_DEG_S, ZERO_RATE, TruthState, TruthStatus, Vector
from starhil.protocol.errors import reason
from starid.attitude import Attitude, interpolate, propagate

log = logging.getLogger("starhil.truth")

HISTORY: Final = 512
"""Number of messages kept, for exposures whose midpoint has already passed."""

RESTART_S: Final = 1.0
"""A sender's time that jumps back by more than this starts a new timeline, seconds."""

NORM_TOLERANCE: Final = 0.01
MAX_LINE: Final = 4096
"""Longest accepted line, bytes."""


@dataclass(frozen=True)
class FeedMessage:
    """A decoded message: the sender's time (or None), attitude and rate (rad/s, or None)."""

    t: float | None
    attitude: Attitude
    rate_rad_s: Vector | None


def parse_message(line: bytes | str) -> FeedMessage:
    """Decode one line.

    Raises
    ------
    FeedError
        The line is not a valid message; the text names the key.
    """
    try:
        message: Any = parse_json(line)
    except RepeatedKeyError as error:
        raise FeedError(str(error)) from None
    except (ValueError, RecursionError):
        raise FeedError("not a JSON line") from None
    if not isinstance(message, dict):
        raise FeedError("not a JSON object")
    unknown = sorted(set(message) - {"t", "q", "rate"})
    if unknown:
        raise FeedError(f"unknown key {unknown[0]!r}; known: t, q, rate")
    if "q" not in message:
        raise FeedError("q is missing")
    quaternion = _numbers("q", message["q"], 4)
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > NORM_TOLERANCE:
        raise FeedError("q is not of length 1")
    rate = _numbers("rate", message["rate"], 3) if message.get("rate") is not None else None
    if rate is not None and np.abs(rate).max() > MAX_RATE_DEG_S:
        raise FeedError(f"rate exceeds {MAX_RATE_DEG_S:g} degrees per second")
    t = _numbers("t", [message["t"]], 1)[0] if message.get("t") is not None else None
    return FeedMessage(
        None if t is None else float(t), Attitude(quaternion), None if rate is None else np.radians(rate)
    )


def _numbers(key: str, value: object, count: int) -> Vector:
    if not isinstance(value, list) or len(value) != count:
        raise FeedError(f"{key} is not {count} numbers")
    for number in value:
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not abs(number) < 1e15:
            raise FeedError(f"{key} holds {number!r}, not a finite number")
    return np.array(value, dtype=np.float64)


class LiveTruth:
    """Truth from the messages of a live feed.

    Parameters
    ----------
    attitude
        Attitude before the first message.
    stale_s
        Silence, in seconds of simulation time, after which the attitude is held and flagged stale.
    timeline
        `anchor`: the first message sets the offset of the sender's clock; `run`: the sender uses
        simulation time.
    """

    kind: Final = "live"

    def __init__(
        self, attitude: Attitude, *, stale_s: float = 1.0, timeline: Literal["anchor", "run"] = "anchor"
    ) -> None:
        self.stale_s = stale_s
        self.timeline = timeline
        self.accepted = 0
        self.refused = 0
        self.last_fault = ""
        self._start = attitude
        self._clock = SenderClock()
        self._rates = FeedRates(timed=True)
        self._last_t: float | None = None
        """The sender's time in the last message with a time."""
        self._received_s = 0.0
        """Simulation time at which the last message was accepted."""
        self._times: deque[float] = deque(maxlen=HISTORY)
        self._states: deque[tuple[Attitude, Vector]] = deque(maxlen=HISTORY)

    def receive(self, line: bytes | str, received_s: float) -> bool:
        """Process one line received at a simulation time in seconds; return whether it was accepted."""
        try:
            self._add_message(parse_message(line), received_s)
        except FeedError as fault:
            self.reject(str(fault))
            return False
        self.accepted += 1
        return True

    def reject(self, fault: str) -> None:
        """Count a bad message and keep its fault in `last_fault`."""
        self.refused += 1
        self.last_fault = fault
        if str(self.refused).rstrip("0") == "1":
            log.warning("truth feed: message rejected (%d so far): %s", self.refused, fault)

    def _add_message(self, message: FeedMessage, received_s: float) -> None:
        timed = message.t is not None
        if message.t is not None:
            self._check_time(message.t)
            self._last_t = message.t
        if self._rates.timed != timed:
            self._rates = FeedRates(timed=timed)
        at_s = received_s if message.t is None else message.t
        rate = self._rates.body_rate(at_s, message.attitude, message.rate_rad_s)
        t = at_s
        if timed and self.timeline == "anchor":
            t = self._clock.simulation_time(at_s, received_s, self.stale_s)
            rate = rate * (1.0 - self._clock.slope)
        self._drop_superseded(t, timed=timed)
        self._received_s = received_s
        self._times.append(t)
        self._states.append((message.attitude, rate))

    def _check_time(self, t: float) -> None:
        """Reject a sender's time that does not increase; a long jump back starts a new timeline."""
        if self._last_t is None or t >= self._last_t + SHORTEST_S:
            return
        if self._last_t - t <= RESTART_S:
            raise FeedError(f"t = {t} is not later than the message before")
        self._times.clear()
        self._states.clear()
        self._clock, self._rates = SenderClock(), FeedRates(timed=True)

    def _drop_superseded(self, t: float, *, timed: bool) -> None:
        """Drop messages that a new one replaces: one received at the same time, or an abandoned timeline."""
        if not self._times or t >= self._times[-1] + SHORTEST_S:
            return
        if not timed and t >= self._times[-1]:
            self._times.pop()
            self._states.pop()
        elif self._times[-1] - t > RESTART_S:
            self._times.clear()
            self._states.clear()
        else:
            raise FeedError(f"its time is {self._times[-1] - t:.3g} s before that of the message before")

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        if not self._times:
            return TruthState(self._start, ZERO_RATE, TruthStatus.WAITING)
        age = t_s - self._times[-1]
        attitude, rate = self._states[-1]
        silence = age if self.timeline == "run" else min(age, t_s - self._received_s)
        if silence > self.stale_s:
            return TruthState(propagate(attitude, rate, self.stale_s), ZERO_RATE, TruthStatus.STALE)
        if age >= 0.0:
            status = TruthStatus.EXTRAPOLATED if age > 0.0 else TruthStatus.OK
            return TruthState(propagate(attitude, rate, min(age, self.stale_s)), rate, status)
        if t_s <= self._times[0]:
            attitude, rate = self._states[0]
            return TruthState(attitude, rate, TruthStatus.BEFORE_START)
        upper = bisect.bisect_right(self._times, t_s)
        low = upper - 1
        fraction = (t_s - self._times[low]) / (self._times[upper] - self._times[low])
        (before, rate_before), (after, rate_after) = self._states[low], self._states[upper]
        rate = (1.0 - fraction) * rate_before + fraction * rate_after
        return TruthState(interpolate(before, after, fraction), rate)


class _Datagrams(asyncio.DatagramProtocol):
    """Passes each line of each datagram to the feed."""

    def __init__(self, feed: LiveFeed) -> None:
        self._feed = feed

    def datagram_received(self, data: bytes, addr: object) -> None:  # noqa: ARG002 (asyncio's signature)
        """Process a datagram."""
        for line in data.splitlines():
            if line.strip():
                self._feed.receive(line)


class LiveFeed:
    """The socket that a dynamics simulator sends to, feeding a `LiveTruth`.

    Parameters
    ----------
    truth
        Receives the messages.
    now_s
        Returns the simulation time in seconds.
    """

    def __init__(self, truth: LiveTruth, now_s: Callable[[], float]) -> None:
        self.truth = truth
        self._now_s = now_s
        self._transport: asyncio.DatagramTransport | None = None
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def start(self, protocol: Literal["udp", "tcp"], host: str, port: int) -> str:
        """Start listening; return the address as `udp:HOST:PORT` or `tcp:HOST:PORT`."""
        loop = asyncio.get_running_loop()
        try:
            if protocol == "udp":
                transport, _ = await loop.create_datagram_endpoint(
                    lambda: _Datagrams(self), local_addr=(host, port)
                )
                self._transport = transport
                address = transport.get_extra_info("sockname")
            else:
                self._server = await asyncio.start_server(self._serve, host, port, limit=MAX_LINE)
                address = self._server.sockets[0].getsockname()
        except (OSError, ValueError) as error:  # ValueError: not a valid host name
            raise EmulatorError(
                f"truth feed {protocol}:{host}:{port}: cannot listen ({reason(error)}); choose another port, or 0"
            ) from None
        return f"{protocol}:{address[0]}:{address[1]}"

    def receive(self, line: bytes) -> None:
        """Process one line received now."""
        self.truth.receive(line, self._now_s())

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            async for line in read_lines(reader):
                if line is None:
                    self.truth.reject(f"line longer than {MAX_LINE} bytes")
                elif line.strip():
                    self.receive(line)
        except ConnectionError:
            self.truth.reject("connection broken")
        finally:
            self._writers.discard(writer)
            writer.close()

    def close(self) -> None:
        """Stop listening."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in list(self._writers):
            writer.transport.abort()
