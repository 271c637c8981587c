"""Messages of 42, NASA's spacecraft simulator, over its sockets (`Inp_IPC.txt`, mode TX).

A message is a block of text lines that ends with ``[ENDMSG]``::

    TIME 2024-099-00:00:00.100000000
    SC[0].qn = [2.970455206341e-01 7.069619089064e-02 2.835841375021e-01 9.090357771958e-01]
    SC[0].B[0].wn = [4.870131279943e-03 6.719891915419e-03 8.264863363114e-03]
    Orb[0].PosN = [6.369110518417e+06 1.427708321263e+06 1.827383319013e+06]
    Orb[0].VelN = [-2.623614934750e+03 4.436324912759e+03 5.678236949775e+03]
    [ENDMSG]

``qn`` is an attitude quaternion J2000 → body, scalar last, the conjugate of the quaternion used here. ``wn`` is the
body rate in the body frame, rad/s. ``PosN`` and ``VelN`` describe the reference orbit, to which ``SC[0].PosR`` and
``VelR`` are added. 42 sends its first block after its first step, so its time is one step later than in the first row of
42's own files. Older versions of 42 write no brackets, and only ``SC[0].B[0].qn``. If blocking is enabled, 42
waits for four bytes, ``Ack`` and a zero, after each message.
"""

from __future__ import annotations

import logging
import re
from datetime import date
from typing import Final

import numpy as np

from starhil.emulator.truth.feed_message import FeedMessage, checked_attitude, checked_date, checked_rate
from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.source import Vector

log = logging.getLogger("starhil.truth")

ACKNOWLEDGE: Final = b"Ack\0"

DAY_NS: Final = 86_400_000_000_000

_TIME: Final = re.compile(
    r"^TIME\s+(\d{4})-(\d{1,3})-(\d{1,2}):(\d{1,2}):(\d{1,2})(?:\.(\d{1,9})\d*)?\s*$", re.MULTILINE
)
_PREFIXES: Final = 'give 42 the prefixes "SC" and "Orb" in Inp_IPC.txt'


class Format42:
    """Message format of 42 for spacecraft i of ``SC[i]`` and its reference orbit, i of ``Orb[i]``."""

    end: Final = b"[ENDMSG]"
    max_size: Final = 65536
    always_answers: Final = True

    def __init__(self, spacecraft: int = 0, orbit: int = 0) -> None:
        self._spacecraft = f"SC[{spacecraft}]"
        self._orbit = f"Orb[{orbit}]"
        self._first_ns: int | None = None
        self._lacks_orbit = False

    def decode(self, data: bytes | str) -> FeedMessage:
        """Decode one block; `t` is relative to the first block."""
        text = data if isinstance(data, str) else data.decode("ascii", "replace")
        if not text.rstrip().endswith(self.end.decode()):
            raise FeedError("block without [ENDMSG]")
        time_ns = _unix_ns(text)
        values = dict(line.split(" = ", 1) for line in text.splitlines() if " = " in line)
        body = self._spacecraft
        quaternion = _vector(values, 4, f"{body}.qn", f"{body}.B[0].qn")
        rate = _vector(values, 3, f"{body}.B[0].wn", f"{body}.wn")
        if quaternion is None or rate is None:
            missing = f"{body}.{'qn' if quaternion is None else 'B[0].wn'}"
            raise FeedError(f"no {missing}; {_others(values, body, 'truth.spacecraft') or _PREFIXES}")
        if self._first_ns is None:
            self._first_ns = time_ns
        position = _sum(_vector(values, 3, f"{self._orbit}.PosN"), _vector(values, 3, f"{body}.PosR"))
        velocity = _sum(_vector(values, 3, f"{self._orbit}.VelN"), _vector(values, 3, f"{body}.VelR"))
        if position is None or velocity is None:
            self._orbit_is_missing(values)
        return FeedMessage(
            (time_ns - self._first_ns) / 1e9,
            checked_attitude(f"{body}.qn", quaternion, "attitude"),
            checked_rate(f"{body}.wn", rate),
            None if position is None or velocity is None else OrbitState(position, velocity),
            checked_date("TIME", time_ns / 1e9),
        )

    def _orbit_is_missing(self, values: dict[str, str]) -> None:
        """Reject a block with other orbits; report once that 42 sends none."""
        others = _others(values, self._orbit, "truth.orbit")
        if others:
            raise FeedError(f"no {self._orbit}.PosN; {others}")
        if not self._lacks_orbit:
            self._lacks_orbit = True
            log.warning(
                "truth feed: 42 sends no orbit, so there is neither Earth nor aberration: %s", _PREFIXES
            )

    def answer(self, run_time_s: float, fault: str) -> bytes:  # noqa: ARG002 (42 accepts one answer)
        """Return the answer expected by 42."""
        return ACKNOWLEDGE


def _unix_ns(text: str) -> int:
    """Return the Unix time of a block, nanoseconds."""
    match = _TIME.search(text)
    if match is None:
        raise FeedError("no line TIME year-day-hour:minute:second; is this 42?")
    year, day, hour, minute, second = (int(part) for part in match.groups()[:5])
    nanoseconds = int((match[6] or "0").ljust(9, "0"))
    try:
        days = date(year, 1, 1).toordinal() - date(1970, 1, 1).toordinal() + day - 1
    except ValueError:
        raise FeedError(f"TIME has no valid year: {year}") from None
    return days * DAY_NS + (hour * 3600 + minute * 60 + second) * 1_000_000_000 + nanoseconds


def _others(values: dict[str, str], missing: str, key: str) -> str:
    """Return which objects a block has instead, and the key that selects one; an empty text if it has none."""
    prefix = missing.partition("[")[0] + "["
    found = sorted({name.partition(".")[0] for name in values if name.startswith(prefix)})
    return f"the block has {', '.join(found)}: set {key}" if found and missing not in found else ""


def _vector(values: dict[str, str], count: int, *names: str) -> Vector | None:
    """Return the numbers for the first of the names that is in the block."""
    for name in names:
        if name in values:
            try:
                numbers = np.array([float(item) for item in values[name].strip(" []\r").split()])
            except ValueError:
                numbers = np.zeros(0)
            if numbers.shape != (count,) or not np.isfinite(numbers).all():
                raise FeedError(f"{name} is not {count} finite numbers")
            return numbers
    return None


def _sum(of_orbit: Vector | None, relative: Vector | None) -> Vector | None:
    return of_orbit if of_orbit is None or relative is None else of_orbit + relative
