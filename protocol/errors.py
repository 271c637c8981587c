"""Base classes of errors, the reason of a failed system call as text, and text for a terminal."""

from __future__ import annotations

import os


class OneLineError(Exception):
    """An error whose arguments are its problems; the text is one line with all of them."""

    @property
    def problems(self) -> tuple[str, ...]:
        """The problems, each one line that names what and where; controls in what they quote are escaped."""
        return tuple(escape_controls(str(problem)) for problem in self.args)

    def __str__(self) -> str:
        return "; ".join(self.problems)


class ProtocolError(OneLineError):
    """Invalid bytes, frames, values or definitions."""


class IcdError(ProtocolError):
    """An invalid interface definition; the text names file, row and field."""


def reason(error: Exception) -> str:
    """Return the reason of a failure: the system's message for the error number, or else the error's text.

    Messages of the event loop would repeat the address. An invalid host name has a negative error number or
    raises ValueError.
    """
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number > 0:
        return os.strerror(number)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def escape_controls(text: str) -> str:
    """Return text with each character escaped that could control a terminal, end the line or reorder the text."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
