"""The error that every user-visible failure of this package derives from, and the words of what the system refuses."""

from __future__ import annotations

import os


class ProtocolError(Exception):
    """Bytes, frames, values or definitions that the protocol refuses; one line says what and where."""


def reason(error: Exception) -> str:
    """Why something was refused, in the system's words where it has some for the error.

    Event loops put addresses into theirs; a name that is no host's has a number of its own, or is a ValueError.
    """
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number > 0:
        return os.strerror(number)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
