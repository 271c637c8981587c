"""The address of a node on a CAN bus. It must be unique: two nodes with the same address would both answer each request."""

from __future__ import annotations

import logging
import socket
from typing import Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.name_lock import InUseError, LockError, lock_name

log = logging.getLogger("starhil.link")

PRIVATE_BUS: Final = "virtual:"
"""Prefix of buses that no other process can join."""

HIGHEST: Final = 126
"""Highest address that a message suggests; valid for both CAN protocols."""


def in_use(what: str, bus: str, number: int) -> str:
    """Return who uses an address of a bus, `address` or `node`; empty if no other emulator on this machine does."""
    try:
        _lock(what, bus, number).close()
    except InUseError as error:
        return f"CAN {bus}: {what} {number}: {error}"
    except LockError:
        pass  # logged by `acquire`
    return ""


def _lock(what: str, bus: str, number: int) -> socket.socket:
    return lock_name(what, f"{bus} {number}".encode())


class BusAddress:
    """Reserves an address of a bus among the emulators on this machine, and warns of other nodes with it.

    `what` is its name in messages, `address` or `node`; `setting` is the key of the profile that sets it.
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
        """Use a new address on a bus. EmulatorError if another emulator uses it; warn if it cannot be reserved."""
        self.release()
        self._bus, self.number, self.duplicate_reported = bus, number, False
        if not number or bus.startswith(PRIVATE_BUS):
            return
        try:
            self._lock = _lock(self._what, bus, number)
        except InUseError as error:
            raise EmulatorError(
                f"{self._problem(str(error))}; choose another, {self._remedy}, or another bus, "
                "e.g. that of `starhil hub --port 0`"
            ) from None
        except LockError as error:
            log.warning("%s", self._problem(str(error)))

    def change(self, bus: str, number: int) -> None:
        """Use a new address in operation; warn if another emulator uses it."""
        try:
            self.acquire(bus, number)
        except EmulatorError as error:
            log.warning("%s", error)

    def report_duplicate(self) -> None:
        """Warn, once per address, of a CAN frame from another node with this address."""
        if not self.duplicate_reported:
            self.duplicate_reported = True
            problem = self._problem("also used by another node, whose frames arrive here")
            log.warning("%s; change one of them: %s", problem, self._remedy)

    def release(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _problem(self, why: str) -> str:
        return f"CAN {self._bus}: {self._what} {self.number}: {why}"

    @property
    def _remedy(self) -> str:
        return f"--set {self._setting}={self.number % HIGHEST + 1}"
