"""The disk cache of a kernel's machine code.

It is in the cache folder (`starid.storage.cache`), in one folder per state of the sources: the module of the function and every
module of the project that it imports, directly or not. Installations with equal sources share it; if any of these
sources changes, the function is compiled again. Each file begins with a checksum of the rest; a damaged file is removed.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import logging
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterable
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np

from starid.storage.cache import KERNEL_SUFFIX, evict, kernel_folder, mark_used
from starid.storage.files import write_atomically

_log = logging.getLogger(__name__)

_IMPORT: Final = re.compile(rb"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)


class StoredKernel(NamedTuple):
    """Machine code of a kernel in the cache.

    Attributes
    ----------
    code : bytes
        Object file (ELF).
    entry : str
        Name of its function that Python can call.
    environments : list of (str, list)
        Python objects that the code uses, by the name of the variable that refers to them.
    description : bytes
        What numba needs to load it, pickled.
    """

    code: bytes
    entry: str
    environments: list[tuple[str, list[Any]]]
    description: bytes


class KernelStore:
    """The cached machine code of one function.

    Attributes
    ----------
    function : callable
        The Python function.
    compilations : int
        How many times it was compiled in this process.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.compilations = 0

    @cached_property
    def _folder(self) -> Path:
        """Folder of the machine code.

        It is in the cache folder, or is ``__pycache__`` beside the source if no cache folder can be made.
        """
        module = self.function.__module__
        key = hashlib.sha256(repr((module, source_stamp(module), versions())).encode()).hexdigest()[:16]
        return kernel_folder(key) or Path(self.function.__code__.co_filename).parent / "__pycache__"

    def _path(self, types: str) -> Path:
        code = self.function.__code__
        key = hashlib.sha256(f"{types} {code.co_firstlineno} {processor()}".encode()).hexdigest()[:16]
        return self._folder / f"{self.function.__name__}-{key}{KERNEL_SUFFIX}"

    @property
    def in_cache(self) -> bool:
        """Whether there is cached machine code, for any types."""
        return any(self._folder.glob(f"{self.function.__name__}-*{KERNEL_SUFFIX}"))

    def read(self, types: str) -> StoredKernel | None:
        """Return the cached machine code for types of arguments; None if there is none."""
        path = self._path(types)
        content = read_verified(path)
        if content is None:
            return None
        mark_used(path.parent)
        return StoredKernel(*pickle.loads(content))  # noqa: S301 (this package's own cache)

    def write(self, types: str, stored: StoredKernel) -> None:
        """Cache machine code; if it cannot be written, a warning is logged and each process compiles it."""
        path = self._path(types)
        try:
            write_verified(path, pickle.dumps(tuple(stored)))
        except OSError as error:
            _warn_not_kept(path.parent.parent, error.strerror)
        else:
            evict(keep=path.parent)


def record_name(fields: Iterable[tuple[str, str]]) -> str:
    """Return the name of a type of record with fields of these names and types."""
    return f"record({', '.join(' '.join(each) for each in fields)})"


@cache
def versions() -> tuple[str, ...]:
    """Versions on which machine code depends: Python, numpy and numba (which is not imported)."""
    place = importlib.util.find_spec("numba")
    folder = Path(cast("str", cast("Any", place).origin)).parent
    numba = hashlib.sha256((folder / "_version.py").read_bytes()).hexdigest()
    return importlib.machinery.EXTENSION_SUFFIXES[0], np.__version__, numba


@cache
def processor() -> str:
    """Describe the processor for which machine code is compiled: its features, and settings of numba."""
    text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").partition("\n\n")[0]
    fixed = ("vendor_id", "cpu family", "model", "flags", "CPU", "Features", "isa")
    lines = [line for line in text.splitlines() if line.startswith(fixed)]
    chosen = [os.environ.get(f"NUMBA_{name}", "") for name in ("CPU_NAME", "CPU_FEATURES", "OPT")]
    return " ".join([*lines, *chosen])


def write_verified(path: Path, content: bytes) -> None:
    """Write a file that begins with the checksum of the rest.

    Raises
    ------
    OSError
        It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda part: part.write_bytes(hashlib.sha256(content).digest() + content))


def read_verified(path: Path) -> bytes | None:
    """Return the content of a file; None if there is none, or if it is damaged, when it is removed."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    if hashlib.sha256(data[size:]).digest() == data[:size]:
        return data[size:]
    _log.info("%s: damaged or of another version, removed; compiled again", path)
    path.unlink(missing_ok=True)
    return None


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
