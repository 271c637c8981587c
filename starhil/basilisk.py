"""A star tracker in a Basilisk simulation: a module that sends the spacecraft's state to the emulator.

Needs Basilisk (`pip install starhil[basilisk]`); the emulator itself does not. The emulator listens with
``[truth] kind = "live"`` and names the address in its ready line (``truth=tcp:127.0.0.1:5500``)::

    from starhil.basilisk import StarTrackerFeed

    feed = StarTrackerFeed("tcp:127.0.0.1:5500", lockstep=True)
    feed.scStateInMsg.subscribeTo(spacecraft.scStateOutMsg)
    simulation.AddModelToTask("dynamics", feed)

In lock-step (``truth.lockstep = true`` and the stepped clock) Basilisk waits until the emulator has reached
the time of each message. Without it, let Basilisk run in real time with its module `simSynch.ClockSynch`.
"""

from __future__ import annotations

import json
import math
import socket
from typing import Any, Final

import numpy as np
from Basilisk.architecture import messaging, sysModel

from starhil.protocol.icd.conventions import NANOSECONDS

ANSWER_WITHIN_S: Final = 300.0
"""Maximum time for an answer in lock-step, seconds; at its first start, the emulator compiles kernels."""

EARTH_RADIUS_M: Final = 6.3e6
"""Positions closer to the origin are not in an Earth orbit and are not sent."""


class StarTrackerFeedError(Exception):
    """The emulator is not available, or has rejected a message; the text gives the reason."""


class StarTrackerFeed(sysModel.SysModel):  # type: ignore[misc]
    """Sends attitude, rate, position and velocity of a spacecraft to the emulator in each step of its task.

    Parameters
    ----------
    address : str
        Address of the emulator: ``udp:HOST:PORT`` or ``tcp:HOST:PORT``.
    lockstep : bool
        Whether to wait for the answer to each message; TCP only.
    epoch_unix_s : float, optional
        Date of simulation time zero, as Unix time; default: the emulator's date.

    Attributes
    ----------
    scStateInMsg : SCStatesMsgReader
        State of the spacecraft, to be connected with `subscribeTo`.
    sent : int
        Number of messages sent.
    fault : str
        Fault reported by the emulator for a rejected message, empty if there is none; in lock-step only.

    Raises
    ------
    StarTrackerFeedError
        The address is invalid, or no emulator listens there.
    """

    def __init__(self, address: str, *, lockstep: bool = False, epoch_unix_s: float | None = None) -> None:
        super().__init__()
        self.ModelTag = "starTrackerFeed"
        self.scStateInMsg: Any = messaging.SCStatesMsgReader()
        self.sent = 0
        self.fault = ""
        self._epoch_unix_s = epoch_unix_s
        self._lockstep = lockstep
        self._address = address
        protocol, _, where = address.partition(":")
        host, _, port = where.rpartition(":")
        if protocol not in ("udp", "tcp") or not host or not port.isdecimal():
            raise StarTrackerFeedError(f"{address}: must be udp:HOST:PORT or tcp:HOST:PORT")
        if lockstep and protocol == "udp":
            raise StarTrackerFeedError(f"{address}: lock-step needs tcp, because each message is answered")
        kind = socket.SOCK_STREAM if protocol == "tcp" else socket.SOCK_DGRAM
        self._socket = socket.socket(socket.AF_INET, kind)
        try:
            self._socket.connect((host, int(port)))
        except OSError as error:
            self._socket.close()
            raise StarTrackerFeedError(
                f"{address}: no emulator ({error.strerror or error}); the address is on its ready line, truth=…"
            ) from None
        self._socket.settimeout(ANSWER_WITHIN_S)
        self._answers = self._socket.makefile("rb")

    def Reset(self, CurrentSimNanos: int) -> None:  # noqa: ARG002 (Basilisk's interface)
        """Check that the module is connected to a spacecraft; called by Basilisk before a run."""
        if not self.scStateInMsg.isLinked():
            raise StarTrackerFeedError(
                "scStateInMsg is not connected; subscribe it to scStateOutMsg of a spacecraft"
            )

    def UpdateState(self, CurrentSimNanos: int) -> None:
        """Send the current state."""
        message = feed_message(self.scStateInMsg(), CurrentSimNanos / NANOSECONDS, self._epoch_unix_s)
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
            self.sent += 1
            if self._lockstep:
                self._read_answer()
        except OSError as error:
            raise StarTrackerFeedError(f"{self._address}: connection lost ({error})") from None

    def _read_answer(self) -> None:
        line = self._answers.readline()
        if not line:
            raise StarTrackerFeedError(f"{self._address}: the emulator has closed the connection")
        answer = json.loads(line)
        if not answer["ok"]:
            self.fault = answer["error"]
            raise StarTrackerFeedError(f"{self._address}: message {self.sent} rejected: {self.fault}")

    def close(self) -> None:
        """Close the connection."""
        self._answers.close()
        self._socket.close()


def feed_message(state: Any, t: float, epoch_unix_s: float | None = None) -> dict[str, Any]:
    """Return the message for the state of a spacecraft.

    Parameters
    ----------
    state : SCStatesMsgPayload
        Attitude as modified Rodrigues parameters N → B, rate in rad/s in B, position and velocity in N.
    t : float
        Simulation time, seconds.
    epoch_unix_s : float, optional
        Date of simulation time zero, as Unix time.
    """
    sigma = np.asarray(state.sigma_BN, dtype=np.float64)
    square = float(sigma @ sigma)
    x, y, z = (-2.0 * sigma / (1.0 + square)).tolist()  # the conjugate: it rotates vectors
    message: dict[str, Any] = {
        "t": t,
        "q": [x, y, z, (1.0 - square) / (1.0 + square)],
        "rate": [math.degrees(rate) for rate in state.omega_BN_B],
    }
    if float(np.linalg.norm(state.r_BN_N)) > EARTH_RADIUS_M:
        message |= {"position_m": list(state.r_BN_N), "velocity_m_s": list(state.v_BN_N)}
    if epoch_unix_s is not None:
        message["unix_s"] = epoch_unix_s + t
    return message
