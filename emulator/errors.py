"""The error of files, ports and input from outside, and unexpected errors in one line.

A docstring mentions it only where that does not go without saying.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from starhil.protocol.errors import OneLineError, reason


class EmulatorError(OneLineError):
    """Invalid input or an unusable file or port; the message is one line with what, where and the remedy."""


@contextmanager
def explained(
    what: str, remedy: str = "", *, errors: tuple[type[Exception], ...] = (OSError,)
) -> Iterator[None]:
    """Raise an error of the system as one line, `what (reason); remedy`; an invalid host or path is a ValueError."""
    try:
        yield
    except errors as error:
        is_of_file = isinstance(error, OSError) and error.filename is not None
        why = getattr(error, "strerror", None) if is_of_file else reason(error)
        raise EmulatorError(f"{what} ({why})" + (f"; {remedy}" if remedy else "")) from None


def one_line(error: BaseException) -> str:
    """Return type, text and origin of an unexpected error in one line."""
    text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    module = "/".join(frames[-1].filename.split("/")[-2:])
    return f"{text} ({module}:{frames[-1].lineno})"
