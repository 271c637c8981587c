"""Validation errors in one line: key, problem and remedy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError

from starhil.protocol.names import did_you_mean
from starid.errors import plain


def explain(error: ValidationError, model: type[BaseModel], *, also: tuple[str, ...] = ()) -> str:
    """Describe the first validation error of a model in one line: key, problem and remedy.

    `also` are further keys allowed at the top level.
    """
    first = _most_helpful_error(error)
    loc = first["loc"]
    path, models = _along(model, loc)
    if first["type"] == "extra_forbidden":
        path, above = _along(model, loc[:-1])
        unknown = str(loc[-1])  # _along would drop it if it is also the tag of an alternative
        known = sorted(
            {*(key for each in above for key in each.model_fields), *(also if len(loc) == 1 else ())}
        )
        remedy = did_you_mean(unknown, known) or f"; known: {', '.join(known)}"
        return f"{'.'.join([*path, unknown])}: unknown key{remedy}"
    where = ".".join(path) or "as a whole"
    context = first.get("ctx", {})
    if first["type"] == "missing":
        return f"{where}: missing"
    if first["type"] in {"union_tag_invalid", "union_tag_not_found"}:
        key = str(context["discriminator"]).strip("'")
        given = f" (given: {context['tag']!r})" if "tag" in context else ""
        expected = context.get("expected_tags") or ", ".join(
            sorted(repr(tag) for each in models for tag in _tags_of(each))
        )
        return f"{'.'.join([*path, key])}: must be one of {expected}{given}"
    whole = isinstance(first["input"], (dict, list)) or first["type"] == "json_invalid"
    shown = "" if whole else f" (given: {first['input']!r})"
    return f"{where}: {plain(first['msg'])}{shown}"


def _most_helpful_error(error: ValidationError) -> Any:
    """Return the first error, but prefer an unknown key, maybe a typo, to a missing one in the same table."""
    errors = error.errors(include_url=False)
    first = errors[0]
    if first["type"] == "missing":
        for other in errors:
            if other["type"] == "extra_forbidden" and other["loc"][:-1] == first["loc"][:-1]:
                return other
    return first


def _along(model: type[BaseModel], loc: Sequence[int | str]) -> tuple[list[str], list[type[BaseModel]]]:
    """Follow a pydantic location; return the keys without tags of unions, and the models at the end."""
    models: list[type[BaseModel]] = [model]
    keys: list[str] = []
    for step in loc:
        tagged = [each for each in models if step in _tags_of(each)] if len(models) > 1 else []
        if tagged:
            models = tagged
            continue
        keys.append(str(step))
        if isinstance(step, str):
            fields = [each.model_fields[step] for each in models if step in each.model_fields]
            models = [below for field in fields for below in _models_in(field.annotation)]
    return keys, models


def _tags_of(model: type[BaseModel]) -> tuple[object, ...]:
    """Return the discriminator values of a model: the values of fields that allow only one."""
    literals = (
        get_args(field.annotation)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
    )
    return tuple(values[0] for values in literals if len(values) == 1)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return all models in an annotation, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]
