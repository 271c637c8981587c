"""Options that commands of `starid` and `starhil` share."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import typer

from starid.errors import StaridError

AsJson: TypeAlias = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def one_of(option: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return the value of an option.

    Raises
    ------
    StaridError
        The value is not allowed; the message lists the allowed ones.
    """
    if value not in allowed:
        *others, last = allowed
        raise StaridError(f"{option} {value}: must be {', '.join(others)} or {last}")
    return value
