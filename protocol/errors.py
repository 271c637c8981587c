"""Base class of the errors of this package, and the reason of a failed system call as text."""

from __future__ import annotations

import os


class ProtocolError(Exception):
    """Invalid bytes, frames, values or definitions.

    The text is one line that names what and where.
    """


def reason(error: Exception) -> str:
    """Return the reason of a failure: the system's message for the error number, or else the error's text.

    Messages of the event loop would repeat the address. An invalid host name has a negative error number or
    raises ValueError.
    """
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number > 0:
        return os.strerror(number)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
