"""The base class of this package's errors, and the reason of a failed system call as text."""

from __future__ import annotations

import os


class ProtocolError(Exception):
    """Invalid bytes, frames, values or definitions.

    The text is one line that names what and where.
    """


def reason(error: Exception) -> str:
    """Return the reason of a failure: the system's text for the error number, else the error's own text.

    The texts of an event loop repeat the address. An invalid host name has a negative error number or is a
    ValueError.
    """
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number > 0:
        return os.strerror(number)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
