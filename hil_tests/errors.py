"""Errors of the bench: one line each, with what, where and remedy."""

from __future__ import annotations

import operator
from typing import Final

from starhil.protocol.errors import OneLineError

HIDDEN_BEHIND_ONE_LINE: Final = operator.methodcaller("errisinstance", OneLineError)
"""Value of `__tracebackhide__` in a module whose frames pytest leaves out of the traceback of such an error, so that it ends
at the line of the test."""


class BenchError(OneLineError):
    """A script, port or device cannot be used; the text is one line with what, where and remedy."""


class ScriptError(BenchError):
    """An invalid session script; each problem names file, step and key."""


class DeviceError(BenchError):
    """A failed transaction between OBC and device."""


class NackError(DeviceError):
    """The device refused a request, a telecommand or telemetry row given by name, with a published error code.

    `code` is the number on the wire, `code_name` its name in the interface definition.
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
    """A reply that does not match the request: wrong length, wrong ID or unknown value."""


class LinkLostError(DeviceError):
    """The port or bus of the client was lost."""


class EmulatorProcessError(BenchError):
    """The emulator process did not start, or did not end cleanly."""
