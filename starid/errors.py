"""The base class of all errors that this package reports to the user, and their wording."""

from __future__ import annotations

from typing import Final


class StaridError(Exception):
    """Invalid input; a one-line message states the fault, its location and the remedy."""


def plain(message: str) -> str:
    """Rephrase the message of a validator in the style of the project: `must be …`, without a capital."""
    text = message.partition(", unable to parse")[0].partition(" or instance of ")[0]
    for original, replacement in _REPLACEMENTS:
        text = text.replace(original, replacement)
    return f"{text[:1].lower()}{text[1:]}"


_REPLACEMENTS: Final = (
    ("Value error, ", ""),
    ("Input should be", "must be"),
    ("valid dictionary", "table"),
    ("greater than or equal to", "at least"),
    ("less than or equal to", "at most"),
)
