"""LSS slave: sets node ID and bit rate, answers inquiries and identity scans (CiA 305)."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from starhil.protocol.canopen.cob import LSS_SLAVE
from starhil.protocol.canopen.context import UNCONFIGURED_NODE, Context, EventKind
from starhil.protocol.canopen.storage import StorageError
from starhil.protocol.canopen.store_restore import StoreRestore

LENGTH: Final = 8
IDENTITY: Final = 0x1018
BIT_RATES: Final = {
    0: 1_000_000,
    1: 800_000,
    2: 500_000,
    3: 250_000,
    4: 125_000,
    6: 50_000,
    7: 20_000,
    8: 10_000,
}
"""Standard bit timing table: index → bit/s."""
DEFAULT_BIT_RATE: Final = 1_000_000
"""Bit rate, bit/s, if LSS has stored none."""

OK: Final = 0
OUT_OF_RANGE: Final = 1
STORAGE_FAILED: Final = 2


SWITCH_SELECTIVE: Final = range(0x40, 0x44)
IDENTIFY: Final = range(0x46, 0x4C)
INQUIRE_IDENTITY: Final = range(0x5A, 0x5E)
"""Command specifiers of frames in order, each with a number of the identity: vendor-ID, product code, revision, serial
number; revision and serial number as lower and upper limit to identify."""


class Command(IntEnum):
    """The other LSS command specifiers."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SWITCHED = 0x44
    IDENTIFY_NON_CONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    NON_CONFIGURED = 0x50
    FASTSCAN = 0x51
    INQUIRE_NODE_ID = 0x5E


class LssSlave:
    """Answers the LSS master, which may set the allowed bit rates, bit/s.

    Node ID and bit rate are pending until the next reset of communication or the command to activate the bit rate; until
    they are stored, a reset of the node discards them.

    `on_node_id` is called with the ID of a node that had none.
    """

    def __init__(
        self,
        context: Context,
        store: StoreRestore,
        on_node_id: Callable[[int], None],
        allowed_bit_rates: frozenset[int],
    ) -> None:
        self._context = context
        self._store = store
        self._on_node_id = on_node_id
        self._allowed = allowed_bit_rates
        self._silence: tuple[float, float] | None = None
        """When the bit rate is switched, and when the node may send again."""
        self.configuring = False
        self._matched = dict.fromkeys((SWITCH_SELECTIVE, IDENTIFY), 0)
        """Number of frames in order that matched."""
        self._scan_position = 0
        self.restart(context.node_id)

    def restart(self, node_id: int) -> None:
        """Start with what is stored, or with this node ID and the default bit rate; discard what is only configured."""
        self.pending_node_id, self.bit_rate = self._store.load_lss() or (node_id, DEFAULT_BIT_RATE)
        self.pending_bit_rate = self.bit_rate

    def receive(self, data: bytes) -> None:
        """Process a frame of the LSS master; ignore any length other than 8."""
        if len(data) != LENGTH:
            return
        command = data[0]
        number = int.from_bytes(data[1:5], "little")
        if command == Command.SWITCH_GLOBAL:
            self._switch_global(data[1])
        elif command in SWITCH_SELECTIVE:
            step = command - SWITCH_SELECTIVE.start
            if self._all_match(SWITCH_SELECTIVE, step, matches=number == self._identity(step)):
                self.configuring = True
                self._send(Command.SWITCHED)
        elif command in IDENTIFY:
            step = command - IDENTIFY.start
            own = self._identity((0, 1, 2, 2, 3, 3)[step])
            matches = number == own if step < 2 else number <= own if step % 2 == 0 else number >= own
            if self._all_match(IDENTIFY, step, matches=matches):
                self._send(Command.IDENTIFIED)
        elif command == Command.IDENTIFY_NON_CONFIGURED:
            if self._unconfigured:
                self._send(Command.NON_CONFIGURED)
        elif command == Command.FASTSCAN:
            self._fastscan(number, data[5], data[6], data[7])
        elif self.configuring:
            self._configuration(command, data)

    @property
    def silent(self) -> bool:
        """Whether the bit rate is being switched."""
        return self._silence is not None

    @property
    def next_deadline(self) -> float | None:
        """When the bit rate is switched or the silence ends; None unless the node is silent."""
        if self._silence is None:
            return None
        switch, end = self._silence
        return switch if self._context.now < switch else end

    def tick(self) -> None:
        """Switch the bit rate, and end the silence."""
        if self._silence is None:
            return
        switch, end = self._silence
        if self._context.now >= switch and self.bit_rate != self.pending_bit_rate:
            self.bit_rate = self.pending_bit_rate
            self._context.report(EventKind.BIT_RATE, self.bit_rate)
        if self._context.now >= end:
            self._silence = None

    @property
    def _unconfigured(self) -> bool:
        return self._context.node_id == UNCONFIGURED_NODE and self.pending_node_id == UNCONFIGURED_NODE

    def _identity(self, number: int) -> int:
        """Return the vendor-ID, product code, revision number or serial number for 0 to 3."""
        return self._context.dictionary.find(IDENTITY, number + 1).number()

    def _send(self, command: int, payload: bytes = b"") -> None:
        self._context.send(LSS_SLAVE, bytes([command]) + payload.ljust(LENGTH - 1, b"\0"))

    def _switch_global(self, mode: int) -> None:
        if mode in (0, 1):
            self.configuring = mode == 1
        if (
            mode == 0
            and self._context.node_id == UNCONFIGURED_NODE
            and self.pending_node_id != UNCONFIGURED_NODE
        ):
            self._on_node_id(self.pending_node_id)

    def _all_match(self, frames: range, step: int, *, matches: bool) -> bool:
        """Return whether this frame is the last of those in order, and all match."""
        in_order = step in (0, self._matched[frames])
        self._matched[frames] = step + 1 if matches and in_order else 0
        return self._matched[frames] == len(frames)

    def _fastscan(self, number: int, bit: int, part: int, following: int) -> None:
        """Compare the upper bits of one number of the identity.

        A complete match leads to the next number.
        """
        if not self._unconfigured or self.configuring:
            return
        if bit == 0x80:
            self._scan_position = 0
            self._send(Command.IDENTIFIED)
            return
        if bit > 31 or part > 3 or following > 3 or part != self._scan_position:
            return
        if number >> bit != self._identity(part) >> bit:
            return
        self._send(Command.IDENTIFIED)
        if bit == 0:
            self._scan_position = following
            self.configuring = following < part

    def _configuration(self, command: int, data: bytes) -> None:
        """Execute a command that requires the configuration state."""
        if command in INQUIRE_IDENTITY:
            self._send(command, self._identity(command - INQUIRE_IDENTITY.start).to_bytes(4, "little"))
        elif command == Command.INQUIRE_NODE_ID:
            self._send(command, bytes([self._context.node_id]))
        elif command == Command.CONFIGURE_NODE_ID:
            valid = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED_NODE
            if valid:
                self.pending_node_id = data[1]
                self._context.report(
                    EventKind.NODE_ID, data[1], "takes effect at the next reset of communication"
                )
            self._send(command, bytes([OK if valid else OUT_OF_RANGE]))
        elif command == Command.CONFIGURE_BIT_TIMING:
            bit_rate = BIT_RATES.get(data[2], 0)
            valid = data[1] == 0 and bit_rate in self._allowed
            if valid:
                self.pending_bit_rate = bit_rate
            self._send(command, bytes([OK if valid else OUT_OF_RANGE]))
        elif command == Command.ACTIVATE_BIT_TIMING:
            delay_s = int.from_bytes(data[1:3], "little") * 1e-3
            self._silence = (self._context.now + delay_s, self._context.now + 2 * delay_s)
        elif command == Command.STORE:
            self._store.save_lss(self.pending_node_id, self.pending_bit_rate, self._stored)

    def _stored(self, error: StorageError | None) -> None:
        """Answer the command to store, unless the node has left the configuration state meanwhile."""
        if self.configuring:
            self._send(Command.STORE, bytes([OK if error is None else STORAGE_FAILED]))
