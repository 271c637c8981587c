"""A client of the emulator's control channel, and through it the truth."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import urlsplit

from starhil.hil_tests.attitude import (
    AttitudeDifference,
    Quaternion,
    attitude_error,
    from_reported,
    unit,
)
from starhil.hil_tests.errors import HIDDEN_BEHIND_ONE_LINE, BenchError
from starhil.protocol.errors import reason

if TYPE_CHECKING:
    from starhil.protocol.icd.conventions import Conventions

__tracebackhide__ = HIDDEN_BEHIND_ONE_LINE

ANSWER_WITHIN_S: Final = 60.0
"""A step of the stepped clock takes as long as its frames."""
LONGEST_ANSWER: Final = 1 << 24
"""Longest answer that is read, bytes."""
BOOT_WITHIN_S: Final = 60.0
POLL_S: Final = 0.02
CLOCK_GRAIN_S: Final = 1e-9
LONGEST_WAIT_S: Final = 20.0
"""Longest wait of one request, shorter than an answer may take."""


class _Answer(dict[str, Any]):
    """An answer of a control channel; a key that it lacks is a `BenchError`."""

    def __init__(self, what: str, address: str, content: dict[str, Any]) -> None:
        super().__init__(content)
        self._what = what
        self._address = address

    def __missing__(self, key: str) -> Any:
        raise _other_peer(self._what, self._address)


def _other_peer(what: str, address: str) -> BenchError:
    return BenchError(
        f"{what}: {address} does not answer as an emulator; give the address `control=` of its ready line"
    )


class ControlClient:
    """A client of the control channel; a context manager.

    The address is on the ready line: unix:/PATH or HOST:PORT.
    """

    def __init__(self, address: str) -> None:
        try:
            self._socket = _connected(address)
        except (OSError, ValueError) as error:
            raise BenchError(f"control channel {address}: {reason(error)}") from None
        self._address = address
        self._received = bytearray()

    def do(self, action: str, /, **keys: Any) -> dict[str, Any]:
        """Send a request and return the answer.

        Raises BenchError: the request was rejected, or the channel does not answer.
        """
        return self.exchange(f"control channel: {action}", {"do": action, **keys})

    def exchange(self, what: str, message: dict[str, Any]) -> dict[str, Any]:
        """Send a JSON object and return the answer, without its `ok`; `what` begins the text of errors.

        Raises BenchError: the answer is an error, or there is none.
        """
        try:
            self._socket.settimeout(ANSWER_WITHIN_S)
            self._socket.sendall(json.dumps(message).encode() + b"\n")
            line = self._read_line(time.monotonic() + ANSWER_WITHIN_S)
        except OSError as error:
            raise BenchError(f"{what}: no answer: {reason(error)}") from None
        if line is None:
            raise BenchError(f"{what}: closed by the emulator")
        try:
            answer = _Answer(what, self._address, json.loads(line))
            accepted = answer.pop("ok")
        except (ValueError, TypeError, KeyError, RecursionError):
            raise _other_peer(what, self._address) from None
        if accepted is not True:
            raise BenchError(f"{what}: {answer['error']}")
        return answer

    def _read_line(self, deadline: float) -> bytes | None:
        """Return the next line, or the beginning of what is none of a control channel; None if the peer has closed."""
        received = self._received
        while (end := received.find(b"\n")) < 0:
            if not received.startswith(b"{"[: len(received)]) or len(received) > LONGEST_ANSWER:
                return bytes(received)
            self._socket.settimeout(max(deadline - time.monotonic(), POLL_S))
            chunk = self._socket.recv(1 << 16)
            if not chunk:
                return None
            received += chunk
            if time.monotonic() > deadline:
                raise TimeoutError("timed out")
        line = bytes(received[: end + 1])
        del received[: end + 1]
        return line

    def wait(self, seconds: float = 0.0, *, phase: str | None = None) -> float:
        """Let simulation time pass on any clock; return the simulation time, seconds.

        With `phase`, wait for the next `exposure` to begin, its middle (`mid_frame`) or its end (`readout`).
        """
        if phase is not None:
            return float(self.do("wait", phase=phase)["run_time_s"])
        status = self.do("status")
        now_s = float(status["run_time_s"])
        stepped, end_s = status["clock"] == "stepped", now_s + seconds
        while (left_s := end_s - now_s) >= CLOCK_GRAIN_S:
            answer = self.do("step" if stepped else "wait", seconds=min(left_s, LONGEST_WAIT_S))
            now_s = float(answer["run_time_s"])
        return now_s

    def step_until(
        self,
        holds: Callable[[dict[str, Any]], bool],
        *,
        step_s: float = 0.1,
        within_s: float = 60.0,
    ) -> dict[str, Any]:
        """Let simulation time pass in steps until a condition of the answer to `status` holds; return this answer.

        Raises BenchError: it does not hold within this simulation time.
        """
        status = self.do("status")
        end_s = float(status["run_time_s"]) + within_s
        while not holds(status):
            if float(status["run_time_s"]) >= end_s:
                raise BenchError(
                    f"control channel: the condition does not hold within {within_s:g} s; mode {status['mode']}, "
                    f"{status['frames_valid']} of {status['frames']} frames valid"
                )
            self.wait(step_s)
            status = self.do("status")
        return status

    def reset(self) -> None:
        """Clear faults, restore the truth of the profile, and let the device start and boot as at power-on.

        On the stepped clock, it boots when time is advanced.
        """
        self.do("clear_faults")
        self.do("set_truth")
        self.do("fault", device={"reset": "power_on"})
        deadline = time.monotonic() + BOOT_WITHIN_S
        while (status := self.do("status"))["mode"] == "boot" and status["clock"] != "stepped":
            if time.monotonic() > deadline:
                raise BenchError(f"control channel: the device has not booted within {BOOT_WITHIN_S:g} s")
            time.sleep(POLL_S)

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def _connected(address: str) -> socket.socket:
    path = address.removeprefix("unix:")
    if path == address:
        parts = urlsplit(f"//{address}")
        return socket.create_connection((parts.hostname, parts.port), ANSWER_WITHIN_S)
    with ExitStack() as stack:
        connection = stack.enter_context(socket.socket(socket.AF_UNIX))
        connection.settimeout(ANSWER_WITHIN_S)
        connection.connect(path)
        stack.pop_all()
    return connection


class Truth:
    """The true attitude of the emulated sensor, whose unit has these conventions."""

    def __init__(self, control: ControlClient, conventions: Conventions) -> None:
        self._control = control
        self._conventions = conventions

    def set(self, **truth: Any) -> None:
        """Replace the truth; the keys are those of `[truth]` in a profile, such as `kind`."""
        self._control.do("set_truth", truth=truth)

    def point(self, ra_deg: float, dec_deg: float, roll_deg: float = 0.0) -> None:
        """Hold the sensor at an attitude."""
        self.set(kind="fixed", attitude={"ra_deg": ra_deg, "dec_deg": dec_deg, "roll_deg": roll_deg})

    def attitude(self, unix_s: float | None = None) -> Quaternion:
        """Return the attitude at a time of the device's clock, default: now."""
        keys = {} if unix_s is None else {"unix_s": unix_s}
        return unit(self._control.do("truth", **keys)["quaternion_xyzw"])

    def error(self, quaternion_xyzw: list[float], unix_s: float | None = None) -> AttitudeDifference:
        """Return the error of an attitude as the unit reports it, measured at a time of the device's clock, default: now.

        That clock is not the computer's: until it is set, it starts at `run.start_unix_s`. A truth that moves needs the time
        that the unit reports with the attitude.
        """
        measured = from_reported(unit(quaternion_xyzw), self._conventions)
        return attitude_error(measured, self.attitude(unix_s))
