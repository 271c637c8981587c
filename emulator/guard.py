"""Callbacks that must not end whoever calls them."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable
from typing import Final, ParamSpec

log: Final = logging.getLogger("starhil.internal")

Arguments = ParamSpec("Arguments")


def one_line(error: BaseException) -> str:
    """Describe an unexpected error in one line: its type, its text and where it was raised."""
    text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    module = "/".join(frames[-1].filename.split("/")[-2:])
    return f"{text} ({module}:{frames[-1].lineno})"


def call_guarded(
    what: str, callback: Callable[Arguments, object], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> None:
    """Call back; what that raises is logged as an internal error, and its traceback at level debug."""
    try:
        callback(*args, **kwargs)
    except Exception as error:  # whatever it is, the caller has more to do
        log.error("%s: internal error: %s", what, one_line(error))  # noqa: TRY400 (one line; the traceback below)
        log.debug("%s", what, exc_info=True)
