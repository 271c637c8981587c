"""Errors planted in the product's own protocol code, so that device and client share them.

`protocol_mutants.toml` lists them as data: which function of `starhil.protocol`, which text in it, and what replaces it.
A mutant is made by compiling the changed function and putting the new code into the function that exists, which all
importers share. A function or a text that no longer exists raises `LostAimError`: move the aim, do not drop the mutant.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
import textwrap
import tomllib
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

FILE = Path(__file__).with_name("protocol_mutants.toml")


class LostAimError(Exception):
    """The function or the text that a mutant changes does not exist, or the text occurs several times."""


@dataclass(frozen=True)
class Edit:
    """A change: in the function `at` (`module:Qualified.name`, of `starhil.protocol` by default), `before` becomes `after`."""

    at: str
    before: str
    after: str


@dataclass(frozen=True)
class ProtocolMutant:
    """An error of the product, and the cases of a unit of which at least one must fail.

    Attributes
    ----------
    unit
        Bundled unit, `tutorial` for that of docs/your-unit.md, or a link of `tests.conformance.links` with `link:`
        before its name.
    link
        `serial`, `can` or `canopen`.
    hidden
        Whether the product's own codec does not notice the error: it decodes what it encodes.
    """

    mechanism: str
    name: str
    unit: str
    cases: tuple[str, ...]
    edits: tuple[Edit, ...]
    link: str = "serial"
    hidden: bool = True

    @contextmanager
    def planted(self) -> Iterator[None]:
        """Put the error into the running product."""
        changed = [
            (function, function.__code__, _mutated(function, edit)) for edit, function in _aims(self.edits)
        ]
        try:
            for function, _old, new in changed:
                function.__code__ = new
            _forget()
            yield
        finally:
            for function, old, _new in reversed(changed):
                function.__code__ = old
            _forget()


def read_mutants() -> list[ProtocolMutant]:
    """Return the mutants of the file."""
    found = []
    for table in tomllib.loads(FILE.read_text(encoding="utf-8"))["mutant"]:
        edits, cases = tuple(Edit(**edit) for edit in table.pop("edits")), tuple(table.pop("cases"))
        found.append(ProtocolMutant(**table, cases=cases, edits=edits))
    return found


def _aims(edits: tuple[Edit, ...]) -> Iterator[tuple[Edit, types.FunctionType]]:
    """Yield each function with its edits, joined into one."""
    joined: dict[str, list[Edit]] = {}
    for edit in edits:
        joined.setdefault(edit.at, []).append(edit)
    for at, group in joined.items():
        function = _function(at)
        source = textwrap.dedent(inspect.getsource(function))
        changed = source
        for edit in group:
            if source.count(edit.before) != 1 or changed.count(edit.before) != 1:
                raise LostAimError(
                    f"{at}: {edit.before!r} occurs {source.count(edit.before)} times, must be once"
                )
            changed = changed.replace(edit.before, edit.after)
        yield Edit(at, source, changed), function


def _function(at: str) -> types.FunctionType:
    module, _, path = at.partition(":")
    try:
        whole = module if module.startswith("starhil.") else f"starhil.protocol.{module}"
        found: object = importlib.import_module(whole)
        for part in path.split("."):
            found = inspect.getattr_static(found, part)
    except (ImportError, AttributeError) as error:
        raise LostAimError(f"{at}: {error}") from None
    if isinstance(found, property):
        found = found.fget
    if isinstance(found, functools.cached_property):
        found = found.func
    found = inspect.unwrap(getattr(found, "__func__", found))  # type: ignore[arg-type]
    if not isinstance(found, types.FunctionType):
        raise LostAimError(f"{at}: not a function")
    return found


def _mutated(function: types.FunctionType, edit: Edit) -> types.CodeType:
    """Compile a changed function in the place of the old one, with the same free variables."""
    lines = edit.after.splitlines(keepends=True)
    while lines[0].startswith("@"):
        del lines[0]
    free = function.__code__.co_freevars
    outer = (
        f"def outer({', '.join(free)}):\n"
        + textwrap.indent("".join(lines), "    ")
        + f"\n    return {function.__name__}\n"
    )
    space: dict[str, types.FunctionType] = {}
    exec(
        compile("from __future__ import annotations\n" + outer, str(FILE), "exec"),
        function.__globals__ | {},
        space,
    )
    code = next(
        item for item in space["outer"].__code__.co_consts
        if isinstance(item, types.CodeType) and item.co_name == function.__name__
    )  # fmt: skip
    if code.co_freevars != free:
        raise LostAimError(
            f"{edit.at}: the changed function has the free variables {code.co_freevars}, not {free}"
        )
    return code


def _forget() -> None:
    """Clear what the product has computed once, such as the definitions of units and tables of checks."""
    modules = [module for name, module in sys.modules.items() if name.startswith("starhil.")]
    for item in {id(item): item for module in modules for item in vars(module).values()}.values():
        if isinstance(item, functools._lru_cache_wrapper):
            item.cache_clear()
