"""What a validator refuses, in one line: where, what, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any, Final, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError

NEAR: Final = 0.55
"""Likeness from which on a known key is offered in place of an unknown one."""


def explain(
    error: ValidationError, model: type[BaseModel], *, under: tuple[str, ...] = (), also: tuple[str, ...] = ()
) -> str:
    """Say in one line where the first fault of a validation is, what it is and what to do.

    Parameters
    ----------
    error, model
        What was refused, and by which model.
    under
        Keys of the model under which what was refused stands.
    also
        Keys that may stand at the top beside those of the model.
    """
    first = _telling_fault(error)
    loc = (*under, *first["loc"])
    path, models = _along(model, loc)
    if first["type"] == "extra_forbidden":
        path, above = _along(model, loc[:-1])
        unknown = str(loc[-1])  # what a user wrote, even where an alternative is called that
        known = sorted(
            {*(key for each in above for key in each.model_fields), *(also if len(loc) == 1 else ())}
        )
        near = difflib.get_close_matches(unknown, known, n=1, cutoff=NEAR)
        remedy = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return f"{'.'.join([*path, unknown])}: unknown key; {remedy}"
    where = ".".join(path) or "as a whole"
    context = first.get("ctx", {})
    if first["type"] == "missing":
        return f"{where}: missing; give it"
    if first["type"] in {"union_tag_invalid", "union_tag_not_found"}:
        key = str(context["discriminator"]).strip("'")
        given = f" (given: {context['tag']!r})" if "tag" in context else ""
        expected = context.get("expected_tags") or ", ".join(
            sorted(repr(tag) for each in models for tag in _tags_of(each))
        )
        return f"{'.'.join([*path, key])}: must be one of {expected}{given}"
    shown = "" if isinstance(first["input"], (dict, list)) else f" (given: {first['input']!r})"
    return f"{where}: {plain(first['msg'])}{shown}"


def _telling_fault(error: ValidationError) -> Any:
    """Return the first fault; where a key is missing beside an unknown one, the unknown one, which is the likelier slip."""
    faults = error.errors(include_url=False)
    first = faults[0]
    if first["type"] == "missing":
        for fault in faults:
            if fault["type"] == "extra_forbidden" and fault["loc"][:-1] == first["loc"][:-1]:
                return fault
    return first


def plain(message: str) -> str:
    """A validator's message as our own ones read: `must be …`, without a capital."""
    text = message.partition(", unable to parse")[0].partition(" or instance of ")[0]
    for theirs, ours in _WORDS:
        text = text.replace(theirs, ours)
    return f"{text[:1].lower()}{text[1:]}"


_WORDS: Final = (
    ("Value error, ", ""),
    ("Input should be", "must be"),
    ("valid dictionary", "table"),
    ("greater than or equal to", "at least"),
    ("less than or equal to", "at most"),
)


def _along(model: type[BaseModel], loc: Sequence[int | str]) -> tuple[list[str], list[type[BaseModel]]]:
    """Follow a field path of pydantic; return its keys without the tags of alternatives, and the models at its end."""
    models: list[type[BaseModel]] = [model]
    keys: list[str] = []
    for part in loc:
        chosen = [each for each in models if part in _tags_of(each)] if len(models) > 1 else []
        if chosen:
            models = chosen
            continue
        keys.append(str(part))
        if isinstance(part, str):
            fields = [each.model_fields[part] for each in models if part in each.model_fields]
            models = [below for field in fields for below in _models_in(field.annotation)]
    return keys, models


def _tags_of(model: type[BaseModel]) -> tuple[object, ...]:
    """Return the values by which a model is told from its alternatives: those of its fields that can have but one."""
    literals = (
        get_args(field.annotation)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
    )
    return tuple(values[0] for values in literals if len(values) == 1)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation names, however deep."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]
