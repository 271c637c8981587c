"""The errors of the bench: each is one line that says what, where and, if there is one, the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class BenchError(Exception):
    """A script, port or device that the bench refuses; one line says what, where and the remedy."""


class ScriptError(BenchError):
    """A session script that cannot be run as it stands; names file, step and key."""


class DeviceError(BenchError):
    """What went wrong between the OBC and a device that was asked something."""


class NackError(DeviceError):
    """The device refused a request with a published error code.

    Attributes
    ----------
    request : str
        Name of the telecommand or telemetry row that was asked for.
    code : int
        The error code on the wire.
    code_name : str
        Its name in the interface definition.
    """

    def __init__(self, request: str, code: int, code_name: str) -> None:
        super().__init__(f"{request}: refused by the device with error {code} ({code_name})")
        self.request = request
        self.code = code
        self.code_name = code_name


class NoReplyError(DeviceError):
    """No reply came within the time-out."""

    def __init__(self, request: str, timeout_s: float, attempts: int = 1) -> None:
        tries = "" if attempts == 1 else f", {attempts} attempts"
        super().__init__(f"{request}: no reply within {timeout_s:g} s{tries}")
        self.request = request
        self.timeout_s = timeout_s
        self.attempts = attempts


class BadReplyError(DeviceError):
    """A reply came that does not fit the request: wrong length, wrong identifier or no known value."""


class LinkLostError(DeviceError):
    """The port or bus under the client is gone."""


class EmulatorProcessError(BenchError):
    """The emulator could not be started as a process, or did not end as it should."""


def near_matches(name: str, known: Iterable[str]) -> str:
    """Return a clause such as `; did you mean 'quaternion'?`, empty if nothing known is near `name`."""
    near = difflib.get_close_matches(name, list(known), n=3, cutoff=0.55)
    if not near:
        return ""
    return "; did you mean " + " or ".join(f"'{word}'" for word in near) + "?"
