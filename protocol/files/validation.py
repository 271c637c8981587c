"""Validation errors of pydantic models, each in one line: key, problem and remedy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import repeat
from typing import Any, Final, Literal, NamedTuple, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from starhil.protocol.errors import MAX_PROBLEMS, did_you_mean, remedy

_REQUIREMENTS: Final = {
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

_ERRORS_OF_ABSENT_KEYS: Final = {"missing", *_UNIONS}
"""Types of errors in a key that the document may lack."""


@dataclass(frozen=True)
class TableOf:
    """Annotation of a dictionary: the keys given in a table, which is valid for a model."""

    model: type[BaseModel]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            lambda table: table.model_dump(exclude_unset=True),
            handler.generate_schema(self.model),
            serialization=core_schema.plain_serializer_function_ser_schema(dict),
        )


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
    most: int | None = None,
) -> Iterator[Problem]:
    """Yield all errors of a document that is not valid for a model.

    Only the first `MAX_PROBLEMS` suggest similar names, because an error shows no more of them.

    Parameters
    ----------
    document:
        What was validated, for the names of tables in lists.
    hints:
        Remedies for unknown keys, instead of the known keys.
    also:
        Further keys allowed at the top level.
    most:
        Number of errors that are examined, at least `MAX_PROBLEMS`; for each further one there is an empty problem.
        Default: all.
    """
    reports: dict[tuple[int | str, ...], tuple[ErrorDetails, Callable[[bool], list[str]]]] = {}
    above: set[tuple[int | str, ...]] = set()
    items = error.errors(include_url=False)
    for item in items[:most]:
        unknown = item["type"] == "extra_forbidden"
        # without an unknown key, which _along would drop if it is also the tag of an alternative
        location, models = _along(model, item["loc"][: -1 if unknown else None])
        say: Callable[[bool], list[str]] = partial(_texts, item)
        if unknown:
            key = str(item["loc"][-1])
            say = partial(_unknown_key, key, models, hints or {}, () if location else also)
            location = (*location, key)
        elif item["type"] in _UNIONS:
            location = (*location, str(item["ctx"]["discriminator"]).strip("'"))
            say = partial(_choice, item, models)
        if document is not None:
            location = _in(document, location, absent=item["type"] in _ERRORS_OF_ABSENT_KEYS)
        reports.setdefault(location, (item, say))  # an alternative of a union may have been reported
        above.update(location[:count] for count in range(len(location)))
    written = 0
    for location, (item, say) in reports.items():
        if item["type"] in _REQUIREMENTS and location in above:
            continue  # another alternative has the right type, and errors in it
        key = _dotted(document, location)
        for text in say(written < MAX_PROBLEMS):
            yield Problem(location, key, text, item["type"] == "extra_forbidden")
            written += 1
    yield from repeat(Problem((), "", ""), len(items) - len(items[:most]))


def _unknown_key(
    key: str, models: Sequence[type[BaseModel]], hints: Mapping[str, str], also: Sequence[str], suggest: bool
) -> list[str]:
    """Return the text of a key that none of the models has."""
    if not suggest:
        return ["unknown key"]
    known = {*(key for each in models for key in _keys_of(each)), *also}
    return [f"unknown key{hints.get(key) or remedy(key, known)}"]


def _texts(item: ErrorDetails, suggest: bool) -> list[str]:
    """Return what an error says: one text, or those of a validator that has found several problems."""
    raised = item.get("ctx", {}).get("error")
    if isinstance(raised, ValueError) and len(raised.args) > 1:
        return [str(text) for text in raised.args]
    return [wording(item, suggest=suggest)]


def wording(item: ErrorDetails, *, suggest: bool = True) -> str:
    """Return the problem and what is needed instead, such as `must be at least 1 (given: 0)`."""
    kind, context, value = item["type"], item.get("ctx", {}), item["input"]
    if kind == "missing":
        return "missing"
    if kind in _LIMITS:
        words, key = _LIMITS[kind]
        text = f"must be {words} {context[key]:g}"
    elif kind == "literal_error":
        allowed = context["expected"].replace(" or ", ", ")
        names = re.findall("'([^']*)'", allowed) if suggest and isinstance(value, str) else ()
        return f"must be one of {allowed} (given: {value!r}){did_you_mean(str(value), names)}"
    elif kind in ("too_short", "too_long"):
        words, limit = ("at least", "min_length") if kind == "too_short" else ("at most", "max_length")
        number = context["actual_length"]
        return f"must have {words} {context[limit]} items" + ("" if number is None else f", not {number}")
    elif kind in _REQUIREMENTS:
        text = f"must be {_REQUIREMENTS[kind]}"
    else:
        message = item["msg"].removeprefix("Value error, ")
        text = f"{message[:1].lower()}{message[1:]}"
    quoted = isinstance(value, str) and repr(value) in text
    return (
        text
        if quoted or isinstance(value, (dict, list)) or kind == "json_invalid"
        else f"{text} (given: {value!r})"
    )


def _choice(item: ErrorDetails, models: Sequence[type[BaseModel]], suggest: bool) -> list[str]:
    """Return the text of an error in the key that selects one of several models."""
    context = item["ctx"]
    note = f" (given: {context['tag']!r})" if "tag" in context else ""
    expected = context.get("expected_tags") or ", ".join(
        sorted(repr(tag) for each in models for tag in _tags_of(each))
    )
    names = re.findall("'([^']*)'", expected) if suggest else ()
    return [f"must be one of {expected}{note}{did_you_mean(str(context.get('tag', '')), names)}"]


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
            within_mapping = any(field.is_mapping for field in fields)
            models = [below for field in fields for below in field.models]
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


class _Key(NamedTuple):
    annotation: Any
    models: list[type[BaseModel]]
    """Models of the tables in it."""
    is_mapping: bool
    """Whether it is a table whose keys the document chooses."""


@cache
def _keys_of(model: type[BaseModel]) -> dict[str, _Key]:
    keys = {}
    for name, field in model.model_fields.items():
        models = [below for item in (field.annotation, *field.metadata) for below in _models_in(item)]
        is_mapping = get_origin(field.annotation) is dict and not any(
            isinstance(item, TableOf) for item in field.metadata
        )
        keys[field.alias or name] = _Key(field.annotation, models, is_mapping)
    return keys


@cache
def _tags_of(model: type[BaseModel]) -> tuple[object, ...]:
    """Return the discriminator values of a model: the values of fields that allow only one."""
    literals = (
        get_args(key.annotation) for key in _keys_of(model).values() if get_origin(key.annotation) is Literal
    )
    return tuple(values[0] for values in literals if len(values) == 1)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return all models in an annotation, at any depth."""
    if isinstance(annotation, TableOf):
        return [annotation.model]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]
