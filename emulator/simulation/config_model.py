"""Base of every configuration model of the emulator, and the types of keys that several of them have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from starid.catalog.earth import LATEST_UNIX_S, unix_time

Date: TypeAlias = Annotated[float, Field(ge=0.0, le=LATEST_UNIX_S), BeforeValidator(unix_time)]
"""A date in UTC, stored as Unix time."""


def _expanded(path: str) -> str:
    """Return a path with the home folder in place of `~`; ValueError if the user has none."""
    try:
        return str(Path(path).expanduser()) if path.startswith("~") else path
    except RuntimeError:
        raise ValueError(f"{path.partition('/')[0]} has no home folder; give another path") from None


UserPath: TypeAlias = Annotated[str, AfterValidator(_expanded)]
"""A path as a user writes it, which may begin with `~`; expanded when it is read."""


class Strict(BaseModel):
    """Base of configuration models: rejects unknown keys, numbers in quotes and non-finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)
