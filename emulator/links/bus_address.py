"""The address of a node on a CAN bus, and a warning if another node uses it too."""

from __future__ import annotations

import logging
import socket
from typing import Final

from starhil.emulator.symlink_lock import LockError, lock_name

log = logging.getLogger("starhil.link")

PRIVATE_BUS: Final = "virtual:"
"""Prefix of buses that no other process can join."""

HIGHEST: Final = 126
"""Highest address that a warning suggests; valid for both CAN protocols."""


class BusAddress:
    """Warns when another emulator on this machine, or any node on the bus, uses the same address.

    `what` is its name in warnings, `address` or `node`; `setting` is the key of the profile that sets it.
    """

    def __init__(self, what: str, setting: str) -> None:
        self._what = what
        self._setting = setting
        self._lock: socket.socket | None = None
        self._bus = ""
        self.number = 0
        self.duplicate_reported = False
        """Whether a CAN frame from another node with this address has been reported."""

    def acquire(self, bus: str, number: int) -> None:
        """Use a new address on a bus; warn if another emulator uses it."""
        self.release()
        self._bus, self.number, self.duplicate_reported = bus, number, False
        if not number or bus.startswith(PRIVATE_BUS):
            return
        try:
            self._lock = lock_name(self._what, f"{bus} {number}".encode())
        except LockError as error:
            self._warn(str(error))

    def report_duplicate(self) -> None:
        """Warn, once per address, of a CAN frame from another node with this address."""
        if not self.duplicate_reported:
            self.duplicate_reported = True
            self._warn("also used by another node, whose frames arrive here")

    def release(self) -> None:
        """Release the address."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _warn(self, why: str) -> None:
        other = self.number % HIGHEST + 1
        log.warning(
            "CAN %s: %s %d: %s; change one of them: --set %s=%d",
            *(self._bus, self._what, self.number, why, self._setting, other),
        )
