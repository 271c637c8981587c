"""Errors planted in the running product, so that whatever shares its code has them: a text in a module becomes another.

The changed module is compiled, and its functions that exist get the new code, wherever they have been imported to; constants
of the module that change, or are computed from what changes, are computed again. A text that is not there exactly once, or
whose change reaches nothing that exists, raises `LostAimError`: move the aim, do not drop the error.
"""

from __future__ import annotations

import ast
import functools
import gc
import importlib
import re
import sys
import tomllib
import types
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

_IMPORT = re.compile(
    r"^ *(?:from|import) (?P<module>starhil[\w.]*)(?: import (?P<names>\([^)]*\)|.*))?", re.MULTILINE
)
_CACHED = type(functools.cache(len))
_CONSTANTS = (bool, int, float, str, bytes, tuple, frozenset, dict)


class LostAimError(Exception):
    """The function or the text that an error changes does not exist, or the text occurs several times."""


@dataclass(frozen=True)
class Edit:
    """A change: in a module, by default of `starhil.protocol`, or in one function of it (`module:Class.function`), `before` becomes `after`.

    Texts of several lines are indented as if the function began at the margin.
    """

    at: str
    before: str
    after: str


@dataclass(frozen=True)
class PlantedDefect:
    """Changes that make one error."""

    name: str
    edits: tuple[Edit, ...]

    def planted(self) -> AbstractContextManager[None]:
        """Put the error into the running product."""
        return planted(*self.edits)


Listed = TypeVar("Listed", bound=PlantedDefect)


def read_defects(file: Path, kind: type[Listed]) -> tuple[Listed, ...]:
    """Return the errors that a file lists as tables `mutant`."""
    found = []
    for table in tomllib.loads(file.read_text(encoding="utf-8"))["mutant"]:
        edits = tuple(Edit(**edit) for edit in table.pop("edits"))
        others = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
        found.append(kind(edits=edits, **others))
    return tuple(found)


@contextmanager
def planted(*edits: Edit) -> Iterator[None]:
    """Change the running product."""
    by_module: defaultdict[str, list[Edit]] = defaultdict(list)
    for edit in edits:
        by_module[edit.at.partition(":")[0]].append(edit)
    changes = [_changed(name, group) for name, group in by_module.items()]
    with ExitStack() as stack:
        for module, source in changes:
            stack.enter_context(_exchanged(module, source))
        names = {module.__name__ for module, _ in changes}
        _forget(names)
        stack.callback(_forget, names)
        yield


def _changed(name: str, edits: Iterable[Edit]) -> tuple[types.ModuleType, str]:
    """Return a module and its changed source."""
    try:
        module = importlib.import_module(name if name.startswith("starhil.") else f"starhil.protocol.{name}")
    except ImportError as error:
        raise LostAimError(f"{name}: {error}") from None
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    for edit in edits:
        begin, end, indent = _part(source, edit)
        before, after = (text.replace("\n", "\n" + indent) for text in (edit.before, edit.after))
        found = source.count(before, begin, end)
        if found != 1:
            raise LostAimError(f"{edit.at}: {edit.before!r} occurs {found} times, must be once")
        at = source.index(before, begin)
        source = source[:at] + after + source[at + len(before) :]
    return module, source


def _part(source: str, edit: Edit) -> tuple[int, int, str]:
    """Return where the text of the function of an edit begins and ends, and its indentation; without one, that of the module."""
    path = edit.at.partition(":")[2]
    if not path:
        return 0, len(source), ""
    node: ast.AST = _parsed(source)
    for part in path.split("."):
        inner = [item for item in ast.iter_child_nodes(node) if getattr(item, "name", None) == part]
        if not inner:
            raise LostAimError(f"{edit.at}: no {part}")
        node = inner[0]
    lines = [0]
    for line in source.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))
    return lines[node.lineno - 1], lines[node.end_lineno], " " * node.col_offset  # type: ignore[attr-defined]


@contextmanager
def _exchanged(module: types.ModuleType, source: str) -> Iterator[None]:
    """Give the functions of a module, and its constants, what a changed source has."""
    file = str(module.__file__)
    texts = source, Path(file).read_text(encoding="utf-8")
    new, old = (_by_name(_compiled(text, file)) for text in texts)
    undo, changes = ExitStack(), 0
    for function in _functions(module):
        code = function.__code__
        if len(new[code.co_qualname]) != len(old[code.co_qualname]):
            continue
        nth = [each.co_firstlineno for each in old[code.co_qualname]].index(code.co_firstlineno)
        changed = new[code.co_qualname][nth]
        if changed.co_freevars == code.co_freevars:
            changes += _meaning(changed) != _meaning(code)
            function.__code__ = changed
            undo.callback(setattr, function, "__code__", code)
    for key, fresh in _constants(module, *texts).items():
        value = getattr(module, key, None)
        if type(value) in _CONSTANTS and fresh != value:
            setattr(module, key, fresh)
            undo.callback(setattr, module, key, value)
            changes += 1
    with undo:
        if not changes:
            raise LostAimError(
                f"{module.__name__}: the change reaches no function and no constant that exists"
            )
        yield


@functools.cache
def _functions(module: types.ModuleType) -> list[types.FunctionType]:
    """Return the functions that a module has made, wherever they are; what these make later is made from their code."""
    gc.unfreeze()  # `starhil run`, in this process, hides its objects from the collector
    functions = [each for each in gc.get_referrers(vars(module)) if type(each) is types.FunctionType]
    return [
        each
        for each in functions  # not those that a decorator of another module has made
        if each.__globals__ is vars(module) and each.__code__.co_filename == module.__file__
    ]


@functools.lru_cache(maxsize=64)
def _parsed(source: str) -> ast.Module:
    return ast.parse(source)


@functools.cache
def _compiled(source: str, file: str) -> types.CodeType:
    return compile(_parsed(source), file, "exec")


def _constants(module: types.ModuleType, source: str, old_source: str) -> dict[str, object]:
    """Return the constants of a module that a change of its source reaches.

    They are computed with the module's own classes: a table whose keys were members of a second enumeration of the same name
    would find nothing.
    """
    old = {text for text, _ in _statements(old_source)}
    values = dict(vars(module))
    changed: set[str] = set()
    constants: dict[str, object] = {}
    for text, statement in _statements(source):
        if text in old and not changed & _names(statement, ast.Load):
            continue
        if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            changed.add(statement.name)
        elif isinstance(statement, (ast.Assign, ast.AnnAssign)):
            assigned = ast.Module([statement], [])
            exec(compile(assigned, str(module.__file__), "exec", annotations.compiler_flag), values)
            names = _names(statement, ast.Store)
            changed |= names
            constants |= {name: values[name] for name in names}
    return constants


@functools.lru_cache(maxsize=64)
def _statements(source: str) -> list[tuple[str, ast.stmt]]:
    """Return the statements of a module, each with its lines, from its decorators on."""
    lines = source.splitlines(keepends=True)
    statements = _parsed(source).body
    begins = [
        min([each.lineno, *(of.lineno for of in getattr(each, "decorator_list", ()))]) for each in statements
    ]
    return [
        ("".join(lines[begin - 1 : each.end_lineno]), each)
        for begin, each in zip(begins, statements, strict=True)
    ]


def _names(statement: ast.stmt, use: type[ast.expr_context]) -> set[str]:
    return {
        node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and isinstance(node.ctx, use)
    }


def _by_name(code: types.CodeType) -> defaultdict[str, list[types.CodeType]]:
    """Return the code of functions by qualified name, those of the same name in the order of their lines."""
    codes: defaultdict[str, list[types.CodeType]] = defaultdict(list)
    waiting = [code]
    while waiting:
        each = waiting.pop()
        codes[each.co_qualname].append(each)
        waiting += [item for item in each.co_consts if isinstance(item, types.CodeType)]
    for group in codes.values():
        group.sort(key=lambda item: item.co_firstlineno)
    return codes


def _meaning(code: types.CodeType) -> tuple[object, ...]:
    """Return what a function does, wherever its lines are."""
    constants = [
        _meaning(item) if isinstance(item, types.CodeType) else repr(item) for item in code.co_consts
    ]
    return code.co_code, code.co_names, code.co_varnames, code.co_freevars, *constants


def _forget(changed: set[str]) -> None:
    """Clear what changed modules, and those that import them, have computed once, such as the definitions of units and tables of checks."""
    modules = {
        name: module
        for name, module in sys.modules.items()
        if name.startswith("starhil.") and getattr(module, "__file__", None)
    }
    reached: set[str] = set()
    while changed - reached:
        reached |= changed
        changed = {name for name, module in modules.items() if not reached.isdisjoint(_imports(module))}
    for name in reached:
        for item in _caches(modules[name]):
            item.cache_clear()


@functools.cache
def _caches(module: types.ModuleType) -> list[Any]:
    """Return the cached functions of a module."""
    return [value for value in vars(module).values() if isinstance(value, _CACHED)]


@functools.cache
def _imports(module: types.ModuleType) -> set[str]:
    """Return the modules of the package that a module imports anywhere."""
    names = set()
    for match in _IMPORT.finditer(Path(str(module.__file__)).read_text(encoding="utf-8")):
        names |= {
            match["module"],
            *(f"{match['module']}.{name}" for name in re.findall(r"\w+", match["names"] or "")),
        }
    return names
