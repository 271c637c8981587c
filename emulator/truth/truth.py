"""The truth of a run: its source, the mount of the sensors, and the socket and lock-step of a live feed.

All heads of a run are mounted on one body. `Truth` describes the body, and `SensorTruth` a head: it applies the mount
of the head. The source can be replaced at any time, with everything that
belongs to it:

- `set` reads the files of a configuration, opens the socket of a live feed, and then replaces the source. The
  previous source stays if this fails, except that a feed on the same port is closed first.
- `put` replaces the source at once. Scenarios use it, because their files are read when the run starts.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.clock import Clock, make_clock
from starhil.emulator.simulation.threads import in_thread
from starhil.emulator.truth.config import Config42, FeedConfig, FileConfig, TruthConfig
from starhil.emulator.truth.feed import LiveFeed, Step
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.source import FixedTruth, TruthSource, TruthState
from starhil.emulator.truth.table import FileTruth
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.arithmetic.matrices import product
from starid.attitude import Attitude


@dataclass(frozen=True)
class TruthHost:
    """What a truth source uses of its run."""

    clock: Clock
    clock_name: str
    """Configured clock: that of a replay differs."""
    start_unix_s: float
    """Date at which the run starts."""
    time_passes: asyncio.Event
    """Set when every pipeline is ready."""
    step: Step
    """Advances the stepped clock, for lock-step."""
    record_truth: Callable[..., None]
    record_message: Callable[..., None]
    """Records a new truth, or a message of a feed, on the tape, if there is one, with the values of the entry."""
    opens_sockets: bool = True
    """Whether live feeds open sockets; the messages of a replay come from the tape."""

    def now_s(self) -> float:
        """Return the simulation time, seconds."""
        return self.clock.now_ns() / NANOSECONDS


class Truth:
    """The truth of the body on which the heads of a run are mounted, which `open` builds from its configuration.

    Relative paths of truth files refer to `folder`.
    """

    def __init__(self, config: TruthConfig, folder: Path, host: TruthHost) -> None:
        self.configured = config
        self.source: TruthSource = FixedTruth(Attitude.identity())
        """Truth of the body: attitude ICRS→body, rate in the body frame."""
        self.mount: Attitude | None = None
        """Mount in the configuration that has replaced the first one; None: each head has that of its profile."""
        self.feed: LiveFeed | None = None
        self.address = ""
        """Address of the live feed; empty if there is none."""
        self._wanted_address = ""
        """Address of the live feed as configured."""
        self._folder = folder
        self._host = host

    async def open(self) -> None:
        self.put(*await self._load(self.configured, None))

    async def set(self, config: TruthConfig, at_s: float | None = None) -> None:
        """Replace the truth; its motion begins now, or at a simulation time, as in a recorded run."""
        loaded = await self._load(config, at_s)
        start_s = getattr(loaded[0], "start_s", self._host.now_s())
        self._host.record_truth(config=config, start_s=start_s)
        self.put(*loaded)

    def put(
        self, source: TruthSource, config: TruthConfig, feed: LiveFeed | None = None, address: str = ""
    ) -> None:
        """Replace source, mount and feed."""
        self.close()
        self.source, self.feed, self.address = source, feed, address
        of_profiles = config is self.configured  # where the profile of the first head has its own mount only
        self.mount = None if config.mount is None or of_profiles else config.mount.build()
        if address and isinstance(config, FeedConfig):
            self._wanted_address = _address(config)

    def close(self) -> None:
        """Close the socket of the live feed, if there is one."""
        if self.feed is not None:
            self.feed.close()
        self.feed, self.address, self._wanted_address = None, "", ""

    async def _load(
        self, config: TruthConfig, at_s: float | None
    ) -> tuple[TruthSource, TruthConfig, LiveFeed | None, str]:
        """Return what `put` needs: read the file of the source, or open its socket."""
        host = self._host
        now_s = host.now_s() if at_s is None else at_s
        source = await in_thread(config.build, now_s, self._folder)
        live = at_s is None
        if (
            live
            and isinstance(source, FileTruth)
            and isinstance(config, FileConfig)
            and config.start == "now"
        ):
            source = replace(source, start_s=host.now_s())  # reading has taken time
        if not isinstance(config, FeedConfig) or not isinstance(source, LiveTruth):
            return source, config, None, ""
        source.set_run(make_clock(host.clock_name).speed, host.start_unix_s)
        feed = LiveFeed(
            source, host.now_s, host.step if self._is_lockstep(config) else None, self._message_received
        )
        if not host.opens_sockets:
            return source, config, feed, ""
        if config.port != 0 and _address(config) in (self.address, self._wanted_address):
            self.close()  # the same port: it must be free first
            await asyncio.sleep(0)  # the loop closes it in its next turn
        try:
            return source, config, feed, await feed.start(config.socket, config.host, config.port)
        except BaseException:  # as by a later truth
            feed.close()
            raise

    def _is_lockstep(self, config: FeedConfig) -> bool:
        """Return whether the messages of a feed advance the clock."""
        stepped = self._host.clock_name == "stepped"
        if isinstance(config, Config42):
            return stepped
        if config.lockstep and not stepped:
            raise EmulatorError(
                f"truth.lockstep: the clock must be stepped, not {self._host.clock.name}; run with --clock stepped"
            )
        return config.lockstep

    def _message_received(self, data: bytes) -> None:
        """Record a message of the feed; until time passes, each message replaces the earlier ones."""
        self._host.record_message(data=data.decode("latin-1"))
        live = None if self.feed is None else self.feed.truth
        if live is not None and live.timeline == "anchor" and not self._host.time_passes.is_set():
            live.begin_timeline()


class SensorTruth:
    """The truth of a sensor that is mounted on the body.

    `mount` is the rotation body→sensor, unless the truth's configuration has one; None: the frames are the same.
    """

    def __init__(self, body: Truth, mount: Attitude | None) -> None:
        self._body = body
        self._mount = mount

    @property
    def kind(self) -> str:
        return self._body.source.kind

    def state(self, t_s: float) -> TruthState:
        """Return the truth of the sensor at a simulation time in seconds."""
        body = self._body
        return seen_from(self._mount if body.mount is None else body.mount, body.source.state(t_s))


def seen_from(mount: Attitude | None, body: TruthState) -> TruthState:
    """Return the truth of a sensor, from that of its body and the rotation body→sensor (None: no rotation)."""
    if mount is None:
        return body
    turn = mount.matrix
    return replace(
        body,
        attitude=Attitude.from_matrix(product(turn, body.attitude.matrix)),
        rate_rad_s=product(turn, body.rate_rad_s),
    )


def _address(config: FeedConfig) -> str:
    return f"{'udp' if config.socket == 'udp' else 'tcp'}:{config.host}:{config.port}"
