"""Base class of the emulator's configuration models, models of plain records, and key types that several share."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping
from functools import cache
from pathlib import Path
from types import GenericAlias, MappingProxyType, UnionType
from typing import Annotated, Any, TypeAlias, Union, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    create_model,
    model_validator,
)

from starhil.protocol.errors import OneLineError
from starid.catalog.earth import LATEST_UNIX_S, unix_time
from starid.errors import StaridError

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


def model_of(
    kind: type,
    base: type[BaseModel] = Strict,
    *,
    optional: Container[str] = (),
    without: Container[str] = (),
    replaced: Mapping[str, Any] = MappingProxyType({}),
) -> type[BaseModel]:
    """Return the model of a table whose keys are the fields of a dataclass, with their types, limits and defaults.

    Such records are used where pydantic is not imported: in the worker, and in `starid`. What they check when they are
    made is checked of a table too.

    Parameters
    ----------
    base:
        Base of the model, with further keys and validators.
    optional:
        Fields that the table may lack although the record needs them.
    without:
        Fields that the table does not have.
    replaced:
        Types of fields that differ from those of the record; None is their default.
    """
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if field.name in without:
            continue
        hint = _key_type(hints[field.name], field.metadata)
        default = ... if field.default is dataclasses.MISSING else field.default
        if field.name in optional:
            hint, default = Union[hint, None], None  # noqa: UP007 (of types that are computed)
        keys[field.name] = (replaced.get(field.name, hint), default)

    def make(table: BaseModel) -> BaseModel:
        try:
            kind(**{name: getattr(table, name) for name in keys})
        except (OneLineError, StaridError) as error:
            raise ValueError(str(error)) from None
        return table

    checks: dict[str, Any] = {"make": model_validator(mode="after")(make)}
    return create_model(kind.__name__, __base__=base, __validators__=checks, **keys)


@cache
def plain_model(kind: type, without: frozenset[str] = frozenset()) -> type[BaseModel]:
    """Return the model of a table whose keys are the fields of a dataclass, or all of them but some, which have defaults."""
    return model_of(kind, without=without)


def _key_type(hint: Any, metadata: Mapping[str, Any]) -> Any:
    """Return the type of a key for that of a field: tables for records, lists for tuples, numbers within their limits."""
    if dataclasses.is_dataclass(hint):
        return plain_model(hint)  # type: ignore[arg-type]
    inner = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(_key_type(each, metadata) for each in inner)]  # noqa: UP007
    if get_origin(hint) is tuple:
        item: Any = GenericAlias(list, (_key_type(inner[0], metadata),))
        if inner[-1] is Ellipsis:
            return Annotated[item, Field(max_length=metadata.get("most"))]
        return Annotated[item, Field(min_length=len(inner), max_length=len(inner))]
    if hint in (int, float) and "limits" in metadata:
        low, high, _ = metadata["limits"]
        return Annotated[hint, Field(ge=low, le=high)]
    return hint
