"""The numba decorator of the package, typed, with a disk cache that notices changed callees.

Numba's own cache compares only the file of the function itself: after a change to a kernel that it calls in
another module, it would go on running the old machine code. So every cache index is stamped with the
contents of all modules of the project that the function's module imports, directly or not. And Numba runs
whatever it finds in its files: here each begins with a checksum of the rest, and a damaged one is removed.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import logging
import pickle
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from numba import njit
from numba.core import caching

Kernel = TypeVar("Kernel", bound=Callable[..., object])

_log = logging.getLogger(__name__)

_NumbaCacheFile: Any = caching.IndexDataCacheFile

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
    cache: Any = getattr(dispatcher, "_cache", None)
    if isinstance(getattr(cache, "_cache_file", None), caching.IndexDataCacheFile):
        stamp = source_stamp(dispatcher.py_func.__module__)
        base = cache._impl.filename_base  # noqa: SLF001
        cache._cache_file = VerifiedCacheFile(cache.cache_path, base, stamp)  # noqa: SLF001
    return dispatcher


class VerifiedCacheFile(_NumbaCacheFile):  # type: ignore[misc]
    """Numba's cache files of one function, each with a checksum: what is damaged is removed and compiled again.

    A file that cannot be written is reported in the log, and the function is compiled in each process.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep the machine code of a signature."""
        try:
            super().save(key, data)
        except OSError as error:
            _log.warning("%s: machine code cannot be kept (%s): compiled each time", self._index_path, error)

    def _load_index(self) -> dict[Any, str]:
        try:
            stream = io.BytesIO(self._read(Path(self._index_path)))
        except FileNotFoundError:
            return {}
        if pickle.load(stream) != self._version:  # noqa: S301 (of this package's own cache, as all below)
            return {}  # the rest may not even be readable
        stamp, overloads = pickle.load(stream)  # noqa: S301
        return overloads if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(
            self._index_path, pickle.dumps(self._version) + self._dump((self._source_stamp, overloads))
        )

    def _load_data(self, name: str) -> Any:
        return pickle.loads(self._read(Path(self._data_path(name))))  # noqa: S301

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as stream:
            stream.write(hashlib.sha256(content).digest() + content)

    @staticmethod
    def _read(path: Path) -> bytes:
        """Return the content of a file; one whose checksum is wrong is removed and counts as missing."""
        data = path.read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[size:]).digest() != data[:size]:
            _log.warning("%s: damaged, removed; compiled again", path)
            path.unlink(missing_ok=True)
            raise FileNotFoundError(path)
        return data[size:]


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
