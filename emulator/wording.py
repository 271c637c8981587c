"""What a validator refuses, in one line: where, what, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any, Final

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
    unknown = first["type"] == "extra_forbidden"  # its last part is what a user wrote, whatever it is called
    path = [str(part) for part in (loc[:-1] if unknown else loc) if part not in _TAGS]
    path += [str(loc[-1])] if unknown else []
    where = ".".join(path) or "as a whole"
    if unknown:
        known = sorted([*_keys_at(model, loc[:-1]), *(also if len(loc) == 1 else ())])
        near = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=NEAR)
        remedy = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return f"{where}: unknown key; {remedy}"
    context = first.get("ctx", {})
    if first["type"] == "missing":
        return f"{where}: missing; give it"
    if first["type"] in {"union_tag_invalid", "union_tag_not_found"}:
        key = str(context["discriminator"]).strip("'")
        given = f" (given: {context['tag']!r})" if "tag" in context else ""
        expected = context.get("expected_tags") or ", ".join(
            repr(tag) for tag in sorted(_tags_at(model, loc))
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

_TAGS: Final = frozenset({"fixed", "rate", "slew", "file", "live", "hold"})
"""Names of the alternatives that pydantic puts between the keys of a place; no key has such a name."""


def _keys_at(model: type[BaseModel], place: Sequence[Any]) -> list[str]:
    """Return the keys that may stand at a place, which may hold the names of alternatives."""
    models: list[type[BaseModel]] = [model]
    for part in place:
        if isinstance(part, int):
            continue
        if part in _TAGS:
            models = [each for each in models if part in _tags_of(each)]
        else:
            models = [
                below
                for each in models
                if part in each.model_fields
                for below in _models_in(each.model_fields[part].annotation)
            ]
    return sorted({key for each in models for key in each.model_fields})


def _tags_at(model: type[BaseModel], place: Sequence[Any]) -> set[str]:
    """Return the values that the key that tells alternatives apart may have at a place."""
    below = [
        each
        for part in place
        if part in model.model_fields
        for each in _models_in(model.model_fields[part].annotation)
    ]
    return {str(tag) for each in below for tag in _tags_of(each)}


def _tags_of(model: type[BaseModel]) -> tuple[object, ...]:
    """Return the values by which a model is told from its alternatives."""
    return tuple(
        value
        for name in ("kind", "do")
        if name in model.model_fields
        for value in getattr(model.model_fields[name].annotation, "__args__", ())
    )


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation names, however deep."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]
