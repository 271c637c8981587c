"""Options that travel together: a command takes them as one dataclass, whose fields are the options.

::

    @dataclass(frozen=True)
    class CameraOptions:
        fov: Annotated[float | None, typer.Option(help="…")] = None
        size: Annotated[str | None, typer.Option(help="…")] = None

    @with_option_groups
    def command(camera: CameraOptions, seed: Annotated[int, typer.Option()] = 0) -> None: ...

Typer reads the options from the signature of a command. The decorator shows it one in which each parameter that is
annotated with a dataclass is replaced by the fields, in order. A field without a default is a required option.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

Result = TypeVar("Result")


def with_option_groups(command: Callable[..., Result]) -> Callable[..., Result]:
    signature = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hints[name] for name in signature.parameters if dataclasses.is_dataclass(hints[name])}
    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        if name not in groups:
            parameters.append(_option(name, parameter.default, hints[name]))
            continue
        fields = get_type_hints(groups[name], include_extras=True)
        parameters += [
            _option(field.name, field.default, fields[field.name])
            for field in dataclasses.fields(groups[name])
        ]

    @functools.wraps(command)
    def expanded(**values: Any) -> Result:
        made = {
            name: group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
            for name, group in groups.items()
        }
        return command(**values, **made)

    expanded.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    expanded.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return expanded


def _option(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    if default is dataclasses.MISSING:
        default = inspect.Parameter.empty
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
