"""Validation errors of pydantic models, each in one line: key, problem and remedy."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from starhil.protocol.names import did_you_mean, remedy

_NEEDED: Final = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
"""Type of an error → what is needed."""

_LIMITS: Final = {
    "greater_than_equal": ("at least", "ge"),
    "greater_than": ("more than", "gt"),
    "less_than_equal": ("at most", "le"),
    "less_than": ("less than", "lt"),
}
"""Type of an error → words of a limit, and its key in the error's context."""

_UNIONS: Final = ("union_tag_invalid", "union_tag_not_found")
"""Types of errors in the key that selects the model of a table."""

_ABSENT: Final = {"missing", *_UNIONS}
"""Types of errors in a key that the document may lack."""


class Problem(NamedTuple):
    """One error in a document; as text, `key: problem and remedy`."""

    location: tuple[int | str, ...]
    """Keys and indices that lead to it in the document."""
    key: str
    """Dotted, with the names of tables in a list instead of their indices; empty: the document as a whole."""
    text: str
    unknown: bool = False
    """Whether it is a key that the model does not have."""

    def __str__(self) -> str:
        return f"{self.key or 'as a whole'}: {self.text}"


def problems(
    error: ValidationError,
    model: type[BaseModel],
    document: object = None,
    *,
    hints: Mapping[str, str] | None = None,
    also: Sequence[str] = (),
) -> Iterator[Problem]:
    """Yield all errors of a document that is not valid for a model.

    Parameters
    ----------
    document:
        What was validated, for the names of tables in lists.
    hints:
        Remedies for unknown keys, instead of the known keys.
    also:
        Further keys allowed at the top level.
    """
    found: dict[tuple[int | str, ...], tuple[str, list[Problem]]] = {}
    for item in error.errors(include_url=False):
        location, models = _along(model, item["loc"])
        unknown = item["type"] == "extra_forbidden"
        if unknown:
            location, models = _along(model, item["loc"][:-1])
            key = str(item["loc"][-1])  # _along would drop it if it is also the tag of an alternative
            known = sorted({*(key for each in models for key in _keys_of(each)), *(() if location else also)})
            hint = (hints or {}).get(key) or remedy(key, known)
            location, texts = (*location, key), [f"unknown key{hint}"]
        elif item["type"] in _UNIONS:
            location = (*location, str(item["ctx"]["discriminator"]).strip("'"))
            texts = [_choice(item, models)]
        else:
            texts = _texts(item)
        if document is not None:
            location = _in(document, location, absent=item["type"] in _ABSENT)
        if location not in found:  # an alternative of a union that has been reported
            key = _dotted(document, location)
            found[location] = item["type"], [Problem(location, key, text, unknown) for text in texts]
    for location, (kind, said) in found.items():
        below = any(other != location and other[: len(location)] == location for other in found)
        if not (kind in _NEEDED and below):  # another alternative has the right type, and errors in it
            yield from said


def _texts(item: ErrorDetails) -> list[str]:
    """Return what an error says: one text, or those of a validator that has found several problems."""
    raised = item.get("ctx", {}).get("error")
    if isinstance(raised, ValueError) and len(raised.args) > 1:
        return [str(text) for text in raised.args]
    return [wording(item)]


def wording(item: ErrorDetails) -> str:
    """Return the problem and what is needed instead, such as `must be at least 1 (given: 0)`."""
    kind, context, given = item["type"], item.get("ctx", {}), item["input"]
    if kind == "missing":
        return "missing"
    if kind in _LIMITS:
        words, key = _LIMITS[kind]
        text = f"must be {words} {context[key]:g}"
    elif kind == "literal_error":
        allowed = context["expected"].replace(" or ", ", ")
        near = did_you_mean(given, re.findall("'([^']*)'", allowed)) if isinstance(given, str) else ""
        return f"must be one of {allowed} (given: {given!r}){near}"
    elif kind in ("too_short", "too_long"):
        words, limit = ("at least", "min_length") if kind == "too_short" else ("at most", "max_length")
        return f"must have {words} {context[limit]} items, not {context['actual_length']}"
    elif kind in _NEEDED:
        text = f"must be {_NEEDED[kind]}"
    else:
        message = item["msg"].removeprefix("Value error, ")
        text = f"{message[:1].lower()}{message[1:]}"
    quoted = isinstance(given, str) and repr(given) in text
    return (
        text
        if quoted or isinstance(given, (dict, list)) or kind == "json_invalid"
        else f"{text} (given: {given!r})"
    )


def _choice(item: ErrorDetails, models: Sequence[type[BaseModel]]) -> str:
    """Return the text of an error in the key that selects one of several models."""
    context = item["ctx"]
    given = f" (given: {context['tag']!r})" if "tag" in context else ""
    expected = context.get("expected_tags") or ", ".join(
        sorted(repr(tag) for each in models for tag in _tags_of(each))
    )
    near = did_you_mean(str(context.get("tag", "")), re.findall("'([^']*)'", expected))
    return f"must be one of {expected}{given}{near}"


def _along(
    model: type[BaseModel], loc: Sequence[int | str]
) -> tuple[tuple[int | str, ...], list[type[BaseModel]]]:
    """Follow a pydantic location; return the keys without tags of unions, and the models at the end."""
    models: list[type[BaseModel]] = [model]
    keys: list[int | str] = []
    within_mapping = False
    for step in loc:
        if within_mapping:  # the step is a key that the document chooses
            keys.append(step)
            within_mapping = False
            continue
        tagged = [each for each in models if step in _tags_of(each) or step == each.__name__]
        if tagged and len(models) > 1:
            models = tagged
            continue
        keys.append(step)
        if isinstance(step, str):
            fields = [_keys_of(each)[step] for each in models if step in _keys_of(each)]
            within_mapping = any(get_origin(annotation) is dict for annotation in fields)
            models = [below for annotation in fields for below in _models_in(annotation)]
    return tuple(keys), models


def _in(document: Any, location: Sequence[int | str], *, absent: bool) -> tuple[int | str, ...]:
    """Return the keys of a location that the document has, without the names of types in a union; `absent`: and the last."""
    keys: list[int | str] = []
    for number, step in enumerate(location, 1):
        try:
            document = document[step]
        except (KeyError, IndexError, TypeError):
            if not (absent and number == len(location)):
                continue
        keys.append(step)
    return tuple(keys)


def _dotted(document: Any, location: Sequence[int | str]) -> str:
    """Return the dotted path of a key, with names of tables instead of indices."""
    steps: list[str] = []
    here = document
    for step in location:
        try:
            here = here[step]
        except (KeyError, IndexError, TypeError):
            here = None
        named = here.get("name", here.get("heading", here.get("id"))) if isinstance(here, dict) else None
        steps.append(named if isinstance(named, str) and isinstance(step, int) else str(step))
    return ".".join(steps)


def _keys_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the keys of a table, each with the annotation of its value."""
    return {field.alias or name: field.annotation for name, field in model.model_fields.items()}


def _tags_of(model: type[BaseModel]) -> tuple[object, ...]:
    """Return the discriminator values of a model: the values of fields that allow only one."""
    literals = (
        get_args(annotation) for annotation in _keys_of(model).values() if get_origin(annotation) is Literal
    )
    return tuple(values[0] for values in literals if len(values) == 1)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return all models in an annotation, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]
