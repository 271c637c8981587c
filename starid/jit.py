"""Decorators that compile kernels with numba and cache their machine code on disk.

The machine code is in the cache folder (`starid.cache`), in one folder per state of the sources: the module
of the function and every module of the project that it imports, directly or not. Installations with equal
sources share it; if any of these sources changes, the function is compiled again. Each file begins with a
checksum of the rest, because numba runs whatever it reads; a damaged file is removed.
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

import numba
import numpy as np
from numba import njit
from numba.core import caching

from starid.cache import evict, kernel_folder, mark_used
from starid.kernel_library import InnerCompiler, LoadedKernels, without_literals

Kernel = TypeVar("Kernel", bound=Callable[..., object])

_log = logging.getLogger(__name__)

_NumbaCacheFile: Any = caching.IndexDataCacheFile
_NumbaCache: Any = caching.FunctionCache

_IMPORT: Final = re.compile(rb"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)


def _import_numba_arrays() -> None:
    """Import numba's array support without importing all of ``scipy.linalg``.

    numba imports ``scipy.linalg`` only to check that it exists, which takes a fifth of the time until the
    first kernel runs, and 12 MB. scipy is a requirement of this package; a kernel that multiplies matrices
    imports what it needs when it is called.
    """
    linalg: Any = importlib.import_module("numba.np.linalg")
    ensure_blas = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = ensure_blas


_import_numba_arrays()


def compiled(function: Kernel) -> Kernel:
    """Compile a function of numbers and plain arrays, cached on disk and run without the GIL."""
    return cast("Kernel", cached_on_disk(njit(nogil=True)(function)))


def compiled_ieee(function: Kernel) -> Kernel:
    """Compile as `compiled`, with IEEE 754 division (x/0 is infinite or NaN, as in numpy arrays).

    Without numba's test of every divisor a loop over pixels has no branch and is vectorised.
    """
    return cast("Kernel", cached_on_disk(njit(nogil=True, error_model="numpy")(function)))


def compiled_sums(function: Kernel) -> Kernel:
    """Compile as `compiled_ieee`, but allow sums in any order, so that they are vectorised too."""
    reordered = {"reassoc", "nsz", "contract"}
    return cast("Kernel", cached_on_disk(njit(nogil=True, error_model="numpy", fastmath=reordered)(function)))


def inner(function: Kernel) -> Kernel:
    """Compile a function that only other kernels call, with IEEE 754 division.

    It is optimised and cached only as part of the kernels that call it, and has no wrappers for callers in
    Python and C, which would take longer to compile than the function itself.
    """
    return _inner(function, "numpy")


def inner_checked(function: Kernel) -> Kernel:
    """Compile as `inner`, but division by zero raises an exception, as in `compiled`."""
    return _inner(function, "python")


def _inner(function: Kernel, error_model: str) -> Kernel:
    options: dict[str, Any] = {
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "error_model": error_model,
    }
    dispatcher = njit(nogil=True, pipeline_class=InnerCompiler, **options)(function)
    return cast("Kernel", without_literals(dispatcher))


def cached_on_disk(dispatcher: Any) -> Any:
    """Cache the machine code of a numba dispatcher on disk; no effect if compilation is disabled."""
    if hasattr(dispatcher, "enable_caching"):
        dispatcher._cache = KernelCache(dispatcher.py_func)  # noqa: SLF001
    return dispatcher


class KernelLocator:
    """Location of the machine code of one function.

    It is in the cache folder, or in ``__pycache__`` beside the source if no cache folder can be made.
    """

    def __init__(self, function: Any, source: str) -> None:
        self._line = function.__code__.co_firstlineno
        self._stamp = source_stamp(function.__module__)
        versions = (numba.__version__, np.__version__)
        key = hashlib.sha256(repr((function.__module__, self._stamp, versions)).encode()).hexdigest()[:16]
        self._folder = kernel_folder(key) or Path(source).parent / "__pycache__"

    @classmethod
    def from_function(cls, function: Any, source: str) -> KernelLocator:
        """Return the locator of a function (called by numba)."""
        return cls(function, source)

    def get_cache_path(self) -> str:
        """Folder of the cache files."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Checksum that the index of the cache must have."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Part of the file names that distinguishes functions of the same name."""
        return str(self._line)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder is created when a file is written."""


class KernelCacheImpl(LoadedKernels):
    """The storage of machine code, with `KernelLocator` as the only locator."""

    _locator_classes = (KernelLocator,)


class KernelCache(_NumbaCache):  # type: ignore[misc]
    """numba's disk cache of one function, with verified files."""

    _impl_class = KernelCacheImpl

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = VerifiedCacheFile(self._cache_path, self._impl.filename_base, stamp)


class VerifiedCacheFile(_NumbaCacheFile):  # type: ignore[misc]
    """numba's cache files of one function, each with a checksum.

    A damaged file is removed and the function compiled again. If a file cannot be written, a warning is
    logged and each process compiles the function.
    """

    def save(self, key: Any, data: Any) -> None:
        """Store the machine code of a signature."""
        folder = Path(self._cache_path)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            super().save(key, data)
        except OSError as error:
            _warn_not_kept(folder.parent, error.strerror)
        else:
            evict(keep=folder)

    def load(self, key: Any) -> Any:
        """Return the machine code of a signature, or None."""
        data = super().load(key)
        if data is not None:
            mark_used(Path(self._cache_path))
        return data

    def _load_index(self) -> dict[Any, str]:
        try:
            stream = io.BytesIO(self._read(Path(self._index_path)))
        except OSError:
            return {}
        if pickle.load(stream) != self._version:  # noqa: S301 (this package's own cache, here and below)
            return {}  # the rest may not be readable
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
        """Read a file; if its checksum is wrong, remove it and treat it as missing."""
        data = path.read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[size:]).digest() != data[:size]:
            _log.info("%s: damaged or of another version, removed; compiled again", path)
            path.unlink(missing_ok=True)
            raise FileNotFoundError(path)
        return data[size:]


@cache
def _warn_not_kept(folder: Path, reason: str) -> None:
    """Warn, once per folder and reason, that machine code cannot be cached."""
    _log.warning("%s: machine code cannot be cached (%s): each process compiles it", folder, reason)


@cache
def source_stamp(module: str) -> str:
    """Checksum of a module and of what it imports of its top-level package and `starid`, outside functions.

    Parameters
    ----------
    module : str
        Full name of an imported module.

    Returns
    -------
    str
        Hexadecimal; equal exactly if the sources are.
    """
    digest = hashlib.sha256()
    roots = {"starid", module.partition(".")[0]}
    for name in sorted(_closure(module, roots)):
        digest.update(name.encode() + b"\0" + _source(name) + b"\0")
    return digest.hexdigest()


def _closure(module: str, roots: set[str]) -> set[str]:
    """Names of a module and of all modules that it imports within the root packages."""
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
    """Names in a module's top-level import statements that may be modules."""
    names = []
    for package, members in _IMPORT.findall(_source(module)):
        names.append(package.decode())
        names += [f"{package.decode()}.{member}" for member in re.findall(r"\w+", members.decode())]
    return tuple(names)


@cache
def _source(module: str) -> bytes:
    """Source of a module; empty if there is none (a class or constant, not a module)."""
    root, *parts = module.split(".")
    home = getattr(sys.modules.get(root), "__file__", None)
    if home is None:
        return b""
    stem = Path(home).parent.joinpath(*parts)
    for path in (stem.with_suffix(".py") if parts else Path(home), stem / "__init__.py"):
        if path.is_file():
            return path.read_bytes()
    return b""
