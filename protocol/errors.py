"""Base classes of errors, the reason of a failed system call as text, and text for a terminal."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Final

MAX_PROBLEMS: Final = 20
"""Number of problems that an error shows; of further ones it gives the number."""

LONGEST_PROBLEM: Final = 2000
"""Length of the text of a problem, which may quote what a peer has sent; longer text loses its middle."""


class OneLineError(Exception):
    """An error whose arguments are its problems; the text is one line with all of them."""

    @property
    def problems(self) -> tuple[str, ...]:
        """The problems, each one line that names what and where; controls in what they quote are escaped.

        At most `MAX_PROBLEMS`, and then the number of further ones.
        """
        shown = tuple(escape_controls(shortened(str(problem))) for problem in self.args[:MAX_PROBLEMS])
        more = len(self.args) - len(shown)
        return (*shown, f"and {more} more") if more else shown

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


def shortened(text: str) -> str:
    """Return text without its middle if it is longer than `LONGEST_PROBLEM`; a problem ends with its remedy."""
    half = LONGEST_PROBLEM // 2
    return text if len(text) <= LONGEST_PROBLEM else f"{text[:half]} … {text[-half:]}"


def escape_controls(text: str) -> str:
    """Return text with each character escaped that could control a terminal, end the line or reorder the text."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


_MIN_SIMILARITY: Final = 0.55
"""Similarity above which a known name is suggested for an unknown one (`difflib`)."""


LONGEST_NAME: Final = 64
"""Length above which nothing is suggested for an unknown name."""


MAX_LISTED: Final = 200
"""Number of known names that an error lists."""


MAX_NAMES: Final = 1000
"""Number of known names of which similar ones are suggested."""


def remedy(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean …?` for an unknown name, or `; known: …` with all names if none is similar."""
    names = sorted(known)
    return did_you_mean(name, names) or f"; known: {listed(names)}"


def listed(names: Sequence[str]) -> str:
    """Return names separated by commas; of very many, the first."""
    more = [f"and {len(names) - MAX_LISTED} more"] if len(names) > MAX_LISTED else []
    return ", ".join([*names[:MAX_LISTED], *more]) or "none"


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return `; did you mean …?` with the known names most similar to an unknown one, or an empty text."""
    if len(name) > LONGEST_NAME:
        return ""
    near = difflib.get_close_matches(name, list(islice(names, MAX_NAMES)), n=3, cutoff=_MIN_SIMILARITY)
    return f"; did you mean {', '.join(near)}?" if near else ""
