"""The numba decorator of the package, typed, with a disk cache that notices changed callees.

Numba's own cache compares only the file of the function itself: after a change to a kernel that it calls in
another module, it would go on running the old machine code. So every cache index is stamped with the
contents of all modules of the project that the function's module imports, directly or not.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])

_IMPORT: Final = re.compile(rb"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)


def _import_numba_arrays() -> None:
    """Import what numba needs for arrays, without the whole of ``scipy.linalg``.

    numba imports that only to see that it is there, which takes a fifth of the time until a first kernel runs, and 12 MB.
    scipy is a requirement of this package; a kernel that multiplies matrices imports what it needs when it is called.
    """
    linalg: Any = importlib.import_module("numba.np.linalg")
    looks_for_scipy = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = looks_for_scipy


_import_numba_arrays()


def compiled(function: Kernel) -> Kernel:
    """Compile a function of numbers and plain arrays: cached on disk, and free of the interpreter's lock."""
    return cast("Kernel", stamped(njit(cache=True, nogil=True)(function)))


def stamped(dispatcher: Any) -> Any:
    """Let numba's disk cache of a dispatcher depend on all project modules that its function can call.

    Parameters
    ----------
    dispatcher : numba dispatcher
        From ``njit(cache=True, …)``; returned as it is where numba keeps no cache for it.
    """
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None and hasattr(cache_file, "_source_stamp"):
        cache_file._source_stamp = source_stamp(dispatcher.py_func.__module__)  # noqa: SLF001
    return dispatcher


@cache
def source_stamp(module: str) -> str:
    """Checksum of a module's source and of all modules of its own top-level packages that it imports.

    Parameters
    ----------
    module : str
        Full name of a module that is being imported or has been.

    Returns
    -------
    str
        Hexadecimal; equal exactly when the sources are (imports inside functions are not followed).
    """
    digest = hashlib.sha256()
    roots = {"starid", module.partition(".")[0]}
    for name in sorted(_closure(module, roots)):
        digest.update(name.encode() + b"\0" + _source(name) + b"\0")
    return digest.hexdigest()


def _closure(module: str, roots: set[str]) -> set[str]:
    """Names of a module and of all that it imports within the root packages."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or not _source(name):
            continue
        found.add(name)
        waiting += [other for other in _imports(name) if other.partition(".")[0] in roots]
    return found


@cache
def _imports(module: str) -> tuple[str, ...]:
    """Names that a module's top-level import statements may mean as modules."""
    names = []
    for package, members in _IMPORT.findall(_source(module)):
        names.append(package.decode())
        names += [f"{package.decode()}.{member}" for member in re.findall(r"\w+", members.decode())]
    return tuple(names)


@cache
def _source(module: str) -> bytes:
    """Source of a module; empty where there is none (a class or constant, no such module)."""
    root, *parts = module.split(".")
    home = getattr(sys.modules.get(root), "__file__", None)
    if home is None:
        return b""
    place = Path(home).parent.joinpath(*parts)
    for path in (place.with_suffix(".py") if parts else Path(home), place / "__init__.py"):
        if path.is_file():
            return path.read_bytes()
    return b""
