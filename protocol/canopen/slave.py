"""A sans-I/O CANopen slave: CAN frames and time in, CAN frames and events out (CiA 301, CiA 305).

The caller owns bus and clock: it passes each frame to `receive`, calls `tick` at `next_deadline`, sends the
returned frames in order, and collects the events. The slave does not block, read a clock or start threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.cob import ERROR_CONTROL, LSS_MASTER, NMT, SDO_RECEIVE
from starhil.protocol.canopen.context import UNCONFIGURED_NODE, Context, EventKind, NmtState, SlaveEvent
from starhil.protocol.canopen.dictionary import Deferred, Dictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.canopen.emergency import EmergencyProducer
from starhil.protocol.canopen.error_control import ErrorControl
from starhil.protocol.canopen.lss import BIT_RATES, LssSlave
from starhil.protocol.canopen.pdo import PdoService
from starhil.protocol.canopen.sdo import SdoServer
from starhil.protocol.canopen.storage import ParameterStorage
from starhil.protocol.canopen.store_restore import ApplicationStore, Background, StoreRestore, write_at_once
from starhil.protocol.canopen.sync import SyncService
from starhil.protocol.canopen.timestamp import TimeConsumer
from starhil.protocol.errors import ProtocolError

STATE_COMMANDS: Final = {1: NmtState.OPERATIONAL, 2: NmtState.STOPPED, 128: NmtState.PRE_OPERATIONAL}
"""NMT command specifier → requested state."""
RESET_NODE: Final = 129
RESET_COMMUNICATION: Final = 130

ERROR_BEHAVIOUR: Final = (0x1029, 1)
HIGH_RESOLUTION: Final = (0x1013, 0)
STORED_EDS: Final = (0x1021, 0)

Handler = Callable[[bytes], None]


class CanopenSlave:
    """One node on the bus.

    Parameters
    ----------
    dictionary
        Object dictionary with at least the communication profile of `communication.add_communication`.
    node_id
        1 to 127, or 255 for a node that waits for LSS; a node ID stored by LSS takes precedence.
    storage
        Storage of the parameters; the default keeps them only until a restart.
    sdo_timeout_s
        Silence of an SDO client after which its transfer is aborted.
    bit_rates
        Bit rates that LSS may set, bit/s.
    on_save, on_restore
        As in `StoreRestore`.
    background
        Performs the writes to `storage`; after the end of one that ends later, `tick` returns its answer.
    on_reset
        Called to reset the application when NMT resets the node; a returned node ID applies unless LSS has
        stored one.

    Raises ProtocolError: the node ID is invalid.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        node_id: int,
        *,
        storage: ParameterStorage | None = None,
        sdo_timeout_s: float = 1.0,
        bit_rates: frozenset[int] = frozenset(BIT_RATES.values()),
        on_save: ApplicationStore | None = None,
        on_restore: ApplicationStore | None = None,
        on_reset: Callable[[], int | None] | None = None,
        background: Background = write_at_once,
    ) -> None:
        if not 1 <= node_id <= 127 and node_id != UNCONFIGURED_NODE:
            raise ProtocolError(f"CANopen node ID {node_id}: must be 1 to 127, or 255 to wait for LSS")
        self.dictionary = dictionary
        self._context = context = Context(dictionary, node_id)
        self.sdo = SdoServer(context, sdo_timeout_s)
        self.store = StoreRestore(
            context,
            ParameterStorage() if storage is None else storage,
            self.sdo.finish,
            on_save,
            on_restore,
            background,
        )
        self._default_node_id = node_id
        self.lss = LssSlave(context, self.store, self._activate_node_id, bit_rates)
        context.node_id = self.lss.pending_node_id
        self.emergency = EmergencyProducer(context)
        self.pdos = PdoService(context, self.emergency)
        self.sync = SyncService(context, self.emergency, self.pdos.synchronise)
        self.time = TimeConsumer(context)
        self.error_control = ErrorControl(context, self.emergency, self._on_communication_error)
        self._timed = (self.sdo, self.error_control, self.sync, self.pdos, self.emergency)
        self._on_reset = on_reset
        self._clock_offset_us = 0
        self._routes: dict[int, list[Handler]] = {}
        self._bind()

    @property
    def state(self) -> NmtState:
        return self._context.state

    @property
    def node_id(self) -> int:
        """Current node ID, 255 while it waits for LSS."""
        return self._context.node_id

    def start(self, now: float) -> list[CanFrame]:
        """Power on: load the parameters, boot up and enter PRE-OPERATIONAL."""
        self._begin_instant(now)
        self._initialise(application=True)
        return self._collect_frames()

    def receive(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Process a frame from the bus; ignore extended and remote frames, except guarding, and unknown CAN IDs."""
        guarding = frame.id == ERROR_CONTROL + self.node_id
        handlers = self._routes.get(frame.id, [])
        if frame.extended or frame.remote is not guarding or not (guarding or handlers):
            return []
        self._begin_instant(now)
        if not self.lss.silent:
            if guarding:
                self.error_control.receive_guarding()
            for handler in tuple(handlers):
                handler(frame.data)
        return self._collect_frames()

    def tick(self, now: float) -> list[CanFrame]:
        """Act on the timers that have expired."""
        self._begin_instant(now)
        if self._context.state is not NmtState.INITIALISING and not self.lss.silent:
            for service in self._timed:
                service.tick()
        return self._collect_frames()

    def next_deadline(self) -> float | None:
        """Return the time at which `tick` must be called, on the caller's clock; None if nothing is due."""
        if self.lss.silent or self._context.state is NmtState.INITIALISING:
            return self.lss.next_deadline
        return min((time for item in self._timed if (time := item.next_deadline) is not None), default=None)

    def notify(self, keys: frozenset[tuple[int, int]] | set[tuple[int, int]], now: float) -> list[CanFrame]:
        """Report new values of objects: event-driven TPDOs are sent, acyclic ones wait for SYNC."""
        self._begin_instant(now)
        self.pdos.trigger(keys)
        self.pdos.tick()
        return self._collect_frames()

    def finish_write(
        self, deferred: Deferred, now: float, refusal: SdoAbortError | None = None
    ) -> list[CanFrame]:
        """Report the result of a deferred write: success, or a refusal."""
        self._begin_instant(now)
        self.sdo.finish(deferred, refusal or self.store.refusal_of(deferred))
        return self._collect_frames()

    def raise_emergency(
        self, code: int, register_bits: int, data: bytes = b"", *, now: float, key: bytes = b""
    ) -> list[CanFrame]:
        """Report an error of the application; see `EmergencyProducer.raise_error`."""
        self._begin_instant(now)
        self.emergency.raise_error(code, register_bits, data, key=key)
        return self._collect_frames()

    def clear_emergency(self, code: int, *, now: float, key: bytes = b"") -> list[CanFrame]:
        """Report that an error of the application is cleared."""
        self._begin_instant(now)
        self.emergency.clear_error(code, key=key)
        return self._collect_frames()

    def reset_node(self, now: float, node_id: int | None = None) -> list[CanFrame]:
        """Restart as after NMT "reset node", at the request of the application and without an event.

        A `node_id` applies from now on, unless LSS has stored one.
        """
        self._begin_instant(now)
        self._default_node_id = node_id or self._default_node_id
        self._initialise(application=True)
        return self._collect_frames()

    def take_events(self) -> list[SlaveEvent]:
        """Return the events since the last call."""
        events, self._context.events = self._context.events, []
        return events

    def _activate_node_id(self, node_id: int) -> None:
        """Leave the unconfigured state (LSS)."""
        self._context.node_id = node_id
        self._initialise(application=False)

    def _bind(self) -> None:
        clock = self.dictionary.find(*HIGH_RESOLUTION)
        clock.reader = lambda: (self._clock_us() + self._clock_offset_us & 0xFFFFFFFF).to_bytes(4, "little")
        clock.writer = self._set_clock
        stored_eds = self.dictionary.find(*STORED_EDS)
        stored_eds.reader = lambda: build_eds(self.dictionary).encode("ascii", errors="replace")

    def _clock_us(self) -> int:
        return round(self._context.now * 1e6)

    def _set_clock(self, data: bytes) -> None:
        self._clock_offset_us = int.from_bytes(data, "little") - self._clock_us()

    def _begin_instant(self, now: float) -> None:
        self._context.now = now
        self.lss.tick()
        self.dictionary.new_instant()

    def _collect_frames(self) -> list[CanFrame]:
        """Apply written parameters, then return the frames to send."""
        context = self._context
        if self.dictionary.changed:
            changed = frozenset(self.dictionary.changed)
            self.dictionary.changed.clear()
            self.pdos.configure(changed)
            self.pdos.trigger(changed)
            self.pdos.tick()
            self._route()
        frames, context.frames = context.frames, []
        return [] if self.lss.silent else frames

    def _route(self) -> None:
        """Assign a handler of data to each CAN ID; all services except LSS need a node ID."""
        self._routes = {LSS_MASTER: [self.lss.receive]}
        if self.node_id == UNCONFIGURED_NODE:
            return
        handlers: list[tuple[int | None, Handler]] = [
            (NMT, self._on_nmt),
            (self.sync.can_id, self.sync.receive),
            (self.time.can_id, self.time.receive),
            (SDO_RECEIVE + self.node_id, self.sdo.receive),
            *(
                (ERROR_CONTROL + other, partial(self.error_control.receive_heartbeat, other))
                for other in range(1, 128)
            ),
            *((pdo.can_id, pdo.receive) for pdo in self.pdos.receiving if pdo.exists),
        ]
        for can_id, handler in handlers:
            if can_id is not None:
                self._routes.setdefault(can_id, []).append(handler)

    def _on_nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in {0, self.node_id}:
            return
        command = data[0]
        if command in STATE_COMMANDS:
            self._enter(STATE_COMMANDS[command])
        elif command in {RESET_NODE, RESET_COMMUNICATION}:
            self._reset(application=command == RESET_NODE)

    def _on_communication_error(self) -> None:
        behaviour = self.dictionary.find(*ERROR_BEHAVIOUR).number()
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        elif behaviour == 2 and self.state is not NmtState.STOPPED:
            self._enter(NmtState.STOPPED)

    def _enter(self, state: NmtState) -> None:
        """Change between STOPPED, PRE-OPERATIONAL and OPERATIONAL."""
        old = self._context.state
        if state is old or old is NmtState.INITIALISING:
            return
        self._context.state = state
        self._context.report(EventKind.STATE, state)
        if old is NmtState.OPERATIONAL:
            self.pdos.stop()
        if state is NmtState.STOPPED:
            self.sdo.reset()
        elif old is NmtState.STOPPED:
            self.sync.restart_counter()
            self.emergency.tick()
        if state is NmtState.OPERATIONAL:
            self.pdos.start()
            self.pdos.tick()

    def _reset(self, *, application: bool) -> None:
        kind = EventKind.RESET_NODE if application else EventKind.RESET_COMMUNICATION
        self._context.report(kind)
        if application and self._on_reset is not None:
            self._default_node_id = self._on_reset() or self._default_node_id
        self._initialise(application=application)

    def _initialise(self, *, application: bool) -> None:
        """Load the stored parameters, send the boot-up message, enter PRE-OPERATIONAL."""
        context = self._context
        context.state = NmtState.INITIALISING
        if application:
            self.lss.restart(self._default_node_id)
        context.node_id = self.lss.pending_node_id
        self.lss.configuring = False
        self.sdo.reset()
        self.emergency.reset(application=application)
        self.store.load()
        self._configure()
        if context.node_id == UNCONFIGURED_NODE:
            return
        context.send(ERROR_CONTROL + context.node_id, b"\0")
        context.state = NmtState.PRE_OPERATIONAL
        context.report(EventKind.STATE, context.state)

    def _configure(self) -> None:
        """Apply the parameters of the communication profile.

        Replace an invalid stored PDO mapping by the defaults.
        """
        try:
            self.pdos.configure()
        except SdoAbortError as refusal:
            self._context.report(EventKind.STORAGE_ERROR, detail=f"stored PDO mapping: {refusal}")
            self.dictionary.load_defaults(self.node_id)
            self.pdos.configure()
        self.sync.configure()
        self.error_control.configure()
        self._route()
