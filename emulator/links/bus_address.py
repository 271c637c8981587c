"""The address of a node on a bus: two nodes of one address answer at once, and neither is understood."""

from __future__ import annotations

import logging
import socket
from typing import Final

from starhil.emulator.symlink_lock import NameTakenError, claim_name

log = logging.getLogger("starhil.link")

OWN_PROCESS: Final = "virtual:"
"""Beginning of the buses that no other process can join."""


HIGHEST: Final = 126
"""Highest number that is suggested: a node of either protocol may have it or the next."""


class BusAddress:
    """Reports when an address is in use on the bus already, by another emulator of this machine or by any node.

    Parameters
    ----------
    what
        What the address is called: `address`, `node`.
    setting
        Key of the profile that sets it.
    """

    def __init__(self, what: str, setting: str) -> None:
        self._what = what
        self._setting = setting
        self._claim: socket.socket | None = None
        self._bus = ""
        self.number = 0
        self.seen_elsewhere = False
        """Whether a frame of another node with this address was reported."""

    def take(self, bus: str, number: int) -> None:
        """Use an address of a bus, instead of the one before; warn if another emulator has it."""
        self.release()
        self._bus, self.number, self.seen_elsewhere = bus, number, False
        if not number or bus.startswith(OWN_PROCESS):
            return
        try:
            self._claim = claim_name(self._what, f"{bus} {number}".encode())
        except NameTakenError as error:
            self._warn(f"is in use by another emulator, process {error.owner}")

    def report_elsewhere(self) -> None:
        """Warn, once an address, that a frame came from another node that has it."""
        if not self.seen_elsewhere:
            self.seen_elsewhere = True
            self._warn("is also that of another node, whose frames arrive here")

    def release(self) -> None:
        """Leave the address to others."""
        if self._claim is not None:
            self._claim.close()
            self._claim = None

    def _warn(self, why: str) -> None:
        other = self.number % HIGHEST + 1
        log.warning(
            "CAN %s: %s %d %s; give one of them another: --set %s=%d",
            *(self._bus, self._what, self.number, why, self._setting, other),
        )
